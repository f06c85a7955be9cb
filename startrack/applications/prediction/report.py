"""Results of a prediction as a record, as lines of text, and as files: predict.json, .tif, .ecsv and .png."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from startrack import output
from startrack.applications.prediction.draws import Conditions, predictor_of
from startrack.applications.prediction.places import AreaCells, PathPoints
from startrack.applications.prediction.quantities import (
    CELL_QUANTITIES,
    FILTERED,
    FORMAT,
    PATH_QUANTITIES,
    PLACE_QUANTITIES,
    SHARES_M,
    SMOOTHED,
    SUMMARY_QUANTITIES,
    Cells,
    median_or_none,
    summarize_cells,
)
from startrack.applications.prediction.run import add_odometry
from startrack.core import __version__
from startrack.core.errors import BadOutput, length_text
from startrack.core.files import check_regular, remove_file, write_atomically
from startrack.core.stored import read_json_object
from startrack.estimation.observations import OdometryErrors
from startrack.frames import format_utc, latlon_from_enu
from startrack.terrain import Terrain, can_write_maps, load_terrain, write_bands

RECORD_FILE, MAP, STYLE = "predict.json", "predict.tif", "predict.qml"
CELL_TABLE, MAP_PICTURE = "predict.ecsv", "predict.png"
STYLED = "radius95_m"  # the band that QGIS shows
FEW_DRAWS = 5  # at a place, below which its radius is mostly noise
COMPARISON_TABLE, COMPARISON_PICTURE = "predict-compare.ecsv", "predict-compare.png"
PREDICTION_FILES = {MAP, STYLE, CELL_TABLE, RECORD_FILE, MAP_PICTURE, COMPARISON_TABLE, COMPARISON_PICTURE}
NO_RADIUS = "no position at half of the places"
PATH_CURVES = {FILTERED: "images so far, and odometry", SMOOTHED: "all images, and odometry"}
SETTINGS = ("kind", "terrain", "camera", "first_time_utc", "last_time_utc", "spacing_m", "places")  # of one prediction


@dataclass(frozen=True, eq=False)
class Plan:
    """Plan of a prediction: the `points` under the `conditions`, on the `terrain` that these name."""

    conditions: Conditions
    terrain: Terrain
    points: AreaCells | PathPoints
    inputs: tuple[tuple[str, str], ...]  # of the record: names and SHA-256 of files

    @classmethod
    def of(cls, conditions: Conditions, inputs: tuple[tuple[str, str], ...], points: AreaCells | PathPoints) -> Plan:
        """The plan of `points` under `conditions`; its record lists `inputs`. Raises BadInput for unusable files."""
        predictor_of(conditions).exposure_s  # noqa: B018 - a camera without a sensor is refused before anything is drawn
        return cls(conditions, load_terrain(conditions.terrain), points, inputs)

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the prediction for its record, without results."""
        predictor, times = predictor_of(self.conditions), self.conditions.times_utc
        return {
            "format": FORMAT,
            "kind": self.points.kind,
            "terrain": self.terrain.name,
            "camera": predictor.camera.name,
            "first_time_utc": format_utc(times[0]),
            "last_time_utc": format_utc(times[-1]),
            "exposure_s": predictor.exposure_s,
            "limiting_v_mag": predictor.limiting_v_mag,
            "sky_mag_arcsec2": self.conditions.sky_v_mag_arcsec2,
            "spacing_m": self.points.spacing_m,
            "places": len(self.points.position_m),
            "draws": len(times),
            "seed": self.conditions.seed,
            "localizer": self.conditions.localizer,
        }

    def check_folder(self, out: Path, *, overwrite: bool) -> None:
        """Raise BadOutput if `out` holds a prediction of other places, cameras or times and not `overwrite`.

        It is raised, too, where a name of its files is taken by what is no regular file.
        """
        for name in sorted(PREDICTION_FILES):
            check_regular(out / name)
        before, now = read_json_object(out / RECORD_FILE), self.settings
        differs = [] if before is None else [key for key in SETTINGS if before.get(key) != now[key]]
        if differs and not overwrite:
            what = f"{out} holds another prediction ({', '.join(differs)} differ)"
            raise BadOutput("bad_image", f"{what}: choose another -D, or replace it with -O")


