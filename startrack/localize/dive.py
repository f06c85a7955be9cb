"""A first good place by following the bounds down: where the horizon is costly to ask, or a grid misses its peak."""

from __future__ import annotations

import numpy as np

from startrack.localize.likelihood import Sectors
from startrack.localize.profile import Profile
from startrack.localize.search import by_sector, centre_scores, ray_by_ray, split
from startrack.terrain import Terrain
from startrack.types import Array, Bools

KEPT_BOXES, KEPT_SMALL_BOXES = 24, 6
SMALL_M = 20.0  # boxes of this half side and less are asked ray by ray
FINEST_M = 0.5


def best_by_diving(sectors: Sectors, profile: Profile, terrain: Terrain) -> tuple[Array, float]:
    """A good place (2,) [m] and its log-likelihood: the most promising ones of ever smaller boxes are quartered.

    The log-likelihood is a lower bound of the maximum, usually within a nat or two of it; it decides nothing, but lets
    the search exclude nearly everything at once.
    """
    centres, half = np.zeros((1, 2)), float(terrain.reach_m)
    while True:
        boxes, first, last = by_sector(centres, half, sectors, profile, terrain)
        keep = _best(boxes.upper, KEPT_BOXES if half >= SMALL_M else KEPT_SMALL_BOXES)
        boxes, first, last = boxes.take(keep), first[keep], last[keep]
        if half < SMALL_M:
            break
        centres, half = boxes.quarters(terrain)[0], half / 2
    small, best, place = ray_by_ray(boxes, first, last, sectors, profile, terrain), -np.inf, np.zeros(2)
    while True:
        score = centre_scores(small, sectors, profile, terrain)
        score = np.where(terrain.allowed(small.centres_m), score, -np.inf)
        if len(small) and score.max() > best:
            best, place = float(score.max()), small.centres_m[int(np.argmax(score))]
        if small.half_m < FINEST_M or not len(small):
            return place, best
        small = split(small.take(_best(small.upper + score, KEPT_SMALL_BOXES)), sectors, profile, terrain)


def _best(values: Array, count: int) -> Bools:
    keep = np.zeros(len(values), dtype=bool)
    keep[np.argsort(-values, kind="stable")[:count]] = True
    return keep
