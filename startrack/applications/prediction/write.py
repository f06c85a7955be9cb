"""A prediction as files: predict.tif, predict.ecsv, predict.json, predict.png."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from startrack.applications.prediction.places import AreaCells
from startrack.applications.prediction.statistics import Cells
from startrack.core.files import write_atomically
from startrack.core.types import Array
from startrack.frames import latlon_from_enu
from startrack.output.ecsv import Column, ecsv_text, format_values
from startrack.output.quantities_prediction import CELL_QUANTITIES, PATH_QUANTITIES
from startrack.terrain import Terrain, write_bands

MAP, TABLE, SUMMARY, PICTURE = "predict.tif", "predict.ecsv", "predict.json", "predict.png"
COMPARISON_TABLE, COMPARISON_PICTURE = "predict-compare.ecsv", "predict-compare.png"
FILES = (MAP, TABLE, SUMMARY, PICTURE, COMPARISON_TABLE, COMPARISON_PICTURE)


def write_map(out: Path, area: AreaCells, cells: Cells) -> Path:
    """The quantities as bands of a GeoTIFF in the projection of the terrain's map."""
    path = out / MAP
    write_bands(path, area.frame, {one.name: area.band(cells[one.name]) for one in CELL_QUANTITIES})
    return path


def write_table(out: Path, terrain: Terrain, position_m: Array, cells: Cells, distance_m: Array | None = None) -> Path:
    """One row a place (k, 2); with the distance along the path, if there is one."""
    columns = [] if distance_m is None else [_column("distance_m", distance_m, "m", "%.3f", "from the path's start")]
    columns += [
        _column("east_m", position_m[:, 0], "m", "%.3f", "of the camera from the terrain's origin"),
        _column("north_m", position_m[:, 1], "m", "%.3f", "of the camera from the terrain's origin"),
    ]
    if terrain.site is not None:
        up_m = np.asarray(terrain.ground_m(position_m)) + terrain.camera_height_m
        names = ("latitude_deg", "longitude_deg")
        for name, angle in zip(
            names, latlon_from_enu(terrain.site, position_m[:, 0], position_m[:, 1], up_m), strict=True
        ):
            columns.append(_column(name, np.degrees(angle), "deg", "%.9f", "of the camera"))
    columns += [
        _column(one.name, cells[one.name], one.unit, one.form, one.description)
        for one in (*CELL_QUANTITIES, *PATH_QUANTITIES)
        if one.name in cells
    ]
    return _write_text(out / TABLE, ecsv_text(columns))


def write_comparison_table(out: Path, variants: list[dict[str, Any]]) -> Path:
    """One row a camera and exposure: the summary of the same places."""
    heads = {"exposure_s": ("s", "%.6g"), "limiting_v_mag": ("mag", "%.3f")}
    columns = [Column("camera", [one["camera"] for one in variants], "string")]
    columns += [_column(key, [one[key] for one in variants], unit, form) for key, (unit, form) in heads.items()]
    columns += [
        _column(key, [one["summary"][key] for one in variants], "m" if key.startswith("median") else "", "%.6g")
        for key in variants[0]["summary"]
    ]
    return _write_text(out / COMPARISON_TABLE, ecsv_text(columns))


def write_summary(out: Path, record: Mapping[str, Any]) -> Path:
    """The summary as JSON."""
    return _write_text(out / SUMMARY, json.dumps(record, indent=1) + "\n")


def write_picture(path: Path, pixels: Any) -> Path:
    """Pixels (H, W, 3) as PNG."""
    from startrack.output import png_bytes

    write_atomically(path, png_bytes(pixels), overwrite=True)
    return path


def _column(name: str, values: Any, unit: str, form: str, description: str = "") -> Column:
    known = [None if value is None or np.isnan(value) else float(value) for value in values]
    return Column(name, format_values(form, known), "float64", unit or None, description=description)


def _write_text(path: Path, text: str) -> Path:
    write_atomically(path, text.encode(), overwrite=True)
    return path
