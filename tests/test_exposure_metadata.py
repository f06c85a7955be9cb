"""Time, exposure, camera and terrain: flag, then sidecar, then header."""

import json
import os
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
import tifffile
from astropy.io import fits
from PIL import Image, PngImagePlugin

from startrack.core.types import TIME_SIGMA_S, BadInput
from startrack.exposure import read_exposure, with_facts

FRAME = np.arange(12, dtype=np.uint16).reshape(3, 4)
MID = datetime(2031, 3, 26, 20, 58, 11, 966208, tzinfo=UTC)


@pytest.fixture
def image(tmp_path):
    """A PNG with all metadata in its header."""
    text = PngImagePlugin.PngInfo()
    for key, value in {
        "DATE-OBS": "2020-01-01T00:00:00",
        "EXPTIME": "20.0",
        "STCAMERA": "header.toml",
        "STTERRAI": "header-terrain",
    }.items():
        text.add_text(key, value)
    path = tmp_path / "frame.png"
    Image.fromarray(FRAME).save(path, pnginfo=text)
    return path


@pytest.fixture
def sidecar(image):
    def write(values, name="frame.json"):
        raw = values if isinstance(values, bytes) else json.dumps(values).encode()
        (image.parent / name).write_bytes(raw)

    return write


def test_header_alone(image):
    exposure = read_exposure(image)
    assert exposure.time_utc == datetime(2020, 1, 1, 0, 0, 10, tzinfo=UTC)
    assert (exposure.exposure_s, exposure.terrain) == (20.0, "header-terrain")
    assert exposure.camera == str(image.parent / "header.toml")


def test_a_time_of_the_file_that_differs_from_the_given_one_is_named(image, sidecar):
    of_file = datetime(2020, 1, 1, 0, 0, 10, tzinfo=UTC)
    assert read_exposure(image, time_utc=of_file + timedelta(seconds=0.5)).warnings == ()
    (warning,) = read_exposure(image, time_utc=of_file + timedelta(hours=7)).warnings
    assert warning == "the time used is 7:00:00 (h:mm:ss) after that of the file, 2020-01-01T00:00:10.000000Z"
    sidecar({"time_utc": "2020-01-01T00:01:10Z"})
    (warning,) = read_exposure(image, time_utc=of_file).warnings
    assert "0:01:00 (h:mm:ss) before that of the file" in warning
    sidecar({"time_utc": "yesterday"})
    assert read_exposure(image, time_utc=of_file).warnings == ()


@pytest.mark.parametrize(("late_s", "kept"), [(0.5, True), (3600.0, False), (-3600.0, False)])
def test_the_clock_error_of_a_file_is_not_that_of_another_time(image, sidecar, late_s, kept):
    """A sidecar that states an exact clock says nothing about a time that a user types."""
    of_file = datetime(2020, 1, 1, 0, 0, 10, tzinfo=UTC)
    sidecar({"time_utc": of_file.isoformat(), "time_sigma_s": 0.0})
    exposure = read_exposure(image)
    assert (exposure.time_sigma_s, exposure.time_sigma_is_stated) == (0.0, True)
    given = of_file + timedelta(seconds=late_s)
    for one in (read_exposure(image, time_utc=given), with_facts(exposure, time_utc=given)):
        assert one.time_utc == given
        assert (one.time_sigma_s, one.time_sigma_is_stated) == ((0.0, True) if kept else (TIME_SIGMA_S, False))
    for one in (read_exposure(image, time_utc=given, time_sigma_s=0.1),
                with_facts(exposure, time_utc=given, time_sigma_s=0.1)):  # fmt: skip
        assert (one.time_sigma_s, one.time_sigma_is_stated) == (0.1, True)


@pytest.mark.parametrize("key", ["camera", "terrain"])
@pytest.mark.parametrize("value", ["", 5, ["a"], "x" * 2000, {"a": "b"}])
def test_a_sidecar_reference_that_is_no_name_is_refused_in_one_line(image, sidecar, key, value):
    sidecar({key: value})
    with pytest.raises(BadInput, match=key) as caught:
        read_exposure(image)
    assert caught.value.reason == "bad_image" and "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_sidecar_goes_before_header_fact_by_fact(image, sidecar):
    sidecar({"time_utc": "2031-03-26T20:58:11.966208Z", "camera": "fisheye-2048"})
    exposure = read_exposure(image)
    assert exposure.time_utc == MID
    assert exposure.exposure_s == 20.0
    assert exposure.camera == "fisheye-2048"
    assert exposure.terrain == "header-terrain"
    assert exposure.warnings == ()


