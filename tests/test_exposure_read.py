"""Rasters written by Pillow, tifffile and OpenCV come back to the last bit, or are refused with the cause."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image, PngImagePlugin

from startrack.core.types import BadInput
from startrack.exposure import read_exposure
from startrack.exposure.png import SIGNATURE, chunk

RNG = np.random.default_rng(20310326)
FRAME16 = RNG.integers(0, 65536, (37, 53)).astype(np.uint16)
FRAME8 = RNG.integers(0, 256, (37, 53)).astype(np.uint8)


def encode_image(image, kind, mode=None, **options):
    file = io.BytesIO()
    picture = Image.fromarray(image)
    (picture.convert(mode) if mode else picture).save(file, kind, **options)
    return file.getvalue()


def tiff(image, **options):
    file = io.BytesIO()
    tifffile.imwrite(file, image, **options)
    return file.getvalue()


def ihdr(width, height, depth=16, colour=0, interlace=0):
    return chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlace))


def png(*chunks, image=FRAME16):
    """A PNG made by hand, with `chunks` before the picture data."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in image)
    picture = chunk(b"IDAT", zlib.compress(rows))
    return SIGNATURE + b"".join((ihdr(*image.shape[::-1]), *chunks, picture, chunk(b"IEND", b"")))


@pytest.fixture
def read(tmp_path):
    def read_bytes(raw, name="frame.png"):
        path = tmp_path / name
        path.write_bytes(raw)
        return read_exposure(path)

    return read_bytes


@pytest.fixture
def cause(read):
    def refusal_cause(raw, name="frame.png"):
        with pytest.raises(BadInput) as caught:
            read(raw, name)
        assert caught.value.reason == "bad_image"
        message = str(caught.value)
        assert "\n" not in message
        assert name in message
        return message

    return refusal_cause


@pytest.mark.parametrize(
    ("raw", "expected", "saturation"),
    [
        (encode_image(FRAME16, "PNG"), FRAME16, 65535),
        (encode_image(FRAME8, "PNG"), FRAME8, 255),
        (cv2.imencode(".png", FRAME16)[1].tobytes(), FRAME16, 65535),
        (png(chunk(b"gAMA", struct.pack(">I", 45455)), chunk(b"sBIT", b"\x0c")), FRAME16, 65535),
        (tiff(FRAME16), FRAME16, 65535),
        (tiff(FRAME16, byteorder=">"), FRAME16, 65535),
        (tiff(FRAME16, bigtiff=True, tile=(16, 16)), FRAME16, 65535),
        (tiff(FRAME16, compression="zlib", predictor=True, rowsperstrip=5), FRAME16, 65535),
        (tiff(FRAME16.view(np.int16)), FRAME16.view(np.int16), 32767),
        (tiff(FRAME16.astype(np.float32) / 7), FRAME16.astype(np.float32) / 7, None),
        (tiff(FRAME16.astype(np.float64)), FRAME16, None),
        (encode_image(FRAME16, "TIFF"), FRAME16, 65535),
        (encode_image(FRAME16, "TIFF", compression="tiff_lzw"), FRAME16, 65535),
        (encode_image(FRAME16, "TIFF", compression="packbits"), FRAME16, 65535),
        (encode_image(FRAME8, "TIFF"), FRAME8, 255),
    ],
)
def test_every_bit_is_kept(read, raw, expected, saturation):
    exposure = read(raw)
    assert exposure.pixels_adu.dtype == np.float32
    assert exposure.pixels_adu.dtype.isnative
    np.testing.assert_array_equal(exposure.pixels_adu, expected)
    assert exposure.saturation_adu == saturation
    assert exposure.size_px == (53, 37)
    assert exposure.warnings == ()
    assert not exposure.pixels_adu.flags.writeable


def test_interlaced_png(read):
    passes = [(0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1)]
    rows = [row for y, x, dy, dx in passes for row in FRAME16[y::dy, x::dx]]
    data = zlib.compress(b"".join(b"\0" + row.astype(">u2").tobytes() for row in rows))
    raw = SIGNATURE + ihdr(53, 37, interlace=1) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    np.testing.assert_array_equal(read(raw).pixels_adu, FRAME16)


def test_jpeg_is_what_pillow_decodes(read):
    smooth = cv2.GaussianBlur(FRAME8, (0, 0), 3)
    raw = encode_image(smooth, "JPEG", quality=95, comment=b"EXPTIME = 2.5")
    exposure = read(raw, "frame.jpg")
    np.testing.assert_array_equal(exposure.pixels_adu, np.asarray(Image.open(io.BytesIO(raw))))
    assert np.abs(exposure.pixels_adu - smooth).max() < 8
    assert exposure.saturation_adu == 255
    assert exposure.exposure_s == 2.5


