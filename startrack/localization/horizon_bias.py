"""An error of the horizon that all azimuths share (crests that a coarse map clips, the height of the camera's own
ground): estimated with the position, and marginalised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from startrack.localization.local_search import Vicinity
from startrack.localization.prefix_sums import Profile
from startrack.localization.sector_likelihood import Sectors
from startrack.terrain import Terrain
from startrack.types import Array, Evidence

Explored = tuple[Array, float, Array, float]  # centres, half side, log-likelihoods, log of the mass dropped

SECTOR_RAD, SECTOR_EPSILON = np.radians(1.5), 1e-4
NEARBY_M = 80.0  # horizons are traced about a place, and interpolated; a place farther off is asked anew
PRIOR_SIGMAS = 3.0
ACROSS = 7  # errors tried at once
ZOOMS = 6
KEPT_NATS = 5.0
ENOUGH_SHRINKING = 0.75
MIXED_SIGMAS = np.linspace(-2.5, 2.5, 11)
FIRST_STEP_M, NEXT_STEP_M, LAST_STEP_M = 16.0, 4.0, 0.5


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
    explore: Callable[[Evidence, Array], Explored], evidence: Evidence, terrain: Terrain, common: CommonError
) -> Explored:
    """The position's posterior over all common errors: explored at the likeliest one, and smeared along the drift.

    Exact where place and error depend on each other linearly over the error's own small uncertainty.
    """
    centres, half, log_weight, log_dropped = explore(raised(evidence, common.error_rad), common.place_m)
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


def common_error(
    evidence: Evidence, terrain: Terrain, place_m: Array, sectors: Sectors | None = None, profile: Profile | None = None
) -> CommonError:
    """The error that fits best with its prior: grids of errors, each with its best place, zoom in on what matters.

    `sectors` and `profile` are the evidence's, where they are known.
    """
    sectors = sectors or Sectors.of(evidence, SECTOR_RAD, SECTOR_EPSILON)
    profile = profile or Profile.of(sectors)
    middle, half, step = 0.0, PRIOR_SIGMAS * terrain.common_sigma_rad, FIRST_STEP_M
    centre, about = place_m, Vicinity.of(sectors, profile, terrain, place_m, NEARBY_M, half)
    for _ in range(ZOOMS):
        errors = middle + half * np.linspace(-1, 1, ACROSS)
        found = [about.climbed(place_m, step, LAST_STEP_M, about.elevation_rad - error) for error in errors]
        places = np.array([place for place, _ in found])
        fits = np.array([fit for _, fit in found]) - 0.5 * (errors / terrain.common_sigma_rad) ** 2
        place_m, step = places[int(np.argmax(fits))], NEXT_STEP_M
        if np.abs(place_m - centre).max() > NEARBY_M:
            widest = PRIOR_SIGMAS * terrain.common_sigma_rad
            centre, about = place_m, Vicinity.of(sectors, profile, terrain, place_m, NEARBY_M, widest)
        kept = errors[fits > fits.max() - KEPT_NATS]
        between = 2 * half / (ACROSS - 1)
        low, high = max(kept.min() - between, middle - half), min(kept.max() + between, middle + half)
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