def test_flags_go_before_sidecar(image, sidecar):
    sidecar({"time_utc": "2031-03-26T20:58:11Z", "exposure_s": 5, "camera": "a.toml", "terrain": "b.toml"})
    flags = {"time_utc": MID, "exposure_s": 7.0, "camera": "flag.toml", "terrain": "flagged"}
    for exposure in (read_exposure(image, **flags), with_facts(read_exposure(image), **flags)):
        assert {key: getattr(exposure, key) for key in flags} == flags


def test_a_fact_given_by_flag_is_not_read_elsewhere(image, sidecar):
    sidecar({"time_utc": "2031-03-26T20:58:11+02:00"})
    with pytest.raises(BadInput, match="local time") as caught:
        read_exposure(image)
    assert caught.value.reason == "no_time"
    assert read_exposure(image, time_utc=MID).time_utc == MID


def test_the_exposure_that_holds_moves_the_middle(image, sidecar):
    """DATE-OBS is the start: half of the resolved exposure time is added, whatever its source."""
    start = datetime(2020, 1, 1, tzinfo=UTC)
    assert read_exposure(image, exposure_s=8.0).time_utc == start + timedelta(seconds=4)
    sidecar({"exposure_s": 6})
    assert read_exposure(image).time_utc == start + timedelta(seconds=3)


def test_with_facts_leaves_the_rest_alone(image):
    before = read_exposure(image)
    after = with_facts(before, camera="other")
    assert (after.camera, after.terrain, after.time_utc) == ("other", before.terrain, before.time_utc)
    assert after.sha256 == before.sha256
    with pytest.raises(ValueError, match="zone"):
        with_facts(before, time_utc=datetime(2031, 1, 1))


@pytest.mark.parametrize(
    ("reference", "is_path"),
    [
        ("camera.toml", True),
        ("../calib/camera.toml", True),
        ("calib/camera", True),
        ("./camera", True),
        ("fisheye-2048", False),
        ("fisheye.2048", False),
    ],
)
def test_paths_are_relative_to_the_sidecar(image, sidecar, monkeypatch, reference, is_path):
    sidecar({"camera": reference})
    monkeypatch.chdir(image.parent)
    for path in (image, "frame.png"):
        camera = read_exposure(path).camera
        assert os.path.abspath(camera) == os.path.abspath(reference) if is_path else camera == reference


def test_an_absolute_path_stays(image, sidecar):
    sidecar({"terrain": "/data/crater.toml"})
    assert read_exposure(image).terrain == "/data/crater.toml"


@pytest.mark.parametrize(
    "raw",
    [
        b"{",
        b"",
        b"\xff\xfe\x00",
        b"[1, 2]",
        b'"text"',
        b"[" * 100_000,
        b'{"exposure_s": "ten"}',
        b'{"exposure_s": true}',
        b'{"exposure_s": 0}',
        b'{"exposure_s": -3}',
        b'{"exposure_s": NaN}',
        b'{"exposure_s": Infinity}',
        b'{"exposure_s": 1' + b"0" * 400 + b"}",
        b'{"camera": 5}',
        b'{"camera": " "}',
        b'{"terrain": ["a"]}',
    ],
)
def test_a_sidecar_that_cannot_be_used_is_refused(image, sidecar, raw):
    sidecar(raw)
    with pytest.raises(BadInput, match=r"sidecar .*frame\.json: ") as caught:
        read_exposure(image)
    assert caught.value.reason == "bad_image"
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    "time", ["2031-03-26T20:58:11-05:00", "2031-03-26", "noon", "9" * 5000, 20310326, "2031-02-30T00:00:00"]
)
def test_a_sidecar_time_that_is_not_utc_is_no_time(image, sidecar, time):
    sidecar({"time_utc": time})
    with pytest.raises(BadInput) as caught:
        read_exposure(image)
    assert caught.value.reason == "no_time"
    assert len(str(caught.value)) < 500


def test_unknown_keys_of_a_sidecar_pass_with_a_warning(image, sidecar):
    sidecar({"exposure": 5, "Camera": "a.toml", "terrain": "b"})
    exposure = read_exposure(image)
    assert (exposure.exposure_s, exposure.terrain) == (20.0, "b")
    known = "time_utc, time_sigma_s, exposure_s, camera, terrain, air, mask, obstacles, dark, flat, bayer_pattern"
    assert exposure.warnings == tuple(
        f"sidecar frame.json: key {key!r} is none of {known}; not used" for key in ("exposure", "Camera")
    )
    sidecar({f"key {k}": k for k in range(1000)})
    assert len(read_exposure(image).warnings) < 10


def test_the_air_of_a_sidecar_is_checked(image, sidecar):
    sidecar({"air": {"pressure_hpa": 780, "temperature_c": -4.5}})
    assert read_exposure(image).air == {"pressure_hpa": 780.0, "temperature_c": -4.5}
    sidecar({"air": {"pressure_hpa": -1}})
    with pytest.raises(BadInput, match=r"air\.pressure_hpa") as caught:
        read_exposure(image)
    assert caught.value.reason == "bad_image"


