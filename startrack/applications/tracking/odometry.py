"""Odometry: poses of the rover's body in a frame of its own, and the moves between them with their possible faults."""

from __future__ import annotations

import array as arrays
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from startrack.applications.tracking.observed_frame import ObservedFrame
from startrack.core import ODOMETRY_FLOOR_M, ODOMETRY_SIGMA
from startrack.core.errors import BadInput
from startrack.core.files import MAX_CAUSE_CHARS, FilePath, printable, read_text
from startrack.core.types import Array, Bools, Ints, Value, array
from startrack.estimation.observations import OdometryErrors, Steps, moves_by_scale_and_heading
from startrack.exposure import BAG_SUFFIXES, ODOMETRY_TYPES, is_bag, read_messages
from startrack.frames import format_utc

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

TUM_COLUMNS = "time tx ty tz qx qy qz qw"
LAST_TIME_S = datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC).timestamp()  # larger numbers are milliseconds or less
QUATERNION_LENGTH_1 = 0.01  # error of a quaternion's length from rounding to two digits; more is another quantity
SPAN_TOLERANCE_S = 1e-3  # some files round times to 0.1 ms; a rover moves less than 0.1 mm in that time
GAP_INTERVALS = 10.0  # between poses, by the median one: where poses are farther apart, some are missing
LARGEST_COORDINATE_M = 1e8  # also of frames that count from the middle of a body
MAX_ODOMETRY_BYTES = 2**28  # two million poses
ODOMETRY_WRONG_PROBABILITY = 0.01  # as a whole
FREEDOMS = 7  # of odometry as a whole: a linear map from three axes to two, and its clock
LEG_FREEDOMS = 2  # of a leg: its scale and its heading
LEG_SIGMA_1 = 0.15  # errors of scale and of heading [rad] that the moves of a leg share
# Errors of scale and of heading [rad] that all moves share are those of one move, or with this probability larger.
LARGER_PROBABILITY, LARGER_SIGMA_1 = 0.2, 0.1
APART_SIGMA_M = 300.0  # of one image from the one before on each axis, by nothing but that both are of one drive
UNITS = (1e-3, 1e3, 0.01, 0.3048)  # by which lengths in mm, km, cm or feet become metres
AXES = ((1, 0, 2), (2, 1, 0), (0, 2, 1), (1, 2, 0), (2, 0, 1))  # orders that are not x y z


