"""The posterior of the position: searched over the whole area, then sampled with shared errors and obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from startrack.core.types import Array, Evidence, Explored, Fix, NotLocated, PositionPrior
from startrack.localization.clock import explore_times, is_wide
from startrack.localization.conclusion import conclude
from startrack.localization.hypothesis import Hypothesis, heaviest_first
from startrack.localization.joint_posterior import NO_OTHERS, sample_posterior
from startrack.localization.other_times import sample_other_times
from startrack.localization.position_prior import SearchedNear, name_prior, require_agreement, require_prior_inside
from startrack.localization.search import NATS, search_boxes
from startrack.localization.search_profiles import SLACK_NATS
from startrack.localization.steepness import settle_steepness
from startrack.terrain import Terrain, require_terrain

MIN_ROWS = 8
MIN_ROW_NATS = 1e-3  # |llr| below which a row is left out


@dataclass(frozen=True)
class ExactPosterior:
    """The posterior of position, shared errors and obstacles; see docs/method.md.

    A branch and bound over the search area leaves the boxes that may matter. Its sectors are independent of each other
    and lose little by an obstacle, so that boxes are dropped only where they are less likely than the best place by
    `prune_nats`. In what is left the published model, the chain of obstacles, is sampled. Where the proof would trace
    more horizons than the budget allows, the neighbourhoods of the best places known are, with `search` "beam".
    """

    prune_nats: float = NATS + SLACK_NATS
    budget_horizons: float = 250_000.0  # traced for the proof: some two seconds

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix:
        """Posterior of the camera's position from rows of `evidence` in the enu of the `terrain`.

        Raises NotLocated: insufficient_geometry, outside_search_area, inconsistent_evidence.
        """
        terrain = settle_steepness(evidence, require_terrain(terrain))  # where the chain has settled it, the same
        informative = (np.abs(evidence.llr) > MIN_ROW_NATS) | (evidence.extended_nats > MIN_ROW_NATS)
        informative &= terrain.is_informative(evidence.azimuth_rad, evidence.elevation_rad)
        count = int(np.count_nonzero(informative))
        if count < MIN_ROWS:
            raise NotLocated(f"only {count} rays carry information about the skyline: expose longer")
        rows = evidence if count == len(evidence) else evidence.take(informative)
        try:
            return weigh_parts(self._explore_parts(rows, terrain), terrain)
        except NotLocated as refusal:
            raise name_prior(refusal, rows.near) from refusal

    def _explore_parts(self, rows: Evidence, terrain: Terrain) -> list[Part]:
        """The rows at each likely time, with the boxes that may matter there."""
        if rows.support is not None:
            return [Part(rows, rows.support)]
        if rows.near is not None:
            return [Part(rows, self._explore_near(rows, terrain, rows.near))]
        if rows.clock is not None and is_wide(rows.clock, terrain):
            return [Part(*one) for one in explore_times(rows, terrain, rows.clock)]
        return [Part(rows, self.explore(rows, terrain))]

    def explore(self, evidence: Evidence, terrain: Terrain) -> Explored:
        """The boxes of the `terrain` that may matter by `evidence`."""
        return search_boxes(evidence, terrain, self.prune_nats, self.budget_horizons)[0]

    def _explore_near(self, evidence: Evidence, terrain: Terrain, near: PositionPrior) -> Explored:
        """Boxes that may matter in the neighbourhood of the prior `near`, with its log-density added.

        The searched disk is enlarged until the likeliest place is not at its edge: else nothing would show how far off
        the prior the evidence is. Raises NotLocated: inconsistent_evidence where the two contradict each other,
        outside_search_area where the prior is.
        """
        nearby = SearchedNear(terrain, near)
        require_prior_inside(nearby)
        found, places = search_boxes(evidence, nearby, self.prune_nats, self.budget_horizons)
        while nearby.is_at_edge(places):
            wider = nearby.enlarged()
            try:
                found, places = search_boxes(evidence, wider, self.prune_nats, self.budget_horizons)
            except NotLocated:  # the smaller disk has an answer
                break
            nearby = wider
        require_agreement(places, near)
        return found._replace(log_weight=found.log_weight + near.log_density(found.centres_m))


class Part(NamedTuple):
    """Rows as they stand at a likely time or attitude, and the boxes that may matter there."""

    rows: Evidence
    explored: Explored
    others_m: Array = NO_OTHERS  # positions (n, 2) of other parts; what is nearer to one of them belongs to it


def weigh_parts(parts: Sequence[Part], terrain: Terrain, of_one_sky: bool = True) -> Fix:
    """The fix by all `parts` together, the likeliest first.

    `of_one_sky`: all have the same rows, turned. Else a part counts by how much better its rows suit the map than a
    skyline that is anywhere: it may have rows in more sectors than another one.

    Raises NotLocated: insufficient_geometry, outside_search_area, inconsistent_evidence.
    """
    found = [one for part in parts for one in sample_posterior(part.explored, part.rows, terrain, part.others_m)]
    at_stated = heaviest_first(found if of_one_sky else _weigh_against_free(found))
    return conclude(heaviest_first([*at_stated, *sample_other_times(at_stated)]), terrain, parts[0].explored)


def _weigh_against_free(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses, weighed by how much better than a free skyline each explains its rows."""
    free = [float(one.model.seen.profiles.free.sum()) for one in found]
    best = int(np.argmax([one.log_evidence - nats for one, nats in zip(found, free, strict=True)]))
    return [one.weighed(free[best] - nats) for one, nats in zip(found, free, strict=True)]
