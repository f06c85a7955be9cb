"""The moves between frames by each kind of odometry: as stated, and with each fault that it may have as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC

import numpy as np

from startrack.applications.tracking.observed_frame import ObservedFrame
from startrack.applications.tracking.odometry import Odometry
from startrack.core.types import Array, Ints
from startrack.estimation.observations import OdometryErrors, Steps, moves_by_scale_and_heading

ODOMETRY_WRONG_PROBABILITY = 0.01  # as a whole
FREEDOMS = 7  # of odometry as a whole: a linear map from three axes to two, and its clock
LEG_FREEDOMS = 2  # of a leg: its scale and its heading
LEG_SIGMA_1 = 0.15  # errors of scale and of heading [rad] that the moves of a leg share
# Errors of scale and of heading [rad] that all moves share are those of one move, or with this probability larger.
LARGER_PROBABILITY, LARGER_SIGMA_1 = 0.2, 0.1
APART_SIGMA_M = 300.0  # of one image from the one before on each axis, by nothing but that both are of one drive
UNITS = (1e-3, 1e3, 0.01, 0.3048)  # by which lengths in mm, km, cm or feet become metres
AXES = ((1, 0, 2), (2, 1, 0), (0, 2, 1), (1, 2, 0), (2, 0, 1))  # orders that are not x y z


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
        """Moves without a fault by `steps`, which are in enu and need no attitude."""
        n = len(steps.sigma_m) + 1
        turn, none = np.tile(np.eye(3), (n + 1, 1, 1)), np.zeros((n - 1, 3, FREEDOMS))
        return cls("", 0.0, np.pad(steps.move_m, ((0, 0), (0, 1))), turn, steps.sigma_m, none)

    def steps(self, anchor: Ints) -> Steps:
        """The first moves in enu, turned as by the entries `anchor` (m,) of `turn`; none is known with a fault."""
        own = (of[: len(anchor)] for of in (self.delta_m, self.sigma_m, self.freedom_m))
        move, sigma_m, shared, of_leg = turned(self.turn[anchor], *own)
        unknown = np.isinf(sigma_m) | bool(self.fault)
        for part in (move, shared, of_leg):
            part[unknown] = 0.0
        return Steps(move, np.where(unknown, np.inf, sigma_m), shared, of_leg)


def turned(turn: Array, delta_m: Array, sigma_m: Array, freedom_m: Array) -> tuple[Array, Array, Array, Array]:
    """Moves (n, 2) in enu by `delta_m` (n, 3) and rotations `turn` (n, 3, 3), and their standard deviations (n,).

    Then their changes (n, 2, FREEDOMS) and (n, 2, LEG_FREEDOMS) by errors that all moves, and those of a leg, share.
    """
    move = np.einsum("nij,nj->ni", turn, delta_m)[:, :2]
    by_leg = LEG_SIGMA_1 * moves_by_scale_and_heading(delta_m)
    known = np.isfinite(move).all(axis=1)
    return move, np.where(known, sigma_m, np.inf), (turn @ freedom_m)[:, :2], (turn @ by_leg)[:, :2]


def odometry_moves(
    frames: Sequence[ObservedFrame], odometry: Odometry | None, errors: OdometryErrors, *, shows_scale: bool = True
) -> list[Moves]:
    """Moves between frames by `odometry` as stated, and with each fault that it may have as a whole.

    The attitude that the stars show turns them. Without odometry no move is known, nor is one from or to a frame that
    it does not cover. `shows_scale`: whether images show a wrong scale. In a crater of unknown size they do not: its
    error is the stated one, and no fault changes lengths. Raises BadInput (bad_odometry) for impossible odometry.
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
        "the opposite order in time": (position[::-1], Q[::-1]),
        "quaternions with w first": (position, first),
        "quaternions of the inverse rotations": (position, back),
        "inverse poses": (-np.einsum("nij,nj->ni", back, position), back),
        "z down and y to the right": (position @ down, down @ Q @ down),
        **{f"lengths {1.0 / to:.4g} times the true ones": (to * position, Q) for to in units},
        **{f"axes in the order {' '.join('xyz'[k] for k in order)}": (position[:, order], Q) for order in axes},
    }
    nowhere = np.full((3, 3), np.nan)
    R = np.array([
        frame.R_body_enu if is_covered and frame.R_body_enu is not None else nowhere
        for frame, is_covered in zip(frames, covered, strict=True)
    ])  # fmt: skip

    def moves(fault: str, position_m: Array, to_odometry: Array) -> Moves:
        """Moves with a `fault` by positions (n, 3) and rotations (n, 3, 3) in a frame of the odometry's own."""
        turn = np.concatenate([nowhere[None], R.swapaxes(1, 2) @ to_odometry.swapaxes(1, 2)])
        delta = np.diff(position_m, axis=0)
        sigma_m = np.where(covered[:-1] & covered[1:], errors.sigma_m(delta), np.inf)
        return Moves(fault, 0.0, delta, turn, sigma_m, unknown.freedom_m, shows_scale)

    right = moves("", position, Q)
    similar, linear, by_clock = (np.zeros_like(unknown.freedom_m) for _ in range(3))
    if errors.time_sigma_s and len(frames) > 1:
        late, early = (
            odometry.increments_body_m(np.clip(time_s + offset_s, *odometry.time_s[[0, -1]]))
            for offset_s in (errors.time_sigma_s, -errors.time_sigma_s)
        )
        by_clock[..., -1] = np.einsum("nij,nj->ni", Q[:-1], 0.5 * (late - early))
    similar[..., :2] = moves_by_scale_and_heading(right.delta_m)
    linear[:, 0], linear[:, 1] = (right.delta_m @ axis for axis in np.eye(6, FREEDOMS).reshape(2, 3, FREEDOMS))
    sizes = [(1.0, errors.sigma_1)]  # of the errors that all moves share, with their probabilities before
    named = [moves(fault, *poses) for fault, poses in faults.items()]
    apart = np.full(len(frames) - 1, APART_SIGMA_M)
    wrong = [replace(unknown, fault="an unknown fault", sigma_m=apart)]
    if shows_scale:
        larger = max(errors.sigma_1, LARGER_SIGMA_1)
        sizes = [(1.0 - LARGER_PROBABILITY, errors.sigma_1), (LARGER_PROBABILITY, larger)]
        of_axes = "other axes, quaternions or lengths"
        wrong.append(replace(unknown, fault=of_axes, freedom_m=linear, sigma_m=right.sigma_m))
    stated = [replace(right, freedom_m=size_1 * similar + by_clock) for _, size_1 in sizes]
    kinds = [(1.0 - ODOMETRY_WRONG_PROBABILITY) * part for part, _ in sizes]
    kinds += [ODOMETRY_WRONG_PROBABILITY / (len(wrong) + 1) / len(named)] * len(named)
    kinds += [ODOMETRY_WRONG_PROBABILITY / (len(wrong) + 1)] * len(wrong)
    return [replace(one, log_prior=float(np.log(p))) for one, p in zip([*stated, *named, *wrong], kinds, strict=True)]


def times_s(frames: Sequence[ObservedFrame]) -> Array:
    """Times (n,) [Unix s] of the frames."""
    return np.array([frame.time_utc.astimezone(UTC).timestamp() for frame in frames])
