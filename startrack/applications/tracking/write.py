"""The files of a track: TUM text, tables, GeoJSON, JSON, picture and page."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np

from startrack import output
from startrack.applications.tracking.legs import SlippedLeg
from startrack.applications.tracking.quantities import FORMAT, FRAME_QUANTITIES, STATUSES, frame_records
from startrack.applications.tracking.track import SizeError, Track, Trajectory
from startrack.applications.tracking.track_map import known_points, track_extent
from startrack.core import __version__
from startrack.core.files import write_atomically
from startrack.core.types import Array
from startrack.frames import R_from_quat_xyzw, tum_line

HERE = Path(__file__).parent
PAGE_SCRIPTS = ("basics.js", "view.js", "input.js", "map.js")  # of the page of results
RELIEF_MARGIN = 1.35  # of the map, beyond its edge where the window is wide
OFF_PAGE = ("_body_enu",)  # quantities that the page does not show
ACCURATE = ("latitude_deg", "longitude_deg")
PAGE_DECIMALS = 4


def track_record(track: Track, odometry: dict[str, Any] | None = None) -> dict[str, Any]:
    """The object in track.json; `odometry` has the settings of the odometry (None: there is none)."""
    statuses = [frame.status for frame in track.frames]
    clock = None if track.clock is None else {"offset_s": track.clock.offset_s, "sigma_s": track.clock.sigma_s}
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
        "legs": [leg_record(track, one) for one in track.legs],
        "horizon": {"error_deg": error_deg, "sigma_deg": sigma_deg},
        "clock": clock,
        "depth": size_record(track.depth, "depth_m"),
        "width": size_record(track.width, "diameter_m"),
        "frames": frame_records(track),
        "provenance": {"version": __version__},
    }  # fmt: skip


def leg_record(track: Track, leg: SlippedLeg) -> dict[str, Any]:
    """The object of a slipped leg in track.json."""
    is_known = np.isfinite(leg.factor_1)
    return {
        "first": track.frames[leg.first].name, "last": track.frames[leg.last].name, "moves": leg.last - leg.first,
        "length_m": leg.length_m, "factor": leg.factor_1 if is_known else None,
        "heading_deg": float(np.degrees(leg.heading_rad)) if is_known else None,
    }  # fmt: skip


def size_record(size: SizeError | None, key: str) -> dict[str, float] | None:
    """The object of the depth or the width of a crater, whose value is under `key`; None of one that is exact."""
    return None if size is None else {
        key: size.size_m, "sigma_m": size.sigma_m, "error_percent": 100.0 * size.error_1,
        "sigma_percent": 100.0 * size.sigma_1,
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
    """track.geojson: a line through the smoothed positions of a `track`, and a point for each of its `records`."""
    points = [
        output.feature("Point", [one["longitude_deg"], one["latitude_deg"]], one)
        for one in records
        if one["latitude_deg"] is not None
    ]
    places = [point["geometry"]["coordinates"] for point in points]
    line = output.feature("LineString", places, {"name": "smoothed track", "terrain": track.terrain.name})
    site = track.terrain.site
    return output.geojson_text([*([line] if len(places) > 1 else []), *points], "" if site is None else site.body)


def track_page(track: Track, picture_png: bytes, *, title: str, odometry_m: Array | None = None) -> str:
    """The page as text: HTML with its style, scripts and data.

    Args:
        track: with n frames.
        picture_png: the picture of the track, as a file.
        title: of the page, plain text.
        odometry_m: positions (n, 2) in enu by odometry alone; None: not known.
    """
    (east_m, north_m), half_m = track_extent(track, odometry_m)
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
        "odometry": None if odometry_m is None else np.round(known_points(odometry_m), 3).tolist(),
        "crater": track.crater_texts,
        "terrain": track.terrain.name,
        "terrains": {track.terrain.name: output.ground_map(track.terrain, (east_m, north_m), RELIEF_MARGIN * half_m)},
        "world": [east_m - half_m, north_m - half_m, east_m + half_m, north_m + half_m],
        "picture": f"data:image/png;base64,{base64.b64encode(picture_png).decode('ascii')}",
    }
    style, script = ((HERE / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return output.fill_frame(f"{title} · startrack", {"results": head}, PAGE_SCRIPTS, style=style, script=script)
