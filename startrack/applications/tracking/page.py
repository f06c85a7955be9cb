"""The page of a track: a map with a slider over its frames, the stated errors, and a table; it needs no network."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np

from startrack.applications.tracking.quantities import FRAME_QUANTITIES, frame_records
from startrack.applications.tracking.track import Track
from startrack.applications.tracking.track_map import known_points, track_extent
from startrack.core.types import Array
from startrack.output import filled_frame, ground_map

HERE = Path(__file__).parent
SCRIPTS = ("basics.js", "view.js", "input.js", "map.js")  # of the page of results
RELIEF_MARGIN = 1.35  # of the map, beyond its edge where the window is wide
LEFT_OUT = ("_body_enu",)  # quantities that the page does not show
ACCURATE = ("latitude_deg", "longitude_deg")
DECIMALS = 4


def track_page(track: Track, picture_png: bytes, *, title: str, odometry_m: Array | None = None) -> str:
    """The page as text: HTML with its style, scripts and data.

    Args:
        track: with n frames.
        picture_png: the picture of the track, as a file.
        title: of the page, plain text.
        odometry_m: positions (n, 2) in enu by odometry alone; None: not known.
    """
    centre_m, half_m = track_extent(track, odometry_m)
    head = {
        "columns": [],
        "title": title,
        "at_rest": track.at_rest,
        "frames": _frame_columns(track),
        "odometry": None if odometry_m is None else np.round(known_points(odometry_m), 3).tolist(),
        "terrain": track.terrain.name,
        "terrains": {track.terrain.name: ground_map(track.terrain, centre_m, RELIEF_MARGIN * half_m)},
        "world": [centre_m[0] - half_m, centre_m[1] - half_m, centre_m[0] + half_m, centre_m[1] + half_m],
        "picture": f"data:image/png;base64,{base64.b64encode(picture_png).decode('ascii')}",
    }
    style, script = ((HERE / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return filled_frame(f"{title} · startrack", {"results": head}, SCRIPTS, style=style, script=script)


def _frame_columns(track: Track) -> dict[str, list[Any]]:
    """The quantities of all frames by their keys."""
    records = frame_records(track)
    keys = [q.key for q in FRAME_QUANTITIES if not q.key.endswith(LEFT_OUT)]
    return {key: [_rounded(record[key], 8 if key in ACCURATE else DECIMALS) for record in records] for key in keys}


def _rounded(value: Any, decimals: int) -> Any:
    return round(value, decimals) if isinstance(value, float) else value
