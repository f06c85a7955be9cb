"""A first good place by following the bounds down: where the horizon is costly to ask, or a grid misses its peak."""

from __future__ import annotations

import numpy as np

from startrack.localize.likelihood import Sectors
from startrack.localize.profile import Profile
from startrack.localize.search import asked, by_sector, centre_scores
from startrack.localize.vicinity import Vicinity
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Ints

KEPT_BOXES, KEPT_SMALL_BOXES = 24, 8  # by each of two measures
SMALL_M = 20.0  # half side of the last boxes
TRIED, APART_M = 3, 60.0  # places from which the top is climbed, and how far they are apart
NEARBY_M = 45.0
FIRST_STEP_M, FINEST_M = 16.0, 0.5


def best_by_diving(sectors: Sectors, profile: Profile, terrain: Terrain) -> tuple[Array, float]:
    """A good place (2,) [m] and its log-likelihood: the most promising ones of ever smaller boxes are quartered.

    The log-likelihood is a lower bound of the maximum, usually within a nat or two of it; it decides nothing, but lets
    the search exclude nearly everything at once.
    """
    centres, half = np.zeros((1, 2)), float(terrain.reach_m)
    while True:
        boxes, first, last = by_sector(centres, half, sectors, profile, terrain)
        # By the upper bound alone, places whose bounds are loose would win; by the middle, those with tight ones.
        keep = _best(boxes.upper, KEPT_BOXES) | _best(boxes.upper + boxes.lower, KEPT_BOXES)
        boxes, first, last = boxes.take(keep), first[keep], last[keep]
        if half < SMALL_M or not len(boxes):
            break
        centres, half = boxes.quarters(terrain)[0], half / 2
    if not len(boxes):
        return np.zeros(2), -np.inf
    few = _best(boxes.upper, KEPT_SMALL_BOXES) | _best(boxes.upper + boxes.lower, KEPT_SMALL_BOXES)
    boxes, first, last = boxes.take(few), first[few], last[few]
    score = centre_scores(asked(boxes, first, last, profile), sectors, profile, terrain)
    best, place = -np.inf, np.zeros(2)
    order = np.argsort(-score, kind="stable")
    for box in _apart(boxes.centres_m, order):
        if boxes.upper[box] < best:
            continue
        start = boxes.centres_m[box]
        about = Vicinity.of(sectors, profile, terrain, start, NEARBY_M, across=2)
        top, _ = about.climbed(start, FIRST_STEP_M, FINEST_M)
        both = np.array([top, start])
        both = both[np.asarray(terrain.allowed(both))]
        found = exact_scores(both, sectors, profile, terrain)
        if len(found) and found.max() > best:
            best, place = float(found.max()), both[int(np.argmax(found))]
    return place, best


def exact_scores(places_m: Array, sectors: Sectors, profile: Profile, terrain: Terrain) -> Array:
    """Log-likelihoods (n,) of places (n, 2)."""
    boxes, first, last = by_sector(places_m, FINEST_M, sectors, profile, terrain)
    return centre_scores(asked(boxes, first, last, profile), sectors, profile, terrain)


def _apart(places_m: Array, order: Ints) -> list[int]:
    """The first few of the places (n, 2) in that order, but for those close to one that came before."""
    chosen: list[int] = []
    for i in order:
        if len(chosen) < TRIED and all(np.abs(places_m[i] - places_m[k]).max() > APART_M for k in chosen):
            chosen.append(int(i))
    return chosen


def _best(values: Array, count: int) -> Bools:
    keep = np.zeros(len(values), dtype=bool)
    keep[np.argsort(-values, kind="stable")[:count]] = True
    return keep
