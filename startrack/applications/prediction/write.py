"""A prediction as files: predict.tif, predict.ecsv, predict.json, predict.png."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from startrack.applications.prediction.places import AreaCells, PathPoints
from startrack.applications.prediction.quantities import (
    CELL_QUANTITIES,
    FILTERED,
    PATH_QUANTITIES,
    PLACE_QUANTITIES,
    SMOOTHED,
    SUMMARY_QUANTITIES,
)
from startrack.applications.prediction.report import RECORD_FILE, Report
from startrack.core.files import write_atomically
from startrack.frames import latlon_from_enu
from startrack.output import (
    Column,
    TableColumn,
    comparison_picture,
    ecsv_text,
    format_values,
    path_picture,
    png_bytes,
    prediction_picture,
    quantity_columns,
)
from startrack.terrain import write_bands

MAP, CELL_TABLE, MAP_PICTURE = "predict.tif", "predict.ecsv", "predict.png"
COMPARISON_TABLE, COMPARISON_PICTURE = "predict-compare.ecsv", "predict-compare.png"
PREDICTION_FILES = (MAP, CELL_TABLE, RECORD_FILE, MAP_PICTURE, COMPARISON_TABLE, COMPARISON_PICTURE)
PATH_CURVES = {FILTERED: "images so far, and odometry", SMOOTHED: "all images, and odometry"}


def write_report(report: Report, out: Path, *, plots: bool) -> list[Path]:
    """Write the files of a `report` into the folder `out`, with pictures if `plots`; returns their paths.

    Files of an earlier prediction that this one does not make are removed.
    """
    points, made = report.points, dict[str, bytes]()
    if isinstance(points, AreaCells):  # the quantities as bands, in the projection of the terrain's map
        bands = {one.key: points.band(report.cells[one.key]) for one in CELL_QUANTITIES}
        write_bands(out / MAP, points.frame, bands)
    made[CELL_TABLE] = _table(report).encode()
    if plots:
        made[MAP_PICTURE] = png_bytes(_picture(report))
    if report.variants:
        made[COMPARISON_TABLE] = _comparison_table(report.variants).encode()
        if plots:
            made[COMPARISON_PICTURE] = png_bytes(_comparison_picture(report))
    made[RECORD_FILE] = (json.dumps(report.record, indent=1) + "\n").encode()
    for name, data in made.items():
        write_atomically(out / name, data, overwrite=True)
    names = [*([MAP] if isinstance(points, AreaCells) else []), *made]
    for name in set(PREDICTION_FILES) - set(names):
        (out / name).unlink(missing_ok=True)
    return [out / name for name in names]


def _table(report: Report) -> str:
    """One row a place; with the distance along the path, if there is one."""
    points, site, (east_m, north_m) = report.points, report.terrain.site, report.points.position_m.T
    values = {**report.cells, "east_m": east_m, "north_m": north_m}
    if isinstance(points, PathPoints):
        values["distance_m"] = points.distance_m
    if site is not None:
        up_m = np.asarray(report.terrain.ground_m(points.position_m)) + report.terrain.camera_height_m
        values |= zip(
            ("latitude_deg", "longitude_deg"), np.degrees(latlon_from_enu(site, east_m, north_m, up_m)), strict=True
        )
    return ecsv_text(quantity_columns((*PLACE_QUANTITIES, *CELL_QUANTITIES, *PATH_QUANTITIES), values))


def _comparison_table(variants: list[dict[str, Any]]) -> str:
    """One row a camera and exposure: the summary of the same places."""
    rows = [{**one, **one["summary"]} for one in variants]
    columns = [
        TableColumn("camera", "string", None, "%s", ("camera",)),
        TableColumn("exposure_s", "float64", "s", "%.6g", ("exposure_s",)),
        TableColumn("limiting_v_mag", "float64", "mag", "%.3f", ("limiting_v_mag",)),
        *(column for quantity in SUMMARY_QUANTITIES for column in quantity.table_columns),
    ]
    return ecsv_text([
        Column(one.name, format_values(one.form, [one.value(row) for row in rows]), one.datatype, one.unit)
        for one in columns
    ])  # fmt: skip


def _picture(report: Report) -> Any:
    points, cells = report.points, report.cells
    radius = np.where(np.isnan(cells["radius95_m"]), np.inf, cells["radius95_m"])
    title = f"How well one image of the stars gives the position: {report.terrain.name}"
    if isinstance(points, AreaCells):
        raster = points.raster(radius)
        return prediction_picture(report.terrain, points.site, raster, title, _caption(report))
    curves = {words: cells[name] for name, words in PATH_CURVES.items() if name in cells}
    return path_picture(points.distance_m, radius, cells["p_ok"], title, _caption(report), curves)


def _comparison_picture(report: Report) -> Any:
    return comparison_picture(report.variants, f"Cameras and exposures at the same places: {report.terrain.name}")


def _caption(report: Report) -> list[str]:
    s = report.settings
    times = s["first_time_utc"][:16].replace("T", " ")
    if s["last_time_utc"] != s["first_time_utc"]:
        times += f" to {s['last_time_utc'][:16].replace('T', ' ')}"
    draws = f"{s['draws']} draws every {s['spacing_m']:.4g} m"
    return [f"camera {s['camera']}, {s['exposure_s']:.3g} s, {times} UTC, {draws}"]
