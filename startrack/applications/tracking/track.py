"""Frames of one camera to a track: filtered and smoothed positions with their covariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise

import numpy as np

from startrack.applications.tracking.observed_frame import ImageFix, ObservedFrame
from startrack.applications.tracking.odometry import Odometry, odometry_moves, times_s
from startrack.applications.tracking.positions import (
    SIZES,
    OnlineTrack,
    conclude,
    filter_positions,
    known_m2,
    place_modes,
    positions_at_rest,
)
from startrack.applications.tracking.track_errors import BIAS, CLOCK, ErrorFound, TrackErrors
from startrack.core.types import Array, BadInput, Bools, ClockError, Ints
from startrack.estimation.observations import USUAL_ODOMETRY, OdometryErrors, Steps
from startrack.estimation.trajectory import radius_holding
from startrack.frames import quat_xyzw_from_R
from startrack.localization import camera_at
from startrack.terrain import Terrain

UNKNOWN_SIGMA_M = 1000.0  # a position with a larger error is not known


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Positions of the camera; nan and infinite where nothing is known."""

    position_enu_m: Array  # (n, 3)
    covariance_m2: Array  # (n, 2, 2) of east and north
    radius95_m: Array  # (n,) circle about the position that holds 95 %
    radius999_m: Array  # (n,) 99.9 %

    @classmethod
    def of_normal(cls, position_enu_m: Array, covariance_m2: Array) -> Trajectory:
        """Trajectory of `position_enu_m` (n, 3) with the circles of normal errors of `covariance_m2` (n, 2, 2)."""
        radius95, radius999 = (radius_holding(covariance_m2, part) for part in (0.95, 0.999))
        return cls(position_enu_m, covariance_m2, radius95, radius999)


@dataclass(frozen=True, eq=False)
class TrackFrame:
    """Image of the track with its status."""

    name: str
    time_utc: datetime
    status: str  # "used"; "left_out": contradicts the track, or ambiguous to the end; "refused"
    reason: str  # code; empty where used
    message: str
    quat_xyzw_body_enu: Array | None  # (4,) None: no attitude, or one that contradicts the track
    search: str = ""  # as `Fix.search` of the image alone; empty: refused
    is_outside: bool = False  # the odometry does not cover its time


