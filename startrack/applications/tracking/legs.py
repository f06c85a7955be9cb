"""Legs of a drive in which the odometry slipped, and images whose own position stands in place of the track's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from startrack.applications.tracking.observed_frame import ObservedFrame
from startrack.applications.tracking.track_errors import TrackErrors
from startrack.core.types import Array, Bools, Ints


@dataclass(frozen=True)
class SlippedLeg:
    """Moves in a row in which the odometry slipped alike."""

    first: int  # number of the image before the leg
    last: int  # of the one after it
    length_m: float  # by the odometry
    factor_1: float  # by which the odometry is longer than the track; nan: not known
    heading_rad: float  # by which the odometry turns to the right of the track; nan: not known

    def text(self, names: Sequence[str]) -> str:
        """The leg in words, with the `names` of the images."""
        where = f"{self.length_m:.1f} m of odometry slipped from {names[self.first]} to {names[self.last]}"
        if not np.isfinite(self.factor_1):
            return where
        turned = f"{abs(np.degrees(self.heading_rad)):.1f} degrees to the {'right' if self.heading_rad > 0 else 'left'}"
        return f"{where}: {self.factor_1:.2f} times the track, {turned}"


def images_outside(frames: Sequence[ObservedFrame], mode: Ints, position_m: Array, shared: TrackErrors) -> list[int]:
    """Images in use whose position (n, 2) on the track lies outside the 99.9 % circle of their own fix.

    An image has no own circle where it is refused or ambiguous, or where its fix was made without the gross errors
    of the `shared` ones. In a crater of unknown size it is that of the stated size.
    """
    if shared.bends:
        return []
    return [
        k for k, (frame, used, at) in enumerate(zip(frames, mode, position_m, strict=True))
        if used >= 0 and len(frame.fixes) == 1 and frame.facts == shared.gross
        and np.linalg.norm(at - frame.fixes[0].position_enu_m[:2]) > frame.fixes[0].radius999_m
    ]  # fmt: skip


def legs_about(leg: Ints, images: Sequence[int], known: Bools) -> Ints:
    """The numbers `leg` (n - 1,) of the `known` moves, with those to and from `images` as further legs."""
    leg = np.where(known, leg, 0)
    touched = np.isin(np.arange(len(leg)), [[k - 1, k] for k in images]) & known & (leg == 0)
    begins = touched & ~np.append(False, touched[:-1])[: len(leg)]
    return np.asarray(np.where(touched, leg.max(initial=0) + np.cumsum(begins), leg))


def slipped_legs(leg: Ints, move_m: Array, position_m: Array) -> tuple[SlippedLeg, ...]:
    """The legs with these numbers (n - 1,), of moves (n - 1, 2) by odometry between positions (n, 2).

    Factor and heading are those of the similarity that turns the track's moves into the odometry's, by least squares.
    """
    found = []
    for number in np.unique(leg[leg > 0]):
        at = np.flatnonzero(leg == number)
        by_odometry = move_m[at] @ [1.0, 1.0j]
        by_track = np.diff(position_m, axis=0)[at] @ [1.0, 1.0j]
        length2 = np.sum(np.abs(by_track) ** 2)
        turn = np.sum(by_track.conj() * by_odometry) / length2 if length2 > 0.0 else np.nan
        length_m = float(np.abs(by_odometry).sum())
        found.append(SlippedLeg(int(at[0]), int(at[-1]) + 1, length_m, float(np.abs(turn)), float(-np.angle(turn))))
    return tuple(sorted(found, key=lambda one: one.first))
