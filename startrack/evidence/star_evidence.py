"""Evidence of the stars: for every catalogue star in view, is it visible or hidden?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.evidence.flux_scale import FluxScale
from startrack.evidence.likelihood_ratio import gaussian_llr, visibility_llr
from startrack.evidence.photometry import Photometry, Sources, half_width, measure
from startrack.exposure import touch_masked
from startrack.frames import angle_between_rad, azel_from_rays, off_axis_rad, turn_azel
from startrack.psf import noise_area_px
from startrack.types import Array, Body, Bools, Detections, Evidence, Ints, Stars

MIN_SNR = 0.6  # a sixth of the time less than with 0.5; mean errors grow by 2 % (60 frames, with the sky's light)
MIN_PSF_AREAS_PER_STAR = 2.0  # with more stars in the pixels the same light would be counted twice
BODY_GLARE_PX = 8.0
DISKS_RAD = {"Sun": 0.0047, "Moon": 0.0049, "Earth": 0.0180}  # largest radii, the Earth's seen from the Moon
DECIDABLE_SNR = 2.0  # of stars whose own flux shows whether they are visible
NOISE_STEP_PX = 16  # both ways: the noise is interpolated between blocks of 16 px
VIEW_MARGIN_RAD = 1e-6  # for rounding
CAUSES = ("", "edge of the image circle", "beyond the calibrated angle", "off the frame", "bad pixels", "masked")
USABLE, EDGE_OF_CIRCLE, NOT_CALIBRATED, OFF_FRAME, BAD_PIXELS, MASKED = range(len(CAUSES))
SEEN_LLR = 3.0  # from here on a star counts as seen, from minus this as hidden


@dataclass(frozen=True, kw_only=True)
class StarPhotometry:
    """Expected and measured light of each catalogue star in the frame (n); the star table's rows."""

    star: Ints  # index into Stars
    xy_px: Array  # (n, 2) predicted
    azimuth_rad: Array
    elevation_rad: Array
    expected_e: Array
    flux_e: Array  # measured
    sigma_e: Array  # of the measured flux without a star
    llr: Array  # 0 where unusable
    cause_code: NDArray[np.int8]  # index into `causes`; 0 where usable
    causes: tuple[str, ...]  # why stars are unusable; the first is ""

    @property
    def cause(self) -> NDArray[np.str_]:
        """Why each star (n,) is unusable; "" where it is usable."""
        return np.array(self.causes)[self.cause_code]

    @property
    def usable(self) -> Bools:
        """Whether each star (n,) is evidence."""
        return np.asarray(self.cause_code == USABLE)

    def masked(self, reason: NDArray[np.str_]) -> StarPhotometry:
        """The same with no evidence where there is a reason (n,) against it; an earlier cause stays."""
        texts = tuple(np.unique(reason[self.usable & (reason != "")]).tolist())
        code = self.cause_code.copy()
        for number, text in enumerate(texts, start=len(self.causes)):
            code[self.usable & (reason == text)] = number
        return replace(self, cause_code=code, causes=self.causes + texts, llr=np.where(code == USABLE, self.llr, 0.0))

    def turned(self, R: Array) -> StarPhotometry:
        """The same under a sky turned by a rotation `R` (3, 3) in enu."""
        azimuth, elevation = turn_azel(self.azimuth_rad, self.elevation_rad, R)
        return replace(self, azimuth_rad=azimuth, elevation_rad=elevation)

    def replace_stars(self, newer: StarPhotometry, which: Ints) -> StarPhotometry:
        """Replace the rows of the stars `which` by the newer measurement, where both contain the star."""
        there = np.flatnonzero(np.isin(newer.star, which))
        here = np.searchsorted(self.star, newer.star[there])
        causes = self.causes + tuple(text for text in newer.causes if text not in self.causes)
        fresh = replace(newer, cause_code=np.array([causes.index(text) for text in newer.causes])[newer.cause_code])
        changed = {}
        for name in ("flux_e", "sigma_e", "llr", "cause_code"):
            values = getattr(self, name).copy()
            values[here] = getattr(fresh, name)[there]
            changed[name] = values
        return replace(self, **changed, causes=causes)

    def evidence(self) -> Evidence:
        """The rays for the localizer."""
        use = self.usable
        return Evidence(
            azimuth_rad=self.azimuth_rad[use],
            elevation_rad=self.elevation_rad[use],
            llr=self.llr[use],
        )


