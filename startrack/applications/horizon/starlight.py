"""Evidence of the stars above a skyline on the Earth: the catalogue dimmed as the air and the lens dim it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.applications.horizon.columns import HIGHEST_GROUND_RAD
from startrack.applications.horizon.frames import SkyFrame
from startrack.catalog import airmass
from startrack.core.statistics import robust_sigma
from startrack.core.types import Array, Evidence, Stars
from startrack.evidence import SEEN_LLR, FluxScale, StarEvidence, StarPhotometry
from startrack.frames import azel_from_rays, off_axis_rad

BRIGHT_SNR = 12.0  # stars that show the dimming, and beside which the light of the sky is not measured
USUAL_EXTINCTION_MAG, EXTINCTION_SIGMA_MAG = 0.2, 0.1  # per airmass, in clear air; in haze beyond most stars'
FREE_TERM_MAG = 3.0  # prior sigma of the other terms of the throughput
TYPICAL_SCATTER_MAG = 0.3
MIN_SCATTER_MAG = 0.1
TESTED_QUANTILE = 0.95
DIMMING_ROUNDS = 12
STAR_GLARE_PX, GLARE_PER_DECADE_PX = 3.0, 2.5  # of the faintest of them, and more for each factor of ten


@dataclass(frozen=True)
class Dimming:
    """Zero point of the image: a polynomial of the angle off the axis, and extinction."""

    terms_mag: Array  # (4,) zero point on the axis above the air, its a^2 and a^4, extinction per airmass
    scatter_mag: float
    tested_airmass: float  # of most bright stars; beyond it the zero point is extrapolated

    def zero_mag(self, angle_rad: Array, air: Array) -> Array:
        """V magnitude (n,) of a star of one electron at angles off the axis (n,) through airmasses (n,)."""
        return _design(angle_rad, air) @ self.terms_mag

    def sigma_mag(self, air: Array) -> Array:
        """Error (n,) of the zero point in directions that no bright star tested."""
        return np.asarray(EXTINCTION_SIGMA_MAG * np.maximum(air - self.tested_airmass, 0.0))


def fit_dimming(frame: SkyFrame) -> Dimming:
    """The dimming that fits the bright identified stars, by robust least squares with a prior on the extinction."""
    d, s = frame.matched_detection, frame.matched_star
    found, stars = frame.detections, frame.sky.stars
    use = (found.snr[d] > BRIGHT_SNR) & ~found.saturated[d] & (stars.v_sigma_mag[s] < 0.15)
    d, s = (d[use], s[use]) if use.sum() >= 5 else (d, s)
    rays = stars.rays_icrs[s]
    angle, air = off_axis_rad(rays @ frame.R_cam_icrs.T), _airmass(rays @ frame.R_enu_icrs.T)
    gain = stars.v_mag[s] + 2.5 * np.log10(found.flux_e[d])
    prior = np.diag([0.0, 1.0 / FREE_TERM_MAG, 1.0 / FREE_TERM_MAG, 1.0 / EXTINCTION_SIGMA_MAG])
    usual = np.array([0.0, 0.0, 0.0, USUAL_EXTINCTION_MAG])
    matrix, scatter, root = _design(angle, air), TYPICAL_SCATTER_MAG, np.full(len(s), 1.0 / TYPICAL_SCATTER_MAG)
    for _ in range(DIMMING_ROUNDS):
        rows = np.concatenate([matrix * root[:, None], prior])
        terms = np.linalg.lstsq(rows, np.concatenate([gain * root, prior @ usual]), rcond=None)[0]
        rest = gain - matrix @ terms
        scatter = max(robust_sigma(rest, 0.0), MIN_SCATTER_MAG)
        root = 1.0 / (scatter * np.sqrt(1.0 + np.square(rest / (2.0 * scatter))))
    return Dimming(terms, scatter, float(np.quantile(air, TESTED_QUANTILE)))


@dataclass(frozen=True)
class StarLight:
    """The stars of one image: rows of evidence in apparent directions of enu, and the pixels of bright stars."""

    rays: Evidence
    bright_px: Array  # (m, 2) of stars and planets
    glare_px: Array  # (m,) radius of their light
    missing: float  # share of the stars high in the sky that are not seen: clouds


def measure_stars(frame: SkyFrame) -> StarLight:
    """Every catalogue star in view of a frame."""
    dimming = fit_dimming(frame)
    camera = replace(frame.camera, sensor=None, calibrated_angle_rad=frame.camera.max_angle_rad)
    scale = FluxScale(
        zero_mag=0.0, scatter=0.4 * np.log(10) * dimming.scatter_mag, stars=len(frame.matched_star)
    )  # fmt: skip
    light = StarEvidence()(
        frame.detections, camera, _dim_stars(frame, dimming), list(frame.bodies), frame.R_cam_icrs, frame.R_enu_icrs,
        scale, frame.extra_sigma_px,
    )  # fmt: skip
    rows = light.evidence()
    scale_rad = camera.mean_scale_rad_per_px(np.array(min(camera.max_angle_rad, np.pi / 2)))
    rays = replace(rows, edge_sigma_rad=np.full(len(rows), float(scale_rad)))  # a pixel of the usual PSF
    # Stars are missed where no ground is expected.
    highest = rays.elevation_rad > min(HIGHEST_GROUND_RAD, float(np.quantile(rays.elevation_rad, 0.5, method="lower")))
    decided = rays.llr[highest & (np.abs(rays.llr) > SEEN_LLR)]
    missing = float((np.count_nonzero(decided < 0) + 1) / (len(decided) + 2))
    return StarLight(rays, *_glare(frame, dimming, light), missing)


def _glare(frame: SkyFrame, dimming: Dimming, light: StarPhotometry) -> tuple[Array, Array]:
    """Pixels (m, 2) of bright stars and planets, and the radii (m,) of their light [px]."""
    noise_e = max(float(np.median(light.sigma_e[light.usable])) if light.usable.any() else 0.0, 1e-9)
    planets = [body for body in frame.bodies if body.name not in ("Sun", "Moon")]
    rays = np.array([body.ray_icrs for body in planets]).reshape(-1, 3)
    px, seen = frame.camera.project(rays @ frame.R_cam_icrs.T)
    angle = np.minimum(off_axis_rad(rays @ frame.R_cam_icrs.T), frame.camera.max_angle_rad)
    zero_mag = dimming.zero_mag(angle, _airmass(rays @ frame.R_enu_icrs.T))
    flux_e = 10 ** (-0.4 * (np.array([body.v_mag for body in planets]) - zero_mag))
    snr = np.concatenate([light.expected_e, flux_e[seen]]) / noise_e
    missing = np.concatenate([light.llr < -SEEN_LLR, np.zeros(int(seen.sum()), dtype=bool)])  # behind the ground
    bright = (snr > BRIGHT_SNR) & ~missing
    radius_px = STAR_GLARE_PX + GLARE_PER_DECADE_PX * np.log10(snr[bright] / BRIGHT_SNR)
    return np.concatenate([light.xy_px, px[seen]])[bright], radius_px


def _dim_stars(frame: SkyFrame, dimming: Dimming) -> Stars:
    """The catalogue with instrumental magnitudes (zero point 0), brightest first."""
    stars = frame.sky.stars
    angle = off_axis_rad(stars.rays_icrs @ frame.R_cam_icrs.T)
    air = _airmass(stars.rays_icrs @ frame.R_enu_icrs.T)
    mag = stars.v_mag - dimming.zero_mag(np.minimum(angle, frame.camera.max_angle_rad), air)
    sigma = np.hypot(stars.v_sigma_mag, dimming.sigma_mag(air))
    return replace(stars, v_mag=mag, v_sigma_mag=sigma).take(np.argsort(mag, kind="stable"))


def _airmass(rays_enu: Array) -> Array:
    return airmass(np.maximum(azel_from_rays(rays_enu)[1], 0.0))


def _design(angle_rad: Array, air: Array) -> Array:
    a2 = np.square(angle_rad)
    return np.stack([np.ones_like(a2), a2, a2 * a2, -air], axis=-1)
