"""FITS files written by astropy: read as astropy does, or refused with the cause."""

import bz2
import gzip
import io
from datetime import UTC

import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time

from startrack.core.types import BadInput
from startrack.exposure import read_exposure
from startrack.exposure.facts import middle_of_exposure
from startrack.frames import format_utc

FRAME = np.random.default_rng(5).integers(0, 65536, (31, 47)).astype(np.uint16)
SIGNED = FRAME.view(np.int16)
TABLE = fits.BinTableHDU.from_columns([fits.Column("flux", "E", array=np.arange(3.0))])


def fits_bytes(*units, **options):
    """FITS bytes; None stands for an empty primary unit."""
    file = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU() if unit is None else unit for unit in units]).writeto(file, **options)
    return file.getvalue()


def header_bytes(**cards):
    """Header that astropy would not write, without data."""
    lines = [f"{'SIMPLE':8}= {'T':>20}", *(f"{key:8}= {value:>20}" for key, value in cards.items()), "END"]
    return "".join(line.ljust(80) for line in lines).encode().ljust(2880)


@pytest.fixture
def read(tmp_path):
    def read_bytes(raw, name="frame.fits"):
        path = tmp_path / name
        path.write_bytes(raw)
        return read_exposure(path)

    return read_bytes


@pytest.fixture
def cause(read):
    def refusal_cause(raw):
        with pytest.raises(BadInput) as caught:
            read(raw)
        assert caught.value.reason == "bad_image"
        assert "\n" not in str(caught.value)
        return str(caught.value)

    return refusal_cause


@pytest.mark.parametrize(
    ("units", "expected", "saturation"),
    [
        ([fits.PrimaryHDU(FRAME)], FRAME, 65535),  # BZERO = 32768
        ([fits.PrimaryHDU(SIGNED)], SIGNED, 32767),  # big-endian, no BZERO
        ([fits.PrimaryHDU((FRAME >> 8).astype(np.uint8))], FRAME >> 8, 255),
        ([fits.PrimaryHDU(FRAME.astype(np.uint32))], FRAME, 2**32 - 1),
        ([fits.PrimaryHDU(FRAME.astype(np.float32) / 3)], FRAME.astype(np.float32) / 3, None),
        ([fits.PrimaryHDU(FRAME.astype(np.float64))], FRAME, None),
        ([None, fits.ImageHDU(FRAME)], FRAME, 65535),
        ([fits.PrimaryHDU(FRAME), TABLE], FRAME, 65535),
        ([None, TABLE, fits.ImageHDU(FRAME)], FRAME, 65535),
        ([fits.PrimaryHDU(FRAME[None])], FRAME, 65535),  # an axis of length 1 makes no cube
        ([None, fits.CompImageHDU(FRAME)], FRAME, 65535),  # .fz
        ([None, fits.CompImageHDU(FRAME.astype(np.float32), quantize_level=0)], FRAME, None),
    ],
)
def test_pixels(read, units, expected, saturation):
    exposure = read(fits_bytes(*units))
    assert exposure.pixels_adu.dtype == np.float32
    assert exposure.pixels_adu.dtype.isnative
    np.testing.assert_array_equal(exposure.pixels_adu, expected)
    assert exposure.saturation_adu == pytest.approx(saturation) if saturation else exposure.saturation_adu is None
    assert exposure.size_px == (47, 31)


def test_the_first_stored_row_is_row_zero(read):
    """FITS pixel (x + 1, y + 1) is ours (x, y): no flip."""
    raw = fits_bytes(fits.PrimaryHDU(FRAME))
    stored_first = np.frombuffer(raw, ">i2", count=47, offset=2880).astype(int) + 32768
    np.testing.assert_array_equal(read(raw).pixels_adu[0], stored_first)


def test_bscale_and_bzero(read):
    unit = fits.PrimaryHDU(SIGNED, do_not_scale_image_data=True)
    unit.header["BSCALE"], unit.header["BZERO"] = 2.0, 10.0
    exposure = read(fits_bytes(unit))
    np.testing.assert_array_equal(exposure.pixels_adu, SIGNED * 2.0 + 10.0)
    assert exposure.saturation_adu == 32767 * 2 + 10