@pytest.mark.parametrize("planes", ["contig", "separate", "png"])
def test_colour_becomes_the_plain_mean_in_full_depth(read, planes):
    rgb = np.stack([FRAME16, FRAME16 // 2, FRAME16 // 3], axis=-1)
    if planes == "png":
        raw = cv2.imencode(".png", rgb)[1].tobytes()
    else:
        stored = rgb if planes == "contig" else np.moveaxis(rgb, -1, 0).copy()
        raw = tiff(stored, photometric="rgb", planarconfig=planes)
    exposure = read(raw)
    np.testing.assert_allclose(exposure.pixels_adu, rgb.astype(float).mean(axis=-1), rtol=1e-7)
    assert exposure.warnings == ("colour image: the plain mean of its three channels is used",)


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_a_pixel_with_a_clipped_channel_is_saturated(read, kind):
    """A bright red star: its red channel ends at 255, the mean of its channels at 215."""
    rgb = np.full((64, 64, 3), 40, np.uint8)
    rgb[16:40, 16:40] = 255, 220, 170
    exposure = read(encode_image(rgb, kind, **({"quality": 95, "subsampling": 0} if kind == "JPEG" else {})))
    assert exposure.saturation_adu == 255
    assert (exposure.pixels_adu[20:36, 20:36] == 255).mean() > (0.99 if kind == "PNG" else 0.5)
    assert abs(float(np.median(exposure.pixels_adu[48:, 48:])) - 40) <= 1


def test_equal_channels_give_the_channel_exactly(read):
    exposure = read(cv2.imencode(".png", np.stack([FRAME16] * 3, axis=-1))[1].tobytes())
    np.testing.assert_array_equal(exposure.pixels_adu, FRAME16)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "TIFF"])
def test_orientation_is_ignored_with_a_warning(read, kind):
    exif = Image.Exif()
    exif[0x0112] = 6
    raw = tiff(FRAME8, extratags=[(274, "H", 1, 6, True)]) if kind == "TIFF" else encode_image(FRAME8, kind, exif=exif)
    exposure = read(raw)
    assert exposure.size_px == (53, 37)
    if kind != "JPEG":
        np.testing.assert_array_equal(exposure.pixels_adu, FRAME8)
    assert [w for w in exposure.warnings if "orientation tag 6 ignored" in w]


def test_unreadable_exif_costs_a_warning_only(read):
    exposure = read(png(chunk(b"eXIf", b"nonsense")))
    np.testing.assert_array_equal(exposure.pixels_adu, FRAME16)
    assert "EXIF" in exposure.warnings[0]


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (encode_image(FRAME8, "PNG", "RGBA"), "alpha"),
        (encode_image(FRAME8, "PNG", "LA"), "alpha"),
        (png(chunk(b"tRNS", b"\0\1")), "alpha"),
        (encode_image(FRAME8, "PNG", "P"), "palette"),
        (encode_image(FRAME8 > 99, "PNG"), "1 bits"),
        (png(chunk(b"acTL", bytes(8))), "animated"),
        (png(chunk(b"ABCD", b"")), "feature"),
        (encode_image(FRAME8, "JPEG", "CMYK"), "CMYK"),
        (tiff(np.stack([FRAME16] * 4, -1), photometric="rgb", extrasamples=["unassalpha"]), "alpha"),
        (tiff(np.stack([FRAME8] * 4, -1), photometric="separated"), "CMYK"),
        (encode_image(FRAME8, "TIFF", "P"), "palette"),
        (tiff(FRAME16, photometric="miniswhite"), "white-is-zero"),
        (tiff(np.stack([FRAME16] * 4), photometric="minisblack"), "4 pictures"),
        (tiff(np.stack([FRAME16] * 4), imagej=True), "pictures"),
        (tiff(FRAME16.astype(np.complex64)), "complex64"),
        (encode_image(FRAME8, "GIF"), "not a file of PNG, TIFF, FITS, JPEG"),
        (encode_image(FRAME8, "BMP"), "not a file of PNG, TIFF, FITS, JPEG"),
        (b"a text file, not a picture\n", "not a file of PNG, TIFF, FITS, JPEG"),
        (b"", "empty"),
    ],
)
def test_wrong_kinds_are_refused_with_the_cause(cause, raw, why):
    assert why in cause(raw)


