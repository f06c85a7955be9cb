"""The files of a track: TUM text, tables, GeoJSON, JSON and page; one line a quantity makes all, with their schema."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from startrack import output
from startrack.applications.tracking.picture import known_points, track_extent
from startrack.applications.tracking.track import SizeError, Track, TrackFrame, Trajectory
from startrack.core import __version__
from startrack.core.errors import Reason
from startrack.core.files import write_atomically
from startrack.core.types import Array
from startrack.frames import R_from_quat_xyzw, format_utc, latlon_from_enu, tum_line

FORMAT = "startrack.track/1"
HERE = Path(__file__).parent
PAGE_SCRIPTS = ("basics.js", "view.js", "input.js", "map.js")  # of the page of results
RELIEF_MARGIN = 1.35  # of the map, beyond its edge where the window is wide
OFF_PAGE = ("_body_enu",)  # quantities that the page does not show
ACCURATE, PAGE_DECIMALS = ("latitude_deg", "longitude_deg"), 4
STATUSES = ("used", "left_out", "refused")
COUNTS = ("frames", *STATUSES, "slips", "legs", "outside_odometry")
SEARCHES = ("proven", "beam")
Value = Callable[["FrameValues"], Any]


class FrameValues(NamedTuple):
    """Frame k of a track, the track, and the latitudes and longitudes of all its frames."""

    track: Track
    latlon_rad: Array  # (n, 2) of the smoothed positions
    k: int

    @property
    def frame(self) -> TrackFrame:
        """Frame number k of the track."""
        return self.track.frames[self.k]


def _frame(
    key: str, unit: str, form: str, description: str, value: Value, schema: output.Kind = "number", known: bool = False
) -> output.Quantity:
    """A quantity of a frame; one that is not always `known` may be None."""
    before = output.ABSENT if known else None
    return output.Quantity(key, unit, FrameValues, value, description, schema, before, form=form)


def _number(array: Callable[[FrameValues], Array], *at: int, convert: Callable[[Any], Any] = float) -> Value:
    """Function of a frame to the element `at` in its row of an array of the track; None where it is not finite."""

    def value(v: FrameValues) -> float | None:
        found = float(convert(array(v)[(v.k, *at)]))
        return found if np.isfinite(found) else None

    return value


def _quaternion(axis: int) -> Value:
    """Function of a frame to the element `axis` of its quaternion; None without an attitude."""
    return lambda v: None if v.frame.quat_xyzw_body_enu is None else float(v.frame.quat_xyzw_body_enu[axis])


def _trajectory(name: str, prefix: str, when: str) -> list[output.Quantity]:
    """Quantities of the trajectory `name` of a track; keys begin with `prefix`, descriptions tell `when`."""
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


def track_record(track: Track, odometry: dict[str, Any] | None = None) -> dict[str, Any]:
    """The object in track.json; `odometry` has the settings of the odometry (None: there is none)."""
    statuses = [frame.status for frame in track.frames]
    clock = None if track.clock is None else {"offset_s": track.clock.offset_s, "sigma_s": track.clock.sigma_s}

    def size_record(size: SizeError | None, key: str) -> dict[str, float] | None:
        return None if size is None else {
            key: size.size_m, "sigma_m": size.sigma_m, "error_percent": 100.0 * size.error_1,
            "sigma_percent": 100.0 * size.sigma_1,
        }  # fmt: skip

    error_deg, sigma_deg = np.degrees([track.bias_rad, track.bias_sigma_rad]).tolist()
    return {
        "format": FORMAT,
        "terrain": track.terrain.name,
        "at_rest": track.at_rest,
        "odometry": odometry,
        "counts": {
            "frames": len(statuses), **{name: statuses.count(name) for name in STATUSES},
            "slips": int(np.count_nonzero(track.slipped)), "legs": len(track.legs),
            "outside_odometry": sum(frame.is_outside for frame in track.frames),
        },
        "legs": [
            {
                "first": track.frames[leg.first].name, "last": track.frames[leg.last].name,
                "moves": leg.last - leg.first, "length_m": leg.length_m,
                "factor": leg.factor_1 if np.isfinite(leg.factor_1) else None,
                "heading_deg": float(np.degrees(leg.heading_rad)) if np.isfinite(leg.factor_1) else None,
            }
            for leg in track.legs
        ],
        "horizon": {"error_deg": error_deg, "sigma_deg": sigma_deg},
        "clock": clock,
        "depth": size_record(track.depth, "depth_m"),
        "width": size_record(track.width, "diameter_m"),
        "frames": frame_records(track),
        "provenance": {"version": __version__},
    }  # fmt: skip


def write_track(
    track: Track, out: Path, *, odometry: dict[str, Any] | None = None, pictures: dict[str, bytes] | None = None
) -> list[Path]:
    """Write the files of a `track` into the folder `out`, each complete or not at all; returns their paths.

    `odometry` has its settings, `pictures` files by name that were made already. Raises BadInput if one cannot be
    written.
    """
    record = track_record(track, odometry)
    columns = {q.key: [one[q.key] for one in record["frames"]] for q in FRAME_QUANTITIES}
    made: dict[str, bytes] = {
        "track.tum": tum_text(track, track.smoothed).encode(),
        "track.filtered.tum": tum_text(track, track.filtered).encode(),
        "track.ecsv": output.ecsv_text(output.quantity_columns(FRAME_QUANTITIES, columns)).encode(),
        "track.geojson": track_geojson(track, record["frames"]).encode(),
        **(pictures or {}),
        "track.json": output.json_text(record).encode(),  # last: it exists where all others do
    }
    for name, data in made.items():
        write_atomically(out / name, data, overwrite=True)
    return [out / name for name in made]


def tum_text(track: Track, trajectory: Trajectory) -> str:
    """The poses of the body in enu, a line for each frame with a position and an attitude."""
    lines = []
    for frame, position_m in zip(track.frames, trajectory.position_enu_m, strict=True):
        if frame.quat_xyzw_body_enu is not None and np.isfinite(position_m).all():
            R_enu_body = R_from_quat_xyzw(frame.quat_xyzw_body_enu).T
            lines.append(tum_line(frame.time_utc.astimezone(UTC).timestamp(), position_m, R_enu_body))
    return "".join(lines)


def track_geojson(track: Track, records: Sequence[dict[str, Any]]) -> str:
    """Text of track.geojson: a line through the smoothed positions of a `track`, a point for each of its `records`."""
    points = [
        output.feature("Point", [one["longitude_deg"], one["latitude_deg"]], one)
        for one in records
        if one["latitude_deg"] is not None
    ]
    places = [point["geometry"]["coordinates"] for point in points]
    line = output.feature("LineString", places, {"name": "smoothed track", "terrain": track.terrain.name})
    site = track.terrain.site
    return output.geojson_text([*([line] if len(places) > 1 else []), *points], "" if site is None else site.body)


def track_page(track: Track, title: str) -> str:
    """The page of a `track` as text, with a plain `title`: HTML with its style, scripts and data."""
    (east_m, north_m), half_m = track_extent(track)
    records = frame_records(track)
    head = {
        "columns": [],
        "title": title,
        "at_rest": track.at_rest,
        "legs": track.leg_texts,
        "frames": {
            q.key: [
                round(value, 8 if q.key in ACCURATE else PAGE_DECIMALS) if isinstance(value, float) else value
                for value in (record[q.key] for record in records)
            ]
            for q in FRAME_QUANTITIES
            if not q.key.endswith(OFF_PAGE)
        },
        "odometry": np.round(known_points(track.odometry_m), 3).tolist() or None,
        "crater": track.crater_texts,
        "terrain": track.terrain.name,
        "terrains": {track.terrain.name: output.ground_map(track.terrain, (east_m, north_m), RELIEF_MARGIN * half_m)},
        "world": [east_m - half_m, north_m - half_m, east_m + half_m, north_m + half_m],
    }
    style, script = ((HERE / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return output.fill_frame(f"{title} · startrack", {"results": head}, PAGE_SCRIPTS, style=style, script=script)
