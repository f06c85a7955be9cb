"""Branch and bound over the searched square: all positions that can matter are refined, all others excluded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from startrack.localization.box_kernel import bound_boxes, prune_nats_of_box, refine_disks
from startrack.localization.boxes import NO_NUMBERS, Boxes, open_pairs, split_boxes
from startrack.localization.explored import BudgetSpent, Explored, log_sum
from startrack.localization.initial_guess import Guess, beam_search, holds_allowed_ground
from startrack.localization.likelihood import PARTS, PositionLikelihood
from startrack.localization.search_settings import SearchSettings
from startrack.localization.summary import smallest_axis
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Ints, NotLocated

BOXES_AT_ONCE = 2000  # so that memory stays flat
ROW_BY_ROW_M = 20.0  # boxes of this half side and less are bounded row by row, larger ones sector by sector
PARTS_BELOW_M, PARTS_FROM, PARTS_TO = 60.0, 600, 4000  # half side, and numbers of boxes, bounded by parts of sectors
PARTS_TURNS = 6
LOOKED_UP_RAD = np.radians(0.26)  # height maps look up what is as wide as that, and trace what is narrower
LLR_TIERS = ((4.0, np.inf), (2.0, 4.0), (1.0, 2.0), (0.0, 1.0))  # |llr| of rows that are bounded in turns
MAX_SCORED_PAIRS = 200_000  # open (box, row) pairs above which horizons at the boxes' centres cost more than they gain
SOFT_BOXES = 0.3  # of the boxes per sigma suffice where edges are soft: sums of Gaussians converge, and leave no cells
UNLIKELY_NATS = 16.0  # boxes that are less likely than the best by more are no part of the posterior
START_LLR, START_ROWS, START_HALF_M = 4.0, 1000, 3.0  # |llr| and least number of strong rows; their smallest boxes
NODE_STEP_M, FIRST_NODES_M = 10.0, 12.0  # least distance of traced points; half side of the first boxes worth it
WORTH_NODES = 12.0  # horizons traced per open pair, which the levels to come would cost anyhow
PAIRS_NEAR_NODES = 0.97  # of the pairs lie within the points; the others are traced
LOOK_UP_COST, INTERPOLATION_COST, BOX_COST = 0.08, 0.03, 2.0  # a look-up, an interpolation, a traced box; in horizons


@dataclass
class Search:
    """One run: the best log-likelihood known, the work done, and how much probability was dropped."""

    settings: SearchSettings
    likelihood: PositionLikelihood
    guess: Guess
    ground: Terrain  # the terrain, or the same with horizons prepared near the best position
    node_step_m: float = np.inf
    best: float = -np.inf
    certain: float = -np.inf
    log_dropped: float = -np.inf
    work: float = 0.0  # in horizons traced

    @classmethod
    def begin(cls, settings: SearchSettings, likelihood: PositionLikelihood, starts_m: Array | None = None) -> Search:
        """With good positions (n, 2) where some are known, else with the first guess."""
        known = np.zeros((0, 2)) if starts_m is None else starts_m
        if likelihood.in_closed_form and not len(known):
            known = cls._best_of_strong_rows(settings, likelihood)
        known = known[np.asarray(likelihood.terrain.allowed(known))]
        if len(known) or likelihood.in_closed_form:
            guess = Guess(known, likelihood.exact_scores(known))
        else:
            guess = beam_search(likelihood)
        return cls(settings, likelihood, guess, likelihood.terrain, best=guess.best)

    @classmethod
    def _best_of_strong_rows(cls, settings: SearchSettings, likelihood: PositionLikelihood) -> Array:
        """The position (1, 2) that explains the rows of great |llr| best; (0, 2) where these are few, or most rows.

        Bounds in closed form cost so little that few rows need no guess. Of many rows the strong ones give one for a
        fraction of the cost; with it the others exclude most boxes at once.
        """
        strong = likelihood.strong(START_LLR, START_ROWS)
        if 2 * len(strong.evidence) > len(likelihood.evidence):
            return np.zeros((0, 2))
        guess = Guess(np.zeros((0, 2)), np.zeros(0))
        boxes = cls(settings, strong, guess, strong.terrain)._refine_by_disks(strong.root, START_HALF_M)
        return boxes.centres_m[np.argsort(-boxes.score)[:1]]

    @property
    def terrain(self) -> Terrain:
        return self.likelihood.terrain

    def run(self) -> Explored:
        """The posterior. Raises NotLocated, and BudgetSpent where the proof would take too long."""
        if self.likelihood.in_closed_form:
            boxes = self._refine_by_disks(self.likelihood.root, self.settings.finest_m)
        else:
            boxes = self._refine(self._exclude_by_sectors())
        # Which unlikely boxes are left depends on how tight the terrain's bounds are; the likely ones do not.
        top, mass = float(boxes.score.max(initial=-np.inf)), log_sum(boxes.score)
        keep = boxes.score > max(
            top - max(self.settings.prune_nats, UNLIKELY_NATS), mass - self.settings.negligible_nats
        )
        lost = log_sum(boxes.score[~keep]) + float(np.log(4 * boxes.half_m**2))
        self.log_dropped = float(np.logaddexp(self.log_dropped, lost))
        return Explored(boxes.centres_m[keep], boxes.half_m, boxes.score[keep], self.log_dropped, "proven")

    def _exclude_by_sectors(self) -> Boxes:
        """From the whole square to boxes of `ROW_BY_ROW_M`, with look-ups of whole sectors or of their parts."""
        lk, terrain = self.likelihood, self.terrain
        centres, half, parent = np.array([terrain.searched[:2]]), terrain.searched[2], np.zeros(1, dtype=np.int64)
        known: tuple[Ints, Ints] | None = None  # open rows of the parts, once these are bounded
        while True:
            if known is None:
                centres, first, last = self._bound_sectors(centres, half)
            else:
                centres, first, last = self._bound_parts(centres, half, parent, *known)
            if half < ROW_BY_ROW_M:
                if known is None:
                    first, last = lk.part_sums.split(lk.sums, first, last)
                boxes = lk.boxes_by_rows(centres, half, first, last)
                self._spend(LOOK_UP_COST * len(boxes.row), boxes)
                return self._bound_by_llr_tier(boxes)
            quarters, parent = split_boxes(centres, half, terrain.searched)
            half /= 2
            holds = holds_allowed_ground(terrain, quarters, half)
            centres, parent = quarters[holds], parent[holds]
            if known is not None:
                known = first, last
            elif half < PARTS_BELOW_M and PARTS_FROM < len(centres) <= PARTS_TO:
                known = lk.part_sums.split(lk.sums, first, last)

    def _bound_sectors(self, centres: Array, half: float) -> tuple[Array, Ints, Ints]:
        """Centres (n, 2) of the boxes that may matter, and their open rows (n, sectors)."""
        if not len(centres):
            raise NotLocated(
                "no camera can stand anywhere in the search area: is [search] max_slope_deg too small?",
                reason="outside_search_area",
            )
        lk = self.likelihood
        kept: list[tuple[Array, Array, Ints, Ints]] = []
        for start in range(0, len(centres), BOXES_AT_ONCE):
            some = centres[start : start + BOXES_AT_ONCE]
            first, last = lk.sums.open_rays(self.terrain, some, half)
            keep, upper = self._keep(some, half, *lk.sums.sums(first, last))
            kept.append((some[keep], upper, first[keep], last[keep]))
            self._spend_on_boxes(LOOK_UP_COST * first.size, kept, half)
        centres, _, first, last = (np.concatenate(part) for part in zip(*kept, strict=True))
        return centres, first, last

    def _bound_parts(
        self, centres: Array, half: float, parent: Ints, first: Ints, last: Ints
    ) -> tuple[Array, Ints, Ints]:
        """As `_bound_sectors`, by parts of sectors, and only for rows that are open in the parent box.

        Within a whole sector the horizon itself varies more than over a small box. Some sectors are bounded at a time:
        few suffice to exclude most boxes.
        """
        sums = self.likelihood.part_sums
        turns = np.arange(len(sums.ends)) // PARTS % PARTS_TURNS
        kept: list[tuple[Array, Array, Ints, Ints]] = []
        for start in range(0, len(centres), BOXES_AT_ONCE):
            some = slice(start, start + BOXES_AT_ONCE)
            at, low, high, upper = centres[some], first[parent[some]], last[parent[some]], np.zeros(0)
            for turn in range(PARTS_TURNS):
                self._spend_on_boxes(BOX_COST * np.count_nonzero((low < high) & (turns == turn)), kept, half)
                low, high = sums.refine_bounds(self.terrain, at, half, low, high, turns == turn)
                keep, upper = self._keep(at, half, *sums.sums(low, high))
                at, low, high = at[keep], low[keep], high[keep]
            kept.append((at, upper, low, high))
        centres, _, first, last = (np.concatenate(part) for part in zip(*kept, strict=True))
        return centres, first, last

    def _keep(self, centres: Array, half: float, visible: Array, least: Array, most: Array) -> tuple[Bools, Array]:
        """Which boxes (n,) may matter, and the upper bounds of those."""
        sectors, settings, cell = self.likelihood.sectors, self.settings, np.log(4 * half**2)
        lower, upper = sectors.score(visible + least), sectors.score(visible + most)
        sure = lower[np.asarray(self.terrain.allowed(centres))]
        self.best = max(self.best, float(sure.max(initial=-np.inf)))
        negligible = log_sum(sure) - settings.negligible_nats
        keep = upper > max(self.best - prune_nats_of_box(settings.prune_nats, half), negligible)
        self.log_dropped = float(np.logaddexp(self.log_dropped, log_sum(upper[~keep]) + cell))
        return keep, upper[keep]

    def _refine_by_disks(self, boxes: Boxes, finest_m: float) -> Boxes:
        """Quartered until small against the posterior's spread, or `finest_m`, in compiled steps; see `_refine`."""
        s, terrain = self.settings, self.terrain
        while True:
            boxes, self.best, self.certain, dropped = refine_disks(
                self.likelihood.rows, boxes, terrain.searched, self.best, self.certain, s.prune_nats, s.negligible_nats,
                s.boxes_per_sigma, max(finest_m, terrain.finest_m), s.most_boxes,
            )  # fmt: skip
            self.log_dropped = float(np.logaddexp(self.log_dropped, dropped))
            if boxes.half_m <= finest_m or self._width_over_limit(boxes) < 1:
                return boxes

    def _refine(self, boxes: Boxes) -> Boxes:
        """Quartered until small against the posterior's spread."""
        while True:
            last = False
            if len(boxes.row) <= MAX_SCORED_PAIRS or not self._may_split(boxes):
                boxes = self._with_scores(boxes)
                width = self._width_over_limit(boxes)
                if width < 1:
                    return boxes
                last = 1 < width < 2  # the quarters are final: their scores suffice, without bounds
                self._trace_nodes(boxes)
            boxes = self._split(boxes)
            if not last:
                boxes = self._bound_by_llr_tier(boxes)

    def _split(self, boxes: Boxes) -> Boxes:
        """The quarters that hold ground, with the bounds and open rows of the boxes that they are quarters of."""
        centres, parent = split_boxes(boxes.centres_m, boxes.half_m, self.terrain.searched)
        holds = holds_allowed_ground(self.terrain, centres, boxes.half_m / 2)
        boxes = self._bound(boxes, centres[holds], boxes.half_m / 2, parent[holds], np.inf, np.inf, (NO_NUMBERS,) * 3)
        self._spend(0.0, boxes)
        return boxes

    def _bound_by_llr_tier(self, boxes: Boxes) -> Boxes:
        """The boxes bounded row by row: rows of the greatest |llr| first, since few suffice to exclude most boxes."""
        if self.ground is self.terrain and boxes.half_m > ROW_BY_ROW_M / 2:
            boxes = self._bound_tier(boxes, 0.0, np.inf, LOOKED_UP_RAD)
        for weakest, strongest in LLR_TIERS:
            boxes = self._bound_tier(boxes, weakest, strongest)
        return boxes

    def _bound_tier(self, boxes: Boxes, weakest: float, strongest: float, turn_rad: float = 0.0) -> Boxes:
        """The boxes with the horizon bounded for the rows of a tier, over all azimuths within the turn.

        A wide turn may cost less than none: it is looked up.
        """
        same = np.arange(len(boxes.centres_m))
        box, row = open_pairs(same, boxes.first, boxes.row, self.likelihood.strength, weakest, strongest)
        centres, azimuth = boxes.centres_m[box], self.likelihood.rows.azimuth_rad[row]
        looked_up = turn_rad > 0.0
        part = self.ground.interpolated_part(centres, azimuth) if len(box) and not looked_up else 0.0
        cost = LOOK_UP_COST if looked_up else INTERPOLATION_COST * part + BOX_COST * (1.0 - part)
        self._spend(cost * len(box), boxes)
        low, high = self.ground.horizon_bounds_rad(centres, np.array(boxes.half_m), azimuth, turn_rad)
        sigma = self.ground.horizon_sigma_rad(centres, azimuth)
        bounds = tuple(np.ascontiguousarray(a, dtype=np.float64) for a in (low, high, sigma))
        return self._bound(boxes, boxes.centres_m, boxes.half_m, same, weakest, strongest, bounds)

    def _bound(
        self, boxes: Boxes, centres: Array, half: float, parent: Ints, weakest: float, strongest: float,
        bounds: tuple[Array, ...],
    ) -> Boxes:  # fmt: skip
        kept, self.best, self.certain, dropped = cast(Any, bound_boxes)(
            self.likelihood.rows, boxes, centres, half, parent,
            np.asarray(self.terrain.allowed(centres)), self.likelihood.strength, weakest, strongest, *bounds,
            self.best, self.certain, self.settings.prune_nats, self.settings.negligible_nats,
        )  # fmt: skip
        self.log_dropped = float(np.logaddexp(self.log_dropped, dropped))
        return kept

    def _with_scores(self, boxes: Boxes) -> Boxes:
        """The boxes that may matter, with the log-likelihood at their centres."""
        part = 1.0 if self.ground is not self.terrain else 0.0
        self._spend((INTERPOLATION_COST * part + (1.0 - part)) * len(boxes.row), boxes)
        score = self.likelihood.centre_scores(boxes, self.ground)
        score = np.where(self.terrain.allowed(boxes.centres_m), score, -np.inf)
        self.best = max(self.best, float(score.max(initial=-np.inf)))
        return boxes._replace(score=score)

    def _may_split(self, boxes: Boxes) -> bool:
        finest = max(self.settings.finest_m, self.terrain.finest_m)
        return 4 * len(boxes.centres_m) <= self.settings.most_boxes and boxes.half_m > finest and len(boxes.row) > 0

    def _width_over_limit(self, boxes: Boxes) -> float:
        """How many times wider the boxes are than needed; 0 where they shall not be split."""
        if not self._may_split(boxes):
            return 0.0
        if not np.isfinite(boxes.score).any():
            return np.inf
        many = self.settings.boxes_per_sigma * (1.0 if self.terrain.hard_edges else SOFT_BOXES)
        return 2 * boxes.half_m * many / max(smallest_axis(boxes.centres_m, 2 * boxes.half_m, boxes.score), 1e-9)

    def _trace_nodes(self, boxes: Boxes) -> None:
        """Prepare horizons near the boxes once most of them lie close together, and again at smaller distances."""
        if not len(boxes.row) or boxes.half_m > FIRST_NODES_M:
            return
        step = max(2 * boxes.half_m, NODE_STEP_M)
        if step > 0.6 * self.node_step_m:
            return
        box = np.repeat(np.arange(len(boxes.centres_m)), np.diff(boxes.first))
        centres, azimuth = boxes.centres_m[box], self.likelihood.rows.azimuth_rad
        traced = 1.0 - self.ground.interpolated_part(centres, azimuth[boxes.row])
        middle = np.median(centres, axis=0)
        away = np.abs(boxes.centres_m - middle).max(axis=1)[box]
        half = float(np.quantile(away, PAIRS_NEAR_NODES)) + boxes.half_m
        across = max(3, int(np.ceil(2 * half / step)) + 1)
        rows = np.unique(boxes.row[away < half])
        if across**2 * len(rows) < WORTH_NODES * traced * len(boxes.row):
            self._spend(float(across**2 * len(rows)), boxes)
            self.ground = self.terrain.near(middle, half, azimuth[rows], across)
            self.node_step_m = 2 * half / (across - 1)

    def _spend_on_boxes(self, horizons: float, kept: list[tuple[Array, Array, Ints, Ints]], half: float) -> None:
        self.work += horizons * self.terrain.horizon_cost
        if self.work > self.settings.budget_horizons:
            if not kept:  # nothing is known of the whole area
                raise BudgetSpent(np.array([self.terrain.searched[:2]]), np.zeros(1), self.terrain.searched[2])
            centres, upper = (np.concatenate([part[k] for part in kept]) for k in (0, 1))
            raise BudgetSpent(centres, upper, half)

    def _spend(self, horizons: float, boxes: Boxes) -> None:
        self.work += horizons * self.terrain.horizon_cost
        if self.work > self.settings.budget_horizons:
            raise BudgetSpent(boxes.centres_m, boxes.upper, boxes.half_m)
