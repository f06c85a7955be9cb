"""Small tasks that compile what `startrack doctor` otherwise does not use: maps, narrow fields, skylines."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from startrack.core.files import data_dir
from startrack.terrain import Terrain, import_maps, load_terrain

MAP, PLACE_DEG = "ldem75s-240m.tif", (-89.66, 129.78)  # a shipped map, and the middle of Shackleton on it
HALF_M, SMALL_RADIUS_M = 15_000.0, 2000.0  # of the crop, and about its middle
FIELD_RAD, NARROW_PX = float(np.radians(15.0)), 1000  # of the narrow field
DRAWN_STARS = 40


def small_map(folder: Path) -> Terrain:
    """A small height map, whose files are written into a `folder`."""
    latitude_rad, longitude_rad = np.radians(PLACE_DEG)
    made = import_maps(
        [data_dir("terrain") / MAP], folder / "doctor.toml", latitude_rad=latitude_rad, longitude_rad=longitude_rad,
        half_m=[HALF_M], radius_m=SMALL_RADIUS_M, height_sigma_m=5.0,
    )  # fmt: skip
    return load_terrain(str(made.path))


def compile_narrow_field() -> None:
    """Compile the identification of a narrow field without a camera file, by a list of bright stars."""
    from startrack.catalog import apparent_stars, load_catalog
    from startrack.core.types import Centroids
    from startrack.identification import identify_unknown_lens

    stars = apparent_stars(load_catalog(), None, None)
    east, north, along = stars.rays_icrs.T
    in_view = np.flatnonzero((along > 0) & (np.maximum(np.abs(east), np.abs(north)) < np.tan(0.5 * FIELD_RAD) * along))
    seen = in_view[:DRAWN_STARS]
    focal_px = 0.5 * NARROW_PX / np.tan(0.5 * FIELD_RAD)
    xy_px = 0.5 * NARROW_PX + focal_px * stars.rays_icrs[seen, :2] / along[seen, None]
    flux = 10.0 ** (5.0 - 0.4 * stars.v_mag[seen])
    centroids = Centroids(
        xy_px=xy_px, covariance_px2=np.tile(0.01 * np.eye(2), (len(seen), 1, 1)), flux_e=flux, snr=np.sqrt(flux),
        saturated=np.zeros(len(seen), bool), psf_sigma_px=1.0,
    )  # fmt: skip
    identify_unknown_lens(centroids, (NARROW_PX, NARROW_PX), FIELD_RAD, stars)
