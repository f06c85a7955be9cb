"""The posterior of the position: searched over the whole area or near a prior, then sampled with all errors.

Before that, the rows of one image decide how steep a crater is whose depth and width are not known: a round crater of
another size looks the same from a position as much farther from its axis. Rows so show its depth over its width, and
the position over its width. The tangent of the skyline is searched in steps, over all positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from startrack.core.types import Array, Bools, Evidence, Explored, Fix, NotLocated, PositionPrior
from startrack.localization.clock import explore_times, is_wide, sample_other_times
from startrack.localization.conclusion import conclude
from startrack.localization.hypothesis import Hypothesis, heaviest_first
from startrack.localization.joint_posterior import NO_OTHERS, sample_posterior
from startrack.localization.search import BEAMS, NATS, BoxModel, Place, search_boxes
from startrack.localization.search_profiles import SLACK_NATS
from startrack.terrain import ForwardingTerrain, Terrain, require_terrain

DISK_SIGMAS = 6.0  # of the prior, to the edge of the first disk
LEAST_REACH_M = 300.0  # of that radius: in a smaller disk few edges of evidence show which way is likelier
EDGE_PART, ENLARGED = 0.7, 3.0  # of the disk's radius, where its edge begins; factor of the next radius
CONTRADICTED_SIGMAS = 4.5  # of evidence and prior together: a true prior is farther off once in 25,000 images
STEEPNESS_SIGMAS = 3.0  # of what is stated, to the last steepness that is tried
STEEPNESS_STEP = 0.08  # of its logarithm, between two that are tried: the likelihood falls evenly over thirty of them
FINEST_STEP = 1e-3  # the shape's errors are expanded about the one found
MOST_STEEPNESSES = 3  # that the likelihood is followed from
MIN_ROWS = 8
MIN_ROW_NATS = 1e-3  # |llr| below which a row is left out


class SearchedNear(ForwardingTerrain):
    """A terrain of which the neighbourhood of a prior's mean is searched."""

    def __init__(self, whole: Terrain, near: PositionPrior, radius_m: float | None = None) -> None:
        super().__init__(whole)
        self.near_prior, self.radius_m = near, radius_m or max(DISK_SIGMAS * near.sigma_m, LEAST_REACH_M)

    @property
    def searched(self) -> tuple[float, float, float]:  # type: ignore[override]
        """Disk of the prior: east and north of its middle, and its radius [m]."""
        return float(self.near_prior.east_m), float(self.near_prior.north_m), float(self.radius_m)

    def allowed(self, points_m: Array) -> Bools:
        """Whether a camera could stand at the points (..., 2), within the disk."""
        east, north, reach = self.searched
        inside = np.hypot(points_m[..., 0] - east, points_m[..., 1] - north) <= reach
        return np.asarray(inside & self.whole.allowed(points_m))

    def is_at_edge(self, places: list[Place]) -> bool:
        """Whether the likeliest of `places` is at the edge of the disk, within the search area."""
        if self.radius_m > 2 * self.reach_m or not places:
            return False
        return bool(np.linalg.norm(places[0].position_m - self.near_prior.mean_m) > EDGE_PART * self.radius_m)

    def enlarged(self) -> SearchedNear:
        """Copy of this terrain with a larger disk."""
        return SearchedNear(self.whole, self.near_prior, ENLARGED * self.radius_m)


def require_prior_inside(nearby: SearchedNear) -> None:
    """Raise NotLocated (outside_search_area) where no part of the disk of a prior is in the search area."""
    east_m, north_m, radius_m = nearby.searched
    away_m = float(np.hypot(east_m, north_m))
    if away_m > nearby.reach_m + radius_m:
        raise NotLocated(
            f"--near {nearby.near_prior} is {away_m:.0f} m from the origin of the terrain, and the radius of its "
            f"search area is {nearby.search_radius_m:.0f} m",
            reason="outside_search_area",
        )


def require_agreement(places: list[Place], near: PositionPrior) -> None:
    """Raise NotLocated (inconsistent_evidence) where the prior contradicts the likely `places`, the best first.

    Of two normal distributions the maximum of the product lies chi^2 / 2 below the product of the maxima.
    """
    if not places:
        return
    off = np.array([one.position_m for one in places]) - near.mean_m
    both = np.array([one.covariance_m2 for one in places]) + near.sigma_m**2 * np.eye(2)
    chi2 = np.einsum("ni,ni->n", off, np.linalg.solve(both, off[:, :, None])[:, :, 0])
    lost = places[0].log_likelihood - max(one.log_likelihood - 0.5 * c for one, c in zip(places, chi2, strict=True))
    if lost > 0.5 * CONTRADICTED_SIGMAS**2:
        raise contradiction(near, f"lie {np.sqrt(2 * lost):.1f} sigma from it")


def contradiction(near: PositionPrior, how: str) -> NotLocated:
    """The refusal of evidence that contradicts the prior."""
    return NotLocated(
        f"the positions that the image allows {how}, the prior --near {near}: is it right, and its sigma large enough?",
        reason="inconsistent_evidence",
    )


def name_prior(refusal: NotLocated, near: PositionPrior | None) -> NotLocated:
    """The `refusal`, with the prior in its message where there is one: a wrong prior causes it too."""
    if near is None or "--near" in str(refusal):
        return refusal
    evidence: dict[str, Any] = refusal.evidence
    return NotLocated(
        f"{refusal} (searched within 6 sigma of --near {near}: is it right?)", reason=refusal.reason, **evidence
    )


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


@dataclass(frozen=True)
class ExactPosterior:
    """The posterior of position, shared errors and obstacles; see docs/method.md.

    A branch and bound over the search area leaves the boxes that may matter. Its sectors are independent of each other
    and lose little by an obstacle, so that boxes are dropped only where they are less likely than the best place by
    `prune_nats`. In what is left the published model, the chain of obstacles, is sampled. Where the proof would trace
    more horizons than the budget allows, the neighbourhoods of the best places known are: `Fix.search` is then "beam".
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
        """The rows at each likely time, with the boxes that may matter there.

        After an earlier fix nothing is searched: its points stand for boxes, the heaviest first.
        """
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
    found = [one for part in parts for one in sample_posterior(*part[:2], terrain, part.others_m)]
    at_stated = heaviest_first(found if of_one_sky else _weigh_against_free(found))
    return conclude(heaviest_first([*at_stated, *sample_other_times(at_stated)]), terrain, parts[0].explored)


def _weigh_against_free(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses, weighed by how much better than a free skyline each explains its rows."""
    free = [float(one.model.seen.profiles.free.sum()) for one in found]
    best = int(np.argmax([one.log_evidence - nats for one, nats in zip(found, free, strict=True)]))
    return [one.weighed(free[best] - nats) for one, nats in zip(found, free, strict=True)]