def test_null_means_not_given_and_a_byte_order_mark_is_skipped(image, sidecar):
    sidecar(b'\xef\xbb\xbf{"exposure_s": null, "camera": null, "terrain": "x"}')
    exposure = read_exposure(image)
    assert (exposure.exposure_s, exposure.terrain) == (20.0, "x")
    assert exposure.camera == str(image.parent / "header.toml")


@pytest.mark.parametrize("sidecar_name", ["frame.json", "frame.fits.json", "frame.fits.bz2.json"])
def test_sidecars_of_a_packed_file(tmp_path, sidecar_name):
    import bz2

    fits.PrimaryHDU(FRAME).writeto(tmp_path / "frame.fits")
    (tmp_path / "frame.fits.bz2").write_bytes(bz2.compress((tmp_path / "frame.fits").read_bytes()))
    (tmp_path / sidecar_name).write_text('{"exposure_s": 60}')
    assert read_exposure(tmp_path / "frame.fits.bz2").exposure_s == 60.0


def test_the_sidecar_that_names_the_suffix_goes_first(image, sidecar):
    sidecar({"exposure_s": 1})
    sidecar({"exposure_s": 2}, "frame.png.json")
    assert read_exposure(image).exposure_s == 2.0


def test_a_name_as_long_as_the_system_allows(tmp_path):
    path = tmp_path / ("x" * 251 + ".png")
    Image.fromarray(FRAME).save(path)
    assert read_exposure(path).name == "x" * 251


@pytest.mark.parametrize(
    "description",
    [
        "DATE-AVG = 2031-03-26T20:58:11.966208\nEXPTIME= 10\nSTCAMERA = 'camera.toml'\nnotes = none",
        '{"time_utc": "2031-03-26T20:58:11.966208Z", "exposure_s": 10, "camera": "camera.toml"}',
        '{"DATE-OBS": "2031-03-26T20:58:06.966208", "EXPTIME": 10, "STCAMERA": "camera.toml"}',
    ],
)
def test_tiff_description(tmp_path, description):
    path = tmp_path / "frame.tif"
    tifffile.imwrite(path, FRAME, description=description, metadata=None, datetime=True)
    exposure = read_exposure(path)
    assert exposure.time_utc == MID
    assert exposure.exposure_s == 10.0
    assert exposure.camera == str(tmp_path / "camera.toml")


def test_the_zoneless_time_of_a_tiff_is_not_used(tmp_path):
    path = tmp_path / "frame.tif"
    tifffile.imwrite(path, FRAME, datetime=datetime(2020, 1, 1))
    assert read_exposure(path).time_utc is None


@pytest.mark.parametrize(
    "place",
    ["/etc/passwd#a.yaml", "{here}/camera.toml", "../camera.toml", "sub/../../camera.toml",
     "\\\\server\\x\\camera.toml",
     "//server/x/camera.toml", "C:camera.toml", "c:/camera.toml", "..\\camera.toml", "C:name"],
)  # fmt: skip
@pytest.mark.parametrize("key", ["STCAMERA", "STTERRAI"])
def test_a_header_names_no_file_elsewhere(tmp_path, key, place):
    """Not even one that is there: whether it is would be told to the picture's author."""
    folder = tmp_path / "images"
    folder.mkdir()
    for one in (tmp_path, folder):
        (one / "camera.toml").write_text("")
    text = PngImagePlugin.PngInfo()
    text.add_text(key, place.format(here=folder))
    Image.fromarray(FRAME).save(folder / "frame.png", pnginfo=text)
    exposure = read_exposure(folder / "frame.png")
    assert (exposure.camera, exposure.terrain) == (None, None)
    (warning,) = exposure.warnings
    assert warning.startswith(f"{key} '") and warning.endswith("a flag or a sidecar; not used")


def test_a_sidecar_names_files_anywhere(image, sidecar):
    sidecar({"camera": "../camera.toml", "terrain": "/maps/t.toml"})
    exposure = read_exposure(image)
    assert exposure.camera == str(image.parent / "../camera.toml")
    assert exposure.terrain == "/maps/t.toml"


def test_a_header_names_files_beside_and_below_the_image(tmp_path):
    for name in ("camera.toml", "./a b.toml", "calib/c.toml", "..x.toml"):
        text = PngImagePlugin.PngInfo()
        text.add_text("STCAMERA", name)
        Image.fromarray(FRAME).save(tmp_path / "frame.png", pnginfo=text)
        exposure = read_exposure(tmp_path / "frame.png")
        assert (exposure.camera, exposure.warnings) == (str(tmp_path / name).replace("/a b", "/./a b"), ())
