"""The quantities of a track's frames: one line each makes JSON, table, schema and documentation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from startrack.applications.tracking.track import Track
from startrack.core.types import Array
from startrack.frames import format_utc, latlon_from_enu

STATUSES = ("used", "left_out", "refused")


class TrackValues:
    """A track with what is computed of its trajectories."""

    def __init__(self, track: Track) -> None:
        """Of a `track`."""
        self.track = track

    @cached_property
    def latlon_deg(self) -> Array:
        """(n, 2) of the smoothed positions."""
        site = self.track.terrain.site
        if site is None:
            return np.full((len(self.track.frames), 2), np.nan)
        return np.degrees(np.stack(latlon_from_enu(site, *self.track.smoothed.position_enu_m.T), axis=-1))


@dataclass(frozen=True)
class FrameQuantity:
    """A quantity of a frame: a key of its object in track.json, and a column of track.ecsv."""

    key: str
    unit: str  # as docs/formats.md spells it
    form: str  # printf
    description: str
    value: Callable[[TrackValues, int], Any]  # of frame k; None where it is not known

    @property
    def datatype(self) -> str:
        """As ECSV names it."""
        return {"s": "string", "d": "int64"}.get(self.form[-1], "float64")


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def _of(name: str, axis: int) -> Callable[[TrackValues, int], Any]:
    return lambda values, k: _number(getattr(values.track, name).position_enu_m[k, axis])


def _covariance(name: str, row: int, column: int) -> Callable[[TrackValues, int], Any]:
    return lambda values, k: _number(getattr(values.track, name).covariance_m2[k, row, column])


def _radius(name: str, key: str) -> Callable[[TrackValues, int], Any]:
    return lambda values, k: _number(getattr(getattr(values.track, name), key)[k])


def _quaternion(axis: int) -> Callable[[TrackValues, int], Any]:
    def value(values: TrackValues, k: int) -> float | None:
        found = values.track.frames[k].quat_xyzw_body_enu
        return None if found is None else float(found[axis])

    return value


def _trajectory(name: str, prefix: str, when: str) -> list[FrameQuantity]:
    position = [
        FrameQuantity(f"{prefix}{axis}_m", "m", "%.4f", f"{axis} of the camera, {when}", _of(name, k))
        for k, axis in enumerate(("east", "north", "up"))
    ]
    covariance = [
        FrameQuantity(
            f"{prefix}covariance_{text}_m2", "m^2", "%.6g", f"covariance ({text}) of that", _covariance(name, *at)
        )
        for text, at in (("ee", (0, 0)), ("en", (0, 1)), ("nn", (1, 1)))
    ]
    radii = [
        FrameQuantity(f"{prefix}{key}", "m", "%.4f", f"circle about it that holds {part} %", _radius(name, key))
        for key, part in (("radius95_m", "95"), ("radius999_m", "99.9"))
    ]
    return [*position, *covariance, *radii]


FRAME_QUANTITIES = (
    FrameQuantity("image", "", "%s", "name of the image", lambda v, k: v.track.frames[k].name),
    FrameQuantity("time_utc", "", "%s", "middle of the exposure", lambda v, k: format_utc(v.track.frames[k].time_utc)),
    FrameQuantity(
        "status", "", "%s", "used; left_out: contradicts the track, or ambiguous to the end; refused: no position",
        lambda v, k: v.track.frames[k].status,
    ),
    FrameQuantity("reason", "", "%s", "of a frame that is not used", lambda v, k: v.track.frames[k].reason or None),
    FrameQuantity("message", "", "%s", "the same in words", lambda v, k: v.track.frames[k].message or None),
    FrameQuantity(
        "slipped", "", "%d", "1: the odometry's move to this frame is judged wheel slip",
        lambda v, k: int(k > 0 and bool(v.track.slipped[k - 1])),
    ),
    *_trajectory("smoothed", "", "by all frames"),
    *_trajectory("filtered", "filtered_", "by the frames up to this one"),
    FrameQuantity("latitude_deg", "deg", "%.8f", "of the smoothed position", lambda v, k: _number(v.latlon_deg[k, 0])),
    FrameQuantity("longitude_deg", "deg", "%.8f", "of the smoothed position", lambda v, k: _number(v.latlon_deg[k, 1])),
    *(
        FrameQuantity(f"q{axis}_body_enu", "", "%.9f", "quaternion, enu to body (SciPy's order)", _quaternion(k))
        for k, axis in enumerate("xyzw")
    ),
)  # fmt: skip


def frame_records(track: Track) -> list[dict[str, Any]]:
    """The objects of all frames in track.json; None where a quantity is not known."""
    values = TrackValues(track)
    return [{q.key: q.value(values, k) for q in FRAME_QUANTITIES} for k in range(len(track.frames))]
