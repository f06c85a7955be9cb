"""A first good place by following the promise of ever smaller boxes: where the horizon is costly to ask."""

from __future__ import annotations

import numpy as np

from startrack.localization.box_average import Blurred
from startrack.localization.branch_and_bound import CHILDREN, asked, by_sector, centre_scores, holds_ground
from startrack.localization.local_search import Vicinity
from startrack.localization.prefix_sums import Profile
from startrack.localization.sector_likelihood import Sectors
from startrack.terrain import Terrain
from startrack.types import Array, Ints

DIVES = ((32, 16), (128, 64), (512, 96))  # boxes kept at each level, and scored ray by ray; more where fewer fail
GOOD_NATS = -0.6  # mean over the sectors; -0.5 is usual at the best place
SMALL_M = 20.0  # half side of the last boxes
TRIED, APART_M = 3, 60.0  # places from which the top is climbed, and how far they are apart
FINEST_M = 0.5
NEARBY_STEPS_M = np.linspace(-14.0, 14.0, 15)
CLIMBS = ((45.0, 16.0, 2), (15.0, 4.0, 3))  # how far [m], first step [m], points across where horizons are traced


def best_by_diving(sectors: Sectors, profile: Profile, terrain: Terrain) -> tuple[Array, float]:
    """A good place (2,) [m] and its log-likelihood: the most promising ones of ever smaller boxes are quartered.

    The log-likelihood is a lower bound of the maximum, usually within a nat or two of it, that lets the search exclude
    nearly everything at once. Minus infinity where no place was found.
    """
    blurred = Blurred.of(sectors, profile)
    place, best = np.zeros(2), -np.inf
    for width, scored in DIVES:
        centres, half = _promising(blurred, terrain, width)
        found, score = _climbed(centres[:scored], half, sectors, profile, terrain)
        if score > best:
            place, best = found, score
        if best > GOOD_NATS * sectors.count:
            break
    return place, best


def exact_scores(places_m: Array, sectors: Sectors, profile: Profile, terrain: Terrain) -> Array:
    """Log-likelihoods (n,) of places (n, 2)."""
    boxes, first, last = by_sector(places_m, FINEST_M, sectors, profile, terrain)
    return centre_scores(asked(boxes, first, last, profile), sectors, profile, terrain)


def _promising(blurred: Blurred, terrain: Terrain, width: int) -> tuple[Array, float]:
    """Centres (n, 2) of small boxes, the most promising first, and their half side."""
    centres, half = np.zeros((1, 2)), float(terrain.reach_m)
    while half > SMALL_M:
        half /= 2
        centres = (centres[:, None, :] + half * CHILDREN).reshape(-1, 2)
        centres = centres[holds_ground(terrain, centres, half)]
        centres = centres[np.argsort(-blurred.score(terrain, centres, half), kind="stable")[:width]]
    return centres, half


def _climbed(
    centres_m: Array, half_m: float, sectors: Sectors, profile: Profile, terrain: Terrain
) -> tuple[Array, float]:
    """The best place (2,) near those of the boxes (n, 2) that score best, and its log-likelihood."""
    best, place = -np.inf, np.zeros(2)
    if not len(centres_m):
        return place, best
    boxes, first, last = by_sector(centres_m, half_m, sectors, profile, terrain)
    score = centre_scores(asked(boxes, first, last, profile), sectors, profile, terrain)
    for box in _apart(centres_m, np.argsort(-score, kind="stable")):
        if boxes.upper[box] < best:
            continue
        ways = [centres_m[box]]
        for nearby_m, first_step_m, across in CLIMBS:
            about = Vicinity.of(sectors, profile, terrain, ways[-1], nearby_m, across=across)
            ways.append(about.climbed(ways[-1], first_step_m, FINEST_M)[0])
        places = _where_allowed(np.array(ways), about, terrain)
        found = exact_scores(places, sectors, profile, terrain)
        if len(found) and found.max() > best:
            best, place = float(found.max()), places[int(np.argmax(found))]
    return place, best


def _where_allowed(places_m: Array, about: Vicinity, terrain: Terrain) -> Array:
    """Those of the places (n, 2) where a camera can stand; where it can at none, the best one nearby, if any."""
    allowed = np.asarray(terrain.allowed(places_m))
    if allowed.any():
        return places_m[allowed]
    around = places_m[-1] + np.stack(np.meshgrid(NEARBY_STEPS_M, NEARBY_STEPS_M), axis=-1).reshape(-1, 2)
    around = around[np.asarray(terrain.allowed(around))]
    return around[np.argsort(-about.scores(around))[:1]]


def _apart(places_m: Array, order: Ints) -> list[int]:
    """The first few of the places (n, 2) in that order, but for those close to one that came before."""
    chosen: list[int] = []
    for i in order:
        if len(chosen) < TRIED and all(np.abs(places_m[i] - places_m[k]).max() > APART_M for k in chosen):
            chosen.append(int(i))
    return chosen
