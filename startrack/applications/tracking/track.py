"""Frames of one camera to a track: filtered and smoothed positions with their covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise

import numpy as np

from startrack.applications.tracking.contradictions import smooth_robustly
from startrack.applications.tracking.filtered_positions import OnlineTrack, filter_positions, positions_at_rest
from startrack.applications.tracking.observed_frame import ImageFix, ObservedFrame
from startrack.applications.tracking.odometry import Odometry, odometry_steps
from startrack.applications.tracking.track_errors import BIAS, CLOCK, DEPTH, TrackErrors
from startrack.core.types import Array, BadInput, Bools, ClockError, Ints
from startrack.estimation.observations import UNKNOWN_M, USUAL_ODOMETRY, OdometryErrors
from startrack.estimation.trajectory import Smoothed, radius_holding
from startrack.frames import quat_xyzw_from_R
from startrack.localization import camera_at
from startrack.terrain import Terrain

UNKNOWN_SIGMA_M = 1e-3 * UNKNOWN_M  # a position with a larger error is not known


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
    quat_xyzw_body_enu: Array | None  # (4,) None: no attitude


@dataclass(frozen=True, eq=False)
class CrestHeights:
    """Errors of the map's posts that make the skylines of the track, by all frames together."""

    post: Ints  # (c,) number in the terrain
    position_enu_m: Array  # (c, 3) by the map
    error_m: Array  # (c,) true minus map
    sigma_m: Array  # (c,) the map's own is the prior


@dataclass(frozen=True, eq=False)
class DepthError:
    """By which a crater is deeper than its file states, relative."""

    error_1: float
    sigma_1: float


@dataclass(frozen=True, eq=False)
class Track:
    """A track with what its frames share."""

    frames: tuple[TrackFrame, ...]
    filtered: Trajectory  # known at the time of each frame
    smoothed: Trajectory  # known at the end
    bias_rad: float  # by which the true horizon is higher than the map's, all around
    bias_sigma_rad: float
    clock: ClockError | None
    depth: DepthError | None  # None: the file's depth is taken as exact
    crests: CrestHeights | None  # None: a terrain without posts, or without errors of their heights
    slipped: Bools  # (n - 1,) odometry steps judged wheel slip
    at_rest: bool
    terrain: Terrain


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

    Raises BadInput: no_time for frames that are not in the order of time, bad_odometry for odometry that does not cover
    them; ValueError where no frame has a single position.
    """
    times = [frame.time_utc for frame in frames]
    if any(a > b for a, b in pairwise(times)):
        raise BadInput("no_time", "the frames are not in the order of their times")
    n, modes = len(frames), [frame.modes for frame in frames]
    if at_rest:
        robust, position_m, covariance_m2 = positions_at_rest(frames, terrain, shared)
        first, second = [*np.flatnonzero(robust.mode >= 0).tolist(), n][:2]
    else:
        steps = odometry_steps(frames, odometry, odometry_errors)
        robust = smooth_robustly(modes, steps, terrain.height_sigma_m)
        position_m, covariance_m2 = filter_positions(modes, steps, len(shared), terrain.height_sigma_m)
        first = next(k for k, of in enumerate(modes) if len(of) == 1)
        second = first + 1
    found, used = robust.smoothed, np.flatnonzero(robust.mode >= 0).tolist()
    smoothed = np.broadcast_to(found.position_m, (n, 2)), np.broadcast_to(found.covariance_m2, (n, 2, 2))
    by_one = [] if len(used) > 1 else range(n) if at_rest else used
    bias, clock, depth = (_shared_error(found, shared, name) for name in (BIAS, CLOCK, DEPTH))
    crests = None
    if len(found.post):
        places_m = terrain.post_positions_m(found.post)
        crests = CrestHeights(found.post, places_m, found.post_error_m, found.post_sigma_m)
    return Track(
        tuple(_track_frame(frame, mode) for frame, mode in zip(frames, robust.mode, strict=True)),
        _trajectory(position_m, covariance_m2, terrain, frames[first].fixes, range(first, second)),
        _trajectory(*smoothed, terrain, frames[used[0]].fixes, by_one), *(bias or (0.0, 0.0)),
        clock and ClockError(*clock), depth and DepthError(*depth), crests, robust.slipped, at_rest, terrain,
    )  # fmt: skip


def track_of_newest(frame: ObservedFrame, online: OnlineTrack, terrain: Terrain) -> Track:
    """The last `frame` that `online` has, as a track of its own: by all frames up to it."""
    known_by_one = [0] if online.is_first else []
    here = online.filter.position_m[None], online.filter.covariance_m2[None]
    found, none = _trajectory(*here, terrain, frame.fixes, known_by_one), np.zeros(0, dtype=bool)
    return Track((_track_frame(frame, online.mode),), found, found, 0.0, 0.0, None, None, None, none, False, terrain)


def _track_frame(frame: ObservedFrame, mode: int) -> TrackFrame:
    found, count = ("used", "", ""), len(frame.modes)
    if not frame.modes:
        found = "refused", frame.reason, frame.message
    elif mode < 0 and count > 1:
        found = "left_out", "ambiguous", f"none of {count} positions agrees with the track"
    elif mode < 0:
        found = "left_out", "inconsistent_evidence", "its position contradicts the other frames"
    quat = None if frame.R_body_enu is None else quat_xyzw_from_R(frame.R_body_enu)
    return TrackFrame(frame.name, frame.time_utc, *found, quat)


def _trajectory(
    position_m: Array, covariance_m2: Array, terrain: Terrain, fixes: Sequence[ImageFix], by_fix: Sequence[int]
) -> Trajectory:
    """Positions (n, 2) and covariances (n, 2, 2) as a trajectory.

    Those of the frames `by_fix` are by one image alone: the only one of its `fixes` is what is known of them.
    """
    known = np.sqrt(np.trace(covariance_m2, axis1=1, axis2=2)) < UNKNOWN_SIGMA_M
    position = np.full((len(position_m), 3), np.nan)
    for k in np.flatnonzero(known):
        position[k] = camera_at(position_m[k], terrain)
    found = Trajectory.of_normal(position, np.where(known[:, None, None], covariance_m2, np.inf))
    for at in by_fix if len(fixes) == 1 else ():
        found.position_enu_m[at], found.covariance_m2[at] = fixes[0].position_enu_m, fixes[0].covariance_m2
        found.radius95_m[at], found.radius999_m[at] = fixes[0].radius95_m, fixes[0].radius999_m
    return found


def _shared_error(found: Smoothed, shared: TrackErrors, name: str) -> tuple[float, float] | None:
    """The shared error of this name and its standard deviation; None where it is not shared."""
    if name not in shared.names:
        return None
    at = shared.names.index(name)
    sigma = float(shared.sigma[at])
    return sigma * float(found.shared[at]), sigma * float(np.sqrt(found.shared_covariance[at, at]))
