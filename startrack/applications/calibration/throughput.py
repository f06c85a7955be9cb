"""Throughput from the stars' fluxes: zero point, vignetting, colour term and, on the Earth, extinction.

The fit is bounded to physically possible values. In a camera that looks at the zenith airmass is a function of the
angle off the axis, so that extinction and vignetting can be exchanged for each other; a term that the data do not
determine, or that ends at a bound, is left out, and so is the whole throughput where it fails a held-out test.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import MIN_THROUGHPUT_1, Sensor
from startrack.core.limits import check_time
from startrack.core.statistics import robust_sigma
from startrack.core.types import Array, Ints, Rows, array
from startrack.estimation.frame_matching import JointFit
from startrack.frames import airmass

MIN_THROUGHPUT_STARS = 30
MIN_FLUX_SNR = 10.0
LOSS_MAG = 0.2  # residual beyond which a star's influence is constant
PHOTOMETRY_MAG = 0.05  # error of a star's magnitude beyond catalogue and noise
LARGEST_TERM_SIGMA_MAG = 0.03  # per airmass, or per B-V: a term with a larger sigma is left out
TYPICAL_B_V = 0.6
LOWEST_ELEVATION_RAD = np.radians(8.0)
TERMS = {  # smallest value, start and largest value
    "middle": (MIN_THROUGHPUT_1, 0.95, 1.1),  # throughput relative to the axis, half way to the calibrated angle, ...
    "edge": (MIN_THROUGHPUT_1, 0.9, 1.1),  # ... and there: a lens is darker at its edge
    "colour": (-1.0, 0.0, 1.0),  # magnitudes per B-V
    "air": (0.0, 0.2, 1.5),  # magnitudes of extinction per airmass; 0.1 to 0.5 in clear air
}
AT_BOUND_1 = 1e-3  # of the range of a term
HELD_OUT_PARTS = 5
LARGEST_HELD_OUT_MAG = 0.4  # median scatter of held-out stars
LARGEST_HELD_OUT_RATIO = 1.5  # of held-out scatter to that of the fit
LARGEST_IMAGE_OFFSET_MAG = 0.15  # of an image's zero point from the common one: clouds, or twilight
MIN_STARS_PER_IMAGE = 10


@dataclass(frozen=True, kw_only=True)
class Throughput:
    """Fitted throughput; None for terms that the data do not determine."""

    zero_point_adu_per_s: float  # of a V = 0 star of typical colour on the axis, above the air if extinction is known
    zero_point_sigma_mag: float
    vignetting: tuple[float, float]  # relative throughput 1 + v1 a^2 + v2 a^4
    colour_mag: float | None  # gain per magnitude of B-V redder than 0.6
    extinction_mag: float | None  # loss per airmass
    scatter_mag: float
    stars: int


@dataclass(frozen=True, kw_only=True)
class StarFluxes(Rows):
    """Bright matched stars of all frames."""

    gain_mag: Array = array("n")  # V minus the instrumental magnitude
    sigma_mag: Array = array("n")
    angle_rad: Array = array("n")
    b_v: Array = array("n")
    airmass: Array = array("n")  # 0: not known
    image: Ints = array("n", dtype=np.int64)


@dataclass(frozen=True)
class _Fit:
    """Values of the terms, their sigmas, the terms at a bound, and the stars' residuals."""

    values: dict[str, float]
    sigma: dict[str, float]
    at_bound: set[str]
    residual_mag: Array  # (n,)
    edge_rad: float

    @property
    def scatter_mag(self) -> float:
        """Robust standard deviation of the stars' residuals [mag]."""
        return float(robust_sigma(self.residual_mag, 0.0))

    @property
    def vignetting(self) -> tuple[float, float]:
        """Coefficients v1 and v2 of the relative throughput 1 + v1 a^2 + v2 a^4 at an angle a off the axis."""
        return _vignetting(self.values, self.edge_rad)


def measure_throughput(joint: JointFit, flux_ratio: float = 1.0) -> tuple[Throughput | None, list[str]]:
    """The throughput from the matched stars of all frames (None where it is not known), and warnings for the record.

    `flux_ratio`: by which the detector's fluxes are multiplied (its PSF is not quite each star's own).
    """
    stars = _star_fluxes(joint)
    if len(stars) < MIN_THROUGHPUT_STARS:
        return None, [
            "zero point: not measured; the images must state their exposure time (EXPTIME, exposure_s), and 30 "
            "unsaturated stars are needed"
        ]
    return fit_throughput(stars, joint.fit.camera.calibrated_angle_rad, flux_ratio)