@dataclass(frozen=True, eq=False)
class Report:
    """A prediction: the quantities of the points of a `plan`, and what it is compared with."""

    plan: Plan
    cells: Cells
    variants: list[dict[str, Any]]  # records of other conditions
    depth: dict[str, Any] | None  # record of the search for a depth, if there was one
    odometry: OdometryErrors | None  # between the images along a path

    @classmethod
    def of(
        cls, plan: Plan, cells: Cells, others: Mapping[Conditions, Cells], depth: dict[str, Any] | None,
        odometry: OdometryErrors | None,
    ) -> Report:  # fmt: skip
        """The report with the predictions: `cells` of the `plan`, and `others` to compare with.

        `depth` is the record of the search for a depth; with `odometry` the cells get the radii by images and odometry.
        """
        variants = []
        for other, found in others.items():
            known = predictor_of(other)
            light = {"exposure_s": known.exposure_s, "limiting_v_mag": known.limiting_v_mag}
            variants.append({"camera": known.camera.name, **light, "summary": summarize_cells(found)})
        if odometry is not None:
            cells = add_odometry(plan.points.position_m, cells, odometry)
        return cls(plan, cells, variants, depth, odometry)

    @property
    def record(self) -> dict[str, Any]:
        """The content of predict.json."""
        more: dict[str, Any] = {"variants": self.variants} if self.variants else {}
        if self.depth is not None:
            more["depth"] = self.depth
        if self.odometry is not None:
            medians = {f"median_{name}": median_or_none(self.cells[name]) for name in (FILTERED, SMOOTHED)}
            more["odometry"] = {"sigma": self.odometry.sigma_1, "floor_m": self.odometry.floor_m, **medians}
        provenance = {"version": __version__, "inputs": dict(self.plan.inputs)}
        return {**self.plan.settings, "summary": summarize_cells(self.cells), **more, "provenance": provenance}

    def lines(self) -> list[str]:
        """The summary in words."""
        found, what = summarize_cells(self.cells), "area" if self.plan.points.kind == "area" else "path"
        radius = _median_error_text(found["median_radius95_m"])
        shares = ", ".join(f"{100 * found[f'share_below_{bound}_m']:.0f} % below {bound} m" for bound in SHARES_M)
        lines = [
            f"{self.plan.terrain.name}: {len(self.plan.points.position_m)} places, {radius}; of the {what} {shares}",
            f"draws: {100 * found['p_ok']:.1f} % located, {100 * found['p_ambiguous']:.1f} % ambiguous, "
            f"{100 * found['p_refused']:.1f} % refused",
        ]
        if self.odometry is not None:
            radii = [self.record["odometry"][f"median_{name}"] for name in (FILTERED, SMOOTHED)]
            texts = [length_text(one, 3) for one in radii if one is not None]
            known = len(texts) == len(radii)
            text = f"median 95 % radius {texts[0]} at each place, {texts[1]} by all images" if known else NO_RADIUS
            lines.append(f"with odometry: {text}")
        if (depth := self.depth) is not None:
            reached = f"not reached by any exposure to {depth['tried'][-1]['exposure_s']:.3g} s"
            if depth["exposure_s"] is not None:
                reached = f"{depth['exposure_s']:.3g} s, limiting magnitude V {depth['limiting_v_mag']:.1f}"
            wanted = f"{depth['target_radius95_m']:g} m at {100 * depth['share']:.0f} % of the places"
            lines.append(f"{wanted}: {reached}")
        for one in self.variants:
            radius = _median_error_text(one["summary"]["median_radius95_m"])
            lines.append(f"{one['camera']}, {one['exposure_s']:.3g} s (V {one['limiting_v_mag']:.1f}): {radius}")
        return lines


def _median_error_text(radius95_m: float | None) -> str:
    if radius95_m is None:
        return NO_RADIUS
    return f"median 95 % radius {length_text(radius95_m, 3)}"


