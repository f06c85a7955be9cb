"""The steepness of a crater whose depth and width are not known, as the rows of one image show it.

A round crater of another size looks the same from a position as much farther from its axis. Rows so show its depth over
its width, and the position over its width. The tangent of the skyline is searched in steps, over all positions.
"""

from __future__ import annotations

import numpy as np

from startrack.core.types import Evidence, NotLocated
from startrack.localization.places import BoxModel
from startrack.localization.search import BEAMS, NATS
from startrack.terrain import Terrain

STEEPNESS_SIGMAS = 3.0  # of what is stated, to the last steepness that is tried
STEEPNESS_STEP = 0.08  # of its logarithm, between two that are tried: the likelihood falls evenly over thirty of them
FINEST_STEP = 1e-3  # the shape's errors are expanded about the one found
MOST_STEEPNESSES = 3  # that the likelihood is followed from


def settle_steepness(evidence: Evidence, terrain: Terrain) -> Terrain:
    """The `terrain`, or where its steepness is not known, that of the steepness that `evidence` shows.

    Raises NotLocated (outside_search_area, insufficient_geometry) where there is none, or more than one.
    """
    sigma = terrain.errors.unknown_steepness_1
    if not sigma:
        return terrain
    steps = int(np.ceil(STEEPNESS_SIGMAS * sigma / STEEPNESS_STEP))
    tried = STEEPNESS_STEP * np.arange(-steps, steps + 1)
    fits = np.array([_fit(one, evidence, terrain, sigma) for one in tried])
    if not np.isfinite(fits).any():
        raise NotLocated("no position in the search area is allowed", reason="outside_search_area")
    higher = np.pad(fits, 1, constant_values=-np.inf)
    peaks = np.flatnonzero((fits >= higher[:-2]) & (fits >= higher[2:]) & np.isfinite(fits))
    peaks = peaks[np.argsort(-fits[peaks], kind="stable")][:MOST_STEEPNESSES]
    found = sorted((_climb(tried[at], fits[at], evidence, terrain, sigma) for at in peaks), reverse=True)
    (best, log_steepness), *others = found
    if any(fit > best - NATS and abs(other - log_steepness) > STEEPNESS_STEP for fit, other in others):
        raise NotLocated(
            "craters of more than one shape fit the image: state depth_m and diameter_m of the terrain file and their "
            "sigmas more exactly"
        )
    return terrain.with_steepness(float(np.exp(log_steepness)))


def _climb(log_steepness: float, fit: float, evidence: Evidence, terrain: Terrain, sigma: float) -> tuple[float, float]:
    """The fit and the logarithm of the steepness of the peak near one, in ever smaller steps."""
    step = 0.5 * STEEPNESS_STEP
    while step > FINEST_STEP:
        sides = [(_fit(log_steepness + side, evidence, terrain, sigma), log_steepness + side) for side in (-step, step)]
        fit, log_steepness = max((fit, log_steepness), *sides)
        step /= 2
    return fit, log_steepness


def _fit(log_steepness: float, evidence: Evidence, terrain: Terrain, sigma: float) -> float:
    """Log-likelihood of the best place of a beam at this steepness, with the prior of that."""
    model = BoxModel.of(evidence, terrain.with_steepness(float(np.exp(log_steepness))))
    places = model.fit_places(*model.last_boxes(*BEAMS[0]), most=1)
    return places[0].log_likelihood - 0.5 * (log_steepness / sigma) ** 2 if places else -np.inf