@dataclass(frozen=True)
class StarEvidence:
    """Forced photometry at the catalogue's stars, turned into log-likelihood ratios."""

    faintest_snr: float = MIN_SNR
    crowded: float = MIN_PSF_AREAS_PER_STAR
    capped: bool = True  # False: plain Gaussian ratios, to measure the effect of the caps

    def __call__(
        self,
        detections: Detections,
        camera: Camera,
        stars: Stars,
        bodies: list[Body],
        R_cam_icrs: Array,
        R_enu_icrs: Array,
        scale: FluxScale,
        position_sigma_px: float,
        visible: Array | None = None,
    ) -> StarPhotometry:
        """Photometry of every star in view.

        Args:
            detections: their image, its background and noise, and the PSF are used.
            camera: projects the stars.
            stars: of the catalogue, brightest first.
            bodies: whose glare spoils the stars beside them.
            R_cam_icrs: (3, 3).
            R_enu_icrs: (3, 3).
            scale: of the fluxes.
            position_sigma_px: error of the predicted pixels per axis.
            visible: (len(stars),) probability that each star is visible where that is known already; it is used for
                the star's light in its neighbours' measurements only.
        """
        sigma_px = detections.psf_sigma_px
        faintest = scale.zero_mag - 2.5 * np.log10(self.faintest_snr * max(filtered_noise_e(detections), 1e-9))
        star = stars_in_view(camera, stars, R_cam_icrs, faintest)
        rays_icrs = stars.rays_icrs[star]
        rays_cam = rays_icrs @ R_cam_icrs.T
        xy, inside = camera.project(rays_cam)
        brightest = np.flatnonzero(inside)[: _max_stars(camera, self.crowded * noise_area_px(sigma_px))]
        star, xy, rays_cam, rays_icrs = star[brightest], xy[brightest], rays_cam[brightest], rays_icrs[brightest]
        angle = off_axis_rad(rays_cam)
        expected = scale.flux_e(stars.v_mag[star], angle, camera)
        # A misplaced profile loses light. The rays do not depend on the lens: they are the catalogue's.
        misplaced2 = position_sigma_px**2 + (
            np.square(camera.projection_sigma_px(rays_cam)) if camera.covariance_order else 0.0
        )
        blur = misplaced2 / (2 * sigma_px) ** 2
        fraction = np.sqrt(scale.scatter**2 + np.square(0.4 * np.log(10) * stars.v_sigma_mag[star]) + blur**2)
        cause = _causes(xy, angle, camera, bodies, R_cam_icrs, half_width(sigma_px))
        if detections.mask is not None:
            touching = touch_masked(detections.mask.masked, xy, half_width(sigma_px))
            cause[touching & (cause == USABLE)] = MASKED
        measurable = np.flatnonzero(cause != OFF_FRAME)
        if visible is None:
            at = xy[measurable], expected[measurable], fraction[measurable]
            shining = _guess_visibility(detections, *at)
        else:
            shining = visible[star[measurable]]
        sources = Sources(
            xy_px=xy[measurable], flux_e=expected[measurable], fraction_sigma=fraction[measurable], visible=shining
        )
        light = measure(detections, sources)
        llr, sigma = _ratios(light, expected[measurable], fraction[measurable], self.capped)
        azimuth, elevation = azel_from_rays(rays_icrs @ R_enu_icrs.T)
        cause[measurable[~light.usable & (cause[measurable] == USABLE)]] = BAD_PIXELS
        return StarPhotometry(
            star=star,
            xy_px=xy,
            azimuth_rad=azimuth,
            elevation_rad=elevation,
            expected_e=expected,
            flux_e=_scatter_rows(light.flux_e, measurable, len(star)),
            sigma_e=_scatter_rows(sigma, measurable, len(star)),
            llr=np.where(cause == USABLE, _scatter_rows(llr, measurable, len(star)), 0.0),
            cause_code=cause,
            causes=(*CAUSES, *(f"beside {body.name}" for body in bodies)),
        )


