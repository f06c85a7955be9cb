"""Painted pixels of a sky that stops at a skyline: known levels, slopes, noise and shifts. Skyfield's sky."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.special import ndtr

from startrack.core.types import SECTORS, Array
from startrack.evidence import BAND_PX
from startrack.evidence.sky_levels import SkyPixels
from startrack.evidence.skyline import CLIP_SHIFT_PX

EDGE_PX = 1.04  # a PSF of 1 px, and the pixel
PX_PER_RAD = 652.0
ELEVATION_RAD = 0.15  # of the predicted skyline
GROUND_E, NOISE_E = 100.0, 10.0
PER_SECTOR = 600  # pixels, as in a 2048 px fisheye
Wave = Callable[[Array], Array]  # of azimuths


def level_horizon(azimuth_rad: Array) -> Array:
    """The predicted skyline."""
    return np.full(np.shape(azimuth_rad), ELEVATION_RAD)


def no_shift(azimuth_rad: Array) -> Array:
    """The skyline stands where it is predicted."""
    return np.zeros(np.shape(azimuth_rad))


def paint_pixels(
    rng: np.random.Generator, step_e: float, *, shift_px: Wave = no_shift, slopes_e: tuple[float, float] = (0.0, 0.0),
    noise_e: float = NOISE_E, group: int = 1, edge_px: float = EDGE_PX,
) -> SkyPixels:  # fmt: skip
    """Pixels, evenly spread over azimuths and heights, of a sky brighter than the ground by `step_e`.

    `shift_px` is how much higher than predicted the skyline stands; `slopes_e` are those of ground and sky away from
    the predicted skyline; the pixels of one `group` side by side share their noise.
    """
    n = SECTORS * PER_SECTOR
    azimuth = np.sort(rng.uniform(0, 2 * np.pi, n))
    height = np.repeat(rng.uniform(-BAND_PX, BAND_PX, n // group), group)
    visible = ndtr((height - shift_px(azimuth)) / edge_px)
    ground, sky = GROUND_E + slopes_e[0] * height, GROUND_E + step_e + slopes_e[1] * height
    noise = np.repeat(rng.normal(0, noise_e, n // group), group)
    return SkyPixels(
        azimuth_rad=azimuth, px_per_rad=np.full(n, PX_PER_RAD), height_px=height,
        light_e=ground + (sky - ground) * visible + noise, edge_px=EDGE_PX, reach_px=np.full(SECTORS, CLIP_SHIFT_PX),
    )  # fmt: skip


@cache
def skyfield_moon():
    """Skyfield's ephemeris and its own reading of the lunar orientation kernel that lunarsky has."""
    from skyfield.api import PlanetaryConstants, load_file

    folder = Path(find_spec("lunarsky").origin).parent / "data"
    constants = PlanetaryConstants()
    constants.read_text(BytesIO((folder / "fk/satellites/moon_080317.tf").read_bytes()))
    constants.read_text(BytesIO(b"KPL/PCK\n\\begindata\nBODY301_RADII = ( 1737.4 1737.4 1737.4 )\n\\begintext\n"))
    constants.read_binary(open(folder / "pck/moon_pa_de421_1900-2050.bpc", "rb"))  # noqa: SIM115
    return load_file(str(Path(find_spec("skyfield_data").origin).parent / "data/de421.bsp")), constants
