"""The exact posterior of the position, by branch and bound over the whole search area."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.localization import compiled
from startrack.localization.branch_and_bound import Boxes, RayBoxes, asked, by_sector, centre_scores, scored, tightened
from startrack.localization.cylinder_shape import CraterFit, marginalised
from startrack.localization.grid_search import likely_places, taken
from startrack.localization.horizon_bias import common_error, marginalised_over_common
from startrack.localization.initial_guess import best_by_diving, exact_scores
from startrack.localization.prefix_sums import Profile
from startrack.localization.rim_plane import cylinder_of
from startrack.localization.sector_likelihood import Sectors
from startrack.localization.summary import smallest_axis, summarize
from startrack.terrain import Cylinder, Terrain
from startrack.terrain.horizon_interpolator import HorizonInterpolator
from startrack.types import Array, Bools, Evidence, Fix, Ints, NotLocated

FEWEST_RAYS = 8
MOST_COARSE_BOXES = 12_000  # boxes of 20 m and more that all might matter: the stars do not say where
MOST_PAIRS = 3_000_000  # (box, ray) pairs of real ground, some 0.3 GB and a minute: what exceeds them takes many
BOXES_AT_ONCE = 2000
CONTRADICTED_NATS = -1.7  # mean over the sectors at the best place; -0.5 is usual, and -9.2 the worst
CLOSEST_NODES_M, FIRST_NODES_M = 10.0, 12.0  # between traced points; half side of the first boxes worth it
WORTH_NODES = 12.0  # horizons traced per open (box, ray) pair, that the levels to come would cost anyhow
MANY_PAIRS = 200_000  # open ones: horizons at the boxes' middles would cost more than they can tell
MOST_PAIRS_NEAR = 0.97  # so many of them within the points; the others are traced as before
LOOKED_UP_RAD = np.radians(0.26)  # height maps look up what is as wide as that, and trace what is narrower
LOUDNESS = ((4.0, np.inf), (2.0, 4.0), (1.0, 2.0), (0.0, 1.0))  # |llr| of rays that are asked in turns
RAY_BY_RAY_M = 20.0  # boxes of this half side and less are asked ray by ray, larger ones sector by sector
NARROW_M, NARROW_PARTS = 60.0, 4  # on real ground, boxes below this half side are asked by quarters of a sector
NARROW_FROM, NARROW_TO = 600, 4000  # as many boxes as are worth it, and as few as can be traced in seconds
NARROW_TURNS = 6
FINEST_ON_GROUND_M = 0.45  # half side: no height map knows its ground better; the boxes' size is in the covariance
SMOOTH = 0.6  # of the boxes are enough on real ground, whose many soft edges leave no cells: sums of Gaussians converge


@dataclass(frozen=True)
class ExactPosterior:
    """log P(p | evidence) = sum over sectors of the capped sums of l_i V_i(p), uniform prior on the search area.

    The area is cut into boxes; each ray is certainly visible, certainly hidden or open over a box, which bounds the
    box's likelihood. Boxes that cannot matter are dropped (their total probability is bounded and stated), the others
    are quartered until they are small against the posterior's own spread. All modes are found; nothing is guessed.
    """

    sector_width_rad: float = float(np.radians(1.5))
    sector_epsilon: float = 1e-4
    prune_nats: float = 16.0  # boxes whose best place is e^-16 as likely as the best known one are dropped
    negligible_nats: float = 18.0  # and so are those that hold at most e^-18 of the probability
    finest_m: float = 0.05
    boxes_per_sigma: float = 1.8  # boxes are quartered until this many fit into the posterior's smaller axis
    most_boxes: int = 40_000
    compiled: bool = False  # with numba, for a cylinder with hard edges: the same answer, 10 to 50 times sooner

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix:
        """Posterior of the camera's position on a `terrain`.

        Raises NotLocated (insufficient_geometry, outside_search_area).
        """
        told = (np.abs(evidence.llr) > 1e-3) & terrain.is_informative(evidence.azimuth_rad, evidence.elevation_rad)
        if told.sum() < FEWEST_RAYS:
            raise NotLocated(f"only {int(told.sum())} rays say anything about the skyline: expose longer")
        evidence, error_rad = taken(evidence, told), 0.0
        if isinstance(terrain, Cylinder) and (terrain.depth_sigma_m > 0 or terrain.diameter_sigma_m > 0):
            (centres, half, log_weight, log_dropped), _ = marginalised(self._explored, evidence, terrain)
        elif terrain.common_sigma_rad > 0:
            first = _Search(self, evidence, terrain)
            common = common_error(evidence, terrain, first.place_m, first.sectors, first.profile)
            error_rad = common.error_rad
            centres, half, log_weight, log_dropped = marginalised_over_common(
                lambda rays, place: self._explored(rays, terrain, place), evidence, terrain, common
            )
        else:
            centres, half, log_weight, log_dropped = self._explored(evidence, terrain)
        dropped = float(np.exp(min(log_dropped - _log_mass(log_weight, half), 0.0)))
        fix = summarize(centres, 2 * half, log_weight, dropped, terrain)
        return replace(fix, horizon_error_rad=error_rad) if error_rad else fix

    def crater(self, evidence: Evidence, cylinder: Cylinder) -> CraterFit:
        """Depth and diameter of a cylinder with uncertain ones, estimated together with the position."""
        return marginalised(self._explored, evidence, cylinder)[1]

    def _explored(
        self, evidence: Evidence, terrain: Terrain, place_m: Array | None = None
    ) -> tuple[Array, float, Array, float]:
        """Centres (n, 2) of equal boxes, half side, log-likelihoods (n,) there, log of a bound on the mass dropped.

        `place_m` is a good place if one is known.
        """
        if self.compiled and compiled.applies(evidence, terrain):
            return compiled.explored(self, evidence, cylinder_of(terrain))
        search = _Search(self, evidence, terrain, place_m)
        boxes = search.refine(search.exclude())
        return boxes.centres_m, boxes.half_m, search.scores(boxes), search.log_dropped


class _Search:
    """One run: what is known of the best place, and how much probability was given up."""

    def __init__(
        self, method: ExactPosterior, evidence: Evidence, terrain: Terrain, place_m: Array | None = None
    ) -> None:
        self.method, self.terrain, self.ground = method, terrain, terrain
        self.on_heights = not isinstance(terrain, Cylinder)
        self.finest_m = max(method.finest_m, FINEST_ON_GROUND_M) if self.on_heights else method.finest_m
        self.place_m = np.zeros(2)  # a good one to begin with
        self.sectors = Sectors.of(evidence, method.sector_width_rad, method.sector_epsilon)
        self.profile = Profile.of(self.sectors)
        if not self.on_heights:
            self.best = float(likely_places(evidence, self.sectors, terrain)[1].max(initial=-np.inf))
        elif place_m is not None and np.all(terrain.allowed(place_m)):
            self.place_m = place_m
            self.best = float(exact_scores(place_m[None], self.sectors, self.profile, terrain)[0])
        else:  # real ground: horizons are costly, and the peak is narrower than any grid's step
            self.place_m, self.best = best_by_diving(self.sectors, self.profile, terrain)
        self.log_dropped = -np.inf

    def exclude(self) -> RayBoxes:
        """From the whole area down to small boxes. Raises NotLocated where too much stays open."""
        known_bad = -np.inf < self.best < CONTRADICTED_NATS * self.sectors.count
        if known_bad and self.on_heights:
            raise self._lost(np.pi * self.terrain.reach_m**2)  # nothing could be excluded, at great length
        centres, half, of = np.zeros((1, 2)), float(self.terrain.reach_m), np.zeros(1, dtype=np.int64)
        known: tuple[Ints, Ints] | None = None  # open rays of the boxes that the centres are quarters of
        while True:
            if known is None:
                boxes, first, last = self._bounded(centres, half)
            else:
                boxes, first, last = self._closer(centres, half, of, *known)
            if len(boxes) > MOST_COARSE_BOXES:
                raise self._lost(len(boxes) * 4 * half**2)
            if half < RAY_BY_RAY_M:
                if (last - first).sum() > MOST_PAIRS:
                    raise self._lost(len(boxes) * 4 * half**2)
                return self._asked_in_turns(asked(boxes, first, last, self.profile))
            (centres, of), half = boxes.quarters(self.terrain), half / 2
            if known is not None:
                known = first, last
            elif half < NARROW_M and NARROW_FROM < len(centres) <= NARROW_TO and self.on_heights:
                # From here on a ray's number is one of the new profile.
                whole, self.profile = self.profile, Profile.of(self.sectors, NARROW_PARTS)
                known = self.profile.handed_down(whole, first, last)

    def _bounded(self, centres: Array, half: float) -> tuple[Boxes, Ints, Ints]:
        """The promising ones of the boxes with their open rays, some at a time so that memory stays flat."""
        if not len(centres):
            raise NotLocated(
                "nowhere in the search area can the camera stand: is [search] max_slope_deg too small?",
                reason="outside_search_area",
            )
        kept = []
        for start in range(0, len(centres), BOXES_AT_ONCE):
            some = centres[start : start + BOXES_AT_ONCE]
            boxes, first, last = by_sector(some, half, self.sectors, self.profile, self.terrain)
            keep = self._promising(boxes)
            kept.append((boxes.take(keep), first[keep], last[keep]))
        return _joined(kept, half)

    def _closer(self, centres: Array, half: float, of: Ints, first: Ints, last: Ints) -> tuple[Boxes, Ints, Ints]:
        """Likewise, by parts of a sector, traced anew where the boxes that these are quarters of left rays open.

        Within a whole sector the horizon itself varies more than over a small box; but looking closer costs more, so
        some sectors are asked at a time: few suffice to exclude most boxes.
        """
        turns = np.arange(len(self.profile.ends)) // NARROW_PARTS % NARROW_TURNS
        kept = []
        for start in range(0, len(centres), BOXES_AT_ONCE):
            some = slice(start, start + BOXES_AT_ONCE)
            at, low, high = centres[some], first[of[some]], last[of[some]]
            for turn in range(NARROW_TURNS):
                low, high = self.profile.closer(self.terrain, at, half, low, high, turns == turn)
                boxes = scored(at, half, low, high, self.sectors, self.profile)
                keep = self._promising(boxes)
                boxes, at, low, high = boxes.take(keep), at[keep], low[keep], high[keep]
            kept.append((boxes, low, high))
        return _joined(kept, half)

    def _lost(self, open_m2: float) -> NotLocated:
        """Why so much of the area stays open: nothing fits, or everything does."""
        if self.best < CONTRADICTED_NATS * self.sectors.count:
            return NotLocated(
                "no place explains the stars: wrong terrain, time or camera file?", reason="inconsistent_evidence"
            )
        return NotLocated(
            f"the rays leave {open_m2 / 1e6:.1f} km2 of the search area open: "
            "is the skyline in the picture, the exposure long enough, the map fine enough nearby?"
        )

    def refine(self, boxes: RayBoxes) -> RayBoxes:
        """Quartered until small against the posterior's spread."""
        while True:
            more = 4 * len(boxes) <= self.method.most_boxes and boxes.half_m > self.finest_m
            if len(boxes.ray) > MANY_PAIRS and more:
                boxes = boxes.take(self._promising(boxes))
                if len(boxes.ray) > MOST_PAIRS:
                    raise self._lost(len(boxes) * 4 * boxes.half_m**2)
                boxes = self._asked_in_turns(boxes.handed_down(self.terrain))
                continue
            score = self.scores(boxes)
            self.best = max(self.best, float(score.max(initial=-np.inf)))
            keep = self._promising(boxes)
            boxes, score = boxes.take(keep), score[keep]
            wide = self._width_over_limit(boxes, score)
            if wide < 1:
                return boxes
            self._look_closer(boxes)
            boxes = boxes.handed_down(self.terrain)
            if not 1 < wide < 2:  # else these are the last, which are not quartered: their likelihoods suffice
                boxes = self._asked_in_turns(boxes)

    def _asked_in_turns(self, boxes: RayBoxes) -> RayBoxes:
        """The boxes bounded ray by ray: the loudest first, since few suffice to exclude most boxes."""
        if not self.on_heights:
            return tightened(boxes, None, self.sectors, self.profile, self.ground)
        if self.ground is self.terrain and boxes.half_m > RAY_BY_RAY_M / 2:
            boxes = tightened(boxes, None, self.sectors, self.profile, self.terrain, LOOKED_UP_RAD)
            boxes = boxes.take(self._promising(boxes))
        for softest, loudest in LOUDNESS:
            loudness = np.abs(self.profile.evidence.llr[boxes.ray])
            which = (loudness >= softest) & (loudness < loudest)
            boxes = tightened(boxes, which, self.sectors, self.profile, self.ground)
            boxes = boxes.take(self._promising(boxes))
        return boxes

    def _look_closer(self, boxes: RayBoxes) -> None:
        """Where most boxes lie close together, horizons are interpolated between points that are traced once.

        And again between closer ones where many azimuths are too rough for that.
        """
        if not self.on_heights or not len(boxes.ray) or boxes.half_m > FIRST_NODES_M:
            return
        step = max(2 * boxes.half_m, CLOSEST_NODES_M)
        traced = 1.0
        if isinstance(self.ground, HorizonInterpolator):
            if step > 0.6 * self.ground.step_m:
                return
            traced = self.ground.traced_part(boxes.centres_m[boxes.box], self.profile.evidence.azimuth_rad[boxes.ray])
        middle = np.median(boxes.centres_m[boxes.box], axis=0)
        away = np.abs(boxes.centres_m - middle).max(axis=1)[boxes.box]
        half = float(np.quantile(away, MOST_PAIRS_NEAR)) + boxes.half_m
        across = max(3, int(np.ceil(2 * half / step)) + 1)
        rays = np.unique(boxes.ray[away < half])
        if across**2 * len(rays) < WORTH_NODES * traced * len(boxes.ray):
            self.ground = self.terrain.near(middle, half, self.profile.evidence.azimuth_rad[rays], across)

    def scores(self, boxes: RayBoxes) -> Array:
        """Log-likelihood (n,) at the centres, minus infinity where the camera cannot be."""
        score = centre_scores(boxes, self.sectors, self.profile, self.ground)
        return np.where(self.terrain.allowed(boxes.centres_m), score, -np.inf)

    def _promising(self, boxes: Boxes) -> Bools:
        """Which boxes (n,) might matter; the others' probability is added to what was given up."""
        sure = boxes.lower[np.asarray(self.terrain.allowed(boxes.centres_m))]
        self.best = max(self.best, float(sure.max(initial=-np.inf)))
        negligible = _log_mass(sure, boxes.half_m) - self.method.negligible_nats - np.log(4 * boxes.half_m**2)
        keep = boxes.upper > max(self.best - self.method.prune_nats, negligible)
        self.log_dropped = np.logaddexp(self.log_dropped, _log_mass(boxes.upper[~keep], boxes.half_m))
        return keep

    def _width_over_limit(self, boxes: RayBoxes, log_weight: Array) -> float:
        """How many times wider the boxes are than need be; 0 where they shall not be quartered anyway."""
        if not np.isfinite(log_weight).any():
            return np.inf
        if boxes.half_m <= self.finest_m or 4 * len(boxes) > self.method.most_boxes or not len(boxes.ray):
            return 0.0
        smaller = smallest_axis(boxes.centres_m, 2 * boxes.half_m, log_weight)
        many = self.method.boxes_per_sigma * (SMOOTH if self.on_heights else 1.0)
        return 2 * boxes.half_m * many / max(smaller, 1e-9)


def _joined(parts: list[tuple[Boxes, Ints, Ints]], half: float) -> tuple[Boxes, Ints, Ints]:
    columns = [(boxes.centres_m, boxes.lower, boxes.upper, first, last) for boxes, first, last in parts]
    centres, lower, upper, first, last = (np.concatenate(column) for column in zip(*columns, strict=True))
    return Boxes(centres, half, lower, upper), first, last


def _log_mass(log_density: Array, half_m: float) -> float:
    top = float(np.max(log_density, initial=-np.inf))
    if not np.isfinite(top):
        return -np.inf
    return top + float(np.log(np.sum(np.exp(log_density - top)) * 4 * half_m * half_m))
