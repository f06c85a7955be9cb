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

    state: TrackFilter  # their estimates
    log_likelihood: Array  # (b,) with all priors but that of wrong frames
    log_wrong: Array  # (b, w) the part of it by each of the last frames that is wrong
    wrong: Ints  # (b,) number of wrong frames
    odometry: Ints  # (b,) which moves
    anchor: Ints  # (b,) number from 1 of the frame whose attitude turns the next move; 0: none
    history: Ints  # (b, w, 3) mode, kind and anchor of the move before it, of the last frames

    def __getitem__(self, which: Ints | Bools | slice) -> Branches:
        """Those of an index."""
        return Branches(*(part[which] for part in self._parts))

    @property
    def _parts(self) -> tuple[Any, ...]:
        return tuple(getattr(self, f.name) for f in fields(self))

    @staticmethod
    def join(parts: Sequence[Branches]) -> Branches:
        """All of several."""
        states, *decisions = zip(*(one._parts for one in parts), strict=True)
        return Branches(TrackFilter.join(states), *map(np.concatenate, decisions))
