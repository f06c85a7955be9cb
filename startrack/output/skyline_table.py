"""The table of a measured skyline: elevation, sigma and source by azimuth."""

from __future__ import annotations

import numpy as np

from startrack.output.ecsv import Column, ecsv_text, format_values
from startrack.types import Array, MeasuredSkyline

LEAST_HALF_DEG, MOST_HALF_DEG = 0.02, 5.0


def skyline_table_text(skyline: MeasuredSkyline) -> str:
    """The table of a `skyline` as ECSV, from north through east; empty where the elevation is not known."""
    azimuth, elevation, sigma = skyline_texts_deg(skyline)
    return ecsv_text([
        Column("azimuth_deg", azimuth, unit="deg", description="from north through east"),
        Column("elevation_deg", elevation, unit="deg", description="of the skyline in the image"),
        Column("sigma_deg", sigma, unit="deg", description="standard deviation of the elevation"),
        Column("source", skyline.source, "string", description="stars, sky light, both"),
    ])  # fmt: skip


def half_range_deg(raised_deg: Array, sigma_deg: Array) -> float:
    """Half the range [deg] that shows heights (n,) of a skyline above a predicted one, two sigma (n,) included.

    One height in twenty may lie beyond it; nan where a height is not known.
    """
    known = np.isfinite(raised_deg)
    if not known.any():
        return 1.0
    reach = np.quantile(np.abs(raised_deg[known]) + 2.0 * sigma_deg[known], 0.95)
    return float(np.clip(reach, LEAST_HALF_DEG, MOST_HALF_DEG))


def skyline_texts_deg(skyline: MeasuredSkyline) -> tuple[list[str], list[str], list[str]]:
    """Azimuth, elevation and sigma [deg] of a `skyline` as texts, the last two empty where they are not known."""
    known = skyline.known.tolist()
    elevation, sigma = (
        [value if ok else None for value, ok in zip(np.degrees(values).tolist(), known, strict=True)]
        for values in (skyline.elevation_rad, skyline.sigma_rad)
    )
    azimuth = [f"{value:g}" for value in np.round(np.degrees(skyline.azimuth_rad), 6)]
    return azimuth, format_values("%.4f", elevation), format_values("%.4f", sigma)
