"""The moves between frames by one kind of odometry: as stated, or with a fault as a whole."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from startrack.core.types import Array, Ints
from startrack.estimation.observations import Steps, moves_by_scale_and_heading

FREEDOMS = 7  # of odometry as a whole: a linear map from three axes to two, and its clock
LEG_FREEDOMS = 2  # of a leg: its scale and its heading
LEG_SIGMA_1 = 0.15  # errors of scale and of heading [rad] that the moves of a leg share


@dataclass(frozen=True, eq=False)
class Moves:
    """The moves between n frames, by odometry with one fault as a whole or none."""

    fault: str  # empty: none
    log_prior: float
    delta_m: Array  # (n - 1, 3) in the odometry's frame
    turn: Array  # (n + 1, 3, 3) from that frame to enu: before the first attitude, then by each frame's; nan: not known
    sigma_m: Array  # (n - 1,) on each axis; infinite where the move is not known
    freedom_m: Array  # (n - 1, 3, FREEDOMS) of `delta_m`, by errors of a standard normal prior that all moves share
    has_legs: bool = True  # whether some may slip alike; images must show the scale of moves

    @classmethod
    def of(cls, steps: Steps) -> Moves:
        """Those of `steps`, which need no attitude."""
        n = len(steps.sigma_m) + 1
        turn, none = np.tile(np.eye(3), (n + 1, 1, 1)), np.zeros((n - 1, 3, FREEDOMS))
        return cls("", 0.0, np.pad(steps.move_m, ((0, 0), (0, 1))), turn, steps.sigma_m, none)

    def part(self, first: int, frames: int) -> Moves:
        """Those between so many frames from number `first` on."""
        turn, moves = np.concatenate([self.turn[:1], self.turn[first + 1 :][:frames]]), slice(first, first + frames - 1)
        return replace(
            self, turn=turn, delta_m=self.delta_m[moves], sigma_m=self.sigma_m[moves], freedom_m=self.freedom_m[moves]
        )  # fmt: skip

    def steps(self, anchor: Ints) -> Steps:
        """The first moves in enu, turned as by the entries `anchor` (m,) of `turn`; none is known with a fault."""
        delta, sigma = self.delta_m[: len(anchor)], self.sigma_m[: len(anchor)]
        move = np.einsum("nij,nj->ni", self.turn[anchor], delta)[:, :2]
        known = np.isfinite(move).all(axis=1) & np.isfinite(sigma) & (not self.fault)
        shared = np.where(known[:, None, None], (self.turn[anchor] @ self.freedom_m[: len(anchor)])[:, :2], 0.0)
        of_leg = np.where(known[:, None, None], (self.turn[anchor] @ self.leg_m[: len(anchor)])[:, :2], 0.0)
        straight = np.zeros(len(anchor), dtype=np.int64)
        return Steps(np.where(known[:, None], move, 0.0), np.where(known, sigma, np.inf), shared, straight, of_leg)

    @cached_property
    def leg_m(self) -> Array:
        """(n - 1, 3, LEG_FREEDOMS) of `delta_m`, by errors of a standard normal prior that the moves of a leg share."""
        return LEG_SIGMA_1 * moves_by_scale_and_heading(self.delta_m)