@pytest.mark.parametrize(("pack", "suffix"), [(gzip.compress, "gz"), (bz2.compress, "bz2")])
def test_packed(read, pack, suffix):
    exposure = read(pack(fits_bytes(fits.PrimaryHDU(FRAME))), f"night 1.5.fits.{suffix}")
    np.testing.assert_array_equal(exposure.pixels_adu, FRAME)
    assert exposure.name == "night 1.5"


def undefined_image():
    unit = fits.PrimaryHDU(SIGNED.copy())
    unit.header["BLANK"] = int(SIGNED[4, 7])
    return fits_bytes(unit)


def nan_image():
    pixels = FRAME.astype(np.float32)
    pixels[2, 3] = np.nan
    return fits_bytes(fits.PrimaryHDU(pixels))


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (fits_bytes(None), "no image"),
        (fits_bytes(None, TABLE), "no image"),
        (fits_bytes(fits.PrimaryHDU(np.stack([FRAME] * 3))), "a cube (47 x 31 x 3)"),
        (fits_bytes(fits.PrimaryHDU(FRAME[0])), "a spectrum (47)"),
        (
            fits_bytes(None, fits.ImageHDU(FRAME, name="A"), fits.ImageHDU(FRAME)),
            "2 images (A 47 x 31, unnamed 47 x 31)",
        ),
        (nan_image(), "1 of 1457 pixels are NaN"),
        (undefined_image(), "pixels are NaN"),
        (fits_bytes(fits.PrimaryHDU(FRAME)) + b"x" * 2880, "damaged"),
        (fits_bytes(fits.PrimaryHDU(FRAME))[:-1], "truncated"),
        (fits_bytes(fits.PrimaryHDU(FRAME))[:3000], "truncated"),
        (fits_bytes(fits.PrimaryHDU(FRAME))[:800], "truncated"),
        (fits_bytes(None, fits.ImageHDU(FRAME))[:4000], "truncated"),
        (gzip.compress(fits_bytes(fits.PrimaryHDU(FRAME)), mtime=0)[:-9], "truncated"),
        (bz2.compress(fits_bytes(fits.PrimaryHDU(FRAME)))[:-9], "truncated"),
        (gzip.compress(b"a packed text", mtime=0), "without FITS data"),
        (header_bytes(BITPIX=16, NAXIS=2, NAXIS1=20000, NAXIS2=20000) + bytes(2880), "400.0 Mpx"),
        (
            gzip.compress(header_bytes(BITPIX=16, NAXIS=2, NAXIS1=20000, NAXIS2=20000) + bytes(2880), mtime=0),
            "400.0 Mpx",
        ),
        (header_bytes(BITPIX=16, NAXIS=2, NAXIS1=-5, NAXIS2=20) + bytes(2880), "no pixels"),
        (header_bytes(BITPIX=17, NAXIS=2, NAXIS1=5, NAXIS2=20) + bytes(2880), "damaged"),
    ],
)
def test_refused_with_the_cause(cause, raw, why):
    assert why in cause(raw)


def changed_with_its_old_sum(change, tmp_path):
    """The file that astropy leaves where a program changes the pixels and keeps the header."""
    (tmp_path / "whole.fits").write_bytes(fits_bytes(fits.PrimaryHDU(FRAME), checksum=True))
    with fits.open(tmp_path / "whole.fits") as units:
        pixels, header = change(units[0].data), units[0].header
    return pixels, fits_bytes(fits.PrimaryHDU(pixels, header))


