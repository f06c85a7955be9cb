"""The files of a track: TUM text, tables, GeoJSON, JSON, picture and page."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np

from startrack import __version__
from startrack.applications.tracking.quantities import FORMAT, FRAME_QUANTITIES, STATUSES, frame_records
from startrack.applications.tracking.track import CrestHeights, Track, Trajectory
from startrack.core.files import write_atomically
from startrack.frames import R_from_quat_xyzw, tum_line
from startrack.output import Column, ecsv_text, feature, geojson_text, json_text, quantity_columns

FILES = ("track.tum", "track.filtered.tum", "track.ecsv", "track.geojson", "track.json", "track.crests.ecsv")


def track_record(track: Track, odometry: dict[str, Any] | None = None) -> dict[str, Any]:
    """The object in track.json; `odometry` has the settings of the odometry (None: there is none)."""
    statuses = [frame.status for frame in track.frames]
    clock = None if track.clock is None else {"offset_s": track.clock.offset_s, "sigma_s": track.clock.sigma_s}
    depth = track.depth and {
        "error_percent": 100.0 * track.depth.error_1, "sigma_percent": 100.0 * track.depth.sigma_1
    }  # fmt: skip
    error_deg, sigma_deg = np.degrees([track.bias_rad, track.bias_sigma_rad]).tolist()
    return {
        "format": FORMAT,
        "terrain": track.terrain.name,
        "at_rest": track.at_rest,
        "odometry": odometry,
        "counts": {
            "frames": len(statuses), **{name: statuses.count(name) for name in STATUSES},
            "slips": int(np.count_nonzero(track.slipped)),
        },
        "horizon": {"error_deg": error_deg, "sigma_deg": sigma_deg},
        "clock": clock,
        "depth": depth,
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
    made: dict[str, bytes] = {
        "track.tum": tum_text(track, track.smoothed).encode(),
        "track.filtered.tum": tum_text(track, track.filtered).encode(),
        "track.ecsv": frames_table(record["frames"]).encode(),
        "track.geojson": track_geojson(track, record["frames"]).encode(),
        "track.crests.ecsv": crests_table(track).encode(),
        **(pictures or {}),
        "track.json": json_text(record).encode(),  # last: it exists where all others do
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


def frames_table(records: Sequence[dict[str, Any]]) -> str:
    """track.ecsv: a row for each of the frames' `records`."""
    values = {q.key: [record[q.key] for record in records] for q in FRAME_QUANTITIES}
    return ecsv_text(quantity_columns(FRAME_QUANTITIES, values))


def crests_table(track: Track) -> str:
    """track.crests.ecsv: a row for each post of the map whose height the track depends on."""
    crests = track.crests or CrestHeights(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    number = "number of the post in the terrain's maps"
    columns = [Column("post", crests.post, "int64", form="%d", description=number)]
    for axis, values in zip(("east", "north", "up"), crests.position_enu_m.T, strict=True):
        columns.append(Column(f"{axis}_m", values, unit="m", form="%.3f", description=f"{axis} of the post by the map"))
    columns.append(
        Column("error_m", crests.error_m, unit="m", form="%.4f", description="height of the ground less the map's")
    )
    columns.append(
        Column("sigma_m", crests.sigma_m, unit="m", form="%.4f", description="standard deviation of error_m")
    )
    return ecsv_text(columns)


def track_geojson(track: Track, records: Sequence[dict[str, Any]]) -> str:
    """track.geojson: a line through the smoothed positions of a `track`, and a point for each of its `records`."""
    known = [one for one in records if one["latitude_deg"] is not None]
    places = [[one["longitude_deg"], one["latitude_deg"]] for one in known]
    line = feature("LineString", places, {"name": "smoothed track", "terrain": track.terrain.name})
    points = [feature("Point", place, one) for place, one in zip(places, known, strict=True)]
    site = track.terrain.site
    return geojson_text([*([line] if len(places) > 1 else []), *points], "" if site is None else site.body)
