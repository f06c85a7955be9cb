"""The predicted quantities: bands of predict.tif, columns of predict.ecsv, keys of the summary, and their schema."""

from __future__ import annotations

from collections.abc import Callable
from operator import itemgetter
from typing import Any

import numpy as np

from startrack import output
from startrack.core.types import Array
from startrack.localization import RISK

Cells = dict[str, Array]  # the quantities of places (k,), by the names of CELL_QUANTITIES; and ERROR_RATIO
FORMAT = "startrack.prediction/1"
SHARES_M = (5, 10, 20)  # radii of which the summary has the share of the area
ERROR_RATIO, FILTERED, SMOOTHED = "error_ratio", "radius95_filtered_m", "radius95_smoothed_m"
UNKNOWN = "over the places; null: half of the places or more have no radius"


def _cell(name: str, unit: str, description: str, form: str = "%.6g") -> output.Quantity:
    """Quantity of places: a band of predict.tif, a column of predict.ecsv."""
    return output.Quantity(name, unit, dict, itemgetter(name), description, "number", form=form)


PLACE_QUANTITIES = (
    _cell("distance_m", "m", "from the path's start", "%.3f"),
    _cell("east_m", "m", "of the camera from the terrain's origin", "%.3f"),
    _cell("north_m", "m", "of the camera from the terrain's origin", "%.3f"),
    _cell("latitude_deg", "deg", "of the camera", "%.9f"),
    _cell("longitude_deg", "deg", "of the camera", "%.9f"),
)
CELL_QUANTITIES = (
    _cell("radius95_m", "m", "median over the draws of the 95 % radius; a draw without a position "
          "counts as infinite; empty: half of the draws or more have no position"),
    _cell("p_ok", "", "share of the draws that have one position"),
    _cell("p_ambiguous", "", "share of the draws that several positions fit"),
    _cell("p_refused", "", "share of the draws that are refused"),
    _cell("sigma_major_m", "m", "standard deviation along the long axis of the error ellipse: "
          "of the mean covariance of the draws that have one position"),
    _cell("sigma_minor_m", "m", "standard deviation across it"),
    _cell("azimuth_deg", "deg", "azimuth of the long axis, from 0 to 180"),
    _cell("protection_level_m", "m", "median over the draws of the protection level, beyond which the true position "
          f"lies with probability {RISK:g} at most, also where something stands on no map; a draw without one counts "
          "as infinite; empty: half of the draws or more have none"),
)  # fmt: skip
PATH_QUANTITIES = (  # beside the others, along a path with odometry
    _cell(FILTERED, "m", "95 % radius of the position by the images so far and the odometry between "
          "them; empty before the first image with a position"),
    _cell(SMOOTHED, "m", "the same by all images of the path"),
)  # fmt: skip


def median_or_none(radius_m: Array) -> float | None:
    """Median of radii (k,), NaN where there is no position; None if half of them or more are such."""
    median = float(np.median(np.where(np.isnan(radius_m), np.inf, radius_m)))
    return median if np.isfinite(median) else None


def _error_ratio(cells: Cells) -> float | None:
    """Root mean square over the places of the ratios of errors to stated ones; None where no place has one."""
    ratio = cells[ERROR_RATIO]
    return float(np.sqrt(np.nanmean(np.square(ratio)))) if np.isfinite(ratio).any() else None


def _cells_quantity(
    key: str, unit: str, value: Callable[[Cells], Any], description: str, **more: Any
) -> output.Quantity:
    """A quantity of the summary of places."""
    return output.Quantity(key, unit, dict, value, description, **{"schema": "chance", "form": "%.6g", **more})


def _share_below(bound: int) -> Callable[[Cells], float]:
    return lambda cells: float(np.mean(cells["radius95_m"] < bound))


def _mean(name: str) -> Callable[[Cells], float]:
    return lambda cells: float(np.mean(cells[name]))


SUMMARY_QUANTITIES = (
    _cells_quantity("median_radius95_m", "m", lambda cells: median_or_none(cells["radius95_m"]), UNKNOWN,
              schema="positive", before=None),
    *(
        _cells_quantity(f"share_below_{bound}_m", "", _share_below(bound),
                  f"of the places: those with radius95_m below {bound} m")
        for bound in SHARES_M
    ),
    *(_cells_quantity(name, "", _mean(name), "mean over the places") for name in ("p_ok", "p_ambiguous", "p_refused")),
    _cells_quantity(ERROR_RATIO, "", _error_ratio,
              "errors of the draws over the stated ones, root mean square over the places: near 1 where the stated "
              "ones are right; null: no draw has a position", schema="positive", before=None),
)  # fmt: skip


def summarize_cells(cells: Cells) -> dict[str, Any]:
    """The summary of the places in `cells`, by the keys of the schema."""
    return output.record_from(SUMMARY_QUANTITIES, cells)


SUMMARY = output.schema_of(SUMMARY_QUANTITIES)
VARIANT: output.Schema = output.object_schema({
    "camera": "text",
    "exposure_s": "positive",
    "limiting_v_mag": output.schema_of_kind("number", "of a star on the axis at 5 sigma"),
    "summary": SUMMARY,
})  # fmt: skip
DEPTH: output.Schema = output.object_schema({
    "target_radius95_m": "positive",
    "share": output.schema_of_kind("chance", "of the places that must reach the target"),
    "exposure_s": output.or_null("positive", "shortest that reaches the target; null: none within the limits"),
    "limiting_v_mag": output.or_null("number", "of this exposure: a star on the axis at 5 sigma"),
    "tried": output.list_schema(output.object_schema({"exposure_s": "positive", "share": "chance"})),
})  # fmt: skip
ALONG_PATH: output.Schema = output.object_schema({
    "sigma": output.schema_of_kind("number", "error of a move on each axis, as a part of its length"),
    "floor_m": output.schema_of_kind("number", "beside that, in quadrature"),
    f"median_{FILTERED}": output.or_null("positive", UNKNOWN),
    f"median_{SMOOTHED}": output.or_null("positive", "the same, by all images"),
})  # fmt: skip
INPUTS: output.Schema = {
    "type": "object",
    "additionalProperties": output.schema_of_kind("text"),
    "description": "SHA-256 of the camera's, terrain's and map files by name; shipped ones belong to the version",
}
PREDICTION = output.file_schema(
    "Summary of expected accuracy",
    output.object_schema(
        {
            "format": {"const": FORMAT},
            "kind": {"enum": ["area", "path"]},
            "terrain": "text",
            "camera": "text",
            "first_time_utc": "time",
            "last_time_utc": "time",
            "exposure_s": "positive",
            "limiting_v_mag": VARIANT["properties"]["limiting_v_mag"],
            "sky_mag_arcsec2": "number",
            "spacing_m": "positive",
            "places": "count",
            "draws": "count",
            "seed": "count",
            "localizer": "text",
            "summary": SUMMARY,
            "provenance": output.object_schema({"version": "text", "inputs": INPUTS}),
        },
        optional={"variants": output.list_schema(VARIANT), "depth": DEPTH, "odometry": ALONG_PATH},
    ),
)