@dataclass(frozen=True, eq=False)
class SizeError:
    """The depth or the width of a crater, and by how much it is larger than its file states."""

    size_m: float
    error_1: float  # relative to the stated one
    sigma_1: float

    @classmethod
    def of(cls, found: ErrorFound, size_m: float) -> SizeError:
        """Error of a crater's size `size_m` by the error `found`, counted from another than the stated size."""
        stated = 1.0 + found.mean
        return cls(size_m, found.error / stated, found.sigma / stated)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the size."""
        return self.size_m * self.sigma_1 / (1.0 + self.error_1)

    def __str__(self) -> str:
        return f"{self.size_m:.1f} ± {self.sigma_m:.1f} m"


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


@dataclass(frozen=True, eq=False)
class Track:
    """A track with what its frames share."""

    frames: tuple[TrackFrame, ...]
    filtered: Trajectory  # known at the time of each frame
    smoothed: Trajectory  # known at the end
    terrain: Terrain  # where its size is not known, the crater as estimated
    bias_rad: float = 0.0  # by which the true horizon is higher than the map's, all around
    bias_sigma_rad: float = 0.0
    clock: ClockError | None = None
    depth: SizeError | None = None  # None: the file's depth is taken as exact
    width: SizeError | None = None  # None: the file's diameter is taken as exact
    slipped: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n - 1,) steps judged wheel slip
    at_rest: bool = False
    odometry_fault: str = ""  # of the odometry as a whole, which is left out then
    legs: tuple[SlippedLeg, ...] = ()  # the slipped steps, each leg of them as one
    odometry_m: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (n, 2) by odometry alone; (0, 2): not known

    @property
    def leg_texts(self) -> list[str]:
        """The slipped legs in words."""
        return [one.text([frame.name for frame in self.frames]) for one in self.legs]

    @property
    def crater_texts(self) -> list[str]:
        """Depth and width of a crater in words; empty where they are taken as exact."""
        sizes = {"depth": self.depth, "width": self.width}
        return [f"{word} of the crater: {size}" for word, size in sizes.items() if size is not None]


def estimate_track(
    frames: Sequence[ObservedFrame],
    terrain: Terrain,
    shared: TrackErrors,
    *,
    odometry: Odometry | None = None,
    odometry_errors: OdometryErrors = USUAL_ODOMETRY,
    at_rest: bool = False,
) -> Track:
    """The track of frames in the order of time.

    Args:
        frames: what `observe_frame` gave of each image, with the same `shared`.
        terrain: the ground on which all were located.
        shared: the errors that the frames share.
        odometry: moves between the frames; None: not known.
        odometry_errors: errors of these moves.
        at_rest: the camera did not move: all exposures have one position.

    Raises BadInput: no_time for frames that are not in the order of time, bad_odometry for odometry that covers none of
    them or is impossible, inconsistent_evidence where no group of frames is clearly right; ValueError where no frame
    has a position.
    """
    times = [frame.time_utc for frame in frames]
    if any(a > b for a, b in pairwise(times)):
        raise BadInput("no_time", "the frames are not in the order of their times")
    is_outside = np.zeros(len(frames), dtype=bool)
    if odometry is not None:
        is_outside = ~odometry.covers(times_s(frames), odometry_errors.floor_m)
        if is_outside.all():
            odometry.require_covers(times_s(frames))
    if at_rest:
        robust, filtered = positions_at_rest(frames, terrain, shared)
    else:
        moves = odometry_moves(frames, odometry, odometry_errors, shows_scale=not shared.bends)
        names = [frame.name for frame in frames]
        placed = place_modes([frame.modes for frame in frames], moves, shared, names)
        filtered = filter_positions(placed, moves, len(shared))
        robust = conclude(placed, filtered.compared, names)
    found, best = robust.smoothed, robust.best
    alone = np.where(robust.mode[filtered.alone] >= 0, filtered.alone, -1)  # -1 is the last one, or no frame
    by_first = _trajectory(
        filtered.position_m, known_m2(filtered.covariance_m2, (filtered.mode < 0) | (robust.mode >= 0)), terrain,
        {k: frames[of].fixes for k, of in enumerate(alone.tolist()) if of >= 0},
    )  # fmt: skip
    used = np.flatnonzero(robust.mode >= 0).tolist()
    own = dict.fromkeys(range(len(frames)) if at_rest else used, frames[used[0]].fixes) if len(used) == 1 else {}
    smoothed = _trajectory(found.position_m, found.covariance_m2, terrain, own)
    errors = dict(zip(shared.names, shared.errors_found(found.shared, found.shared_covariance), strict=True))
    crater = terrain
    if shared.size_sigma_1:
        shape = [errors[one.name].mean + errors[one.name].error if one.name in errors else one.mean
                 for one in terrain.errors.shape]  # fmt: skip
        crater = terrain.with_shape(np.array(shape))
    depth, width = (
        SizeError.of(errors[name], crater.facts().get(key, np.nan)) if name in errors else None
        for name, key in SIZES.items()
    )
    steps = best.steps
    leg = np.where(np.isfinite(steps.sigma_m), best.leg, 0)
    return Track(
        tuple(map(_track_frame, frames, robust.mode, robust.attitude_fits, is_outside.tolist())),
        by_first, smoothed, crater if shared.bends else terrain,
        *(errors[BIAS][:2] if BIAS in errors else (0.0, 0.0)),
        ClockError(*errors[CLOCK][:2]) if CLOCK in errors else None, depth, width, leg > 0, at_rest, best.moves.fault,
        slipped_legs(leg, steps.move_m, smoothed.position_enu_m[:, :2]),
        np.zeros((0, 2)) if odometry is None or at_rest or best.moves.fault else _odometry_alone_m(steps, smoothed),
    )  # fmt: skip


def track_of_newest(
    frame: ObservedFrame, online: OnlineTrack, terrain: Terrain, *, is_outside: bool = False
) -> Track:  # fmt: skip
    """The last `frame` that `online` has, as a track of its own: by all frames up to it.

    `is_outside`: the odometry does not cover the frame.
    """
    own = {0: frame.fixes} if online.is_first else {}
    found = _trajectory(online.position[0][None], online.position[1][None], terrain, own)
    return Track((_track_frame(frame, online.mode, True, is_outside),), found, found, terrain)


def _track_frame(frame: ObservedFrame, mode: int, attitude_fits: bool, is_outside: bool) -> TrackFrame:
    """Frame of the track by the number of its used `mode`; -1: none is used."""
    found, count = ("used", "", ""), len(frame.modes)
    if not frame.modes:
        found = "refused", frame.reason, frame.message
    elif mode < 0 and count > 1:
        found = "left_out", "ambiguous", f"none of {count} positions agrees with the track"
    elif mode < 0:
        found = "left_out", "inconsistent_evidence", "its position contradicts the other frames"
    R = frame.R_body_enu if attitude_fits and found[0] != "left_out" else None
    quat = None if R is None else quat_xyzw_from_R(R)
    return TrackFrame(frame.name, frame.time_utc, *found, quat, frame.search, is_outside)


def _trajectory(
    position_m: Array, covariance_m2: Array, terrain: Terrain, alone: Mapping[int, Sequence[ImageFix]]
) -> Trajectory:
    """Trajectory of positions (n, 2) and covariances (n, 2, 2); `alone` has the fixes of rows by one image only."""
    known = np.sqrt(np.trace(covariance_m2, axis1=1, axis2=2)) < UNKNOWN_SIGMA_M
    position = np.full((len(known), 3), np.nan)
    for k in np.flatnonzero(known):
        position[k] = camera_at(position_m[k], terrain)
    found = Trajectory.of_normal(position, np.where(known[:, None, None], covariance_m2, np.inf))
    for at, fixes in ((at, fixes) for at, fixes in alone.items() if len(fixes) == 1):
        found.position_enu_m[at], found.covariance_m2[at] = fixes[0].position_enu_m, fixes[0].covariance_m2
        found.radius95_m[at], found.radius999_m[at] = fixes[0].radius95_m, fixes[0].radius999_m
    return found


def _odometry_alone_m(steps: Steps, smoothed: Trajectory) -> Array:
    """Positions (n, 2) by the moves alone from the first smoothed one; nan behind a move that is not known."""
    move_m = np.where(np.isfinite(steps.sigma_m)[:, None], steps.move_m, np.nan)
    return np.cumsum(np.concatenate([smoothed.position_enu_m[:1, :2], move_m]), axis=0)


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
