"""Valid files of every kind that users write, small, as bytes: what the mutations start from."""

from __future__ import annotations

import bz2
import gzip
import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from .seeds_beside import seeds_beside

FRAME = np.random.default_rng(3).normal(1000, 50, (40, 60)).astype(np.uint16)
HEADER = {"DATE-OBS": "2031-03-26T20:58:11", "EXPTIME": 2.5, "STCAMERA": "fisheye-2048", "BAYERPAT": "RGGB"}
SIDECAR = {
    "time_utc": "2031-03-26T20:58:11Z", "exposure_s": 1.0, "camera": "camera.toml", "terrain": "terrain.toml",
    "bayer_pattern": "RGGB",
}  # fmt: skip
CYLINDER = """format = 1
name = "crater"
body = "moon"
[origin]
latitude_deg = -89.66
longitude_deg = 129.78
[cylinder]
diameter_m = 20000.0
depth_m = 2000.0
[rover]
camera_height_m = 1.5
[search]
radius_m = 10000.0
"""
HEIGHT_MAP = """format = 1
name = "hill"
body = "moon"
[origin]
latitude_deg = -90.0
longitude_deg = 0.0
[dem]
file = ["hill.tif"]
height_sigma_m = 2.0
horizon_sigma_deg = 0.01
scale = 0.0123
offset_m = 0.0
[search]
radius_m = 800.0
max_slope_deg = 25.0
glare_deg = [[10.0, 30.0]]
"""
EARTH = """format = 1
body = "earth"
obstacles = "obstacles.csv"
[origin]
latitude_deg = 34.0
longitude_deg = -111.5
height_m = 2300.0
[air]
pressure_hpa = 760.0
temperature_c = 5.0
terrestrial_refraction_sigma = 0.05
[cylinder]
diameter_m = 900.0
depth_m = 80.0
depth_sigma_m = 2.0
[rover]
camera_height_sigma_m = 0.1
"""
XML = b"""<?xml version="1.0"?>
<opencv_storage>
<image_width>2048</image_width>
<image_height>2048</image_height>
<fisheye_model>1</fisheye_model>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data>652. 0. 1023.5 0. 652. 1023.5 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>4</rows><cols>1</cols><dt>d</dt>
<data>0.01 -0.002 1e-4 0.</data></distortion_coefficients>
</opencv_storage>
"""
CAMERA_EXTRAS = """
[mount]
quat_xyzw_body_cam = [0.0, 0.0, 1.0, 0.0]
[covariance]
order = ["fx", "fy", "cx", "cy", "k1"]
matrix = [[0.04, 0, 0, 0, 0], [0, 0.04, 0, 0, 0], [0, 0, 0.01, 0, 0], [0, 0, 0, 0.01, 0], [0, 0, 0, 0, 1e-8]]
"""


@cache
def seeds() -> dict[str, tuple[bytes, ...]]:
    """Valid files (bytes) by kind of input."""
    cameras = _cameras()
    return {
        "png": tuple(_pngs()),
        "jpeg": tuple(_jpegs()),
        "tiff": tuple(_tiffs()),
        "fits": tuple(_fits()),
        "raw": (_dng(),),
        "sidecar": (json.dumps(SIDECAR, indent=1).encode(),),
        "camera": tuple(text.encode() for text in cameras),
        "converted": tuple(_converted()),
        "terrain": tuple(text.encode() for text in (CYLINDER, HEIGHT_MAP, EARTH)),
        "elevation": tuple(_maps()),
        **seeds_beside(),
    }


def pillow(pixels: Any, form: str, *, eight: bool = False, **options: Any) -> bytes:
    """The `pixels` (H, W) or (H, W, 3) as a file of Pillow's format `form`, of 8 bits if `eight`."""
    from PIL import Image

    file = io.BytesIO()
    eight = eight or form == "JPEG" or pixels.ndim == 3
    Image.fromarray(pixels.astype(np.uint8) if eight else pixels).save(file, form, **options)
    return file.getvalue()


def _jpegs() -> list[bytes]:
    grey, colour = FRAME // 8, np.dstack(3 * [FRAME // 8])
    comment = json.dumps(HEADER).encode()
    return [
        pillow(grey, "JPEG"), pillow(grey, "JPEG", progressive=True), pillow(colour, "JPEG", comment=comment),
    ]  # fmt: skip


