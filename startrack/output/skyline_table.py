"""The table of a measured skyline: elevation, sigma and source by azimuth."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, MeasuredSkyline
from startrack.output.ecsv import Column, ecsv_text, format_values

LEAST_HALF_RAD, MOST_HALF_RAD = np.radians(0.02), np.radians(5.0)


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
