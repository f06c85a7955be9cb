"""The best position at each of the times that the clock allows, followed from one to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localization.clock import REACH_SIGMAS, duration, turn_evidence
from startrack.localization.horizon_bias import estimate_horizon_bias, lower_evidence
from startrack.localization.initial_guess import BEAMS, CLIMBS, LAST_STEP_M, beam_search
from startrack.localization.likelihood import PositionLikelihood
from startrack.terrain import Terrain
from startrack.types import Array, Clock, Evidence, Ints, NotLocated

Node = tuple[float, Array]  # log-likelihood with the prior [nats], and position (2,)

STEP_RAD = np.radians(0.13)  # of the turn between two times; a position is followed over it
MOST_SCANNED = 250  # of these times: 65 degrees of turn, five days on the Moon
SCAN_STEPS = 2  # between the times at which a position is searched for from nothing
LIKELY_NATS = 10.0  # less than the best: a time still matters
TRACKED_NATS = 30.0  # less than the best: a position is not followed further
JUMP = 4.0  # times the usual way between two times, from which on the positions are two
FINE_TIMES = 1500  # to which the shares and positions are interpolated


@dataclass(frozen=True)
class Track:
    """The best position at each of many times, followed from one to the next."""

    evidence: Evidence
    terrain: Terrain
    clock: Clock

    def likely_way(self) -> tuple[Array, Array, Array]:
        """Times (n,) that matter [s later], the logarithm of their share (n,), and the best positions (n, 2)."""
        nodes = self._nodes()
        numbers = np.array(sorted(nodes))
        log_share = np.array([nodes[k][0] for k in numbers])
        way_m = np.array([nodes[k][1] for k in numbers])
        apart = np.linalg.norm(np.diff(way_m, axis=0), axis=1) > JUMP * self.step_s * self._speed_m_s
        runs = np.split(np.arange(len(numbers)), np.flatnonzero((np.diff(numbers) > 1) | apart) + 1)
        parts = [self._fine_run(numbers[run], log_share[run], way_m[run], len(numbers)) for run in runs]
        later_s, log_share, way_m = (np.concatenate([part[i] for part in parts]) for i in range(3))
        keep = log_share > log_share.max() - LIKELY_NATS
        return later_s[keep], log_share[keep], way_m[keep]

    @property
    def _speed_m_s(self) -> float:
        """By which a turn of the sky about a middle as far as the search area moves a position."""
        return float(np.linalg.norm(self.clock.turn_rad_s)) * self.terrain.reach_m

    def _fine_run(self, numbers: Ints, log_share: Array, way_m: Array, of: int) -> tuple[Array, Array, Array]:
        """Finer times, their shares and positions, between neighbouring nodes whose positions hang together."""
        from scipy.interpolate import PchipInterpolator

        each = max(FINE_TIMES // of, 1)
        fine = (np.arange(len(numbers) * each) + 0.5) / each - 0.5  # each node stands for as much time
        fine = np.clip(fine, 0.0, len(numbers) - 1.0)
        later_s = (numbers[0] + fine) * self.step_s
        if len(numbers) == 1:
            return later_s, np.repeat(log_share, each), np.repeat(way_m, each, axis=0)
        at = np.arange(len(numbers))
        share = PchipInterpolator(at, log_share)(fine)
        return later_s, np.asarray(share), np.asarray(PchipInterpolator(at, way_m)(fine))

    @property
    def limits_s(self) -> tuple[float, float]:
        """First and last time that is tried [s later]."""
        clock = self.clock
        low, high = (-clock.offset_s + side * REACH_SIGMAS * clock.sigma_s for side in (-1, 1))
        return max(low, -clock.reach_s), min(high, clock.reach_s)

    @property
    def step_s(self) -> float:
        """Between two times."""
        low, high = self.limits_s
        return float(min(STEP_RAD / np.linalg.norm(self.clock.turn_rad_s), (high - low) / 4))

    def _nodes(self) -> dict[int, Node]:
        """Fit and position by the number of the step."""
        low, high = (round(limit / self.step_s) for limit in self.limits_s)
        nodes: dict[int, Node] = {}
        for seed, start in self._seeds(low, high):
            if seed in nodes:
                continue
            nodes[seed] = self._node(seed, start)
            for direction in (1, -1):
                self._follow(nodes, seed, direction, low, high)
        return nodes

    def _follow(self, nodes: dict[int, Node], seed: int, direction: int, low: int, high: int) -> None:
        """Add the nodes on one side of a seed, up to the limits or to where the position is too unlikely."""
        last = before = nodes[seed][1]
        for k in range(seed + direction, (high if direction > 0 else low) + direction, direction):
            fit, position = self._node(k, 2 * last - before)
            if k in nodes and nodes[k][0] >= fit:
                return
            nodes[k] = (fit, position)
            if fit < max(node[0] for node in nodes.values()) - TRACKED_NATS:
                return
            last, before = position, last

    def _seeds(self, low: int, high: int) -> list[tuple[int, Array]]:
        """Numbers of steps to follow positions from, the best first, with positions (2,)."""
        middle = min(max(0, low), high)
        wanted = range(low, high + 1, SCAN_STEPS) if high - low > 2 * SCAN_STEPS else [middle]
        if len(wanted) > MOST_SCANNED:
            raise NotLocated(
                f"a clock that is right to {duration(self.clock.sigma_s)} leaves too many times to search on this "
                "terrain: find the time more exactly (--time-sigma states its error)"
            )
        found = []
        for k in wanted:
            likelihood = self._likelihood(k)
            guess = beam_search(likelihood, BEAMS[:1] if len(wanted) > 1 else BEAMS)
            if len(guess.points_m):
                found.append((guess.best + self._log_offset(k, likelihood), k, guess.points_m[0]))
        if not found:
            raise NotLocated("no position in the search area is allowed", reason="outside_search_area")
        best = max(fit for fit, _, _ in found)
        likely = sorted((one for one in found if one[0] > best - TRACKED_NATS), key=lambda one: -one[0])
        return [(k, position) for _, k, position in likely]

    def _node(self, number: int, start_m: Array) -> Node:
        likelihood, bias_nats = self._likelihood(number), 0.0
        offset = self._log_offset(number, likelihood)
        if self.terrain.common_sigma_rad > 0.0:
            bias = estimate_horizon_bias(likelihood, start_m)
            bias_nats = 0.5 * float(np.square(bias.bias_rad / self.terrain.common_sigma_rad))
            lowered = lower_evidence(likelihood.evidence, bias.bias_rad)
            likelihood, start_m = PositionLikelihood.from_evidence(lowered, self.terrain), bias.position_m
        way, _ = likelihood.climb(start_m, CLIMBS, LAST_STEP_M)
        scores = likelihood.exact_scores(way)
        top = int(np.argmax(scores))
        return offset + float(scores[top]) - bias_nats, way[top]

    def _log_offset(self, number: int, likelihood: PositionLikelihood) -> float:
        """The prior, and what makes likelihoods at different times comparable: their sectors hold different rows."""
        return float(self.clock.log_prior(number * self.step_s)) + float(likelihood.sectors.ceiling.sum())

    def _likelihood(self, number: int) -> PositionLikelihood:
        return PositionLikelihood.from_evidence(turn_evidence(self.evidence, number * self.step_s), self.terrain)