def _pngs() -> list[bytes]:
    from startrack.exposure.png import add_text

    texts = {key: str(value) for key, value in HEADER.items()}
    colour = np.dstack([FRAME // 8, FRAME // 9, FRAME // 10])
    return [pillow(FRAME, "PNG"), add_text(pillow(FRAME, "PNG"), texts), pillow(colour, "PNG")]


def _tiffs() -> list[bytes]:
    import tifffile

    def one(**options: Any) -> bytes:
        file = io.BytesIO()
        tifffile.imwrite(file, options.pop("pixels", FRAME), **options)
        return file.getvalue()

    return [
        one(description=json.dumps(HEADER), metadata=None), one(compression="zlib", rowsperstrip=8),
        one(tile=(16, 16)), one(pixels=FRAME.astype(np.float32)), one(bigtiff=True),
        pillow(FRAME, "TIFF", compression="tiff_lzw"),
    ]  # fmt: skip


def _fits() -> list[bytes]:
    from astropy.io import fits

    def one(*units: Any) -> bytes:
        file = io.BytesIO()
        fits.HDUList(list(units)).writeto(file)
        return file.getvalue()

    primary = fits.PrimaryHDU(FRAME)
    for key, value in HEADER.items():
        primary.header[key] = value
    plain = one(primary)
    return [
        plain, one(fits.PrimaryHDU(FRAME.astype(">f4"))), one(fits.PrimaryHDU(), fits.ImageHDU(FRAME)),
        one(fits.PrimaryHDU(), fits.CompImageHDU(FRAME)), gzip.compress(plain, mtime=0), bz2.compress(plain),
    ]  # fmt: skip


def _dng() -> bytes:
    import tifffile

    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True), (33421, "H", 2, (2, 2), True), (33422, "B", 4, (0, 1, 1, 2), True),
        (50708, "s", 0, "Test", True), (50778, "H", 1, (21,), True), (50717, "I", 1, 4095, True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
    ]  # fmt: skip
    file = io.BytesIO()
    tifffile.imwrite(file, FRAME, photometric=32803, extratags=tags, subfiletype=0)
    return file.getvalue()


def _cameras() -> list[str]:
    from startrack.camera import Decentring, camera_text, load_camera
    from startrack.camera.lenses import LENSES

    fisheye = load_camera("fisheye-2048")
    bent = replace(fisheye, decentring=Decentring(2e-4, -6e-4), mirrored=True)
    shapes = (shape for kind in LENSES for shape in kind.typical_shapes())
    every = [replace(fisheye, lens=shape, max_angle_rad=1.0, calibrated_angle_rad=1.0) for shape in shapes]
    return [camera_text(fisheye) + CAMERA_EXTRAS, *map(camera_text, (bent, load_camera("lowell-ldt"), *every))]


def _converted() -> list[bytes]:
    """The camera file in other programs' formats; `targets.PROGRAMS` has the same order."""
    from startrack.camera import foreign_text as to_text
    from startrack.camera import load_camera, platepar_of
    from startrack.camera.formats import FOREIGN_FORMATS
    from startrack.frames import Site

    camera, time = load_camera("fisheye-2048"), datetime(2024, 8, 12, tzinfo=UTC)
    plate = platepar_of(camera, np.eye(3), time, Site("earth", 0.8, 0.25, 300.0)).text.encode()
    programs = [program for program, one in FOREIGN_FORMATS.items() if one.write is not None]
    return [*(to_text(camera, program).encode() for program in programs), plate, XML]


def hill_map() -> bytes:
    """A height map of a ring-shaped hill about the south pole, as GeoTIFF."""
    from map_helpers import polar_stereographic

    from startrack.terrain import Raster, write_map

    line = (np.arange(31) - 15) * 200.0
    heights = (800 * np.exp(-((np.hypot(line[:, None], line) - 2000) ** 2) / 500**2)).astype(np.float32)
    raster = Raster(
        heights_m=heights, projection=polar_stereographic(), x0_m=line[0], y0_m=-line[0], dx_m=200.0, dy_m=-200.0
    )
    return _bytes_of(lambda path: write_map(path, raster))


def _maps() -> list[bytes]:
    import tifffile

    whole = hill_map()
    with tifffile.TiffFile(io.BytesIO(whole)) as file:
        page = file.pages.first
        tags = [(t.code, t.dtype, t.count, t.value, True) for t in page.tags if 33550 <= t.code <= 34737]
        values = page.asarray()
    plain = io.BytesIO()
    tifffile.imwrite(plain, values.astype(np.float32), extratags=tags, metadata=None)
    return [whole, plain.getvalue(), *_lzw(plain.getvalue())]


def _lzw(plain: bytes) -> list[bytes]:
    """The map with LZW compression, which is read through rasterio; none where that is not installed."""
    try:
        from rasterio import shutil
    except ImportError:
        return []
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "plain.tif").write_bytes(plain)
        return [_bytes_of(lambda path: shutil.copy(f"{folder}/plain.tif", str(path), driver="GTiff", compress="lzw"))]


def _bytes_of(write: Callable[[Path], object]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.tif"
        write(path)
        return path.read_bytes()
