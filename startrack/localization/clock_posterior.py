"""The error of the clock is estimated with the position, and marginalised.

In a round crater nothing shows the turn of the sky, and the position lies on an arc. On real ground the evidence shows
both.
"""

from __future__ import annotations

import numpy as np

from startrack.localization.clock import clock_matters, turn_evidence
from startrack.localization.clock_track import LIKELY_NATS, Explore, Track
from startrack.localization.explored import Explored
from startrack.localization.summary import smallest_axis
from startrack.terrain import Terrain
from startrack.types import Array, Clock, ClockError, Evidence

STEP_SIGMAS = 0.5  # of the posterior, between two copies of it along the way
MOST_BOXES = 400_000  # of all copies


def marginalize_clock(explore: Explore, explore_plain: Explore, evidence: Evidence, terrain: Terrain) -> Explored:
    """The position's posterior over all times that the clock allows, explored at the likeliest, copied to the others.

    `evidence` may have a clock; `explore` marginalises the other errors, `explore_plain` none. Raises NotLocated as
    these do.
    """
    clock = evidence.clock
    if clock is None:
        return explore(evidence, terrain)
    if not clock_matters(clock, terrain):
        return explore(evidence, terrain)._replace(clock=ClockError(0.0, clock.sigma_s))
    track = Track(evidence, terrain, clock, explore_plain)
    later_s, log_share, way_m = track.likely_way()
    best = int(np.argmax(log_share))
    found = explore(turn_evidence(evidence, float(later_s[best])), terrain)
    return _spread(found, clock, later_s, log_share, way_m - way_m[best], terrain)


def spread_on_arc(found: Explored, explore_plain: Explore, evidence: Evidence, terrain: Terrain) -> Explored:
    """A posterior at the time of the `evidence`, of an axisymmetric `terrain`, over all times that the clock allows.

    `explore_plain` gives the positions at these times from the evidence. Raises NotLocated as it does.
    """
    clock = evidence.clock
    if clock is None or not clock_matters(clock, terrain):
        return found
    later_s, log_share, way_m = Track(evidence, terrain, clock, explore_plain).likely_way()
    now = np.array([np.interp(0.0, later_s, along) for along in way_m.T])
    return _spread(found, clock, later_s, log_share, way_m - now, terrain)


def _spread(
    found: Explored, clock: Clock, later_s: Array, log_share: Array, steps_m: Array, terrain: Terrain
) -> Explored:
    """The posterior copied to times (n,) with their shares (n,), by steps (n, 2) of the position."""
    share = np.exp(log_share - log_share.max())
    share /= share.sum()
    mean_s = float(share @ later_s)
    sigma_s = float(np.sqrt(share @ np.square(later_s - mean_s)))
    moved = _copy_along(found, steps_m, share, terrain)
    return moved._replace(clock=ClockError(clock.offset_s + mean_s, sigma_s))


def _copy_along(found: Explored, steps_m: Array, share: Array, terrain: Terrain) -> Explored:
    """The posterior copied to each of the steps (n, 2) with its share (n,) of the probability."""
    top = found.log_likelihood.max(initial=-np.inf)
    keep = found.log_likelihood > top - LIKELY_NATS
    centres, log = found.centres_m[keep], found.log_likelihood[keep]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(steps_m, axis=0), axis=1))])
    narrow = smallest_axis(centres, 2 * found.half_m, log)
    apart = max(STEP_SIGMAS * narrow, found.half_m, way[-1] * len(log) / MOST_BOXES)
    group = np.floor(way / apart).astype(np.int64)  # steps that lie closer together make one copy
    mass = np.bincount(group, weights=share)
    used = mass > 0.0
    middle = np.stack([np.bincount(group, weights=share * along)[used] / mass[used] for along in steps_m.T], axis=1)
    points = (centres + middle[:, None]).reshape(-1, 2)
    inside = np.asarray(terrain.allowed(points))
    weights = (log + np.log(mass[used])[:, None]).ravel()
    return found._replace(centres_m=points[inside], log_likelihood=weights[inside])
