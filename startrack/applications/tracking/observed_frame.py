"""Observations of a track, each of one image: a few numbers and rows of its result, without the image.

They are kept as files: a track that was stopped goes on without locating its images again.
"""

from __future__ import annotations

import io
import json
from dataclasses import asdict, dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from startrack.applications.tracking.frame_estimate import estimate_frame
from startrack.applications.tracking.track_errors import TrackErrors
from startrack.chain import Located, Measured, Outcome, Refused, last_value
from startrack.core.stored import read_sealed, write_sealed
from startrack.core.types import Array, Clock, Evidence, Fix, ImageErrors, ShownError
from startrack.estimation.observations import FrameEstimate
from startrack.estimation.trajectory import SIGMAS_95
from startrack.localization import HIGH_RAD, LOW_RAD, MIN_ROW_NATS, camera_at
from startrack.terrain import Terrain

FRAME_FORMAT = "startrack.observed-frame/6"
ROWS = ("azimuth_rad", "elevation_rad", "llr", "edge_sigma_rad", "extended_nats")
MODE_SIGMA_M = 10.0  # of a mode whose circle is not known
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class ImageFix:
    """Position by an image alone, as `locate` states it."""

    position_enu_m: Array  # (3,)
    covariance_m2: Array  # (2, 2)
    radius95_m: float
    radius999_m: float
    compared_at_m: Array  # (2,) as in `Fix`
    weight: float  # probability of the position


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """Image of a track: what it shows of the position, or why it was refused."""

    name: str
    time_utc: datetime
    R_body_enu: Array | None  # (3, 3) from enu; None: no attitude
    modes: tuple[FrameEstimate, ...]  # of the position; empty: refused
    evidence: Evidence | None  # rows about the skyline; None: refused
    fixes: tuple[ImageFix, ...] = ()  # by the image alone, of each mode
    shown: tuple[ShownError, ...] = ()  # errors beyond the defaults of facts that no file states
    reason: str = ""  # of a refusal
    message: str = ""
    steepness_1: float = 1.0  # of the terrain, as the image shows it where it is not known
    search: str = ""  # as `Fix.search`; empty: refused

    @property
    def facts(self) -> frozenset[str]:
        """Facts whose gross error the image shows."""
        return frozenset(one.fact for one in self.shown)


def observe_frame(outcome: Outcome, errors: TrackErrors | None = None, terrain: Terrain | None = None) -> ObservedFrame:
    """The `outcome` of one image as an observation of its position and of the shared `errors`.

    `errors` and `terrain` are those of the track; None: those of the image. Errors are counted from the steepness of
    the `terrain`. Raises ValueError for an image without a time, for a fix that states no error (another localizer),
    and for one that shows a gross error of a fact that is not among those of `errors` (see `TrackErrors.with_gross`).
    """
    value, name, when = last_value(outcome), outcome.exposure.name, outcome.exposure.time_utc
    if when is None:
        raise ValueError(f"{name}: an image of a track needs its time")
    R = value.camera.R_body_cam @ value.R_cam_enu if isinstance(value, Measured) else None
    if isinstance(outcome, Refused):
        return ObservedFrame(name, when, R, (), None, reason=str(outcome.reason), message=outcome.message)
    if not isinstance(value, Located):
        return ObservedFrame(name, when, R, (), None)
    if value.fix.is_approximate:
        raise ValueError(f"{name}: a track needs the localizer posterior")
    terrain = terrain or value.terrain
    if errors is None:
        errors = TrackErrors.of(terrain, value.clock, value.sky_at_skyline is not None)
        errors = errors.with_gross(facts_of(value, errors))
    missing = facts_of(value, errors) - errors.gross
    if missing:
        raise ValueError(f"{name}: it shows a gross error of {', '.join(missing)}: it must be shared")
    fixes = image_fixes(value.fix, terrain)
    rows = _informative_rows(value, terrain, fixes[0].compared_at_m)
    frame = ObservedFrame(
        name, when, R, (), rows, fixes, value.fix.shown, steepness_1=value.terrain.errors.steepness_1,
        search=value.fix.search,
    )  # fmt: skip
    return observe_again(frame, errors, terrain)


def facts_of(outcome: Outcome, errors: TrackErrors) -> frozenset[str]:
    """Facts among those of `errors` whose gross error an `outcome` shows."""
    shown = outcome.fix.shown if isinstance(outcome, Located) else ()
    return frozenset(one.fact for one in shown) & frozenset(errors.listed.facts)


def observe_again(frame: ObservedFrame, errors: TrackErrors, terrain: Terrain) -> ObservedFrame:
    """The `frame` by its evidence, with these shared `errors`."""
    if (rows := frame.evidence) is None:
        return frame
    errors = errors.on(terrain)
    modes = [
        replace(estimate_frame(rows, terrain, errors, one.compared_at_m, one.covariance_m2), weight=one.weight)
        for one in frame.fixes
    ]
    return replace(frame, modes=tuple(modes))


