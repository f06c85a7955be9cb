"""A prediction as files: predict.tif, predict.ecsv, predict.json, predict.png."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from startrack.applications.prediction.places import AreaCells, PathPoints
from startrack.applications.prediction.report import RECORD_FILE, Report
from startrack.core.files import write_atomically
from startrack.frames import latlon_from_enu
from startrack.output.ecsv import Column, ecsv_text, format_values
from startrack.output.quantities_prediction import CELL_QUANTITIES, FILTERED, PATH_QUANTITIES, SMOOTHED
from startrack.terrain import write_bands

MAP, TABLE, PICTURE = "predict.tif", "predict.ecsv", "predict.png"
COMPARISON_TABLE, COMPARISON_PICTURE = "predict-compare.ecsv", "predict-compare.png"
FILES = (MAP, TABLE, RECORD_FILE, PICTURE, COMPARISON_TABLE, COMPARISON_PICTURE)
PATH_CURVES = {FILTERED: "images so far, and odometry", SMOOTHED: "all images, and odometry"}


def write_report(report: Report, out: Path, *, plots: bool) -> list[Path]:
    """Write the files; those of an earlier prediction that this one does not make are removed."""
    from startrack.output import png_bytes

    points, made = report.points, dict[str, bytes]()
    if isinstance(points, AreaCells):  # the quantities as bands, in the projection of the terrain's map
        bands = {one.name: points.band(report.cells[one.name]) for one in CELL_QUANTITIES}
        write_bands(out / MAP, points.frame, bands)
    made[TABLE] = _table(report).encode()
    if plots:
        made[PICTURE] = png_bytes(_picture(report))
    if report.variants:
        made[COMPARISON_TABLE] = _comparison_table(report.variants).encode()
        if plots:
            made[COMPARISON_PICTURE] = png_bytes(_comparison_picture(report))
    made[RECORD_FILE] = (json.dumps(report.record, indent=1) + "\n").encode()
    for name, data in made.items():
        write_atomically(out / name, data, overwrite=True)
    names = [*([MAP] if isinstance(points, AreaCells) else []), *made]
    for name in set(FILES) - set(names):
        (out / name).unlink(missing_ok=True)
    return [out / name for name in names]


def _table(report: Report) -> str:
    """One row a place; with the distance along the path, if there is one."""
    points, site, (east_m, north_m) = report.points, report.terrain.site, report.points.position_m.T
    columns = []
    if isinstance(points, PathPoints):
        columns.append(_column("distance_m", points.distance_m, "m", "%.3f", "from the path's start"))
    for name, values in (("east_m", east_m), ("north_m", north_m)):
        columns.append(_column(name, values, "m", "%.3f", "of the camera from the terrain's origin"))
    if site is not None:
        up_m = np.asarray(report.terrain.ground_m(points.position_m)) + report.terrain.camera_height_m
        angles = latlon_from_enu(site, east_m, north_m, up_m)
        for name, angle in zip(("latitude_deg", "longitude_deg"), angles, strict=True):
            columns.append(_column(name, np.degrees(angle), "deg", "%.9f", "of the camera"))
    columns += [
        _column(one.name, report.cells[one.name], one.unit, one.form, one.description)
        for one in (*CELL_QUANTITIES, *PATH_QUANTITIES)
        if one.name in report.cells
    ]
    return ecsv_text(columns)


def _comparison_table(variants: list[dict[str, Any]]) -> str:
    """One row a camera and exposure: the summary of the same places."""
    heads = {"exposure_s": ("s", "%.6g"), "limiting_v_mag": ("mag", "%.3f")}
    columns = [Column("camera", [one["camera"] for one in variants], "string")]
    columns += [_column(key, [one[key] for one in variants], unit, form) for key, (unit, form) in heads.items()]
    columns += [
        _column(key, [one["summary"][key] for one in variants], "m" if key.startswith("median") else "", "%.6g")
        for key in variants[0]["summary"]
    ]
    return ecsv_text(columns)


def _column(name: str, values: Any, unit: str, form: str, description: str = "") -> Column:
    known = [None if value is None or np.isnan(value) else float(value) for value in values]
    return Column(name, format_values(form, known), "float64", unit or None, description=description)


def _picture(report: Report) -> Any:
    from startrack.output.picture.prediction_map import prediction_picture
    from startrack.output.picture.prediction_plot import path_picture

    points, cells = report.points, report.cells
    radius = np.where(np.isnan(cells["radius95_m"]), np.inf, cells["radius95_m"])
    title = f"How well one image of the stars gives the position: {report.terrain.name}"
    if isinstance(points, AreaCells):
        raster = points.raster(radius)
        return prediction_picture(report.terrain, points.site, raster, title, _caption(report))
    curves = {words: cells[name] for name, words in PATH_CURVES.items() if name in cells}
    return path_picture(points.distance_m, radius, cells["p_ok"], title, _caption(report), curves)


def _comparison_picture(report: Report) -> Any:
    from startrack.output.picture.prediction_plot import comparison_picture

    return comparison_picture(report.variants, f"Cameras and exposures at the same places: {report.terrain.name}")


def _caption(report: Report) -> list[str]:
    s = report.settings
    times = s["first_time_utc"][:16].replace("T", " ")
    if s["last_time_utc"] != s["first_time_utc"]:
        times += f" to {s['last_time_utc'][:16].replace('T', ' ')}"
    draws = f"{s['draws']} draws every {s['spacing_m']:.4g} m"
    return [f"camera {s['camera']}, {s['exposure_s']:.3g} s, {times} UTC, {draws}"]
