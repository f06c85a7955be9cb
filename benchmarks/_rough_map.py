"""A user's own rough map: a crater of 9 km with fractal roughness, imported by `startrack terrain import`.

    python benchmarks/_rough_map.py FOLDER

writes FOLDER/rough.toml with its map and prints the path. 1500 x 1500 posts of 20 m at 30 degrees north. The bowl has
the proportions of fresh craters of the Moon (Pike 1977: depth 0.196 D, rim 0.036 D high); the roughness is
self-affine with Hurst exponent 0.8 up to 2 km, and 5 degrees of slope (RMS) between neighbouring posts.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from startrack.cli.main import main as startrack
from startrack.terrain import STEREOGRAPHIC, Projection, Raster, write_map

POSTS, POST_M = 1500, 20.0
LATITUDE_DEG, LONGITUDE_DEG = 30.0, 12.0
DIAMETER_M, DEPTH_M, RIM_M = 9000.0, 1760.0, 320.0
FLOOR_RADII = 0.35  # part of the crater's radius that is flat
HURST = 0.8
LARGEST_ROUGHNESS_M = 2000.0  # wavelength; larger waves have no more power
SLOPE_RAD = np.radians(5.0)
SEARCH_RADIUS_M = 3500.0
HEIGHT_SIGMA_M = 0.48  # rendered from the map itself; what its roughness shows between posts
SEED = 30


def rough_terrain(folder: Path, errors: Sequence[str] = ("--sigma", str(HEIGHT_SIGMA_M))) -> Path:
    """The terrain file in the folder; it is made if it does not exist, with flags that state the `errors`."""
    terrain, source = folder / "rough.toml", folder / "rough-source.tif"
    if terrain.exists():
        return terrain
    folder.mkdir(parents=True, exist_ok=True)
    write_map(source, rough_crater())
    words = ["--latitude", str(LATITUDE_DEG), "--longitude", str(LONGITUDE_DEG), "--radius", str(SEARCH_RADIUS_M)]
    words += errors
    if startrack(["terrain", "import", str(source), "-o", str(terrain), *words, "-q"]) != 0:
        raise SystemExit("the rough map could not be imported")
    return terrain


def rough_crater(seed: int = SEED) -> Raster:
    """The map: heights above the 1737.4 km sphere, curvature not included."""
    line = (np.arange(POSTS) - (POSTS - 1) / 2) * POST_M
    radii = np.hypot(line[:, None], line) / (DIAMETER_M / 2)
    heights = crater_profile(radii) + fractal_heights(np.random.default_rng(seed))
    return Raster(
        heights_m=(heights - 1500.0).astype(np.float32),
        projection=Projection(
            kind=STEREOGRAPHIC, latitude_rad=np.radians(LATITUDE_DEG), longitude_rad=np.radians(LONGITUDE_DEG)
        ),
        x0_m=line[0], y0_m=-line[0], dx_m=POST_M, dy_m=-POST_M, source="rough-source.tif",
    )  # fmt: skip


def crater_profile(radii: np.ndarray) -> np.ndarray:
    """Heights [m] above the plain at distances from the centre, in radii of the crater."""
    wall = np.clip((radii - FLOOR_RADII) / (1 - FLOOR_RADII), 0, 1)
    inside = RIM_M - DEPTH_M + DEPTH_M * wall**1.5
    outside = RIM_M * np.maximum(radii, 1.0) ** -3.0  # ejecta, McGetchin et al. 1973
    return np.where(radii < 1, inside, outside)


def fractal_heights(rng: np.random.Generator) -> np.ndarray:
    """Self-affine heights (POSTS, POSTS) [m] with the stated slope between neighbouring posts."""
    n = 1 << (POSTS - 1).bit_length()
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.rfftfreq(n), indexing="ij"))
    wave = np.maximum(wave, POST_M / LARGEST_ROUGHNESS_M)
    heights = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(n, n))) * wave ** -(HURST + 1))[:POSTS, :POSTS]
    rise = np.diff(heights, axis=0)
    return np.asarray((heights - heights.mean()) * POST_M * np.tan(SLOPE_RAD) / np.sqrt(np.mean(rise**2)))


def main() -> None:
    """Make the terrain and print its path."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    print(rough_terrain(parser.parse_args().folder))


if __name__ == "__main__":
    main()