def fit_throughput(
    stars: StarFluxes, edge_rad: float, flux_ratio: float = 1.0
) -> tuple[Throughput | None, list[str]]:  # fmt: skip
    """The throughput of stars up to the angle `edge_rad` off the axis, tested; None with a warning if it fails."""
    warnings: list[str] = []
    terms = ["zero", "middle", "edge", "colour", *(["air"] if stars.airmass.all() else [])]
    while True:
        fit = _fit(stars, terms, edge_rad)
        optional = [t for t in ("air", "colour") if t in terms]
        poor = [t for t in optional if t in fit.at_bound or fit.sigma[t] > LARGEST_TERM_SIGMA_MAG]
        if not poor:
            break
        if poor[0] == "air" and "air" in fit.at_bound:
            warnings.append("extinction: left out; the fitted value is not physical: it cannot be separated from "
                            "vignetting")  # fmt: skip
        terms.remove(poor[0])
    failures = _failures(stars, terms, fit)
    if failures:
        return None, [*warnings, *(f"throughput: left out; {failure}" for failure in failures)]
    if fit.values.get("air") is None and not warnings:
        warnings.append("extinction: not distinguished from vignetting; zero point and vignetting contain it")
    throughput = Throughput(
        zero_point_adu_per_s=float(flux_ratio * 10 ** (0.4 * fit.values["zero"])),
        zero_point_sigma_mag=fit.sigma["zero"],
        vignetting=fit.vignetting,
        colour_mag=fit.values.get("colour"),
        extinction_mag=fit.values.get("air"),
        scatter_mag=fit.scatter_mag,
        stars=len(stars),
    )
    return throughput, warnings


def _failures(stars: StarFluxes, terms: list[str], fit: _Fit) -> list[str]:
    """Reasons not to trust the fit: a bound, held-out stars, or images with different zero points."""
    failures = []
    sensor = Sensor(zero_point_e_per_s=1.0, vignetting=fit.vignetting)
    if {"middle", "edge"} & fit.at_bound or sensor.lowest_throughput(fit.edge_rad) < MIN_THROUGHPUT_1:
        failures.append("the fitted vignetting is not physical")
    held_out = _held_out_mag(stars, terms, fit.edge_rad)
    scatter = robust_sigma(held_out, 0.0)
    if scatter > min(LARGEST_HELD_OUT_MAG, LARGEST_HELD_OUT_RATIO * max(fit.scatter_mag, PHOTOMETRY_MAG)):
        failures.append(f"held-out stars scatter by {scatter:.2f} mag, the fitted ones by {fit.scatter_mag:.2f}")
    offsets = [
        float(np.median(fit.residual_mag[stars.image == i]))
        for i, count in enumerate(np.bincount(stars.image))
        if count >= MIN_STARS_PER_IMAGE
    ]
    if len(offsets) > 1 and (largest := float(np.max(np.abs(offsets)))) > LARGEST_IMAGE_OFFSET_MAG:
        failures.append(f"the zero points of the images differ by up to {largest:.2f} mag from their mean: clouds?")
    return failures


def _held_out_mag(stars: StarFluxes, terms: list[str], edge_rad: float) -> Array:
    """Residuals (n,) of fits that do not contain the star: with several images, none of its image's stars."""
    fold = np.argsort(np.argsort(stars.angle_rad, kind="stable")) % HELD_OUT_PARTS
    fold = stars.image if len(np.unique(stars.image)) > 1 else fold
    residual = np.empty(len(fold))
    for k in np.unique(fold):
        held = fold == k
        rest = stars.take(~held)
        if len(rest) < MIN_THROUGHPUT_STARS:
            rest = stars
        residual[held] = (stars.gain_mag - _model(stars, _fit(rest, terms, edge_rad).values, edge_rad))[held]
    return residual