def test_pixels_that_are_no_numbers_are_refused_and_counted(cause):
    holes = FRAME16.astype(np.float32)
    holes[3, 4:6] = np.nan, np.inf
    assert f"2 of {holes.size} pixels" in cause(tiff(holes))
    assert f"1 of {holes.size} pixels" in cause(tiff(np.where(np.arange(53) + 53 * np.arange(37)[:, None], 1.0, 1e300)))


def tiff_header(width, height):
    """Both sizes are 32-bit entries when tifffile writes BigTIFF; tags: 256 ImageWidth, 257 ImageLength."""
    raw = bytearray(tiff(FRAME16, bigtiff=True))
    for tag, value in ((256, width), (257, height)):
        at = next(i for i in range(16, 200) if raw[i : i + 2] == struct.pack("<H", tag))
        raw[at : at + 20] = struct.pack("<HHQQ", tag, 16, 1, value)
    return bytes(raw)


def jpeg_header(width, height):
    raw = bytearray(encode_image(FRAME8, "JPEG"))
    at = raw.index(b"\xff\xc0")
    raw[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(raw)


@pytest.mark.parametrize(
    "raw",
    [
        SIGNATURE + ihdr(20000, 20000) + chunk(b"IDAT", zlib.compress(bytes(10**6))) + chunk(b"IEND", b""),
        tiff_header(20000, 20000),
        jpeg_header(20000, 20000),
    ],
)
def test_bombs_are_refused_from_their_header(cause, raw):
    assert "20000 x 20000 is 400.0 Mpx, more than the 200 allowed" in cause(raw)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "TIFF"])
def test_the_cap_is_ours_and_not_pillows(read, monkeypatch, kind):
    tall = np.tile(FRAME8, (16, 1))
    # Pillow before 13 applies its cap to the strips of a JPEG, too: it takes those of any picture that ours takes.
    monkeypatch.setattr("PIL.Image.MAX_IMAGE_PIXELS", tall.size - 1)
    assert read(encode_image(tall, kind)).size_px == (53, 592)


def test_png_picture_data_too_short_behind_good_checksums(cause):
    raw = SIGNATURE + ihdr(53, 37) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    assert "cannot be decoded" in cause(raw)


def test_truncated_multi_page_tiff_does_not_pass_for_a_single_picture(cause):
    pages = tiff(np.stack([FRAME16] * 2), photometric="minisblack", metadata=None)
    second = struct.unpack_from("<I", pages, 8 + 2 + 12 * struct.unpack_from("<H", pages, 8)[0])[0]
    assert "directories is not in the file" in cause(pages[:second])


def test_jpeg_thumbnail_does_not_hide_the_missing_end(cause):
    """An EXIF thumbnail ends with the same marker as the picture."""
    whole = encode_image(FRAME8, "JPEG", comment=encode_image(FRAME8[:8, :8], "JPEG"))
    assert "truncated" in cause(whole[:-2])


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"restart_marker_rows": 1}, {"mode": "RGB"}])
@pytest.mark.parametrize("kept", [0.3, 0.6, 0.97])
def test_jpeg_cut_and_closed_with_an_end_marker(cause, options, kept):
    """Pillow and OpenCV both fill the missing part with a constant, without an error."""
    whole = encode_image(FRAME8, "JPEG", **options)
    scan = whole.index(b"\xff\xda") + 14
    cut = whole[: scan + round(kept * (len(whole) - 2 - scan))] + b"\xff\xd9"
    Image.open(io.BytesIO(cut)).load()
    assert "truncated" in cause(cut)


def test_text_chunks_of_pillow_are_read(tmp_path):
    text = PngImagePlugin.PngInfo()
    text.add_text("DATE-AVG", "2031-03-26T20:58:11.966208")
    text.add_text("EXPTIME", "10", zip=True)
    text.add_itxt("STCAMERA", "Kamera ü.toml", zip=True)
    text.add_text("Software", "something else")
    Image.fromarray(FRAME16).save(tmp_path / "frame.png", pnginfo=text)
    exposure = read_exposure(tmp_path / "frame.png")
    assert exposure.time_utc.isoformat() == "2031-03-26T20:58:11.966208+00:00"
    assert exposure.exposure_s == 10.0
    assert exposure.camera == str(tmp_path / "Kamera ü.toml")
    assert exposure.terrain is None


def test_a_text_bomb_is_not_inflated(read):
    exposure = read(png(chunk(b"zTXt", b"STCAMERA\0\0" + zlib.compress(bytes(10**7)))))
    assert exposure.camera is None
    assert "STCAMERA" in exposure.warnings[0]
