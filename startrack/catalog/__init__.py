"""Stars and bodies: Hipparcos, Gaia's fainter stars, names, and the Sun, planets, Moon and Earth."""

from startrack.catalog.hipparcos import StarCatalog, load_catalog
from startrack.catalog.names import proper_name_designations, star_names

__all__ = ["StarCatalog", "load_catalog", "proper_name_designations", "star_names"]