def _star_fluxes(joint: JointFit) -> StarFluxes:
    """The bright, unsaturated matched stars of the images that have an exposure time."""
    none, no_image = np.zeros(0), np.zeros(0, dtype=np.int64)
    parts = [StarFluxes(gain_mag=none, sigma_mag=none, angle_rad=none, b_v=none, airmass=none, image=no_image)]
    calibrated = joint.fit.camera.calibrated_angle_rad
    for i, (frame, matched) in enumerate(zip(joint.frames, joint.matches, strict=True)):
        check_time()
        exposure_s = frame.exposure.exposure_s
        if exposure_s is None:
            continue
        used = joint.fit.used[joint.points.image == i]
        d, s = matched.detection[used], matched.star[used]
        found, sky = frame.sources, frame.sky
        angle = joint.fit.camera.angle_rad(found.xy_px[d])
        good = (found.snr[d] > MIN_FLUX_SNR) & ~found.saturated[d] & (angle < calibrated) & np.isfinite(sky.b_v[s])
        if sky.elevation_rad is not None:
            good &= sky.elevation_rad[s] > LOWEST_ELEVATION_RAD
        d, s, angle = d[good], s[good], angle[good]
        instrumental = -2.5 * np.log10(found.flux_e[d] / exposure_s)
        sigma = np.sqrt((1.086 / found.snr[d]) ** 2 + sky.stars.v_sigma_mag[s] ** 2 + PHOTOMETRY_MAG**2)
        air = airmass(sky.elevation_rad[s]) if sky.elevation_rad is not None else np.zeros(len(s))
        parts.append(StarFluxes(
            gain_mag=sky.stars.v_mag[s] - instrumental, sigma_mag=sigma, angle_rad=angle, b_v=sky.b_v[s], airmass=air,
            image=np.full(len(s), i),
        ))  # fmt: skip
    return StarFluxes.concatenate(*parts)


def _vignetting(values: dict[str, float], edge_rad: float) -> tuple[float, float]:
    """Coefficients v1, v2 of the throughput 1 + v1 a^2 + v2 a^4 by its values at a^2 = edge^2 / 2 and edge^2."""
    middle, edge, u = values["middle"], values["edge"], edge_rad**2
    return (4.0 * middle - edge - 3.0) / u, (2.0 + 2.0 * edge - 4.0 * middle) / u**2


def _model(stars: StarFluxes, values: dict[str, float], edge_rad: float) -> Array:
    """V minus the instrumental magnitude (n,) by the model."""
    v1, v2 = _vignetting(values, edge_rad)
    a2 = np.square(stars.angle_rad)
    throughput = np.maximum(1.0 + a2 * (v1 + a2 * v2), MIN_THROUGHPUT_1 / 2)
    by_colour, by_air = values.get("colour", 0.0) * (stars.b_v - TYPICAL_B_V), values.get("air", 0.0) * stars.airmass
    return np.asarray(values["zero"] + 2.5 * np.log10(throughput) + by_colour - by_air)


def _fit(stars: StarFluxes, terms: list[str], edge_rad: float) -> _Fit:
    """Bounded robust least squares over the terms."""
    from scipy.optimize import least_squares

    zero = float(np.median(stars.gain_mag))
    limits = {"zero": (zero - 10.0, zero, zero + 10.0)} | TERMS  # with the start
    low, start, high = np.array([limits[t] for t in terms]).T

    def misfit(p: Array) -> Array:
        values = dict(zip(terms, p.tolist(), strict=True))
        return np.asarray((stars.gain_mag - _model(stars, values, edge_rad)) / stars.sigma_mag)

    loss_scale = LOSS_MAG / float(np.median(stars.sigma_mag))
    tolerances = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-12)
    fit = least_squares(misfit, start, bounds=(low, high), loss="soft_l1", f_scale=loss_scale, **tolerances)
    residual = misfit(fit.x)
    spread = robust_sigma(residual, 0.0)
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * max(spread, 1.0) ** 2
    margin = AT_BOUND_1 * (high - low)
    at_bound = (fit.x < low + margin) | (fit.x > high - margin)
    return _Fit(
        values=dict(zip(terms, fit.x.tolist(), strict=True)),
        sigma=dict(zip(terms, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        at_bound={t for t, reached in zip(terms, at_bound, strict=True) if reached},
        residual_mag=residual * stars.sigma_mag,
        edge_rad=edge_rad,
    )
