"""An error of the horizon that all azimuths share (crests that a coarse map clips, the height of the camera's own
ground): estimated with the position, and marginalised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from startrack.localize.likelihood import Sectors
from startrack.localize.scout import scores, taken
from startrack.terrain import Terrain
from startrack.types import Array, Evidence

Explored = tuple[Array, float, Array, float]  # centres, half side, log-likelihoods, log of the mass dropped

NEARBY_M = 80.0  # horizons are traced about a place, and interpolated; a place farther off is asked anew
WINDOW_RAD = np.radians(1.5)
TELLING_LLR = 0.5
PRIOR_SIGMAS = 3.0
ACROSS = 7  # errors tried at once
ZOOMS = 6
KEPT_NATS = 5.0
ENOUGH_SHRINKING = 0.75
MIXED_SIGMAS = np.linspace(-2.5, 2.5, 11)
FIRST_STEP_M, LAST_STEP_M = 16.0, 0.5
COMPASS = np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)], dtype=np.float64)


@dataclass(frozen=True)
class CommonError:
    """How much higher the true horizon stands than the map's, as the stars see it."""

    error_rad: float
    sigma_rad: float
    place_m: Array  # (2,) where the camera then is
    drift_m_per_rad: Array  # (2,) and how that place moves with the error


def raised(evidence: Evidence, error_rad: float) -> Evidence:
    """The rays as they stand against the map's horizon where the true one is `error_rad` higher."""
    return Evidence(
        azimuth_rad=evidence.azimuth_rad,
        elevation_rad=evidence.elevation_rad - error_rad,
        llr=evidence.llr,
        edge_sigma_rad=evidence.edge_sigma_rad,
    )


def marginalised_over_common(
    explore: Callable[[Evidence], Explored], evidence: Evidence, terrain: Terrain, place_m: Array
) -> Explored:
    """The position's posterior over all common errors: explored at the likeliest one, and smeared along the drift.

    Exact where place and error depend on each other linearly over the error's own small uncertainty.
    """
    common = common_error(evidence, terrain, place_m)
    centres, half, log_weight, log_dropped = explore(raised(evidence, common.error_rad))
    keep = log_weight > np.max(log_weight, initial=-np.inf) - 20.0
    steps = MIXED_SIGMAS[:, None, None] * common.sigma_rad * common.drift_m_per_rad
    if not keep.any() or np.abs(steps).max() < 0.5 * half:
        return centres, half, log_weight, log_dropped
    share = np.exp(-0.5 * MIXED_SIGMAS**2)
    share /= share.sum()
    smeared = (centres[keep] + steps).reshape(-1, 2)
    weights = (log_weight[keep] + np.log(share)[:, None]).ravel()
    inside = np.asarray(terrain.allowed(smeared))
    return smeared[inside], half, weights[inside], log_dropped


def common_error(evidence: Evidence, terrain: Terrain, place_m: Array) -> CommonError:
    """The error that fits best with its prior: grids of errors, each with its best place, zoom in on what matters."""
    middle, half = 0.0, PRIOR_SIGMAS * terrain.common_sigma_rad
    centre, near = place_m, terrain.near(place_m, NEARBY_M)
    for _ in range(ZOOMS):
        errors = middle + half * np.linspace(-1, 1, ACROSS)
        rays = _telling(evidence, place_m, near, float(np.abs(errors).max()))
        sectors = Sectors.of(rays, np.radians(1.5), 1e-4)
        found = [_best_place(place_m, raised(rays, error), sectors, near) for error in errors]
        places = np.array([place for place, _ in found])
        fits = np.array([fit for _, fit in found]) - 0.5 * (errors / terrain.common_sigma_rad) ** 2
        place_m = places[int(np.argmax(fits))]
        if np.abs(place_m - centre).max() > NEARBY_M:
            centre, near = place_m, terrain.near(place_m, NEARBY_M)
        kept = errors[fits > fits.max() - KEPT_NATS]
        step = 2 * half / (ACROSS - 1)
        low, high = max(kept.min() - step, middle - half), min(kept.max() + step, middle + half)
        if high - low > ENOUGH_SHRINKING * 2 * half:
            break
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
    weight = np.exp(fits - fits.max())
    weight /= weight.sum()
    error = float(weight @ errors)
    off = errors - error
    variance = float(weight @ off**2) + (errors[1] - errors[0]) ** 2 / 12
    place = weight @ places
    return CommonError(error, float(np.sqrt(variance)), place, (weight * off) @ (places - place) / variance)


def _telling(evidence: Evidence, place_m: Array, ground: Terrain, widest_rad: float) -> Evidence:
    """The rays near the skyline that say something: the others do not change with a small step or error."""
    above = evidence.elevation_rad - ground.horizon_rad(place_m[None], evidence.azimuth_rad)
    return taken(evidence, (np.abs(above) < WINDOW_RAD + widest_rad) & (np.abs(evidence.llr) > TELLING_LLR))


def _best_place(place_m: Array, evidence: Evidence, sectors: Sectors, ground: Terrain) -> tuple[Array, float]:
    """Best place (2,) near the start and its log-likelihood: steps to the best of 8 neighbours, ever shorter."""
    step, best = FIRST_STEP_M, -np.inf
    while step >= LAST_STEP_M:
        around = place_m + step * COMPASS
        around = around[np.asarray(ground.allowed(around))]
        score = scores(around, evidence, sectors, ground)
        top = int(np.argmax(score)) if len(score) else 0
        if not len(score) or score[top] <= best:
            step /= 2
            continue
        place_m, best = around[top], float(score[top])
    return place_m, best
