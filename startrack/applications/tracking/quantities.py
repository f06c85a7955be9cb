"""The quantities of a track's frames: one line each makes JSON, table, schema and documentation."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from startrack import output
from startrack.applications.tracking.track import Track, TrackFrame
from startrack.core.errors import Reason
from startrack.core.types import Array
from startrack.frames import format_utc, latlon_from_enu

FORMAT = "startrack.track/1"
STATUSES = ("used", "left_out", "refused")
COUNTS = ("frames", *STATUSES, "slips", "legs", "outside_odometry")
SEARCHES = ("proven", "beam")
Value = Callable[["FrameValues"], Any]


class FrameValues(NamedTuple):
    """Frame k of a track, with what is computed of all its frames."""

    track: Track
    latlon_rad: Array  # (n, 2) of the smoothed positions
    k: int

    @property
    def frame(self) -> TrackFrame:
        """The frame."""
        return self.track.frames[self.k]


def _frame(
    key: str, unit: str, form: str, description: str, value: Value, schema: output.Kind = "number", known: bool = False
) -> output.Quantity:
    """A quantity of a frame; one that is not always `known` may be None."""
    before = output.ABSENT if known else None
    return output.Quantity(key, unit, FrameValues, value, description, schema, before, form=form)


def _number(array: Callable[[FrameValues], Array], *at: int, convert: Callable[[Any], Any] = float) -> Value:
    """The element `at` an index of an array at the frame; None where it is not finite."""

    def value(v: FrameValues) -> float | None:
        found = float(convert(array(v)[(v.k, *at)]))
        return found if np.isfinite(found) else None

    return value


def _quaternion(axis: int) -> Value:
    return lambda v: None if v.frame.quat_xyzw_body_enu is None else float(v.frame.quat_xyzw_body_enu[axis])


def _trajectory(name: str, prefix: str, when: str) -> list[output.Quantity]:
    elements: list[tuple[Any, ...]] = [
        *((f"{axis}_m", "m", "%.4f", f"{axis} of the camera, {when}", "position_enu_m", k)
          for k, axis in enumerate(("east", "north", "up"))),
        *((f"covariance_{text}_m2", "m^2", "%.6g", f"covariance ({text}) of that", "covariance_m2", *at)
          for text, *at in (("ee", 0, 0), ("en", 0, 1), ("nn", 1, 1))),
        *((key, "m", "%.4f", f"circle about it that holds {part} %", key)
          for key, part in (("radius95_m", "95"), ("radius999_m", "99.9"))),
    ]  # fmt: skip
    return [
        _frame(f"{prefix}{key}", unit, form, text, _number(attrgetter(f"track.{name}.{field}"), *at))
        for key, unit, form, text, field, *at in elements
    ]


FRAME_QUANTITIES = (
    _frame("image", "", "%s", "name of the image", lambda v: v.frame.name, "text", known=True),
    _frame("time_utc", "", "%s", "middle of the exposure", lambda v: format_utc(v.frame.time_utc), "text", known=True),
    _frame(
        "status", "", "%s", "used; left_out: contradicts the track, or ambiguous to the end; refused: no position",
        lambda v: v.frame.status, {"enum": list(STATUSES)}, known=True,
    ),
    _frame(
        "reason", "", "%s", "of a frame that is not used", lambda v: v.frame.reason or None,
        {"enum": [None, *(one.value for one in Reason)]}, known=True,
    ),
    _frame("message", "", "%s", "the same in words", lambda v: v.frame.message or None, "text"),
    _frame(
        "slipped", "", "%d", "1: the odometry's move to this frame is judged wheel slip",
        lambda v: int(v.k > 0 and bool(v.track.slipped[v.k - 1])), {"enum": [0, 1]}, known=True,
    ),
    _frame(
        "outside_odometry", "", "%d", "1: the odometry does not cover its time, so that it has no move",
        lambda v: int(v.frame.is_outside), {"enum": [0, 1]}, known=True,
    ),
    _frame(
        "search", "", "%s", "proven: the image alone excludes every other position; beam: its search ended before that",
        lambda v: v.frame.search or None, {"enum": [None, *SEARCHES]}, known=True,
    ),
    *_trajectory("smoothed", "", "by all frames"),
    *_trajectory("filtered", "filtered_", "by the frames up to this one"),
    *(
        _frame(
            key, "deg", "%.8f", "of the smoothed position",
            _number(attrgetter("latlon_rad"), axis, convert=np.degrees),
        )
        for axis, key in enumerate(("latitude_deg", "longitude_deg"))
    ),
    *(
        _frame(f"q{axis}_body_enu", "", "%.9f", "quaternion, enu to body (SciPy's order)", _quaternion(k))
        for k, axis in enumerate("xyzw")
    ),
)  # fmt: skip
STATED_SIZE = "and how much larger than its file states; null where that is taken as exact"


def size_schema(key: str) -> dict[str, Any]:
    """Schema of the depth or the width of a crater, whose value is under `key`."""
    return output.object_schema({
        key: "positive", "sigma_m": "positive", "error_percent": "number", "sigma_percent": "positive"
    })  # fmt: skip


TRACK = output.file_schema(
    "Trajectory of a camera",
    output.object_schema({
        "format": {"const": FORMAT},
        "terrain": "text",
        "at_rest": "flag",
        "odometry": output.or_null(
            output.object_schema({
                "file": "text", "sigma": "positive", "floor_m": "positive", "time_sigma_s": "number",
                "fault": output.or_null("text", "for which it is left out as a whole"),
            }),
            "its file and stated errors",
        ),
        "counts": output.object_schema(dict.fromkeys(COUNTS, "count")),
        "legs": output.list_schema(output.object_schema({
            "first": "text", "last": "text", "moves": "count", "length_m": "positive",
            "factor": output.or_null("positive", "length by the odometry over that of the track"),
            "heading_deg": output.or_null("number", "of the odometry, to the right of the track"),
        })),
        "horizon": output.object_schema(
            {"error_deg": "number", "sigma_deg": "positive"}, "true horizon less the map's"
        ),
        "clock": output.or_null(
            output.object_schema({"offset_s": "number", "sigma_s": "positive"}), "true time less the stated one"
        ),
        "depth": output.or_null(size_schema("depth_m"), f"of a crater, {STATED_SIZE}"),
        "width": output.or_null(size_schema("diameter_m"), f"of a crater, {STATED_SIZE}"),
        "frames": output.list_schema(output.schema_of(FRAME_QUANTITIES, units=True)),
        "provenance": output.object_schema({"version": "text"}),
    }),
)  # fmt: skip


def frame_records(track: Track) -> list[dict[str, Any]]:
    """The objects of all frames in track.json; None where a quantity is not known."""
    latlon_rad, site = np.full((len(track.frames), 2), np.nan), track.terrain.site
    if site is not None:
        latlon_rad = np.stack(latlon_from_enu(site, *track.smoothed.position_enu_m.T), axis=-1)
    return [output.record_from(FRAME_QUANTITIES, FrameValues(track, latlon_rad, k)) for k in range(len(track.frames))]
