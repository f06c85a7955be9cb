"""Explanations of a track as they grow frame by frame: decisions so far, and the state of a Kalman filter each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from startrack.applications.tracking.moves import LEG_FREEDOMS
from startrack.core.types import Array, Bools, Ints


@dataclass(eq=False)
class Branches:
    """Explanations (b,) of the frames so far."""

    log_likelihood: Array  # (b,) with all priors but that of wrong frames
    log_wrong: Array  # (b,) the part of it by wrong frames
    wrong: Ints  # (b,) number of wrong frames
    mean: Array  # (b, p) of the position, the shared errors, and those of the odometry as a whole and of a leg
    covariance: Array  # (b, p, p) with p = 2 + k + FREEDOMS + LEG_FREEDOMS
    odometry: Ints  # (b,) which moves
    anchor: Ints  # (b,) entry of their turns
    history: Ints  # (b, frames, 3) mode, kind and anchor of the move before it

    def take(self, which: Ints | Bools) -> Branches:
        """Those of an index."""
        return Branches(*(getattr(self, f.name)[which] for f in fields(self)))

    def move_by_leg(self, by_leg: Array, *, is_new: bool) -> None:
        """Move by the errors of a leg, of which a new one has its own: `by_leg` (b, 2, LEG_FREEDOMS) by one sigma."""
        leg = slice(-LEG_FREEDOMS, None)
        if is_new:
            self.mean[:, leg], self.covariance[:, leg], self.covariance[:, :, leg] = 0.0, 0.0, 0.0
            self.covariance[:, leg, leg] = np.eye(LEG_FREEDOMS)
        shift = np.tile(np.eye(self.mean.shape[1]), (len(self.mean), 1, 1))
        shift[:, :2, leg] = by_leg
        self.mean = np.einsum("bij,bj->bi", shift, self.mean)
        self.covariance = shift @ self.covariance @ shift.swapaxes(1, 2)

    @staticmethod
    def join(parts: Sequence[Branches]) -> Branches:
        """All of several."""
        return Branches(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Branches)))
