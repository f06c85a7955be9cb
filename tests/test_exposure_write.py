"""Written files are read back, by startrack and by others; no file is ever incomplete."""

import errno
import io
import json
import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import tifffile
from astropy.io import fits
from PIL import Image

from startrack.core.types import BadInput, Exposure
from startrack.exposure import Facts, read_exposure, write_exposure, write_sidecar

FRAME = np.random.default_rng(8).integers(0, 65536, (33, 44)).astype(np.uint16)
MID = datetime(2031, 3, 26, 20, 58, 11, 966208, tzinfo=UTC)
FACTS = ("time_utc", "time_sigma_s", "exposure_s", "saturation_adu")
SUFFIXES = [".png", ".tif", ".tiff", ".fits", ".fit", ".fits.gz", ".fits.bz2", ".PNG"]


def exposure_of(pixels, saturation=65535.0, **facts):
    return Exposure(pixels_adu=pixels, saturation_adu=saturation, **facts)


@pytest.fixture
def exposure(tmp_path):
    camera = tmp_path / "calib" / "camera.toml"
    return exposure_of(
        FRAME, time_utc=MID, time_sigma_s=0.25, exposure_s=9.999999, camera=str(camera), terrain="shackleton"
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_round_trip(tmp_path, exposure, suffix):
    path = write_exposure(tmp_path / f"frame 1.0{suffix}", exposure)
    back = read_exposure(path)
    np.testing.assert_array_equal(back.pixels_adu, FRAME)
    assert [getattr(back, f) for f in FACTS] == [getattr(exposure, f) for f in FACTS]
    assert os.path.realpath(back.camera) == os.path.realpath(exposure.camera)
    assert (back.terrain, back.name, back.warnings) == ("shackleton", "frame 1.0", ())


def test_a_camera_elsewhere_is_in_the_sidecar_alone(tmp_path, exposure):
    path = write_exposure(tmp_path / "deep" / "er" / "frame.png", exposure)
    assert "STCAMERA" not in Image.open(path).text
    assert (read_exposure(path).camera, read_exposure(path).warnings) == (None, ())
    write_sidecar(path, exposure)
    back = read_exposure(path)
    assert os.path.realpath(back.camera) == os.path.realpath(exposure.camera)
    assert back.terrain == "shackleton"


@pytest.mark.parametrize("suffix", [".png", ".tif", ".fits"])
def test_eight_bits_stay_eight(tmp_path, suffix):
    path = write_exposure(tmp_path / f"frame{suffix}", exposure_of(FRAME >> 8, saturation=255.0))
    back = read_exposure(path)
    np.testing.assert_array_equal(back.pixels_adu, FRAME >> 8)
    assert back.saturation_adu == 255.0


@pytest.mark.parametrize("suffix", [".tif", ".fits"])
@pytest.mark.parametrize(("pixels", "saturation"), [(FRAME / np.float32(7), 65535.0), (FRAME - 40000.0, None)])
def test_pixels_that_are_no_counts_are_written_as_float(tmp_path, suffix, pixels, saturation):
    back = read_exposure(write_exposure(tmp_path / f"frame{suffix}", exposure_of(pixels, saturation)))
    np.testing.assert_array_equal(back.pixels_adu, pixels.astype(np.float32))
    assert back.saturation_adu is None


def test_png_rounds_and_refuses_what_does_not_fit(tmp_path):
    back = read_exposure(write_exposure(tmp_path / "frame.png", exposure_of(np.array([[0.4, 7.6], [65535.4, -0.4]]))))
    np.testing.assert_array_equal(back.pixels_adu, [[0, 8], [65535, 0]])
    for wrong in (-1.0, 65536.0, np.nan):
        with pytest.raises(BadInput, match=r"do not fit 16 bits|NaN"):
            write_exposure(tmp_path / "wrong.png", exposure_of(np.array([[0.0, wrong]])))
    assert not (tmp_path / "wrong.png").exists()


def test_others_read_our_png(tmp_path, exposure):
    picture = Image.open(write_exposure(tmp_path / "frame.png", exposure))
    np.testing.assert_array_equal(np.asarray(picture), FRAME)
    assert picture.text == {
        "TIMESYS": "UTC",
        "DATE-OBS": "2031-03-26T20:58:06.966208",
        "DATE-AVG": "2031-03-26T20:58:11.966208",
        "STTSIG": "0.25",
        "EXPTIME": "9.999999",
        "STCAMERA": "calib/camera.toml",
        "STTERRAI": "shackleton",
    }


def test_others_read_our_fits(tmp_path, exposure):
    path = write_exposure(tmp_path / "frame.fits", exposure)
    with fits.open(path, checksum=True) as units:
        units.verify("exception")
        np.testing.assert_array_equal(units[0].data, FRAME)
        header = units[0].header
    assert header["DATE-OBS"] == "2031-03-26T20:58:06.966208"
    assert header["DATE-AVG"] == "2031-03-26T20:58:11.966208"
    assert (header["STTSIG"], header.comments["STTSIG"]) == (0.25, "[s] standard deviation of the clock's error")
    assert (header["EXPTIME"], header["TIMESYS"], header["STCAMERA"]) == (9.999999, "UTC", "calib/camera.toml")


def test_others_read_our_tiff(tmp_path, exposure):
    path = write_exposure(tmp_path / "frame.tif", exposure)
    np.testing.assert_array_equal(tifffile.imread(path), FRAME)
    np.testing.assert_array_equal(np.asarray(Image.open(path)), FRAME)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_equal_input_gives_equal_bytes(tmp_path, exposure, suffix, monkeypatch):
    first = write_exposure(tmp_path / f"a{suffix}", exposure).read_bytes()
    monkeypatch.setattr("time.time", lambda: 1e9)
    assert write_exposure(tmp_path / f"b{suffix}", exposure).read_bytes() == first


def test_unknown_facts_are_left_out(tmp_path):
    path = write_exposure(tmp_path / "frame.png", exposure_of(FRAME, time_utc=MID))
    assert Image.open(path).text == {"TIMESYS": "UTC", "DATE-AVG": "2031-03-26T20:58:11.966208"}
    assert Image.open(write_exposure(tmp_path / "timeless.png", exposure_of(FRAME))).text == {}
    assert write_sidecar(path, Facts()).read_text() == "{}\n"


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_unicode_in_a_path(tmp_path, suffix):
    exposure = exposure_of(FRAME, camera=str(tmp_path / "Kamera ü ☾.toml"))
    assert read_exposure(write_exposure(tmp_path / f"f{suffix}", exposure)).camera == exposure.camera


def test_fits_refuses_names_beyond_ascii(tmp_path):
    with pytest.raises(BadInput, match="ASCII"):
        write_exposure(tmp_path / "f.fits", exposure_of(FRAME, camera=str(tmp_path / "Kamera ü.toml")))
    assert list(tmp_path.iterdir()) == []


def test_long_paths_in_fits(tmp_path):
    exposure = exposure_of(FRAME, camera=str(tmp_path / ("x" * 60) / ("y" * 60) / "camera.toml"))
    assert read_exposure(write_exposure(tmp_path / "f.fits", exposure)).camera == exposure.camera


def test_sidecar(tmp_path, exposure):
    (tmp_path / "frames").mkdir()
    Image.fromarray(FRAME).save(tmp_path / "frames" / "a.png")
    path = write_sidecar(tmp_path / "frames" / "a.png", exposure)
    assert path == tmp_path / "frames" / "a.json"
    assert json.loads(path.read_text()) == {
        "time_utc": "2031-03-26T20:58:11.966208Z",
        "time_sigma_s": 0.25,
        "exposure_s": 9.999999,
        "camera": "../calib/camera.toml",
        "terrain": "shackleton",
    }
    back = read_exposure(tmp_path / "frames" / "a.png")
    assert (back.time_utc, back.time_sigma_s, back.exposure_s) == (MID, 0.25, 9.999999)
    assert os.path.realpath(back.camera) == os.path.realpath(exposure.camera)


def test_a_path_without_suffix_stays_a_path(tmp_path):
    exposure = exposure_of(FRAME, camera=str(tmp_path / "camera"))
    assert read_exposure(write_exposure(tmp_path / "f.png", exposure)).camera == f"{tmp_path}/./camera"


def test_relative_paths_hold_through_a_symbolic_link(tmp_path, exposure):
    (tmp_path / "elsewhere" / "out").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere" / "out")
    write_sidecar(write_exposure(tmp_path / "link" / "f.png", exposure), exposure)
    for folder in ("link", "elsewhere/out"):
        camera = read_exposure(tmp_path / folder / "f.png").camera
        assert os.path.realpath(camera) == os.path.realpath(exposure.camera)


def test_an_existing_file_is_kept_without_overwrite(tmp_path, exposure):
    path, sidecar = tmp_path / "frame.png", tmp_path / "frame.json"
    for file, write in ((path, write_exposure), (sidecar, write_sidecar)):
        file.write_text("mine")
        with pytest.raises(BadInput, match="exists already") as caught:
            write(path, exposure)
        assert caught.value.reason == "bad_image"
        assert file.read_text() == "mine"
        write(path, exposure, overwrite=True)
    np.testing.assert_array_equal(read_exposure(path).pixels_adu, FRAME)


@pytest.mark.parametrize("name", ["frame.jpg", "frame", "frame.png.gz", "frame.fits.fz"])
def test_suffixes_that_are_not_written(tmp_path, exposure, name):
    with pytest.raises(BadInput, match="startrack writes"):
        write_exposure(tmp_path / name, exposure)


def full_disk(*_args, **_keywords):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("step", ["os.replace", "pathlib.Path.open"])
def test_a_failed_write_leaves_nothing_behind(tmp_path, exposure, monkeypatch, step):
    path = tmp_path / "frame.png"
    path.write_text("old")
    with monkeypatch.context() as broken:
        broken.setattr(step, full_disk)
        with pytest.raises(BadInput, match=r"cannot be written \(No space left on device\)"):
            write_exposure(path, exposure, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["frame.png"]
    assert path.read_bytes() == b"old"


def test_a_folder_that_is_a_file(tmp_path, exposure):
    (tmp_path / "out").write_text("")
    with pytest.raises(BadInput, match="cannot be written"):
        write_exposure(tmp_path / "out" / "frame.png", exposure)


def test_the_file_is_as_public_as_any_other(tmp_path, exposure):
    """Temporary files of the standard library are private to their owner, and stay so when renamed."""
    plain = tmp_path / "plain"
    plain.write_text("")
    path = write_exposure(tmp_path / "frame.png", exposure)
    assert Path(path).stat().st_mode == plain.stat().st_mode


def test_noise_takes_no_more_space_than_with_pillow(tmp_path):
    noise = np.random.default_rng(1).normal(1000, 20, (1024, 1024)).astype(np.uint16)
    path = write_exposure(tmp_path / "frame.png", exposure_of(noise))
    file = io.BytesIO()
    Image.fromarray(noise).save(file, "PNG")
    assert path.stat().st_size < 1.1 * len(file.getvalue())
