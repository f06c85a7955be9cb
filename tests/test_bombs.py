"""Small files that ask a reader for much work are refused before it is done."""

from __future__ import annotations

import bz2
import gzip
import io
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
import tifffile
from astropy.io import fits
from fuzz.seeds import hill_map
from PIL import Image

from startrack.camera import load_camera
from startrack.core.types import BadInput
from startrack.exposure import read_exposure
from startrack.exposure.png import ADAM7, SIGNATURE, chunk
from startrack.terrain import load_terrain

FRAME = np.random.default_rng(1).integers(0, 1000, (40, 60)).astype(np.uint16)
ZEROS = bytes(10**7)


def fits_bytes(*units):
    file = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), *units]).writeto(file)
    return file.getvalue()


def cards(*lines):
    text = "".join(line.ljust(80) for line in (*lines, "END"))
    return text.ljust(-(-len(text) // 2880) * 2880).encode()


IMAGE = fits_bytes(fits.ImageHDU(FRAME.astype(np.int16)))
HEAD = "SIMPLE  =                    T", "BITPIX  =                   16"
EMPTY = cards("XTENSION= 'IMAGE   '", "BITPIX  =                   16", "NAXIS   =                    0")


def deflated_tiff():
    file = io.BytesIO()
    tifffile.imwrite(file, FRAME, compression="zlib", rowsperstrip=40, metadata=None)
    return file.getvalue()


def with_strip(raw, strip):
    """The deflated TIFF `raw` with `strip` in place of its first strip or tile."""
    with tifffile.TiffFile(io.BytesIO(raw)) as tiff:
        tags = tiff.pages[0].tags
        starts, counts = (tags[273], tags[279]) if 273 in tags else (tags[324], tags[325])
        assert tiff.pages[0].compression in (8, 32946)
    raw = bytearray(raw)
    for tag, value in ((starts, len(raw)), (counts, len(strip))):
        struct.pack_into({3: "<H", 4: "<I", 16: "<Q"}[tag.dtype], raw, tag.valueoffset, value)
    return bytes(raw) + strip


def many_pages(count):
    one = struct.pack("<HHHII", 1, 256, 4, 1, 1)
    return b"II*\0" + b"".join(struct.pack("<I", 8 + 18 * k) + one for k in range(count)) + bytes(4)


def png(data, *chunks, interlaced=0):
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 60, 40, 16, 0, 0, 0, interlaced))
    return SIGNATURE + header + b"".join(chunks) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def bombed_tiles():
    """A tile-compressed image whose rows inflate to much more than their pixels."""
    with fits.open(io.BytesIO(fits_bytes(fits.CompImageHDU(FRAME.astype(np.int16), compression_type="GZIP_1"))),
                   disable_image_compression=True) as units:  # fmt: skip
        header = units[1].header
    tiles = np.empty(40, object)
    tiles[:] = [np.frombuffer(gzip.compress(ZEROS), np.uint8)] * 40
    unit = fits.BinTableHDU.from_columns([fits.Column("COMPRESSED_DATA", "1PB()", array=tiles)])
    unit.header.update({key: value for key, value in header.items() if key.startswith("Z")})
    return fits_bytes(unit)