@dataclass(frozen=True, kw_only=True)
class Odometry(Value):
    """Poses of the body at increasing times, in any frame that is fixed to the ground.

    Raises ValueError for fewer than two poses, times that do not increase, numbers that are not finite, times outside
    0 to 9999-12-31, and quaternions whose length is not 1 (within 1 %).
    """

    time_s: Array = array("n")  # Unix seconds, UTC
    position_m: Array = array("n", 3)
    quat_xyzw: Array = array("n", 4)  # from body to the frame
    warnings: tuple[str, ...] = ()  # of what was read

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self) < 2:
            raise ValueError(f"{len(self)} pose(s): at least two are needed")
        fault = _first_fault(np.column_stack([self.time_s, self.position_m, self.quat_xyzw]))
        if fault is not None:
            raise ValueError(f"pose {fault[0]}: {fault[1]}")

    def __len__(self) -> int:
        return len(self.time_s)

    def increments_body_m(self, time_s: Array) -> Array:
        """Increments (m - 1, 3) [m] between the times `time_s` (m,) [Unix s], each in the body frame of its first time.

        Between two poses the position is interpolated linearly, the attitude along the great arc (slerp).

        Raises:
            BadInput: bad_odometry for times that are not finite, that decrease, or that the odometry does not cover.
        """
        position_m, attitude = self.poses_at(time_s)
        if len(position_m) < 2:
            return np.zeros((0, 3))
        return np.asarray(attitude[:-1].inv().apply(np.diff(position_m, axis=0)))

    def poses_at(self, time_s: Array) -> tuple[Array, Rotation]:
        """Positions (m, 3) [m] and attitudes (m), from body to the frame, at the times `time_s` (m,) [Unix s].

        Interpolates and raises as `increments_body_m`.
        """
        from scipy.spatial.transform import Rotation, Slerp

        at_s = np.asarray(time_s, dtype=np.float64)
        if at_s.ndim != 1 or not np.isfinite(at_s).all():
            _refuse("the frames' times are not a list of finite numbers")
        if (np.diff(at_s) < 0).any():
            _refuse("the frames are not in the order of time")
        self.require_covers(at_s)
        at_s = np.clip(at_s, *self.time_s[[0, -1]])
        about = self._poses_about(at_s)  # alone: a long drive has many others
        own_s = self.time_s[about]
        position_m = np.stack([np.interp(at_s, own_s, axis) for axis in self.position_m[about].T], axis=-1)
        return position_m, Slerp(own_s, Rotation.from_quat(self.quat_xyzw[about]))(at_s)

    def _poses_about(self, time_s: Array) -> slice:
        """The poses, at least two, between which `time_s` (m,) within the odometry lie, in the order of time."""
        first, last = time_s[[0, -1]] if len(time_s) else self.time_s[[0, 0]]
        before = int(np.searchsorted(self.time_s, first, side="right")) - 1
        after = int(np.searchsorted(self.time_s, last))
        return slice(min(before, len(self) - 2), max(after, before + 1) + 1)

    def covers(self, time_s: Array, still_m: float = ODOMETRY_FLOOR_M) -> Bools:
        """Whether the odometry says where the body was at each of `time_s` (m,) [Unix s].

        It does not before its first pose, after its last one, and in a gap in which the body moved by `still_m` [m].
        """
        k = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, len(self) - 2)
        moved_m = np.linalg.norm(self.position_m[k + 1] - self.position_m[k], axis=1)
        is_gap = (self.time_s[k + 1] - self.time_s[k] > self._extremes[0]) & (moved_m > still_m)
        after, before = time_s - self.time_s[k], self.time_s[k + 1] - time_s
        at_pose = (np.abs(after) <= SPAN_TOLERANCE_S) | (np.abs(before) <= SPAN_TOLERANCE_S)
        return np.asarray(at_pose | ((after > 0) & (before > 0) & ~is_gap))

    @cached_property
    def _extremes(self) -> tuple[float, int]:
        """Longest step [s] between poses of which none is missing, and index of the pose before the fastest move."""
        length_m, step_s = np.linalg.norm(np.diff(self.position_m, axis=0), axis=1), np.diff(self.time_s)
        return GAP_INTERVALS * float(np.median(step_s)), int(np.argmax(length_m / (step_s + SPAN_TOLERANCE_S)))

    def require_covers(self, time_s: Array) -> None:
        """Raise BadInput (bad_odometry) for one of `time_s` (m,) [Unix s] before the first pose or after the last."""
        first, last = self.time_s[[0, -1]]
        outside = time_s[(time_s < first - SPAN_TOLERANCE_S) | (time_s > last + SPAN_TOLERANCE_S)]
        if len(outside):
            at = _utc_text(outside[0])
            many = f"{len(outside)} of {len(time_s)} frames, the first at {at}, are"
            which = many if len(time_s) > 1 else f"the frame's time {at} is"
            _refuse(f"{which} outside the odometry, which covers {_utc_text(first)} to {_utc_text(last)}")

    def require_possible(self, max_speed_m_s: float) -> None:
        """Raise BadInput (bad_odometry) for moves faster than `max_speed_m_s`."""
        k = self._extremes[1]
        length_m, step_s = np.linalg.norm(self.position_m[k + 1] - self.position_m[k]), np.diff(self.time_s[k : k + 2])
        if length_m > max_speed_m_s * (step_s[0] + SPAN_TOLERANCE_S):
            _refuse(
                f"pose {k + 1}: {length_m:.4g} m in {step_s[0]:.4g} s are faster than {max_speed_m_s:g} m/s, the "
                "highest speed of the rover (--max-speed): are positions in metres?"
            )


