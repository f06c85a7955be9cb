"""A first good place by following the bounds down: where the horizon is costly to ask, or a grid misses its peak."""

from __future__ import annotations

import numpy as np

from startrack.localize.likelihood import Sectors
from startrack.localize.profile import Profile
from startrack.localize.scout import scores, taken
from startrack.localize.search import by_sector, centre_scores, ray_by_ray, split
from startrack.terrain import Terrain
from startrack.types import Array, Bools

KEPT_BOXES, KEPT_SMALL_BOXES = 24, 6  # by each of two measures
SMALL_M = 20.0  # boxes of this half side and less are asked ray by ray
FINEST_M = 0.5
WINDOW_RAD = np.radians(8.0)
LOUDEST_RAYS = 500
FIRST_STEP_M = 128.0
COMPASS = np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)], dtype=np.float64)


def best_by_diving(sectors: Sectors, profile: Profile, terrain: Terrain) -> tuple[Array, float]:
    """A good place (2,) [m] and its log-likelihood: the most promising ones of ever smaller boxes are quartered.

    The log-likelihood is a lower bound of the maximum, usually within a nat or two of it; it decides nothing, but lets
    the search exclude nearly everything at once.
    """
    centres, half = np.zeros((1, 2)), float(terrain.reach_m)
    while True:
        boxes, first, last = by_sector(centres, half, sectors, profile, terrain)
        kept = KEPT_BOXES if half >= SMALL_M else KEPT_SMALL_BOXES
        # By the upper bound alone, places whose bounds are loose would win; by the middle, those with tight ones.
        keep = _best(boxes.upper, kept) | _best(boxes.upper + boxes.lower, kept)
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
            return _climbed(place, best, sectors, terrain)
        keep = _best(score, KEPT_SMALL_BOXES) | _best(small.upper + score, KEPT_SMALL_BOXES)
        small = split(small.take(keep), sectors, profile, terrain)


def _climbed(place_m: Array, best: float, sectors: Sectors, terrain: Terrain) -> tuple[Array, float]:
    """From a place that is nearly right, steps to the best of 8 neighbours, ever shorter, by the loudest rays."""
    rays = sectors.evidence
    off_skyline = np.abs(rays.elevation_rad - terrain.horizon_rad(place_m[None], rays.azimuth_rad))
    loudest = np.argsort(-np.abs(rays.llr) * (off_skyline < WINDOW_RAD), kind="stable")[:LOUDEST_RAYS]
    few = taken(rays, loudest)
    few_sectors = Sectors.of(few, 2 * np.pi / sectors.count, sectors.epsilon)
    at, step, high = place_m, FIRST_STEP_M, -np.inf
    while step >= FINEST_M:
        around = at + step * COMPASS
        around = around[np.asarray(terrain.allowed(around))]
        score = scores(around, few, few_sectors, terrain)
        if len(score) and score.max() > high:
            at, high = around[int(np.argmax(score))], float(score.max())
        else:
            step /= 2
    found = float(scores(at[None], rays, sectors, terrain)[0])
    return (at, found) if found > best else (place_m, best)


def _best(values: Array, count: int) -> Bools:
    keep = np.zeros(len(values), dtype=bool)
    keep[np.argsort(-values, kind="stable")[:count]] = True
    return keep
