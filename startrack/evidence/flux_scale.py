"""The light that a star of the catalogue leaves in an image: zero point, throughput over the image, extinction.

The natural logarithm of the flux is linear in its unknowns: a constant, terms of the image (a lens that is dirty,
tilted or darker at its edge than its file states; thin cloud) and the extinction, where there is air. The terms have a
normal prior; its width is the one that the bright identified stars make most probable, so that terms vanish where the
stars show none. Of directions that no star tests the error is wide, and so is that of their expected flux.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from startrack.camera import Camera
from startrack.core.statistics import robust_sigma
from startrack.core.types import Array, Detections, Ints, Stars
from startrack.estimation.prior_choice import solve_with_best_prior
from startrack.evidence.photometry import Sources, half_width, measure
from startrack.frames import EXTINCTION_SIGMA_MAG, USUAL_EXTINCTION_MAG, off_axis_rad

SCALE_SNR, SCALE_STARS = 15.0, 5  # of the stars that give the scale, and their least number
MIN_SCATTER, FIRST_SCATTER = 0.02, 0.3
LN_PER_MAG = 0.4 * np.log(10)
CONSTANT_SIGMA = 10.0  # of the prior of the zero point: none
MOST_WAVES = 8  # waves of 45 degrees across a hemisphere: thin cloud
TERMS = tuple((n, m) for n in range(1, MOST_WAVES + 1) for m in range(-n, n + 1, 2))  # Zernike polynomials
# Sigma of the prior of a term of degree 1, and most degree. All-sky cameras in the open: 0.3, 4.
PRIORS = ((0.0, 0), *((size, degree) for degree in (4, MOST_WAVES) for size in (0.03, 0.1, 0.3)))
WEIGHT_ROUNDS = 10  # of the robust weights


@dataclass(frozen=True, kw_only=True)
class FluxScale:
    """Scale of fluxes: a star has 10^(-0.4 (V - zero_mag)) times the lens's throughput and exp(columns @ response)."""

    zero_mag: float  # V of a star of one electron (or ADU), above the air
    scatter: float  # relative scatter of bright stars about the scale
    stars: int  # that defined it
    response: Array | None = None  # (k,) of a constant (0), TERMS and, with air, magnitudes per airmass; None: all 0
    covariance: Array | None = None  # (k, k) of the response; None: no error

    def expect(
        self, v_mag: Array, rays_cam: Array, camera: Camera, air: Array | None = None
    ) -> tuple[Array, Array]:  # fmt: skip
        """Expected flux (n,) of stars of `v_mag` (n,), and its relative error (n,) without that of the magnitudes.

        `rays_cam` (n, 3) are directions in the axes of the `camera`, `air` (n,) airmasses; None without air.
        """
        throughput = camera.sensor.throughput(off_axis_rad(rays_cam)) if camera.sensor is not None else 1.0
        flux_e = np.asarray(10 ** (-0.4 * (v_mag - self.zero_mag)) * throughput)
        if self.response is None or self.covariance is None:
            return flux_e, np.full(len(flux_e), self.scatter)
        columns = _columns(camera, rays_cam, air)
        variance = np.sum((columns @ self.covariance) * columns, axis=1)
        return flux_e * np.exp(columns @ self.response), np.sqrt(self.scatter**2 + variance)


def flux_scale(
    detections: Detections, camera: Camera, stars: Stars, matches: tuple[Ints, Ints], R_cam_icrs: Array,
    air: Array | None = None,
) -> FluxScale:  # fmt: skip
    """The scale by the bright identified stars, measured as all stars are: at their predicted pixels.

    A lens or a width of the PSF that differs over the image takes light from a star that is measured there.
    `matches` are indices (n,) of `detections` and those (n,) of their `stars`; `R_cam_icrs` (3, 3) is the attitude of
    the `camera`; `air` (len(stars),) are the airmasses, None without air.
    """
    d, s = matches
    trusted = (detections.snr[d] > SCALE_SNR) & ~detections.saturated[d] & (stars.v_sigma_mag[s] < 0.1)
    if trusted.sum() < SCALE_STARS:
        trusted = ~detections.saturated[d] if (~detections.saturated[d]).any() else np.ones(len(d), dtype=bool)
    d, s = d[trusted], s[trusted]
    rays_cam, sigma_e = stars.rays_icrs[s] @ R_cam_icrs.T, detections.flux_sigma_e[d]
    xy_px, flux_e = camera.project(rays_cam)[0], detections.flux_e[d].copy()
    near = np.abs(xy_px - detections.xy_px[d]).max(axis=1) < detections.psf_sigma_px
    light = _measure_alone(detections, xy_px[near], flux_e[near])
    flux_e[near] = np.where(light > 0.0, light, flux_e[near])
    return fit_flux_scale(flux_e, sigma_e, stars.v_mag[s], rays_cam, camera, None if air is None else air[s])


def _measure_alone(detections: Detections, xy_px: Array, flux_e: Array) -> Array:
    """Flux (n,) [e] at pixels (n, 2) of stars of about `flux_e` (n,), each alone; 0 where it is not known."""
    room = np.array(detections.image_e.shape[::-1]) - 1 - half_width(detections.psf_sigma_px)
    inside = (xy_px >= half_width(detections.psf_sigma_px)).all(axis=1) & (xy_px <= room).all(axis=1)
    none = np.zeros(np.count_nonzero(inside))
    light = measure(detections, Sources(xy_px=xy_px[inside], flux_e=flux_e[inside], fraction_sigma=none, visible=none))
    found = np.zeros(len(flux_e))
    found[inside] = np.where(light.usable, light.flux_e, 0.0)
    return found


