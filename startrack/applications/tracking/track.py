"""Frames of one camera to a track: filtered and smoothed positions with their covariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise

import numpy as np

from startrack.applications.tracking.contradictions import conclude
from startrack.applications.tracking.filtered_positions import OnlineTrack, filter_positions, positions_at_rest
from startrack.applications.tracking.legs import SlippedLeg, images_outside, legs_about, slipped_legs
from startrack.applications.tracking.observed_frame import ImageFix, ObservedFrame
from startrack.applications.tracking.odometry import Odometry
from startrack.applications.tracking.odometry_moves import odometry_moves, times_s
from startrack.applications.tracking.track_errors import BIAS, CLOCK, TrackErrors
from startrack.applications.tracking.unknown_size import SIZES, place_modes
from startrack.core.types import Array, BadInput, Bools, ClockError
from startrack.estimation.observations import UNKNOWN_M, USUAL_ODOMETRY, OdometryErrors
from startrack.estimation.trajectory import Smoothed, radius_holding
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
        """At `position_enu_m` (3,), with the circles of normal errors of `covariance_m2` (2, 2)."""
        radius95, radius999 = (radius_holding(covariance_m2, part) for part in (0.95, 0.999))
        return cls(position_enu_m, covariance_m2, radius95, radius999)


@dataclass(frozen=True, eq=False)
class TrackFrame:
    """One image of the track."""

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

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the size."""
        return self.size_m * self.sigma_1 / (1.0 + self.error_1)

    def __str__(self) -> str:
        return f"{self.size_m:.1f} ± {self.sigma_m:.1f} m"


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
        terrain: on which all were located.
        shared: the errors that the frames share.
        odometry: moves between the frames; None: not known.
        odometry_errors: of these moves.
        at_rest: the camera did not move: all exposures have one position.

    Raises BadInput: no_time for frames that are not in the order of time, bad_odometry for odometry that covers none of
    them or is impossible, inconsistent_evidence where no group of frames is clearly right; ValueError where no frame
    has a position.
    """
    times = [frame.time_utc for frame in frames]
    if any(a > b for a, b in pairwise(times)):
        raise BadInput("no_time", "the frames are not in the order of their times")
    n = len(frames)
    is_outside = np.zeros(n, dtype=bool)
    if odometry is not None:
        is_outside = ~odometry.covers(times_s(frames), odometry_errors.floor_m)
        if is_outside.all():
            odometry.require_covers(times_s(frames))
    by_image: list[int] = []  # whose smoothed positions are those of their images
    if at_rest:
        robust, position_m, covariance_m2 = positions_at_rest(frames, terrain, shared)
        first, second = [*np.flatnonzero(robust.mode >= 0).tolist(), n][:2]
        alone = dict.fromkeys(range(first, second), frames[first].fixes)
    else:
        moves = odometry_moves(frames, odometry, odometry_errors, shows_scale=not shared.bends)
        names = [frame.name for frame in frames]
        placed = place_modes([frame.modes for frame in frames], moves, shared, names)
        filtered = filter_positions(placed, moves, len(shared))
        robust = conclude(placed, filtered.compared, names)
        position_m, covariance_m2 = filtered.position_m, filtered.covariance_m2
        covariance_m2[(filtered.mode >= 0) & (robust.mode < 0)] = UNKNOWN_M**2 * np.eye(2)  # taken back since
        by_one = [*filtered.alone, *images_outside(frames, filtered.mode, position_m, shared)]
        alone = {k: frames[k].fixes for k in by_one if robust.mode[k] >= 0}
        by_image = images_outside(frames, robust.mode, robust.smoothed.position_m, shared)
    found, used = robust.smoothed, np.flatnonzero(robust.mode >= 0).tolist()
    known_m2 = np.where(robust.vouched[:, None, None], found.covariance_m2, UNKNOWN_M**2 * np.eye(2))
    own = {k: frames[k].fixes for k in by_image}
    if len(used) == 1:
        own = dict.fromkeys(range(n) if at_rest else used, frames[used[0]].fixes)
    smoothed = _trajectory(
        np.broadcast_to(found.position_m, (n, 2)), np.broadcast_to(known_m2, (n, 2, 2)), terrain, own
    )  # fmt: skip
    leg = legs_about(robust.leg, by_image, np.isfinite(robust.steps.sigma_m))
    bias, clock = (_shared_error(found, shared, name) for name in (BIAS, CLOCK))
    crater = terrain.with_shape(_shape_values(found, shared, terrain)) if shared.size_sigma_1 else terrain
    depth, width = (_size_error(found, shared, name, crater.facts().get(key, np.nan)) for name, key in SIZES.items())
    return Track(
        tuple(
            _track_frame(*one)
            for one in zip(frames, robust.mode, robust.attitude_fits, is_outside.tolist(), strict=True)
        ),
        _trajectory(position_m, covariance_m2, terrain, alone), smoothed, crater if shared.bends else terrain,
        *(bias or (0.0, 0.0)), clock and ClockError(*clock), depth, width, leg > 0, at_rest, robust.fault,
        slipped_legs(leg, robust.steps.move_m, smoothed.position_enu_m[:, :2]),
    )  # fmt: skip


def track_of_newest(
    frame: ObservedFrame, online: OnlineTrack, terrain: Terrain, shared: TrackErrors, *, is_outside: bool = False
) -> Track:
    """The last `frame` that `online` has, as a track of its own: by all frames up to it.

    `shared` are the errors of the track; `is_outside`: the odometry does not cover the frame.
    """
    position_m = online.position_m[None]
    by_image = images_outside([frame], np.array([online.mode]), position_m, shared)
    alone = {0: frame.fixes} if online.is_first or by_image else {}
    covariance_m2 = online.covariance_m2 if online.is_vouched else UNKNOWN_M**2 * np.eye(2)
    found = _trajectory(position_m, covariance_m2[None], terrain, alone)
    return Track((_track_frame(frame, online.mode, True, is_outside),), found, found, terrain)


def _track_frame(frame: ObservedFrame, mode: int, attitude_fits: bool, is_outside: bool) -> TrackFrame:
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
    """Positions (n, 2) and covariances (n, 2, 2) as a trajectory."""
    known = np.sqrt(np.trace(covariance_m2, axis1=1, axis2=2)) < UNKNOWN_SIGMA_M
    position = np.full((len(position_m), 3), np.nan)
    for k in np.flatnonzero(known):
        position[k] = camera_at(position_m[k], terrain)
    found = Trajectory.of_normal(position, np.where(known[:, None, None], covariance_m2, np.inf))
    for at, fixes in ((at, fixes) for at, fixes in alone.items() if len(fixes) == 1):
        found.position_enu_m[at], found.covariance_m2[at] = fixes[0].position_enu_m, fixes[0].covariance_m2
        found.radius95_m[at], found.radius999_m[at] = fixes[0].radius95_m, fixes[0].radius999_m
    return found


def _shape_values(found: Smoothed, shared: TrackErrors, terrain: Terrain) -> Array:
    """(n,) of all errors of the terrain's shape, as estimated."""
    known = dict(zip(shared.names, shared.values(found.shared).tolist(), strict=True))
    return np.array([known.get(one.name, one.mean) for one in terrain.errors.shape])


def _size_error(found: Smoothed, shared: TrackErrors, name: str, size_m: float) -> SizeError | None:
    """Of the shared error of this name, in a crater of that size; None where it is not shared."""
    error = _shared_error(found, shared, name)
    if error is None:
        return None
    stated = 1.0 + float(shared.mean[shared.names.index(name)])  # relative to the size that errors are counted from
    return SizeError(size_m, error[0] / stated, error[1] / stated)


def _shared_error(found: Smoothed, shared: TrackErrors, name: str) -> tuple[float, float] | None:
    """The shared error of this name and its standard deviation; None where it is not shared."""
    if name not in shared.names:
        return None
    at = shared.names.index(name)
    error, slope = (shared.values(found.shared) - shared.mean)[at], shared.slopes(found.shared)[at]
    return float(error), float(slope * np.sqrt(found.shared_covariance[at, at]))
