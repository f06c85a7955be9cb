"""Stars and bodies: Hipparcos, Gaia's fainter stars, names, and the Sun, planets, Moon and Earth."""

from startrack.catalog.gaia import has_deep_catalog, hipparcos_rows_in_deep, load_deep_catalog
from startrack.catalog.hipparcos import StarCatalog, load_catalog, proper_name_designations, star_names
from startrack.catalog.solar_system import bodies

__all__ = [
    "StarCatalog", "bodies", "has_deep_catalog", "hipparcos_rows_in_deep", "load_catalog", "load_deep_catalog",
    "proper_name_designations", "star_names",
]  # fmt: skip