def fit_flux_scale(
    flux_e: Array, sigma_e: Array, v_mag: Array, rays_cam: Array, camera: Camera, air: Array | None = None
) -> FluxScale:
    """The scale that fits `flux_e` (n,), with noise `sigma_e` (n,), of stars of `v_mag` (n,) in `rays_cam` (n, 3).

    The `camera` has the throughput of the lens; `air` (n,) are airmasses, None without air.
    """
    throughput = camera.sensor.throughput(off_axis_rad(rays_cam)) if camera.sensor is not None else np.ones(len(v_mag))
    log_flux = np.log(flux_e / np.maximum(throughput, 1e-3)) + LN_PER_MAG * v_mag
    response, covariance, rest = _fit(_columns(camera, rays_cam, air), log_flux, has_air=air is not None)
    noise = float(np.median(sigma_e / flux_e))
    scatter = max(float(np.sqrt(max(robust_sigma(rest, 0.0) ** 2 - noise**2, 0.0))), MIN_SCATTER)
    zero_mag = float(response[0]) / LN_PER_MAG
    if not np.any(response[1:]):
        return FluxScale(zero_mag=zero_mag, scatter=scatter, stars=len(v_mag))
    response[0] = 0.0
    return FluxScale(zero_mag=zero_mag, scatter=scatter, stars=len(v_mag), response=response, covariance=covariance)


def expected_flux_scale(zero_mag: float, noise_e: float, v_mag: Array, error_mag: Array) -> FluxScale:
    """The scale that the bright ones of visible stars would show, for `zero_mag` and `noise_e` of a star's flux.

    `v_mag` (n,) are magnitudes of the catalogue and `error_mag` (n,) their errors.
    """
    error = error_mag[v_mag < zero_mag - 2.5 * np.log10(SCALE_SNR * noise_e)]
    if len(error) < SCALE_STARS:
        return FluxScale(zero_mag=zero_mag, scatter=MIN_SCATTER, stars=len(error))
    scatter = max(LN_PER_MAG * robust_sigma(error), MIN_SCATTER)
    return FluxScale(zero_mag=zero_mag - float(np.median(error)), scatter=scatter, stars=len(error))


def _columns(camera: Camera, rays_cam: Array, air: Array | None) -> Array:
    """Derivatives (n, k) of the logarithm of the flux by the response, in directions (n, 3)."""
    part2 = np.square(np.minimum(off_axis_rad(rays_cam) / camera.max_angle_rad, 1.0))
    turn = np.arctan2(rays_cam[:, 1], rays_cam[:, 0])
    wave = np.sqrt(part2) * np.exp(1j * turn)
    waves = np.stack([wave**m for m in range(MOST_WAVES + 1)])
    columns = [np.ones(len(part2))]
    for n, m in TERMS:
        radial = np.polynomial.polynomial.polyval(part2, _radial_powers(n, abs(m)))
        columns.append(radial * (waves[m].real if m >= 0 else waves[-m].imag))
    if air is not None:
        columns.append(-LN_PER_MAG * air)
    return np.stack(columns, axis=1)


@cache
def _radial_powers(n: int, m: int) -> tuple[float, ...]:
    """Coefficients of Zernike's radial polynomial over r^m, in powers of r^2; an RMS of 1 over the disc."""
    norm = math.sqrt((n + 1) * (1 if m == 0 else 2))
    f, half, top = math.factorial, (n - m) // 2, (n + m) // 2
    falling = [(-1) ** k * f(n - k) / (f(k) * f(top - k) * f(half - k)) for k in range(half + 1)]
    return tuple(norm * value for value in reversed(falling))


def _fit(columns: Array, log_flux: Array, *, has_air: bool) -> tuple[Array, Array, Array]:
    """Response (k,), its covariance (k, k), and the residuals (n,), with the prior of the highest evidence.

    Robust weights 1 / (1 + (r / 2 s)^2) are those of the widest prior.
    """
    mean = np.zeros(columns.shape[1])
    mean[-1] = USUAL_EXTINCTION_MAG if has_air else 0.0
    mean[0] = np.median(log_flux - columns @ mean)
    weight, offset = np.full(len(log_flux), FIRST_SCATTER**-2), log_flux - columns @ mean
    roots = [_prior_root(size, degree, has_air) for size, degree in PRIORS]
    for _ in range(WEIGHT_ROUNDS):
        scaled = weight[:, None] * columns
        found = solve_with_best_prior(scaled.T @ columns, scaled.T @ offset, roots[-1:])
        rest = offset - columns @ found.step
        weight = 1.0 / (max(float(robust_sigma(rest, 0.0)), MIN_SCATTER) ** 2 + np.square(rest / 2.0))
    scaled = weight[:, None] * columns
    found = solve_with_best_prior(scaled.T @ columns, scaled.T @ offset, roots)
    return mean + found.step, found.covariance, offset - columns @ found.step


def _prior_root(size: float, most_degree: int, has_air: bool) -> Array:
    """Diagonal root (k, j) of the prior with terms of `size` over their degree; unknowns that stay 0 are left out."""
    sigma = [CONSTANT_SIGMA, *(size / n if n <= most_degree else 0.0 for n, _ in TERMS)]
    root = np.diag([*sigma, EXTINCTION_SIGMA_MAG] if has_air else sigma)
    return root[:, np.diag(root) > 0.0]
