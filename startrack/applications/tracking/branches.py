"""Explanations of a track as they grow frame by frame: decisions so far, and a filter's estimates by each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from startrack.core.types import Array, Bools, Ints
from startrack.estimation.trajectory import TrackFilter


@dataclass(eq=False)
class Branches:
    """Explanations (b,) of the frames so far."""

    log_likelihood: Array  # (b,) with all priors but that of wrong frames
    log_wrong: Array  # (b, w) the part of it by each of the last frames that is wrong
    wrong: Ints  # (b,) number of wrong frames
    state: TrackFilter  # their estimates
    odometry: Ints  # (b,) which moves
    anchor: Ints  # (b,) number from 1 of the frame whose attitude turns the next move; 0: none
    history: Ints  # (b, w, 3) mode, kind and anchor of the move before it, of the last frames

    def take(self, which: Ints | Bools) -> Branches:
        """Those of an index."""
        return Branches(**{name: of.take(which) if name == "state" else of[which] for name, of in self._parts.items()})

    @property
    def _parts(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @staticmethod
    def join(parts: Sequence[Branches]) -> Branches:
        """All of several."""
        first, *others = parts
        state = first.state.join([one.state for one in others])
        arrays = [f.name for f in fields(Branches) if f.name != "state"]
        joined = {name: np.concatenate([getattr(one, name) for one in parts]) for name in arrays}
        return Branches(state=state, **joined)
