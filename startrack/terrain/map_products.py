"""Published errors of elevation data of the Earth, recognized by the names of their files."""

from __future__ import annotations

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class MapProduct:
    """A product: what its files are called, and the standard deviation of its heights."""

    name: str
    pattern: str  # of the file's name, without regard to case
    height_sigma_m: float
    source: str


PRODUCTS = (
    MapProduct(
        "Copernicus GLO-30", r"copernicus_dsm_(cog_)?10|glo.?30|cop30", 2.4,
        "4 m (90 %), on steep ground relative too: Copernicus DEM Product Handbook",
    ),
    MapProduct(
        "SRTM", r"^[ns]\d\d[ew]\d\d\d.*\.hgt$|srtm", 5.3,
        "relative error 8.7 m (90 %) in Eurasia, 7.0 m in North America: Farr et al. 2007",
    ),
    MapProduct("USGS 3DEP, lidar", r"usgs_1m_|usgs_one_meter", 0.15, "10 cm on bare ground, 15 cm under plants: QL2"),
    MapProduct("USGS 3DEP, 1/3 arcsec", r"usgs_13_|ned.?13", 1.55, "RMSE against geodetic marks: Gesch et al. 2014"),
)  # fmt: skip


def find_product(file_name: str) -> MapProduct | None:
    """The product that a file of this name belongs to; None for others."""
    return next((one for one in PRODUCTS if re.search(one.pattern, file_name.lower())), None)
