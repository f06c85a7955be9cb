"""Tables of stars, of a measured skyline, and of quantities."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from startrack.catalog import star_names
from startrack.chain import Inputs, Measured, Oriented
from startrack.core.ecsv import Column, column_texts, ecsv_text
from startrack.core.types import Array, Bools, Ints, MeasuredSkyline
from startrack.evidence import SEEN_LLR
from startrack.output.quantity import Quantity

if TYPE_CHECKING:
    from startrack.evidence import StarPhotometry

IDENTIFIED = "identified", "predicted"  # without a terrain
STAR_STATUSES = ("seen", "hidden", "uncertain", "unusable")
FAINTER_THAN_FAINTEST_MATCH_MAG = 0.5
OFF_MAP = "whether the maps end there, and ground beyond could stand above their skyline"
LEAST_HALF_RAD, MOST_HALF_RAD = np.radians(0.02), np.radians(5.0)


def quantity_columns(quantities: Iterable[Quantity], values: Mapping[str, Iterable[Any]]) -> list[Column]:
    """Columns of the `quantities` that have `values`, by the names of the columns; empty for None and nan."""
    return [
        replace(one, values=values[one.name])
        for quantity in quantities
        for one in quantity.table_columns
        if one.name in values
    ]


def star_table_text(value: Inputs, *, catalog: bool = False) -> str:
    """The star table of `value`, the last of a result, as ECSV, brightest star first; stars must have been identified.

    After `locate`: every star whose light was measured. Without a terrain: the identified stars, and with `catalog` all
    others in the frame down to half a magnitude below the faintest of them, without azimuth, elevation and evidence.
    """
    if not isinstance(value, Oriented):
        raise ValueError("no star table without identified stars")
    light, named = value.photometry if isinstance(value, Measured) else None, value.names.stars
    if light is None and not catalog:
        star = np.sort(named.star)
        xy_px, _ = value.camera.project(value.stars.rays_icrs[star] @ value.attitude.R_cam_icrs.T)
    elif light is None:  # stars in the frame down to the depth of the matches
        faintest = float(value.stars.v_mag[value.identification.star].max(initial=-np.inf))
        star = np.flatnonzero(value.stars.v_mag <= faintest + FAINTER_THAN_FAINTEST_MATCH_MAG)
        xy_px, inside = value.camera.project(value.stars.rays_icrs[star] @ value.attitude.R_cam_icrs.T)
        star, xy_px = star[inside], xy_px[inside]
    else:
        star, xy_px = light.star, light.xy_px
    stars, hips = value.stars, value.stars.hip[star]
    measured_px = np.full((len(star), 2), np.nan)
    _, row, match = np.intersect1d(star, named.star, return_indices=True)
    measured_px[row] = named.xy_px[match]
    saturated = np.full(len(star), None)
    saturated[row] = named.saturated[match]
    columns = [
        Column("catalog_id", stars.catalog_id[star], "string", description="source and number"),
        Column("hip", [hip or None for hip in hips.tolist()], "int64", description="Hipparcos number"),
        Column("name", names_of(hips), "string", description="proper name, or Bayer, Flamsteed or variable"),
        Column("v_mag", stars.v_mag[star], "float64", "mag", "%.3f", "Johnson V of the catalogue"),
    ]
    if light is not None:
        north = "north through east, in enu"
        columns += [
            Column("azimuth_deg", np.degrees(light.azimuth_rad), "float64", "deg", "%.5f", north),
            Column("elevation_deg", np.degrees(light.elevation_rad), "float64", "deg", "%.5f", "in enu"),
        ]
    origin, centroid = "(0, 0) is the centre of the top-left pixel", "centroid of the detection identified as it"
    columns += [
        Column("x_px", xy_px[:, 0], "float64", "pix", "%.3f", f"predicted; {origin}"),
        Column("y_px", xy_px[:, 1], "float64", "pix", "%.3f", "predicted"),
        Column("x_measured_px", measured_px[:, 0], "float64", "pix", "%.3f", centroid),
        Column("y_measured_px", measured_px[:, 1], "float64", "pix", "%.3f", centroid),
        Column("saturated", saturated, "bool", description="whether that source is; empty: none is identified"),
    ]
    if light is not None:
        flux_e, sigma_e, llr = (np.where(light.usable, one, np.nan) for one in (light.flux_e, light.sigma_e, light.llr))
        unit = "electron" if value.camera.sensor is not None else "adu"
        odds = "ln p(light | visible) - ln p(light | hidden)"
        columns += [
            Column("expected_e", light.expected_e, "float64", unit, "%.6g", "flux if nothing hides it"),
            Column("flux_e", flux_e, "float64", unit, "%.6g", "measured at the predicted position"),
            Column("sigma_e", sigma_e, "float64", unit, "%.6g", "of flux_e without a star"),
            Column("evidence", llr, "float64", None, "%.3f", odds),
            Column("status", status_of(light), "string", description="seen, hidden, uncertain or unusable"),
            Column("cause", light.cause, "string", description="why it is unusable"),
        ]
    else:
        status = np.where(np.isfinite(measured_px[:, 0]), *IDENTIFIED)
        columns.append(Column("status", status, "string", description=" or ".join(IDENTIFIED)))
    return ecsv_text(columns)


def status_of(light: StarPhotometry) -> NDArray[np.str_]:
    """Status (n,) of each star by its photometry: seen, hidden, uncertain, or unusable where it was not measured."""
    kinds = np.select([light.cause != "", light.llr >= SEEN_LLR, light.llr <= -SEEN_LLR], [3, 0, 1], 2)
    return np.array(STAR_STATUSES)[kinds]


def names_of(hips: Ints) -> list[str]:
    """Names of Hipparcos stars, empty for those without one."""
    names = star_names()
    return [names.get(hip, "") for hip in hips.tolist()]


def skyline_table_text(skyline: MeasuredSkyline, off_map: Bools | None = None) -> str:
    """The table of a `skyline` as ECSV, from north through east; empty where the elevation is not known.

    `off_map` (n,): beside a map, where ground off it could stand above its skyline.
    """
    azimuth, elevation, sigma = skyline_texts_deg(skyline)
    clouds = Column("cloud_probability", cloud_texts(skyline), description="that the edge is a cloud's")
    return ecsv_text([
        Column("azimuth_deg", azimuth, unit="deg", description="from north through east"),
        Column("elevation_deg", elevation, unit="deg", description="of the skyline in the image"),
        Column("sigma_deg", sigma, unit="deg", description="standard deviation of the elevation"),
        Column("source", skyline.source, "string", description="stars, sky light, both, varies"),
        *([clouds] if skyline.cloud_probability.any() else ()),
        *(() if off_map is None else (Column("off_map", off_map, "bool", description=OFF_MAP),)),
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
    elevation, sigma = (
        np.where(skyline.known, np.degrees(values), np.nan) for values in (skyline.elevation_rad, skyline.sigma_rad)
    )
    azimuth = [f"{value:g}" for value in np.round(np.degrees(skyline.azimuth_rad), 6)]
    return azimuth, column_texts("%.4f", elevation), column_texts("%.4f", sigma)


def cloud_texts(skyline: MeasuredSkyline) -> list[str]:
    """The probability that each edge of a `skyline` is a cloud's, as texts, empty where it is not known."""
    return [f"{p:.4f}" if known else "" for p, known in zip(skyline.cloud_probability, skyline.known, strict=True)]
