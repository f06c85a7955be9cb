"""Moves between the frames of a track by odometry as it is stated, and with each fault that it may have as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC

import numpy as np

from startrack.applications.tracking.explanations import ODOMETRY_WRONG_PROBABILITY
from startrack.applications.tracking.moves import FREEDOMS, Moves
from startrack.applications.tracking.observed_frame import ObservedFrame
from startrack.applications.tracking.odometry import Odometry
from startrack.core.types import Array
from startrack.estimation.observations import OdometryErrors, Steps, moves_by_scale_and_heading

UNITS = (1e-3, 1e3, 0.01, 0.3048)  # by which lengths in mm, km, cm or feet become metres
# Errors of scale and of heading [rad] that all moves share are those of one move, or with this probability larger.
LARGER_PROBABILITY, LARGER_SIGMA_1 = 0.2, 0.1
APART_SIGMA_M = 300.0  # of one image from the one before on each axis, by nothing but that both are of one drive
AXES = ((1, 0, 2), (2, 1, 0), (0, 2, 1), (1, 2, 0), (2, 0, 1))  # orders that are not x y z


def odometry_moves(
    frames: Sequence[ObservedFrame], odometry: Odometry | None, errors: OdometryErrors, *, shows_scale: bool = True
) -> list[Moves]:
    """Moves between frames by `odometry` as stated, and with each fault that it may have as a whole.

    The attitude that the stars show turns them. Without odometry no move is known, nor is one from or to a frame that
    it does not cover. `shows_scale`: whether images show a
    wrong scale. In a crater of unknown size they do not: its error is the stated one, and no fault changes lengths.

    Raises:
        BadInput: bad_odometry for odometry that is impossible.
    """
    from scipy.spatial.transform import Rotation

    unknown = Moves.of(Steps.unknown(len(frames)))
    if odometry is None:
        return [unknown]
    odometry.require_possible(errors.max_speed_m_s)
    time_s = times_s(frames)
    covered = odometry.covers(time_s, errors.floor_m)
    position, attitude = odometry.poses_at(np.clip(time_s, *odometry.time_s[[0, -1]]))
    Q = attitude.as_matrix()
    back, first = Q.swapaxes(1, 2), Rotation.from_quat(np.roll(attitude.as_quat(), -1, axis=1)).as_matrix()
    down = np.diag([1.0, -1.0, -1.0])
    units, axes = (UNITS, AXES) if shows_scale else ((), AXES[:1])
    faults = {
        "the opposite sign": (-position, Q),
        **{f"lengths {1.0 / to:.4g} times the true ones": (to * position, Q) for to in units},
        "quaternions with w first": (position, first),
        "quaternions of the inverse rotations": (position, back),
        "inverse poses": (-np.einsum("nij,nj->ni", back, position), back),
        "z down and y to the right": (position @ down, down @ Q @ down),
        "the opposite order in time": (position[::-1], Q[::-1]),
        **{f"axes in the order {' '.join('xyz'[k] for k in order)}": (position[:, order], Q) for order in axes},
    }
    apart = np.full(len(frames) - 1, APART_SIGMA_M)
    nowhere = np.full((3, 3), np.nan)
    R = np.array([
        frame.R_body_enu if is_covered and frame.R_body_enu is not None else nowhere
        for frame, is_covered in zip(frames, covered, strict=True)
    ])  # fmt: skip
    none = np.full((1, 3, 3), np.nan)

    def moves(fault: str, position_m: Array, to_odometry: Array) -> Moves:
        """By poses in a frame of the odometry's own."""
        turn = np.concatenate([none, R.swapaxes(1, 2) @ to_odometry.swapaxes(1, 2)])
        delta = np.diff(position_m, axis=0)
        sigma_m = np.where(covered[:-1] & covered[1:], errors.sigma_m(delta), np.inf)
        return Moves(fault, 0.0, delta, turn, sigma_m, unknown.freedom_m)

    right = replace(moves("", position, Q), has_legs=shows_scale)
    east, north = np.eye(6, FREEDOMS).reshape(2, 3, FREEDOMS)
    similar, linear, by_clock = (np.zeros_like(unknown.freedom_m) for _ in range(3))
    if errors.time_sigma_s and len(frames) > 1:
        late, early = (
            odometry.increments_body_m(np.clip(time_s + offset_s, *odometry.time_s[[0, -1]]))
            for offset_s in (errors.time_sigma_s, -errors.time_sigma_s)
        )
        by_clock[..., -1] = np.einsum("nij,nj->ni", Q[:-1], 0.5 * (late - early))
    similar[..., :2] = moves_by_scale_and_heading(right.delta_m)
    linear[:, 0], linear[:, 1] = right.delta_m @ east, right.delta_m @ north
    sizes = [(1.0, errors.sigma_1)]  # of the errors that all moves share, with their probabilities before
    named = [moves(fault, *poses) for fault, poses in faults.items()]
    wrong = [replace(unknown, fault="an unknown fault", sigma_m=apart)]
    if shows_scale:
        larger = max(errors.sigma_1, LARGER_SIGMA_1)
        sizes = [(1.0 - LARGER_PROBABILITY, errors.sigma_1), (LARGER_PROBABILITY, larger)]
        of_axes = "other axes, quaternions or lengths"
        wrong.append(replace(unknown, fault=of_axes, freedom_m=linear, sigma_m=right.sigma_m))
    prior = np.log(ODOMETRY_WRONG_PROBABILITY / (len(wrong) + 1))
    return [
        *(
            replace(
                right,
                freedom_m=size_1 * similar + by_clock,
                log_prior=float(np.log(part * (1.0 - ODOMETRY_WRONG_PROBABILITY))),
            )
            for part, size_1 in sizes
        ),
        *(replace(one, log_prior=float(prior - np.log(len(named)))) for one in named),
        *(replace(one, log_prior=float(prior)) for one in wrong),
    ]


def times_s(frames: Sequence[ObservedFrame]) -> Array:
    """Times (n,) [Unix s] of the frames."""
    return np.array([frame.time_utc.astimezone(UTC).timestamp() for frame in frames])


def odometry_steps(frames: Sequence[ObservedFrame], odometry: Odometry | None, errors: OdometryErrors) -> Steps:
    """Moves between frames in enu by `odometry` as stated, turned by the last attitude of the `frames` before each.

    Moves before the first attitude are not known. Raises as `odometry_moves`.
    """
    has = np.array([frame.R_body_enu is not None for frame in frames[:-1]], dtype=bool)
    anchor = np.maximum.accumulate(np.where(has, np.arange(1, len(has) + 1), 0)) if len(has) else np.zeros(0, int)
    return odometry_moves(frames, odometry, errors)[0].steps(anchor)