def image_fixes(fix: Fix, terrain: Terrain) -> tuple[ImageFix, ...]:
    """The position of a `fix` by one image, or each of several."""
    if not fix.ambiguous:
        position, at = np.asarray(fix.position_enu_m), np.asarray(fix.compared_at_m)
        return (ImageFix(position, np.asarray(fix.covariance_m2), fix.radius95_m, fix.radius999_m, at, 1.0),)
    found = []
    for mode in fix.modes:
        at = np.array([mode.east_m, mode.north_m])
        sigma = mode.radius95_m / SIGMAS_95 if np.isfinite(mode.radius95_m) else MODE_SIGMA_M
        position = np.asarray(camera_at(at, terrain))
        found.append(ImageFix(position, sigma**2 * np.eye(2), mode.radius95_m, mode.radius999_m, at, mode.weight))
    return tuple(found)


def _informative_rows(located: Located, terrain: Terrain, position_m: Array) -> Evidence:
    """The rows that say something about the skyline seen from a position (2,), with the errors of the image."""
    rows, sky = replace(located.evidence(), near=None), located.sky_at_skyline
    rows = rows if sky is None else sky.evidence(rows, located.by_stars)
    return rows_near_skyline(rows, terrain, position_m)


def rows_near_skyline(rows: Evidence, terrain: Terrain, position_m: Array) -> Evidence:
    """The `rows` that say something about the skyline of a `terrain` seen from `position_m` (2,)."""
    azimuth = np.linspace(0.0, 2 * np.pi, 721)
    above = rows.elevation_rad - np.interp(rows.azimuth_rad, azimuth, terrain.horizon_rad(position_m[None], azimuth))
    kept = (np.abs(rows.llr) > MIN_ROW_NATS) | (rows.extended_nats > MIN_ROW_NATS)
    kept &= np.asarray(terrain.is_informative(rows.azimuth_rad, rows.elevation_rad))
    return rows.take(kept & (above > LOW_RAD) & (above < HIGH_RAD))


@dataclass(frozen=True)
class FrameStore:
    """The frames in a folder, which need not exist yet, by the hash of all that decides them."""

    folder: Path

    def read(self, key: str) -> ObservedFrame | None:
        """The frame stored under `key`; None if there is none, or its file is damaged."""
        try:
            data = read_sealed(self._path(key))
            return None if data is None else decode_frame(data)
        except (ValueError, KeyError):
            return None

    def write(self, key: str, frame: ObservedFrame) -> None:
        """Store the `frame` under `key`, complete or not at all. Raises BadInput if that is impossible."""
        write_sealed(self._path(key), encode_frame(frame))

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.npz"


def encode_frame(frame: ObservedFrame) -> bytes:
    """The `frame` as a NumPy archive, without pickled objects."""
    arrays: dict[str, Array] = {} if frame.R_body_enu is None else {"R_body_enu": frame.R_body_enu}
    parts: dict[str, Any] = {f"mode{number}": mode for number, mode in enumerate(frame.modes)}
    parts |= {f"fix{number}": fix for number, fix in enumerate(frame.fixes)}
    if frame.evidence is not None:
        arrays |= {f"evidence.{name}": np.asarray(getattr(frame.evidence, name)) for name in ROWS}
        parts |= {"clock": frame.evidence.clock, "errors": frame.evidence.image_errors}
    for prefix, part in parts.items():
        if part is not None:  # a dataclass of numbers and arrays
            arrays |= {f"{prefix}.{f.name}": np.asarray(getattr(part, f.name)) for f in fields(part)}
    head = {
        "format": FRAME_FORMAT, "name": frame.name, "time_utc": frame.time_utc.isoformat(), "modes": len(frame.modes),
        "fixes": len(frame.fixes), "shown": [asdict(one) for one in frame.shown], "reason": frame.reason,
        "message": frame.message, "steepness_1": frame.steepness_1, "search": frame.search,
    }  # fmt: skip
    file = io.BytesIO()
    np.savez(file, head=np.array(json.dumps(head)), **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def decode_frame(data: bytes | bytearray) -> ObservedFrame:
    """The frame in the archive `data`. Raises ValueError, KeyError or BadZipFile for another file."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        arrays: dict[str, Any] = dict(archive)
    head = json.loads(str(arrays["head"]))
    if head["format"] != FRAME_FORMAT:
        raise ValueError(f"format {head['format']}, expected {FRAME_FORMAT}")
    rows = None
    if "evidence.llr" in arrays:
        clock = _value(Clock, "clock", arrays) if "clock.turn_rad_s" in arrays else None
        errors = _value(ImageErrors, "errors", arrays) if "errors.covariance" in arrays else None
        rows = Evidence(clock=clock, image_errors=errors, **{name: arrays[f"evidence.{name}"] for name in ROWS})
    return ObservedFrame(
        head["name"], datetime.fromisoformat(head["time_utc"]), arrays.get("R_body_enu"),
        tuple(_value(FrameEstimate, f"mode{number}", arrays) for number in range(head["modes"])), rows,
        tuple(_value(ImageFix, f"fix{number}", arrays) for number in range(head["fixes"])),
        tuple(ShownError(**one) for one in head["shown"]), head["reason"], head["message"],
        head["steepness_1"], head["search"],
    )  # fmt: skip


def _value(kind: type[T], prefix: str, arrays: dict[str, Any]) -> T:
    """Value of the dataclass `kind` from `arrays` whose names begin with `prefix`, as `encode_frame` stored them."""
    values = {f.name: arrays[f"{prefix}.{f.name}"] for f in fields(kind)}  # type: ignore[arg-type]
    return kind(**{name: one if one.ndim else float(one) for name, one in values.items()})