def filtered_noise_e(detections: Detections) -> float:
    """Typical noise [e] of a star's flux: that of a pixel, through the matched filter."""
    pixel_e = float(np.median(detections.noise_e[::NOISE_STEP_PX, ::NOISE_STEP_PX]))
    return pixel_e * float(np.sqrt(noise_area_px(detections.psf_sigma_px)))


def stars_in_view(camera: Camera, stars: Stars, R_cam_icrs: Array, faintest_mag: float) -> Ints:
    """Indices (k,), ascending, of the stars brighter than a magnitude that may fall into the image circle."""
    near_axis = stars.rays_icrs @ R_cam_icrs[2] > np.cos(min(camera.max_angle_rad + VIEW_MARGIN_RAD, np.pi))
    return np.flatnonzero(near_axis & (stars.v_mag < faintest_mag))


def _max_stars(camera: Camera, area_px: float) -> int:
    """Number of stars that fit on the frame, each on its own area [px^2]. Stars are sorted, the brightest first."""
    rho = float(camera.lens.rho(np.array(camera.max_angle_rad)))
    circle = np.pi * camera.focal_px[0] * camera.focal_px[1] * rho**2
    width, height = camera.size_px
    return max(int(min(circle, width * height) / area_px), 1)


def _guess_visibility(detections: Detections, xy_px: Array, expected_e: Array, fraction: Array) -> Array:
    """Probability (n,) that each star is visible, before a position is known: by their own flux for the brighter ones.

    It weights their light in their neighbours' measurements; one half for the faint ones.
    """
    shining = np.full(len(xy_px), 0.5)
    noise_e = detections.noise_e[tuple(np.rint(xy_px).astype(int).T[::-1])]
    bright = np.flatnonzero(expected_e > DECIDABLE_SNR * noise_e * np.sqrt(noise_area_px(detections.psf_sigma_px)))
    if len(bright):
        alone = np.zeros(len(bright))
        sources = Sources(
            xy_px=xy_px[bright], flux_e=expected_e[bright], fraction_sigma=fraction[bright], visible=alone
        )
        light = measure(detections, sources)
        llr, _ = _ratios(light, expected_e[bright], fraction[bright])
        shining[bright] = 1.0 / (1.0 + np.exp(-llr))
    return shining


def _ratios(light: Photometry, expected_e: Array, fraction: Array, capped: bool = True) -> tuple[Array, Array]:
    """Log-likelihood ratios and the standard deviations of the fluxes without a star."""
    hidden = light.variance_e2 + light.neighbour_variance_e2
    shining = hidden + light.own_shot * expected_e + np.square(fraction * expected_e)
    sigma = np.sqrt(hidden)
    ratio = visibility_llr if capped else gaussian_llr
    return ratio(light.flux_e, expected_e, sigma, np.sqrt(shining)), sigma


def _causes(
    xy_px: Array, angle_rad: Array, camera: Camera, bodies: list[Body], R_cam_icrs: Array, margin: int
) -> NDArray[np.int8]:
    """Why stars (n) cannot be used: indices into CAUSES, followed by the bodies; USABLE where they can."""
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


def _scatter_rows(values: Array, index: Ints, n: int) -> Array:
    full = np.zeros(n)
    full[index] = values
    return full
