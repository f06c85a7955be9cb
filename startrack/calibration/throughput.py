"""How much light reaches the sensor: zero point, colour, vignetting and, on the Earth, extinction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.calibration.region_growing import Joint
from startrack.types import Array

FEWEST = 30
BRIGHT_SNR = 10.0
ROBUST_MAG = 0.2
PHOTOMETRY_MAG = 0.05  # of a star beside what the catalogue and the noise say
WELL_KNOWN_MAG = 0.03  # per airmass, or B-V: a term less well known is left out
TYPICAL_B_V = 0.6
DIMMEST_1 = 0.02
LOWEST_AIR_RAD = np.radians(8.0)


@dataclass(frozen=True, kw_only=True)
class Light:
    """What the stars' fluxes say; None where they do not tell."""

    zero_point_adu_per_s: float  # of a V = 0 star of typical colour on the axis, above the air if extinction is known
    zero_point_sigma_mag: float
    vignetting: tuple[float, float]  # 1 + v1 a^2 + v2 a^4
    colour_mag: float | None  # gained per magnitude of B-V redder than 0.6
    extinction_mag: float | None  # lost per airmass
    scatter_mag: float
    stars: int


@dataclass(frozen=True)
class _Stars:
    """Stars of all frames, each (n,)."""

    gained_mag: Array  # V minus the instrument's magnitude
    sigma_mag: Array
    angle_rad: Array
    b_v: Array
    airmass: Array | None


def measured_light(joint: Joint, light_1: float = 1.0) -> Light | None:
    """The light of the matched stars; None without exposure times or with fewer than 30 stars.

    `light_1`: by which the detector's fluxes are multiplied (its PSF is not quite each star's own).
    """
    stars = _stars(joint)
    if stars is None or len(stars.gained_mag) < FEWEST:
        return None
    terms = ["zero", "v1", "v2", "colour", *(["air"] if stars.airmass is not None else [])]
    while True:
        values, sigma, scatter = _fit(stars, terms)
        vague = [t for t in ("air", "colour") if t in terms and sigma[terms.index(t)] > WELL_KNOWN_MAG]
        if not vague:
            break
        terms.remove(vague[0])
    found = dict(zip(terms, values.tolist(), strict=True))
    return Light(
        zero_point_adu_per_s=float(light_1 * 10 ** (0.4 * found["zero"])),
        zero_point_sigma_mag=float(sigma[0]),
        vignetting=(found["v1"], found["v2"]),
        colour_mag=found.get("colour"),
        extinction_mag=-found["air"] if "air" in found else None,
        scatter_mag=scatter,
        stars=len(stars.gained_mag),
    )


def airmass(elevation_rad: Array) -> Array:
    """Air along the line of sight, zenith = 1. Source: Rozenberg 1966, Twilight, p. 160."""
    s = np.sin(elevation_rad)
    return 1.0 / (s + 0.025 * np.exp(-11.0 * s))


def _stars(joint: Joint) -> _Stars | None:
    columns: list[tuple[Array, ...]] = []
    reach = joint.fit.camera.calibrated_angle_rad
    for i, (frame, matched) in enumerate(zip(joint.frames, joint.matches, strict=True)):
        exposure_s = frame.exposure.exposure_s
        if exposure_s is None:
            continue
        used = joint.fit.used[joint.points.image == i]
        d, s = matched.detection[used], matched.star[used]
        found, sky = frame.detections, frame.sky
        angle = joint.fit.camera.angle_rad(found.xy_px[d])
        good = (found.snr[d] > BRIGHT_SNR) & ~found.saturated[d] & (angle < reach) & np.isfinite(sky.b_v[s])
        if sky.elevation_rad is not None:
            good &= sky.elevation_rad[s] > LOWEST_AIR_RAD
        d, s, angle = d[good], s[good], angle[good]
        instrument = -2.5 * np.log10(found.flux_e[d] / exposure_s)
        sigma = np.sqrt((1.086 / found.snr[d]) ** 2 + sky.stars.v_sigma_mag[s] ** 2 + PHOTOMETRY_MAG**2)
        air = airmass(sky.elevation_rad[s]) if sky.elevation_rad is not None else np.full(len(s), np.nan)
        columns.append((sky.stars.v_mag[s] - instrument, sigma, angle, sky.b_v[s], air))
    if not columns:
        return None
    gained, sigma, angle, b_v, air = (np.concatenate(c) for c in zip(*columns, strict=True))
    return _Stars(gained, sigma, angle, b_v, None if np.isnan(air).any() else air)


def _fit(stars: _Stars, terms: list[str]) -> tuple[Array, Array, float]:
    """Values and sigmas (m,) of the terms, and the stars' scatter about them [mag]."""
    from scipy.optimize import least_squares

    a2 = np.square(stars.angle_rad)

    def miss(p: Array) -> Array:
        value = dict(zip(terms, p, strict=True))
        through = np.maximum(1.0 + a2 * (value["v1"] + a2 * value["v2"]), DIMMEST_1)
        model = value["zero"] + 2.5 * np.log10(through) + value.get("colour", 0.0) * (stars.b_v - TYPICAL_B_V)
        if stars.airmass is not None:
            model = model + value.get("air", 0.0) * stars.airmass
        return np.asarray((stars.gained_mag - model) / stars.sigma_mag)

    start = np.zeros(len(terms))
    start[0] = np.median(stars.gained_mag)
    robust = ROBUST_MAG / float(np.median(stars.sigma_mag))
    fit = least_squares(miss, start, loss="soft_l1", f_scale=robust)
    residual = miss(fit.x)
    spread = 1.4826 * float(np.median(np.abs(residual)))
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * max(spread, 1.0) ** 2
    scatter = 1.4826 * float(np.median(np.abs(residual * stars.sigma_mag)))
    return fit.x, np.sqrt(np.diag(covariance)), scatter
