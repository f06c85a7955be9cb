"""The track where the size of a crater is not known, of which positions are products: expanded about the estimate."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from startrack.applications.tracking.contradictions import RobustTrack, conclude
from startrack.applications.tracking.explanations import explain
from startrack.applications.tracking.moves import Moves
from startrack.applications.tracking.track_errors import DEPTH, SIZE_ROUNDS, WIDTH, TrackErrors
from startrack.core.types import BadInput
from startrack.estimation.observations import FrameEstimate
from startrack.estimation.trajectory import Smoothed

SIZES = {DEPTH: "depth_m", WIDTH: "diameter_m"}  # errors of a crater, and the fact of each
MOST_SIZE_SIGMAS = 4.0  # of the logarithms of a crater's depth and width: what its file states is wrong beyond
STILL_MOVES_M = 0.01  # expanded about a crater's size anew, until no position moves by more


def place_modes(
    modes: Sequence[Sequence[FrameEstimate]],
    moves: Sequence[Moves],
    shared: TrackErrors,
    names: Sequence[str] = (),
) -> list[list[FrameEstimate]]:
    """The modes of frames with their positions after the turn and the scaling of a round crater.

    Where its size is not known, positions are products of it: they are expanded about the estimate by the `moves`
    between all frames anew, by odometry as it is stated first. What may be wrong with it is compared where the
    expansion is right. `names` are those of `conclude`, which says what this raises then.
    """
    placed = [[shared.place(one) for one in of] for of in modes]
    if not (shared.bends and any(modes)):
        return placed

    def expand(placed: list[list[FrameEstimate]], kinds: Sequence[Moves]) -> tuple[Any, RobustTrack, float]:
        """The modes and the track by `kinds` of moves, and by how much [m] the last expansion moved it."""
        robust = conclude(placed, explain(placed, kinds), names)
        rounds, moved_m = 0, np.inf
        while moved_m > STILL_MOVES_M and rounds < SIZE_ROUNDS:
            before = robust.smoothed
            placed = [
                [shared.place(one, position_m, before.shared) for one in of]
                for of, position_m in zip(modes, before.position_m, strict=True)
            ]
            robust = conclude(placed, explain(placed, kinds), names)
            rounds, moved_m = rounds + 1, float(np.abs(robust.smoothed.position_m - before.position_m).max())
        return placed, robust, moved_m

    if len(moves) > 1:
        with suppress(BadInput):  # wrong as stated: its faults are compared about the stated size
            placed, _, _ = expand(placed, moves[:1])
    placed, robust, moved_m = expand(placed, moves)
    if moved_m > STILL_MOVES_M or not _is_possible(robust.smoothed, shared):
        raise BadInput(
            "inconsistent_evidence",
            "the odometry contradicts what the terrain file states of the crater's size: are its lengths in metres?",
        )
    return placed


def _is_possible(found: Smoothed, shared: TrackErrors) -> bool:
    """Whether the crater's size is one that its file may mean."""
    is_size = np.array([name in SIZES for name in shared.names])
    return bool(np.linalg.norm(found.shared[is_size]) < MOST_SIZE_SIGMAS)
