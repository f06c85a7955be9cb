"""Damaged files: the reader returns pixels or raises `BadInput`; truncation is always noticed."""

import bz2
import gzip
import io
import struct
import zlib

import numpy as np
import pytest
import tifffile
from astropy.io import fits
from PIL import Image

from startrack.core.types import BadInput
from startrack.exposure import read_exposure
from startrack.exposure.png import SIGNATURE, chunk

FRAME = np.random.default_rng(3).normal(1000, 50, (40, 60)).astype(np.uint16)


def encode_pillow(image, kind, **options):
    file = io.BytesIO()
    Image.fromarray(image).save(file, kind, **options)
    return file.getvalue()


def encode_tifffile(**options):
    file = io.BytesIO()
    tifffile.imwrite(file, FRAME, **options)
    return file.getvalue()


def encode_astropy(*units):
    file = io.BytesIO()
    fits.HDUList(list(units)).writeto(file)
    return file.getvalue()


FILES = {
    "png": encode_pillow(FRAME, "PNG"),
    "jpeg": encode_pillow((FRAME // 8).astype(np.uint8), "JPEG"),
    "jpeg progressive": encode_pillow((FRAME // 8).astype(np.uint8), "JPEG", progressive=True),
    "tiff": encode_tifffile(),
    "tiff deflate": encode_tifffile(compression="zlib", rowsperstrip=8),
    "tiff tiles": encode_tifffile(tile=(16, 16)),
    "tiff LZW": encode_pillow(FRAME, "TIFF", compression="tiff_lzw"),
    "fits": encode_astropy(fits.PrimaryHDU(FRAME)),
    "fits extension": encode_astropy(fits.PrimaryHDU(), fits.ImageHDU(FRAME)),
    "fits fz": encode_astropy(fits.PrimaryHDU(), fits.CompImageHDU(FRAME)),
    "fits gz": gzip.compress(encode_astropy(fits.PrimaryHDU(FRAME)), mtime=0),
    "fits bz2": bz2.compress(encode_astropy(fits.PrimaryHDU(FRAME))),
}


@pytest.fixture
def is_read(tmp_path):
    """True if the bytes are read; False if they are refused as they should be."""

    def check(raw):
        path = tmp_path / "frame"
        path.write_bytes(raw)
        try:
            exposure, refusal = read_exposure(path), None
        except BadInput as error:
            exposure, refusal = None, error
        if refusal is not None:
            assert refusal.reason == "bad_image"
            assert str(refusal).startswith(str(path))
            assert "\n" not in str(refusal)
            return False
        assert np.isfinite(exposure.pixels_adu).all()
        return True

    return check


@pytest.mark.parametrize("kind", FILES)
def test_every_cut_is_refused(is_read, kind, capfd):
    whole = FILES[kind]
    assert is_read(whole)
    rng = np.random.default_rng(1)
    cuts = {*range(len(whole) - 12, len(whole)), *rng.integers(0, len(whole), 40).tolist()}
    assert [cut for cut in cuts if is_read(whole[:cut])] == []
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("kind", FILES)
def test_flipped_bytes_never_crash(is_read, kind):
    rng = np.random.default_rng(2)
    refused = 0
    for trial in range(80):
        raw = bytearray(FILES[kind])
        reach = len(raw) if trial % 2 else min(400, len(raw))  # every other time the header
        for _ in range(rng.integers(1, 6)):
            raw[rng.integers(reach)] = rng.integers(256)
        refused += not is_read(bytes(raw))
    assert refused > 0


@pytest.mark.parametrize("kind", ["png", "fits gz", "fits bz2", "tiff deflate"])
def test_formats_with_checksums_never_show_wrong_pixels(tmp_path, kind):
    rng = np.random.default_rng(4)
    for _ in range(60):
        raw = bytearray(FILES[kind])
        at = rng.integers(len(raw) // 4, len(raw))  # behind the header
        raw[at] ^= 1 << rng.integers(8)
        (tmp_path / "frame").write_bytes(bytes(raw))
        try:
            exposure = read_exposure(tmp_path / "frame")
        except BadInput:
            continue
        np.testing.assert_array_equal(exposure.pixels_adu, FRAME)


def test_damage_behind_good_checksums_of_a_png(is_read):
    """Chunks rewritten with fitting checksums reach the decoders of text, EXIF and pixels."""
    whole = FILES["png"]
    data_at = whole.index(b"IDAT")
    data = whole[data_at + 4 : data_at + 4 + struct.unpack_from(">I", whole, data_at - 4)[0]]
    exif = Image.Exif()
    exif[0x0112] = 3
    parts = {
        b"IHDR": struct.pack(">IIBBBBB", 60, 40, 16, 0, 0, 0, 0),
        b"tEXt": b"EXPTIME\0" + b"1.5",
        b"iTXt": b"STCAMERA\0\1\0\0\0" + zlib.compress(b"camera.toml"),
        b"zTXt": b"DATE-AVG\0\0" + zlib.compress(b"2031-03-26T20:58:11"),
        b"eXIf": exif.tobytes(),
        b"IDAT": data,
        b"IEND": b"",
    }

    def assemble_png(bodies):
        return SIGNATURE + b"".join(chunk(kind, bytes(body)) for kind, body in bodies.items())

    assert is_read(assemble_png(parts))
    rng = np.random.default_rng(6)
    for _ in range(150):
        bodies = {kind: bytearray(body) for kind, body in parts.items()}
        kind = list(parts)[rng.integers(6)]
        bodies[kind][rng.integers(len(bodies[kind]))] = rng.integers(256)
        is_read(assemble_png(bodies))
