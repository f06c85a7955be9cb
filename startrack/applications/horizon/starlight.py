"""Evidence of the stars above a skyline on the Earth: the catalogue dimmed as the air and the lens dim it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.applications.horizon.columns import HIGHEST_GROUND_RAD
from startrack.applications.horizon.frames import SkyFrame
from startrack.core.errors import NoSolution
from startrack.core.types import Array, Evidence
from startrack.evidence import (
    SEEN_LLR,
    FluxScale,
    StarPhotometer,
    StarPhotometry,
    flux_scale,
    measure_response,
    with_noise_of_blocks,
)
from startrack.frames import airmass, azel_from_rays

BRIGHT_SNR = 12.0  # of stars beside which the light of the sky is not measured
STAR_GLARE_PX, GLARE_PER_DECADE_PX = 3.0, 2.5  # of the faintest of them, and more for each factor of ten
# Of stars in a damaged frame: what is left of the light of fainter ones is extrapolated, and there are thousands.
LEAST_TRUSTED_SNR = 1.0
UNKNOWN_RESPONSE = "what the damaged image leaves of a star's light is not known"


@dataclass(frozen=True)
class StarLight:
    """The stars of one image: rows of evidence in apparent directions of enu, and the pixels of bright stars."""

    rays: Evidence
    bright_px: Array  # (m, 2) of stars and planets
    glare_px: Array  # (m,) radius of their light
    missing: float  # share of the stars high in the sky that are not seen: clouds


def measure_stars(frame: SkyFrame) -> StarLight:
    """Light of every catalogue star in view of a `frame`, and the pixels of bright stars."""
    camera = replace(frame.camera, sensor=None, calibrated_angle_rad=frame.camera.max_angle_rad)
    stars = frame.sky.stars
    air = airmass(azel_from_rays(stars.rays_icrs @ frame.R_enu_icrs.T)[1])
    matches = frame.matched_detection, frame.matched_star
    detections = frame.detections if frame.damage is None else with_noise_of_blocks(frame.detections)
    scale = flux_scale(detections, camera, stars, matches, frame.R_cam_icrs, air)
    light = StarPhotometer()(
        detections, camera, stars, list(frame.bodies), frame.R_cam_icrs, frame.R_enu_icrs, scale,
        frame.extra_sigma_px, air=air,
    )  # fmt: skip
    rows = (light if frame.damage is None else _with_response(light)).evidence()
    scale_rad = camera.mean_scale_rad_per_px(np.array(min(camera.max_angle_rad, np.pi / 2)))
    rays = replace(rows, edge_sigma_rad=np.full(len(rows), float(scale_rad)))  # a pixel of the usual PSF
    # Stars are missed where no ground is expected.
    highest = rays.elevation_rad > min(HIGHEST_GROUND_RAD, float(np.quantile(rays.elevation_rad, 0.5, method="lower")))
    decided = rays.llr[highest & (np.abs(rays.llr) > SEEN_LLR)]
    missing = float((np.count_nonzero(decided < 0) + 1) / (len(decided) + 2))
    return StarLight(rays, *_glare(frame, scale, light), missing)


def _with_response(light: StarPhotometry) -> StarPhotometry:
    """The `light` of a damaged frame as its response to stars corrects it; no evidence where that is not known."""
    try:
        light = measure_response(light).correct(light)
    except NoSolution:
        return light.mask_stars(np.full(len(light.star), UNKNOWN_RESPONSE))
    return light.mask_stars(np.where(light.expected_e < LEAST_TRUSTED_SNR * light.sigma_e, UNKNOWN_RESPONSE, ""))


def _glare(frame: SkyFrame, scale: FluxScale, light: StarPhotometry) -> tuple[Array, Array]:
    """Pixels (m, 2) of bright stars and planets, and the radii (m,) of their light [px]."""
    noise_e = max(float(np.median(light.sigma_e[light.usable])) if light.usable.any() else 0.0, 1e-9)
    planets = [body for body in frame.bodies if body.name not in ("Sun", "Moon")]
    rays = np.array([body.ray_icrs for body in planets]).reshape(-1, 3)
    px, seen = frame.camera.project(rays @ frame.R_cam_icrs.T)
    air = airmass(azel_from_rays(rays @ frame.R_enu_icrs.T)[1])
    v_mag = np.array([body.v_mag for body in planets])
    flux_e, _ = scale.expect(v_mag, rays @ frame.R_cam_icrs.T, replace(frame.camera, sensor=None), air)
    snr = np.concatenate([light.expected_e, flux_e[seen]]) / noise_e
    missing = np.concatenate([light.llr < -SEEN_LLR, np.zeros(int(seen.sum()), dtype=bool)])  # behind the ground
    bright = (snr > BRIGHT_SNR) & ~missing
    radius_px = STAR_GLARE_PX + GLARE_PER_DECADE_PX * np.log10(snr[bright] / BRIGHT_SNR)
    return np.concatenate([light.xy_px, px[seen]])[bright], radius_px