def write_report(report: Report, out: Path, *, plots: bool) -> list[Path]:
    """Write the files of a `report` into the folder `out`, with pictures if `plots`; returns their paths.

    Files of an earlier prediction that this one does not make are removed. Without rasterio there is no predict.tif.
    """
    points, made, maps = report.plan.points, dict[str, bytes](), list[str]()
    if (
        isinstance(points, AreaCells) and can_write_maps()
    ):  # the quantities as bands, in the projection of the terrain's map
        bands = {one.key: points.band(report.cells[one.key]) for one in CELL_QUANTITIES}
        write_bands(out / MAP, points.frame, bands)
        maps = [MAP]
        if classes := output.radius_classes(report.cells[STYLED]):
            made[STYLE] = output.qgis_style_text(1 + list(bands).index(STYLED), classes).encode()
    made[CELL_TABLE] = _table(report).encode()
    if plots:
        made[MAP_PICTURE] = output.png_bytes(_picture(report))
    if report.variants:
        made[COMPARISON_TABLE] = _comparison_table(report.variants).encode()
        if plots:
            title = f"Cameras and exposures at the same places: {report.plan.terrain.name}"
            made[COMPARISON_PICTURE] = output.png_bytes(output.comparison_picture(report.variants, title))
    made[RECORD_FILE] = (json.dumps(report.record, indent=1) + "\n").encode()
    for name, data in made.items():
        write_atomically(out / name, data, overwrite=True)
    names = [*maps, *made]
    for name in PREDICTION_FILES - set(names):
        remove_file(out / name)
    return [out / name for name in names]


def _table(report: Report) -> str:
    """ECSV text with a row for each place, and with the distance along the path, if there is one."""
    points, site, (east_m, north_m) = report.plan.points, report.plan.terrain.site, report.plan.points.position_m.T
    values = {**report.cells, "east_m": east_m, "north_m": north_m}
    if isinstance(points, PathPoints):
        values["distance_m"] = points.distance_m
    if site is not None:
        up_m = np.asarray(report.plan.terrain.ground_m(points.position_m)) + report.plan.terrain.camera_height_m
        values |= zip(
            ("latitude_deg", "longitude_deg"), np.degrees(latlon_from_enu(site, east_m, north_m, up_m)), strict=True
        )
    return output.ecsv_text(output.quantity_columns((*PLACE_QUANTITIES, *CELL_QUANTITIES, *PATH_QUANTITIES), values))


def _comparison_table(variants: list[dict[str, Any]]) -> str:
    """ECSV text with a row for each camera and exposure: the summary of the same places."""
    rows = [{**one, **one["summary"]} for one in variants]
    columns = [
        output.Column("camera", datatype="string", path=("camera",)),
        output.Column("exposure_s", unit="s", form="%.6g", path=("exposure_s",)),
        output.Column("limiting_v_mag", unit="mag", form="%.3f", path=("limiting_v_mag",)),
    ]
    columns += [column for quantity in SUMMARY_QUANTITIES for column in quantity.table_columns]
    return output.ecsv_text([replace(one, values=[one.value(row) for row in rows], description="") for one in columns])


def _picture(report: Report) -> Any:
    points, cells = report.plan.points, report.cells
    radius = np.where(np.isnan(cells["radius95_m"]), np.inf, cells["radius95_m"])
    title = f"How well one image of the stars gives the position: {report.plan.terrain.name}"
    s = report.plan.settings
    times = s["first_time_utc"][:16].replace("T", " ")
    if s["last_time_utc"] != s["first_time_utc"]:
        times += f" to {s['last_time_utc'][:16].replace('T', ' ')}"
    draws = f"{s['draws']} draw{'' if s['draws'] == 1 else 's'} every {s['spacing_m']:.4g} m"
    draws += ": rough" if s["draws"] < FEW_DRAWS else ""
    caption = [f"camera {s['camera']}, {s['exposure_s']:.3g} s, {times} UTC, {draws}"]
    if isinstance(points, AreaCells):
        return output.prediction_picture(report.plan.terrain, points.site, points.raster(radius), title, caption)
    curves = {words: cells[name] for name, words in PATH_CURVES.items() if name in cells}
    return output.path_picture(points.distance_m, radius, cells["p_ok"], title, caption, curves)
