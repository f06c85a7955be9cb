"""Tables as ECSV: of stars, of a measured skyline, and of quantities.

ECSV 1.0 (Astropy Proposal for Enhancement 6) is a table that astropy, TOPCAT and spreadsheets read. It is written here
in a tenth of the time that astropy takes. Comma-separated; an empty field is a masked value.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from startrack.catalog import star_names
from startrack.chain import Identified, Inputs, Measured, Oriented
from startrack.core.types import Array, Ints, MeasuredSkyline, Stars
from startrack.evidence import SEEN_LLR
from startrack.output.quantity import Quantity

if TYPE_CHECKING:
    from startrack.evidence import StarPhotometry

STAR_STATUSES = ("seen", "hidden", "uncertain", "unusable")
FAINTER_THAN_FAINTEST_MATCH_MAG = 0.5
LEAST_HALF_RAD, MOST_HALF_RAD = np.radians(0.02), np.radians(5.0)


@dataclass(frozen=True)
class Column:
    """One column: its heading and its values, None (or an empty text) where there is none."""

    name: str
    values: Iterable[Any]
    datatype: str = "float64"  # or int64, string, bool
    unit: str | None = None  # as astropy spells it
    form: str = "%s"  # of a value; of one in a sparse column with None in it, use `format_values`
    description: str = ""


def ecsv_text(columns: Sequence[Column]) -> str:
    """The table as ECSV. All columns have the same length; texts must be free of line breaks."""
    head = ["# %ECSV 1.0", "# ---", "# delimiter: ','", "# datatype:"]
    head += [_yaml_line(column) for column in columns]
    head += ["# schema: astropy-2.0", ",".join(column.name for column in columns)]
    row = ",".join(column.form for column in columns)
    values = [_column_values(column) for column in columns]
    return "\n".join([*head, *map(row.__mod__, zip(*values, strict=True))]) + "\n"


def quantity_columns(quantities: Iterable[Quantity], values: Mapping[str, Iterable[Any]]) -> list[Column]:
    """Columns of the `quantities` that have `values`, by the names of the columns; empty for None and nan."""
    return [
        Column(one.name, format_values(one.form, values[one.name]), one.datatype, one.unit, description=one.description)
        for quantity in quantities
        for one in quantity.table_columns
        if one.name in values
    ]


def format_values(form: str, values: Iterable[Any]) -> list[str]:
    """The `values` as texts in the %-format `form`; empty for None and nan."""
    return ["" if value is None or value != value else form % value for value in values]


def quote_texts(texts: Iterable[str]) -> list[str]:
    """Texts as CSV fields: quoted where they hold a comma or a quote."""
    return ['"' + text.replace('"', '""') + '"' if "," in text or '"' in text else text for text in texts]


def _column_values(column: Column) -> list[Any]:
    values = column.values.tolist() if isinstance(column.values, np.ndarray) else list(column.values)
    return quote_texts(values) if column.datatype == "string" else values


def _yaml_line(column: Column) -> str:
    unit = f"unit: {column.unit}, " if column.unit else ""
    description = column.description.replace("'", "''")
    return f"# - {{name: '{column.name}', {unit}datatype: {column.datatype}, description: '{description}'}}"


def star_table_text(value: Inputs) -> str:
    """The star table of `value`, the last of a result, as ECSV, brightest star first; stars must have been identified.

    After `locate`: every star whose light was measured. Without a terrain: the matched stars and all others in the
    frame down to half a magnitude below the faintest of them, without azimuth, elevation and evidence.
    """
    if not isinstance(value, Oriented):
        raise ValueError("no star table without identified stars")
    if not isinstance(value, Measured):
        star, xy_px = stars_in_view(value)
        return ecsv_text([*_catalog_columns(value.stars, star), *_place_columns(value, star, xy_px)])
    light = value.light
    return ecsv_text([
        *_catalog_columns(value.stars, light.star),
        Column("azimuth_deg", np.degrees(light.azimuth_rad), "float64", "deg", "%.5f", "north through east, in enu"),
        Column("elevation_deg", np.degrees(light.elevation_rad), "float64", "deg", "%.5f", "in enu"),
        *_place_columns(value, light.star, light.xy_px),
        *_light_columns(light, "electron" if value.camera.sensor is not None else "adu"),
    ])  # fmt: skip


def status_of(light: StarPhotometry) -> NDArray[np.str_]:
    """Status (n,) of each star by its photometry: seen, hidden, uncertain, or unusable where it was not measured."""
    kinds = np.select([light.cause != "", light.llr >= SEEN_LLR, light.llr <= -SEEN_LLR], [3, 0, 1], 2)
    return np.array(STAR_STATUSES)[kinds]


def names_of(hips: Ints) -> list[str]:
    """Names of Hipparcos stars, empty for those without one."""
    names = star_names()
    return [names.get(hip, "") for hip in hips.tolist()]


def stars_in_view(value: Oriented) -> tuple[Ints, Array]:
    """Stars in the frame down to the depth of the matches: indices (n,) and predicted pixels (n, 2)."""
    stars, matched = value.stars, value.identification.star
    faintest = float(stars.v_mag[matched].max(initial=-np.inf)) + FAINTER_THAN_FAINTEST_MATCH_MAG
    candidates = np.flatnonzero(stars.v_mag <= faintest)
    xy_px, inside = value.camera.project(stars.rays_icrs[candidates] @ value.attitude.R_cam_icrs.T)
    return candidates[inside], xy_px[inside]


def _catalog_columns(stars: Stars, star: Ints) -> list[Column]:
    hips = stars.hip[star]
    return [
        Column("catalog_id", stars.catalog_id[star], "string", description="source and number"),
        Column("hip", ["" if hip == 0 else hip for hip in hips.tolist()], "int64", description="Hipparcos number"),
        Column("name", names_of(hips), "string", description="proper name, or Bayer, Flamsteed or variable"),
        Column("v_mag", stars.v_mag[star], "float64", "mag", "%.3f", "Johnson V of the catalogue"),
    ]


def _place_columns(value: Identified, star: Ints, xy_px: Array) -> list[Column]:
    measured = _measured_px_texts(value, star)
    origin = "(0, 0) is the centre of the top-left pixel"
    return [
        Column("x_px", xy_px[:, 0], "float64", "pix", "%.3f", f"predicted; {origin}"),
        Column("y_px", xy_px[:, 1], "float64", "pix", "%.3f", "predicted"),
        Column("x_measured_px", measured[0], "float64", "pix", "%s", "centroid of the detection identified as it"),
        Column("y_measured_px", measured[1], "float64", "pix", "%s", "centroid of the detection identified as it"),
    ]


def _measured_px_texts(value: Identified, star: Ints) -> tuple[list[str], list[str]]:
    """Measured pixels of the stars as texts, empty where no detection was identified as the star."""
    x: list[float | None] = [None] * len(star)
    y: list[float | None] = [None] * len(star)
    _, row, match = np.intersect1d(star, value.identification.star, return_indices=True)
    xy_px = value.detections.xy_px[value.identification.detection[match]]
    for at, (px, py) in zip(row.tolist(), xy_px.tolist(), strict=True):
        x[at], y[at] = px, py
    return format_values("%.3f", x), format_values("%.3f", y)


def _light_columns(light: StarPhotometry, unit: str) -> Sequence[Column]:
    usable = light.usable.tolist()

    def format_usable(form: str, values: Array) -> list[str]:
        return [form % value if known else "" for value, known in zip(values.tolist(), usable, strict=True)]

    return [
        Column("expected_e", light.expected_e, "float64", unit, "%.6g", "flux if nothing hides it"),
        Column(
            "flux_e", format_usable("%.6g", light.flux_e), "float64", unit, "%s", "measured at the predicted position"
        ),
        Column("sigma_e", format_usable("%.6g", light.sigma_e), "float64", unit, "%s", "of flux_e without a star"),
        Column(
            "evidence", format_usable("%.3f", light.llr), description="ln p(light | visible) - ln p(light | hidden)"
        ),
        Column("status", status_of(light), "string", description="seen, hidden, uncertain or unusable"),
        Column("cause", light.cause, "string", description="why it is unusable"),
    ]


def skyline_table_text(skyline: MeasuredSkyline) -> str:
    """The table of a `skyline` as ECSV, from north through east; empty where the elevation is not known."""
    azimuth, elevation, sigma = skyline_texts_deg(skyline)
    return ecsv_text([
        Column("azimuth_deg", azimuth, unit="deg", description="from north through east"),
        Column("elevation_deg", elevation, unit="deg", description="of the skyline in the image"),
        Column("sigma_deg", sigma, unit="deg", description="standard deviation of the elevation"),
        Column("source", skyline.source, "string", description="stars, sky light, both"),
    ])  # fmt: skip


def half_range_rad(raised_rad: Array, sigma_rad: Array) -> float:
    """Half the range [rad] that shows heights (n,) of a skyline above a predicted one, two sigma (n,) included.

    One height in twenty may lie beyond it; nan where a height is not known.
    """
    known = np.isfinite(raised_rad)
    if not known.any():
        return float(MOST_HALF_RAD)
    reach = np.quantile(np.abs(raised_rad[known]) + 2.0 * sigma_rad[known], 0.95)
    return float(np.clip(reach, LEAST_HALF_RAD, MOST_HALF_RAD))


def skyline_texts_deg(skyline: MeasuredSkyline) -> tuple[list[str], list[str], list[str]]:
    """Azimuth, elevation and sigma [deg] of a `skyline` as texts, the last two empty where they are not known."""
    known = skyline.known.tolist()
    elevation, sigma = (
        [value if ok else None for value, ok in zip(np.degrees(values).tolist(), known, strict=True)]
        for values in (skyline.elevation_rad, skyline.sigma_rad)
    )
    azimuth = [f"{value:g}" for value in np.round(np.degrees(skyline.azimuth_rad), 6)]
    return azimuth, format_values("%.4f", elevation), format_values("%.4f", sigma)
