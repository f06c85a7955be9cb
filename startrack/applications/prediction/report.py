"""What a prediction found, as a record and as lines of text."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from startrack import __version__
from startrack.applications.prediction.draws import Conditions, predictor_of
from startrack.applications.prediction.places import AreaCells, PathPoints
from startrack.applications.prediction.quantities import (
    FILTERED,
    FORMAT,
    SHARES_M,
    SMOOTHED,
    Cells,
    median_or_none,
    summarize_cells,
)
from startrack.applications.prediction.run import variant_record
from startrack.applications.prediction.statistics import add_odometry
from startrack.core.errors import BadOutput, length_text
from startrack.frames import format_utc
from startrack.terrain import Terrain, load_terrain

RECORD_FILE = "predict.json"
SETTINGS = ("kind", "terrain", "camera", "first_time_utc", "last_time_utc", "spacing_m", "places")  # of one prediction


@dataclass(frozen=True)
class OdometryErrors:
    """Errors of moves on each horizontal axis."""

    sigma_1: float  # relative to the length of a move
    floor_m: float  # beside that, in quadrature


@dataclass(frozen=True, eq=False)
class Report:
    """A prediction at the points, with its record."""

    conditions: Conditions
    terrain: Terrain
    points: AreaCells | PathPoints
    inputs: tuple[tuple[str, str], ...]
    cells: Cells = field(default_factory=dict)
    variants: list[dict[str, Any]] = field(default_factory=list)
    depth: dict[str, Any] | None = None
    odometry: OdometryErrors | None = None

    @classmethod
    def begin(
        cls, conditions: Conditions, inputs: tuple[tuple[str, str], ...], points: AreaCells | PathPoints
    ) -> Report:
        """The report on `points` under `conditions` before the draws; the record lists the `inputs`.

        Raises BadInput for files that cannot be used.
        """
        predictor_of(conditions).exposure_s  # noqa: B018 - a camera without a sensor is refused before anything is drawn
        return cls(conditions, load_terrain(conditions.terrain), points, inputs)

    def finish(
        self, conditions: Conditions, cells: Cells, others: Mapping[Conditions, Cells], depth: dict[str, Any] | None
    ) -> Report:
        """The report with the predictions: `cells` of the `conditions`, and `others` to compare with.

        `depth` is the record of the search for a depth, if there was one.
        """
        variants = [variant_record(other, found) for other, found in others.items()]
        return replace(self, conditions=conditions, cells=cells, variants=variants, depth=depth)

    def with_odometry(self, odometry: OdometryErrors) -> Report:
        """The report of a path with odometry between its images."""
        points_m = self.points.position_m
        cells = add_odometry(points_m, self.cells, sigma_1=odometry.sigma_1, floor_m=odometry.floor_m)
        return replace(self, cells=cells, odometry=odometry)

    @property
    def settings(self) -> dict[str, Any]:
        """What was predicted, without results."""
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

    @property
    def record(self) -> dict[str, Any]:
        """The content of predict.json."""
        more: dict[str, Any] = {"variants": self.variants} if self.variants else {}
        if self.depth is not None:
            more["depth"] = self.depth
        if self.odometry is not None:
            medians = {f"median_{name}": median_or_none(self.cells[name]) for name in (FILTERED, SMOOTHED)}
            more["odometry"] = {"sigma": self.odometry.sigma_1, "floor_m": self.odometry.floor_m, **medians}
        provenance = {"version": __version__, "inputs": dict(self.inputs)}
        return {**self.settings, "summary": summarize_cells(self.cells), **more, "provenance": provenance}

    def check_folder(self, out: Path, *, overwrite: bool) -> None:
        """Raise BadOutput if `out` holds a prediction of other places, cameras or times and not `overwrite`."""
        try:
            before = json.loads((out / RECORD_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return
        now = self.settings
        differs = [key for key in SETTINGS if not isinstance(before, dict) or before.get(key) != now[key]]
        if differs and not overwrite:
            what = f"{out} holds another prediction ({', '.join(differs)} differ)"
            raise BadOutput("bad_image", f"{what}: choose another -D, or replace it with -O")

    def lines(self) -> list[str]:
        """The summary in words."""
        found, what = summarize_cells(self.cells), "area" if self.points.kind == "area" else "path"
        radius = _median_error_text(found["median_radius95_m"])
        shares = ", ".join(f"{100 * found[f'share_below_{bound}_m']:.0f} % below {bound} m" for bound in SHARES_M)
        lines = [
            f"{self.terrain.name}: {len(self.points.position_m)} places, {radius}; of the {what} {shares}",
            f"draws: {100 * found['p_ok']:.1f} % located, {100 * found['p_ambiguous']:.1f} % ambiguous, "
            f"{100 * found['p_refused']:.1f} % refused",
        ]
        if self.odometry is not None:
            lines.append(_odometry_line(self.record["odometry"]))
        if self.depth is not None:
            lines.append(_depth_line(self.depth))
        for one in self.variants:
            radius = _median_error_text(one["summary"]["median_radius95_m"])
            lines.append(f"{one['camera']}, {one['exposure_s']:.3g} s (V {one['limiting_v_mag']:.1f}): {radius}")
        return lines


def _depth_line(depth: dict[str, Any]) -> str:
    wanted = f"{depth['target_radius95_m']:g} m at {100 * depth['share']:.0f} % of the places"
    if depth["exposure_s"] is None:
        return f"{wanted}: not reached by any exposure to {depth['tried'][-1]['exposure_s']:.3g} s"
    return f"{wanted}: {depth['exposure_s']:.3g} s, limiting magnitude V {depth['limiting_v_mag']:.1f}"


def _median_error_text(radius95_m: float | None) -> str:
    if radius95_m is None:
        return "no position at half of the places"
    return f"median 95 % radius {length_text(radius95_m, 3)}"


def _odometry_line(found: dict[str, Any]) -> str:
    radii = [found[f"median_{name}"] for name in (FILTERED, SMOOTHED)]
    if None in radii:
        return "with odometry: no position at half of the places"
    filtered, smoothed = (length_text(one, 3) for one in radii)
    return f"with odometry: median 95 % radius {filtered} at each place, {smoothed} by all images"
