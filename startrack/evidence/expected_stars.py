"""The catalogue's stars in view: scale of their fluxes, predicted pixels, expected light, causes against them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.core.types import Array, Body, Ints, Mask, Stars
from startrack.evidence.flux_scale import LN_PER_MAG, FluxScale
from startrack.evidence.photometry import Sources, half_width
from startrack.exposure import touch_masked
from startrack.frames import angle_between_rad, azel_from_rays, off_axis_rad
from startrack.psf import noise_area_px

MIN_SNR = 0.6  # a sixth of the time less than with 0.5; mean errors grow by 2 % (60 frames, with the sky's light)
MIN_PSF_AREAS_PER_STAR = 2.0  # with more stars in the pixels the same light would be counted twice
BODY_GLARE_PX = 8.0
DISKS_RAD = {"Sun": 0.0047, "Moon": 0.0049, "Earth": 0.0180}  # largest radii, the Earth's seen from the Moon
VIEW_MARGIN_RAD = 1e-6  # for rounding
CAUSES = ("", "edge of the image circle", "beyond the calibrated angle", "off the frame", "bad pixels", "masked")
USABLE, EDGE_OF_CIRCLE, NOT_CALIBRATED, OFF_FRAME, BAD_PIXELS, MASKED = range(len(CAUSES))


@dataclass(frozen=True, kw_only=True)
class ExpectedStars:
    """The catalogue's stars in view (n) and their expected light, before anything is measured."""

    star: Ints  # index into Stars
    xy_px: Array  # (n, 2) predicted
    azimuth_rad: Array
    elevation_rad: Array
    expected_e: Array  # light of the whole PSF
    fraction_sigma: Array  # its relative uncertainty
    cause_code: NDArray[np.int8]  # index into `causes`; 0 where usable
    causes: tuple[str, ...]  # why stars are unusable; the first is ""

    @property
    def measurable(self) -> Ints:
        """Indices of the stars whose stamps lie on the frame."""
        return np.flatnonzero(self.cause_code != OFF_FRAME)

    def sources(self, visible: Array | float) -> Sources:
        """The measurable stars for the photometry; `visible`: the probability that each is, for its neighbours."""
        which = self.measurable
        return Sources(
            xy_px=self.xy_px[which], flux_e=self.expected_e[which], fraction_sigma=self.fraction_sigma[which],
            visible=np.broadcast_to(np.asarray(visible, dtype=np.float64), (len(which),)),
        )  # fmt: skip


def expect_stars(
    camera: Camera,
    stars: Stars,
    bodies: list[Body],
    R_cam_icrs: Array,
    R_enu_icrs: Array,
    scale: FluxScale,
    *,
    psf_sigma_px: float,
    noise_e: float,
    position_sigma_px: float = 0.0,
    mask: Mask | None = None,
    air: Array | None = None,
) -> ExpectedStars:
    """The stars in view of a camera and their expected light.

    Args:
        camera: projects the stars.
        stars: of the catalogue, brightest first.
        bodies: whose glare spoils the stars beside them.
        R_cam_icrs: (3, 3).
        R_enu_icrs: (3, 3).
        scale: of the fluxes.
        psf_sigma_px: of the image.
        noise_e: of a star's flux, through the matched filter: fainter stars than MIN_SNR of it are left out, and the
            faintest where they are too many for the image.
        position_sigma_px: error of the predicted pixels per axis.
        mask: pixels that do not count.
        air: airmasses (len(stars),) of the stars; None without air.
    """
    near_axis = stars.rays_icrs @ R_cam_icrs[2] > np.cos(min(camera.max_angle_rad + VIEW_MARGIN_RAD, np.pi))
    star = np.flatnonzero(near_axis & (stars.v_mag < scale.zero_mag - 2.5 * np.log10(MIN_SNR * max(noise_e, 1e-9))))
    rays_cam = stars.rays_icrs[star] @ R_cam_icrs.T
    xy, inside = camera.project(rays_cam)
    circle_px2 = np.pi * camera.focal_px[0] * camera.focal_px[1] * camera.lens.rho(np.array(camera.max_angle_rad)) ** 2
    area_px2 = min(float(circle_px2), camera.size_px[0] * camera.size_px[1])
    room = max(int(area_px2 / (MIN_PSF_AREAS_PER_STAR * noise_area_px(psf_sigma_px))), 1)
    brightest = np.flatnonzero(inside)[:room]
    star, xy, rays_cam = star[brightest], xy[brightest], rays_cam[brightest]
    angle = off_axis_rad(rays_cam)
    # A misplaced profile loses light. The rays do not depend on the lens: they are the catalogue's.
    misplaced2 = position_sigma_px**2 + (
        np.square(camera.projection_sigma_px(rays_cam)) if camera.covariance_order else 0.0
    )
    blur = misplaced2 / (2 * psf_sigma_px) ** 2
    margin = half_width(psf_sigma_px)
    cause = _causes(xy, angle, camera, bodies, R_cam_icrs, margin)
    if mask is not None:
        cause[touch_masked(mask.masked, xy, margin) & (cause == USABLE)] = MASKED
    azimuth, elevation = azel_from_rays(stars.rays_icrs[star] @ R_enu_icrs.T)
    expected_e, fraction = scale.expect(stars.v_mag[star], rays_cam, camera, None if air is None else air[star])
    return ExpectedStars(
        star=star,
        xy_px=xy,
        azimuth_rad=azimuth,
        elevation_rad=elevation,
        expected_e=expected_e,
        fraction_sigma=np.sqrt(fraction**2 + np.square(LN_PER_MAG * stars.v_sigma_mag[star]) + blur**2),
        cause_code=cause,
        causes=(*CAUSES, *(f"beside {body.name}" for body in bodies)),
    )


def _causes(
    xy_px: Array, angle_rad: Array, camera: Camera, bodies: list[Body], R_cam_icrs: Array, margin: int
) -> NDArray[np.int8]:
    """Causes (n,) why stars cannot be used: indices into CAUSES, followed by the bodies; USABLE where they can."""
    cause = np.full(len(xy_px), USABLE, dtype=np.int8)
    x, y = np.ascontiguousarray(xy_px.T)
    for number, body in enumerate(bodies):
        at, seen = camera.project(body.ray_icrs @ R_cam_icrs.T)
        if seen:
            off_axis = angle_between_rad(body.ray_icrs @ R_cam_icrs.T, np.array([0.0, 0.0, 1.0]))
            disk_px = DISKS_RAD.get(body.name, 0.0) / camera.mean_scale_rad_per_px(off_axis)
            near = np.flatnonzero(np.abs(x - at[0]) < BODY_GLARE_PX + disk_px)
            dx, dy = x[near] - at[0], y[near] - at[1]
            cause[near[dx * dx + dy * dy < np.square(BODY_GLARE_PX + disk_px)]] = len(CAUSES) + number
    # The stamp must lie within the lit circle: beyond its edge the background is another.
    edge = camera.max_angle_rad - (margin + 1) * camera.mean_scale_rad_per_px(np.array(camera.max_angle_rad))
    cause[angle_rad > edge] = EDGE_OF_CIRCLE
    cause[angle_rad > camera.calibrated_angle_rad] = NOT_CALIBRATED
    width, height = camera.size_px
    cause[(x < margin) | (y < margin) | (x > width - 1 - margin) | (y > height - 1 - margin)] = OFF_FRAME
    return cause