def read_odometry(
    path: FilePath, topic: str | None = None, *, growing: bool = False, floor_m: float = ODOMETRY_FLOOR_M
) -> Odometry:
    """The odometry in the file `path`: TUM text, or a ROS bag (.bag, .db3, .mcap, a folder with metadata.yaml).

    TUM text has one pose a line, `time tx ty tz qx qy qz qw`, with the time in Unix seconds (UTC) and comments after
    `#`. Of a bag, the nav_msgs/Odometry messages of a `topic` are read (None: its only topic of that type), with the
    times of their headers. Of poses at one time that agree within `floor_m` [m] the last one counts, with a warning.
    `growing`: text that is being written; its last line is left out unless it is complete, with eight numbers and the
    end of the line.

    Raises:
        BadInput: bad_odometry with the file and the cause, in one line.
    """
    if is_bag(path) or Path(path).is_dir():
        return _odometry_of_bag(path, topic, floor_m)
    if topic is not None:
        _refuse(f"{printable(path)}: is read as text and has no topic {topic}; bags end in {', '.join(BAG_SUFFIXES)}")
    return _odometry_of_text(path, growing, floor_m)


class OdometryFile:
    """A file of odometry that is read again where it has changed."""

    def __init__(self, path: str, topic: str | None, is_followed: bool, floor_m: float = ODOMETRY_FLOOR_M) -> None:
        """Take the file at `path`, of a bag a `topic`; `is_followed`: the last line may be incomplete."""
        self.path, self._is_growing = path, is_followed
        self._read_as = partial(read_odometry, path, topic, floor_m=floor_m)
        self._read: tuple[object, Odometry] | None = None  # with the stamp of the file

    @property
    def has_changed(self) -> bool:
        """Whether the file is another one than was read."""
        return self._read is None or self._read[0] != self._stamp()

    def read(self) -> Odometry:
        """The odometry as it is now. Raises BadInput as `read_odometry`."""
        if self._read is None or self.has_changed:
            self._read = self._stamp(), self._read_as(growing=self._is_growing)
        return self._read[1]

    def end(self) -> None:
        """Read the last line too, if it can be read: the file grows no more."""
        with suppress(BadInput):
            self._read = self._stamp(), self._read_as(growing=False)

    def _stamp(self) -> object:
        """Size and time of the file; None where there is none."""
        with suppress(OSError):
            found = Path(self.path).stat()
            return found.st_size, found.st_mtime_ns
        return None