@pytest.mark.parametrize(
    "change", [lambda p: p[3:20, 5:40].copy(), lambda p: p // 3, lambda p: np.asarray(p, np.float32) - 7.5]
)
def test_pixels_that_a_program_changed_are_read_with_a_warning(read, cause, tmp_path, change):
    pixels, raw = changed_with_its_old_sum(change, tmp_path)
    assert b"DATASUM" in raw
    for packed in (raw, gzip.compress(raw)):
        exposure = read(packed)
        np.testing.assert_array_equal(exposure.pixels_adu, pixels)
        assert [("DATASUM" in text, "kept the old sum" in text) for text in exposure.warnings] == [(True, True)]
    assert "truncated" in cause(raw[:-1])
    assert read(fits_bytes(fits.PrimaryHDU(pixels), checksum=True)).warnings == ()


def image_with_cards(**cards):
    unit = fits.PrimaryHDU(FRAME)
    for key, value in cards.items():
        unit.header[key.replace("_", "-")] = value
    return fits_bytes(unit)


def test_facts_of_the_header(read, tmp_path):
    exposure = read(
        image_with_cards(
            DATE_OBS="2018-08-06T05:17:04.752", EXPTIME=60, STCAMERA="calib/all sky.toml", STTERRAI="shackleton"
        )
    )
    assert exposure.time_utc.isoformat() == "2018-08-06T05:17:34.752000+00:00"
    assert exposure.exposure_s == 60.0
    assert exposure.camera == str(tmp_path / "calib/all sky.toml")
    assert exposure.terrain == "shackleton"
    assert exposure.warnings == ()
    assert exposure.row_order == read(image_with_cards(ROWORDER="unknown")).row_order == ""
    assert read(image_with_cards(ROWORDER="bottom-up ")).row_order == "BOTTOM-UP"


def test_date_avg_goes_before_date_obs(read):
    exposure = read(image_with_cards(DATE_OBS="2018-08-06T05:17:04", DATE_AVG="2018-08-06T05:18:00", EXPTIME=60.0))
    assert exposure.time_utc.isoformat() == "2018-08-06T05:18:00+00:00"


BEGIN = {"DATE_BEG": "2018-08-06T05:17:00", "DATE_END": "2018-08-06T05:18:00"}
MJD = 58336.0 + (5 * 3600 + 17 * 60) / 86400  # 2018-08-06T05:17:00, of which the Julian date is 2458336.72


@pytest.mark.parametrize(
    "cards",
    [
        BEGIN,
        {"DATE_BEG": "2018-08-06T05:17:00", "EXPTIME": 60.0},
        {"DATE_END": "2018-08-06T05:18:00", "EXPTIME": 60.0},
        {"DATE_OBS": "2018-08-06T05:17:00", "EXPTIME": 60.0, "MJD_OBS": MJD},
        {"MJD_OBS": MJD, "EXPTIME": 60.0},
        {"MJD_OBS": 0.0, "DATE_END": "2018-08-06T05:18:00", "EXPTIME": 60.0},
        {"DATE_OBS": "2018-08-06T05:17:00", "DATE_END": "2018-08-06T05:18:00", "MJD_AVG": 0},
        {"DATE_OBS": "2018-08-06", "TIME_OBS": "05:17:00", "DATE_END": "2018-08-06T05:18:00"},
        {"MJD_OBS": MJD, "MJD_END": MJD + 60 / 86400},
        {"MJD_AVG": MJD + 30 / 86400},
        {"MJD_BEG": MJD, "MJD_END": MJD + 60 / 86400},
        {"MJD_BEG": MJD, "EXPTIME": 60.0},
        {"MJD_END": MJD + 60 / 86400, "EXPTIME": 60.0, "TIMESYS": "UTC"},
        {**BEGIN, "DATE_AVG": "2018-08-06T05:17:30", "DATE_OBS": "2018-08-06T05:17:00", "MJD_OBS": MJD},
        {**BEGIN, "DATE_OBS": "2018-08-06T05:17:00", "EXPTIME": 40.0},  # 40 s of light within a minute
    ],
)
def test_the_middle_by_the_other_times_of_the_standard(read, cards):
    exposure = read(image_with_cards(**cards))
    assert exposure.time_utc.isoformat(timespec="milliseconds") == "2018-08-06T05:17:30.000+00:00"
    assert exposure.warnings == ()
    astropys = Time(MJD + 30 / 86400, format="mjd", scale="utc").to_datetime(timezone=UTC)
    assert abs((exposure.time_utc - astropys).total_seconds()) < 1e-3


@pytest.mark.parametrize(
    ("cards", "time", "words"),
    [
        (
            {"DATE_OBS": "2018-08-06T03:18:00", "DATE_AVG": "2018-08-06T05:18:30", "EXPTIME": 60.0},
            "05:18:30", ["that by DATE-AVG, 2018-08-06T05:18:30", "by DATE-OBS it is 2:00:00 (h:mm:ss) before"],
        ),
        (
            {"DATE_OBS": "2018-08-06T05:17:00", "DATE_AVG": "2018-08-06T05:18:30"},
            "05:18:30", ["by DATE-OBS (without EXPTIME) it is 0:01:30 (h:mm:ss) before"],
        ),
        (
            {**BEGIN, "MJD_AVG": MJD, "DATE_OBS": "2018-08-06T07:17:00", "EXPTIME": 5.0},
            "05:17:00", ["by MJD-AVG", "by DATE-BEG and DATE-END it is 0:00:30 (h:mm:ss) after", "2:00:30"],
        ),
        ({**BEGIN, "DATE_END": "2018-08-06T05:16:00", "MJD_AVG": MJD - 0.5 / 86400}, "05:16:59.5", []),
        ({"DATE_OBS": "2018-08-06", "MJD_OBS": MJD, "EXPTIME": 60.0}, "05:17:30", ["DATE-OBS not used"]),
        (
            {"DATE_OBS": "2018-08-06T05:17:00", "DATE_END": "2018-08-06T05:17:10", "EXPTIME": 1.0},
            "05:17:00.5", ["by DATE-END it is 0:00:09 (h:mm:ss) after"],
        ),
        ({**BEGIN, "DATE_OBS": "2018-08-06T07:17:30"}, "05:17:30", ["by DATE-OBS it is 2:00:30 (h:mm:ss) after"]),
    ],
)  # fmt: skip
def test_a_choice_among_times_that_disagree_is_stated(read, cards, time, words):
    exposure = read(image_with_cards(**cards))
    assert exposure.time_utc.isoformat().startswith(f"2018-08-06T{time}")
    assert len(exposure.warnings) == bool(words)
    for text in words:
        assert text in exposure.warnings[0]


@pytest.mark.parametrize("nothing", [None, 0, 0.0, "0", "0.0", "", " "])
def test_what_fills_the_place_of_a_time_is_no_time(nothing):
    """As in JSON of a TIFF description, and as many programs write it."""
    notes = []
    assert middle_of_exposure({"MJD-OBS": nothing, "MJD-AVG": nothing, "TIMESYS": "TT"}, 60.0, notes) is None
    header = {"MJD-AVG": nothing, "DATE-BEG": None, "DATE-AVG": "2018-08-06T05:17:30"}
    assert format_utc(middle_of_exposure(header, None, notes)).startswith("2018-08-06T05:17:30")
    assert notes == []


def test_a_card_that_names_the_hardware_is_not_the_camera_file(read):
    assert read(image_with_cards(CAMERA="SX Superstar", TERRAIN="rocks")).camera is None


def test_facts_of_the_primary_header_hold_for_an_extension(read):
    primary = fits.PrimaryHDU()
    primary.header["EXPTIME"] = 4
    primary.header["DATE-AVG"] = "2018-08-06T05:18:00"
    image = fits.ImageHDU(FRAME)
    image.header["EXPTIME"] = 5
    image.header["DATE-AVG"] = None  # a card without a value
    exposure = read(fits_bytes(primary, image))
    assert exposure.exposure_s == 5.0
    assert exposure.time_utc is not None


@pytest.mark.parametrize(
    ("cards", "note"),
    [
        ({"DATE_OBS": "2018-08-06T05:17:04"}, "without EXPTIME its middle is not known"),
        ({"DATE_OBS": "2018-08-06", "EXPTIME": 60.0}, "DATE-OBS not used"),
        ({"DATE_OBS": "06/08/99", "EXPTIME": 60.0}, "DATE-OBS not used"),
        ({"DATE_AVG": "2018-08-06T05:17:04+02:00"}, "local time"),
        ({"DATE_AVG": "2018-08-06T05:17:04", "TIMESYS": "TAI"}, "time scale TAI"),
        ({"MJD_AVG": MJD, "TIMESYS": "TDB"}, "MJD-AVG not used: it is in the time scale TDB"),
        ({"MJD_OBS": MJD}, "MJD-OBS is when the exposure starts, and without EXPTIME its middle is not known"),
        ({"DATE_END": "2018-08-06T05:17:04"}, "DATE-END is when the exposure ends"),
        ({**BEGIN, "DATE_END": "2018-08-06T05:16:00"}, "DATE-BEG and DATE-END not used: the end is before the start"),
        (
            {"DATE_OBS": "2018-08-06T05:17:00", "DATE_END": "2018-08-06T05:16:00"},
            "DATE-OBS and DATE-END not used: the end is before the start",
        ),
        ({"MJD_AVG": "today"}, "MJD-AVG not used"),
        (
            {"MJD_OBS": 2460310.5, "EXPTIME": 60.0},
            "8594 is outside 1900 to 2050, the ephemeris's years (2460310.5: a Julian date?)",
        ),
        ({"MJD_AVG": 6.5e4 + 365 * 100}, "the ephemeris's years"),
        ({"MJD_AVG": 1e9}, "MJD-AVG not used"),
        ({"DATE_OBS": "9999-12-31T23:59:59", "EXPTIME": 60.0}, "DATE-OBS not used"),
        ({"DATE_OBS": "2018-08-06T05:17:04", "EXPTIME": 0.0}, "EXPTIME 0.0"),
        ({"DATE_OBS": "2018-08-06T05:17:04", "EXPTIME": "long"}, "EXPTIME 'long'"),
    ],
)
def test_a_time_that_is_not_known_stays_unknown_and_is_explained(read, cards, note):
    exposure = read(image_with_cards(**cards))
    assert exposure.time_utc is None
    assert note in " ".join(exposure.warnings)


def test_the_time_of_day_may_have_a_card_of_its_own(read):
    for date, time in (("2018-08-16", "20:58:35"), ("2018-08-16T20:58:35", "11:00:00")):
        exposure = read(image_with_cards(DATE_OBS=date, TIME_OBS=time, EXPTIME=60.0))
        assert exposure.time_utc.isoformat() == "2018-08-16T20:59:05+00:00"


def test_an_unusable_date_avg_leaves_date_obs(read):
    exposure = read(image_with_cards(DATE_AVG="yesterday", DATE_OBS="2018-08-06T05:17:00", EXPTIME=60, TIMESYS="UTC"))
    assert exposure.time_utc.isoformat() == "2018-08-06T05:17:30+00:00"
    assert "DATE-AVG not used" in exposure.warnings[0]


def patch_card(raw, card, value, nth=0):
    """The file with the value of its nth card of that name replaced."""
    at = -1
    for _ in range(nth + 1):
        at = raw.index(f"{card:<8}=".encode(), at + 1)
    return raw[: at + 10] + f"{value:>20}".encode() + raw[at + 30 :]


@pytest.mark.parametrize(
    "raw",
    [
        patch_card(fits_bytes(fits.PrimaryHDU(FRAME)), "NAXIS", 10**9),
        patch_card(fits_bytes(fits.PrimaryHDU(FRAME)), "NAXIS", -2),
        patch_card(fits_bytes(fits.PrimaryHDU(FRAME)), "NAXIS1", 10**9),
        patch_card(fits_bytes(None, fits.ImageHDU(FRAME)), "NAXIS", 10**9, nth=1),
        patch_card(fits_bytes(fits.PrimaryHDU(FRAME), TABLE), "TFIELDS", 10**9),
        patch_card(fits_bytes(fits.PrimaryHDU(FRAME), TABLE), "GCOUNT", -(10**9)),
        gzip.compress(patch_card(fits_bytes(fits.PrimaryHDU(FRAME)), "NAXIS", 10**9), mtime=0),
    ],
    ids=["axes", "negative axes", "width", "axes of an extension", "fields", "negative size", "packed"],
)
def test_huge_numbers_in_a_header_are_refused_at_once(read, raw):
    with pytest.raises(BadInput) as caught:
        read(raw)
    assert caught.value.reason == "bad_image"


def test_a_compressed_image_without_rows_is_refused(read):
    with pytest.raises(BadInput, match="damaged FITS"):
        read(patch_card(fits_bytes(None, fits.CompImageHDU(FRAME)), "NAXIS2", 0))