def many_scans():
    file = io.BytesIO()
    Image.fromarray((FRAME // 4).astype(np.uint8)).save(file, "JPEG", progressive=True)
    raw = file.getvalue()[:-2]
    return raw + 100 * raw[raw.rfind(b"\xff\xda") :] + b"\xff\xd9"


BOMBS = {
    "axes.fits": (lambda: cards(*HEAD, "NAXIS   =            999999999", *["COMMENT"] * 40_000), "MB of headers"),
    "units.fits": (lambda: fits_bytes() + 2000 * EMPTY, "MB of headers"),
    "beside.fits": (lambda: IMAGE + fits_bytes(fits.ImageHDU(np.zeros((7000, 6000), np.int16)))[2880:] * 2,
                    "MB beside its largest unit"),
    "zeros.fits.gz": (lambda: gzip.compress(IMAGE + ZEROS), "much follows the last unit"),
    "zeros.fits.bz2": (lambda: bz2.compress(IMAGE + ZEROS), "much follows the last unit"),
    "header.fits.bz2": (lambda: bz2.compress(cards(*HEAD, *["COMMENT"] * 40_000)), "MB of headers"),
    "tiles.fits.fz": (bombed_tiles, "inflates to more than its pixels"),
    "small-tiles.fits.fz": (lambda: fits_bytes(fits.CompImageHDU(np.zeros((400, 100), np.int16), tile_shape=(1, 1))),
                            "40000 tiles of 1 pixels"),
    "deflate.tif": (lambda: with_strip(deflated_tiff(), zlib.compress(ZEROS)), "inflates to more than its part"),
    "pages.tif": (lambda: many_pages(5000), "more than 1000 pictures"),
    "interlaced.png": (lambda: png(zlib.compress(ZEROS), interlaced=1), "cannot be decoded"),
    "chunks.png": (lambda: png(b"", 250_000 * chunk(b"tEXt", b"a\0b")), "more than 200000 chunks"),
    "scans.jpg": (many_scans, "more than 64 scans"),
}  # fmt: skip


@pytest.mark.parametrize("name", BOMBS)
def test_a_picture_that_asks_for_much_work_is_refused(tmp_path, name):
    make, cause = BOMBS[name]
    path = tmp_path / name
    path.write_bytes(make())
    with pytest.raises(BadInput, match=cause):
        read_exposure(path)


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (5, 9), (8, 8), (17, 33)])
@pytest.mark.parametrize("colour", [False, True])
def test_the_size_of_interlaced_rows_is_that_of_opencv(tmp_path, shape, colour):
    """Pillow's own encoder writes no interlaced files: rows of zeros, of the length that the format states."""
    import cv2

    height, width = shape
    passes = [(-(-(height - y0) // dy), -(-(width - x0) // dx)) for x0, y0, dx, dy in ADAM7]
    size = sum(rows * (1 + columns * (6 if colour else 2)) for rows, columns in passes if rows > 0 and columns > 0)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 2 if colour else 0, 0, 0, 1))
    for change, ok in ((0, True), (-1, False)):
        raw = SIGNATURE + header + chunk(b"IDAT", zlib.compress(bytes(size + change))) + chunk(b"IEND", b"")
        path = tmp_path / f"{ok}.png"
        path.write_bytes(raw)
        if ok:
            assert cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_UNCHANGED).shape[:2] == shape
            assert read_exposure(path).pixels_adu.shape == shape
        else:
            with pytest.raises(BadInput, match="cannot be decoded"):
                read_exposure(path)


@pytest.mark.parametrize("key", ["a." * 5000 + "b", '"a" . ' * 5000 + "b", "[" + "a." * 5000 + "b]"])
@pytest.mark.parametrize("read", [load_camera, load_terrain])
def test_a_key_of_many_parts_is_refused(tmp_path, key, read):
    path = tmp_path / "a.toml"
    path.write_text(key if key.startswith("[") else f"{key} = 1")
    with pytest.raises(BadInput, match="more than 16 parts"):
        read(path)


def test_a_height_map_takes_the_memory_of_its_posts(tmp_path):
    """GDAL inflates a strip no further than its posts, and expands no entities of its metadata."""
    with tifffile.TiffFile(io.BytesIO(hill_map())) as file:
        tags = [(t.code, t.dtype, t.count, t.value, True) for t in file.pages[0].tags if 33550 <= t.code <= 34737]
    entities = "".join(f'<!ENTITY a{n} "{10 * f"&a{n - 1};"}">' for n in range(1, 10))
    text = f"<!DOCTYPE b [<!ENTITY a0 \"lol\">{entities}]><GDALMetadata><Item name='c'>&a9;</Item></GDALMetadata>"
    hills = 100.0 * np.sin(FRAME.astype(np.float32))
    tifffile.imwrite(tmp_path / "entities.tif", hills, extratags=[*tags, (42112, "s", 0, text, True)], metadata=None)
    bomb = with_strip(hill_map(), zlib.compress(bytes(10**8), 1))
    (tmp_path / "strip.tif").write_bytes(bomb)
    (tmp_path / "cut.tif").write_bytes(bomb[:-1])
    (tmp_path / "sound.tif").write_bytes(hill_map())
    code = """
import resource, sys
from startrack.core.types import BadInput
from startrack.terrain import read_map
read_map(sys.argv[1] + "/sound.tif")
used = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
before = used()
for name in "entities", "strip", "cut":
    try:
        read_map(f"{sys.argv[1]}/{name}.tif", unusual_heights=True)
    except BadInput as cause:
        print(name, cause)
print(used() - before)
"""
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert [line.split()[0] for line in lines[:-1]] == ["cut"]  # not there as a whole
    assert int(lines[-1]) < 20_000  # kB


def test_aliases_of_yaml_are_refused(tmp_path):
    """Each line is nine times as long as the line before, once written out."""
    lines = ["a0: &a0 [1]", *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12))]
    path = tmp_path / "camera.yaml"
    path.write_text("\n".join([*lines, "camera_matrix: {data: *a11}", "distortion_model: *a11"]))
    with pytest.raises(BadInput, match="not a camera file"):
        load_camera(path)