def _odometry_of_text(path: FilePath, growing: bool, floor_m: float) -> Odometry:
    values, lines = arrays.array("d"), arrays.array("q")  # lists take 620 bytes a pose, these 72
    text = read_text(path, "bad_odometry", max_bytes=MAX_ODOMETRY_BYTES)
    for number, line in enumerate((_complete_lines(text) if growing else text).splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if len(words) != len(TUM_COLUMNS.split()):
            _refuse(f"{printable(path)}: line {number}: {len(words)} columns, expected 8: {TUM_COLUMNS}")
        try:
            values.extend(map(float, words))
        except ValueError as cause:
            why = str(cause)[:MAX_CAUSE_CHARS]
            raise BadInput("bad_odometry", f"{printable(path)}: line {number}: {why}") from cause
        lines.append(number)
    return _odometry_of_rows(path, values, lambda row: f"line {lines[row]}", floor_m)


def _complete_lines(text: str) -> str:
    """The text without a last line that is being written: it has no end, or too few numbers."""
    whole = text[: text.rfind("\n") + 1]
    last = whole.rstrip("\n").rfind("\n") + 1
    words = whole[last:].partition("#")[0].split()
    return whole if not words or len(words) >= len(TUM_COLUMNS.split()) else whole[:last]


def _odometry_of_bag(path: FilePath, topic: str | None, floor_m: float) -> Odometry:
    rows, frames = [], set()
    for message in read_messages(path, ODOMETRY_TYPES, topic, reason="bad_odometry", flag="--odometry-topic"):
        body, pose = message.content, message.content.pose.pose
        at, q = pose.position, pose.orientation
        frames.add((body.header.frame_id, body.child_frame_id))
        rows.append([message.stamp_ns / 1e9, at.x, at.y, at.z, q.x, q.y, q.z, q.w])
    if len(frames) > 1:
        named = "; ".join(f"{child!r} in {frame!r}" for frame, child in sorted(frames))
        _refuse(f"{printable(path)}: the topic has poses of several frames: {named}")
    rows.sort(key=lambda row: row[0])  # a bag is in the order of arrival
    return _odometry_of_rows(path, rows, lambda row: f"pose {row}", floor_m)


def _odometry_of_rows(path: FilePath, rows: ArrayLike, name_row: Callable[[int], str], floor_m: float) -> Odometry:
    """Odometry of rows (n, 8) of TUM's columns without repeated poses; `name_row` names a row in messages."""
    values = np.asarray(rows, dtype=np.float64).reshape(-1, len(TUM_COLUMNS.split()))
    warnings: tuple[str, ...] = ()
    # The rows before those that have the same time, and the same pose within `floor_m` and ODOMETRY_SIGMA rad.
    with np.errstate(over="ignore", invalid="ignore"):
        moved_m = np.linalg.norm(np.diff(values[:, 1:4], axis=0), axis=1)
        ahead, q = values[:-1, 4:], values[1:, 4:]
        half_rad = np.minimum(np.linalg.norm(q - ahead, axis=1), np.linalg.norm(q + ahead, axis=1))
        again = (np.diff(values[:, 0]) == 0) & (moved_m <= floor_m) & (2.0 * half_rad <= ODOMETRY_SIGMA)
    kept = np.flatnonzero(~np.append(again, False)[: len(values)])
    fault = _first_fault(values[kept])
    if fault is not None:
        _refuse(f"{printable(path)}: {name_row(int(kept[fault[0]]))}: {fault[1]}")
    if again.any():
        first, apart_mm = name_row(int(again.argmax()) + 1), 1e3 * moved_m[again].max()
        many = f"{again.sum()} second poses at one time, the first in {first}, up to {apart_mm:.1f} mm apart"
        warnings = (f"{printable(path)}: {many}: the last one counts",)
    values = values[kept]
    try:
        return Odometry(time_s=values[:, 0], position_m=values[:, 1:4], quat_xyzw=values[:, 4:], warnings=warnings)
    except ValueError as cause:
        raise BadInput("bad_odometry", f"{printable(path)}: {cause}") from cause


def _first_fault(rows: Array) -> tuple[int, str] | None:
    """Index and fault of the first pose that cannot be used among `rows` (n, 8) of TUM's columns; None: all can."""
    time_s = rows[:, 0]
    with np.errstate(over="ignore", invalid="ignore"):
        length, step_s = np.linalg.norm(rows[:, 4:], axis=1), np.diff(time_s, prepend=-np.inf)
        apart_m = np.append(0.0, np.linalg.norm(np.diff(rows[:, 1:4], axis=0), axis=1))
        faults = {
            "a number is NaN or infinite": ~np.isfinite(rows).all(axis=1),
            "the time {now:.6g} is not in Unix seconds": ~((time_s >= 0) & (time_s <= LAST_TIME_S)),
            "the quaternion has the length {length:.3g}, not 1": ~(np.abs(length - 1) <= QUATERNION_LENGTH_1),
            f"a coordinate is larger than {LARGEST_COORDINATE_M:.0e} m": (
                ~(np.abs(rows[:, 1:4]).max(axis=1) <= LARGEST_COORDINATE_M)
            ),
            "a second pose at the time {now:.6f}, {apart:.4g} m away": step_s == 0,
            "times are not in order: {now:.6f} follows {before:.6f}": step_s < 0,
        }
    faulty = np.array(list(faults.values()))
    if not faulty.any():
        return None
    k = int(np.argmax(faulty.any(axis=0)))
    text = list(faults)[int(np.argmax(faulty[:, k]))]
    return k, text.format(now=time_s[k], before=time_s[k - 1], length=length[k], apart=apart_m[k])


def _utc_text(time_s: float) -> str:
    """ISO 8601 of Unix seconds; the number where no calendar has it."""
    try:
        return format_utc(datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=float(time_s)))
    except OverflowError:
        return f"{time_s:.6g} s"


def _refuse(cause: str) -> NoReturn:
    raise BadInput("bad_odometry", cause)


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
