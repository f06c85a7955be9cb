"""Stars and bodies: Hipparcos, Gaia's fainter stars, the Sun, the planets, the Moon and the Earth."""

from startrack.catalog.hipparcos import StarCatalog, load_catalog, star_names

__all__ = ["StarCatalog", "load_catalog", "star_names"]
