"""The library's functions: paths, arrays and astropy's types as input, solutions with a printed form as output."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import tifffile
from astropy import units as u
from astropy.time import Time
from astropy.utils.masked import Masked
from jsonschema import Draft202012Validator
from stage_helpers import as_stage

import startrack
from startrack.chain import exposure_input, time_input
from startrack.chain.stages import Oriented, Refused, Settings, last_value
from startrack.core.errors import BadInput
from startrack.exposure import read_exposure
from startrack.localization import Hull
from startrack.output import SCHEMAS

IMAGE = "sample_images/near-wall.png"
LOWELL = "sample_images/lowell-2018-08-06.fits.bz2"
TRUTH_M = np.array([-6900.0, 4700.0])


@pytest.fixture(scope="module")
def solution():
    return startrack.locate(IMAGE)


def test_a_path_is_enough(solution):
    assert solution
    assert np.linalg.norm(solution.position_m[:2] - TRUTH_M) < 3 * solution.radius95_m
    assert solution.covariance_m2.shape == (2, 2)


def test_an_array_with_camera_terrain_and_astropy_time_gives_the_same(solution):
    exposure = read_exposure(IMAGE)
    pixels = exposure.pixels_adu.astype(np.uint16)
    again = startrack.locate(
        pixels, camera=exposure.camera, terrain=exposure.terrain, time=solution.time.tai,
        time_sigma=exposure.time_sigma_s, exposure=exposure.exposure_s * u.s,
    )  # fmt: skip
    np.testing.assert_allclose(again.position_m, solution.position_m, atol=1e-6)


def test_the_duration_of_an_exposure_may_be_seconds_or_a_quantity():
    pixels = np.zeros((64, 64), np.uint16)
    for given in (pixels, IMAGE, read_exposure(IMAGE)):
        assert exposure_input(given, None, duration=90.0).exposure_s == 90.0
        assert exposure_input(given, None, duration=1.5 * u.min).exposure_s == 90.0
    assert exposure_input(pixels, None).exposure_s is None
    assert exposure_input(IMAGE, None).exposure_s == read_exposure(IMAGE).exposure_s


@pytest.mark.parametrize("given", [0.0, -1.0, np.nan, np.inf, 1e9, "long", [1.0, 2.0], 3 * u.m, [1.0, 2.0] * u.s])
def test_an_exposure_that_is_no_duration_is_refused(given):
    with pytest.raises(ValueError, match=r"^exposure=.*(give seconds or an astropy duration|is not above 0 s)"):
        startrack.locate(IMAGE, exposure=given)


def test_astropy_types_at_the_edge(solution):
    assert isinstance(solution.time, Time)
    assert abs((solution.time - Time("2029-09-08T03:12:45")).sec) < 1e-6
    axis = solution.result.attitude.R_cam_icrs[2]
    np.testing.assert_allclose(solution.boresight.cartesian.xyz.value, axis, atol=1e-12)
    assert solution.stars["x_px"].unit == u.pix
    assert len(solution.stars) > 5000
    assert solution.modes["east"].unit == u.m
    assert solution.modes["radius95"].to_value(u.m) == pytest.approx(
        [mode.radius95_m for mode in solution.result.fix.modes]
    )


def test_it_prints_itself(solution, tmp_path):
    assert re.match(r"near-wall.png  ok  E -(6899|6900)\.\d m  N (4699|4700)\.\d m  ±[2-4]\.\d m", repr(solution))
    page = ElementTree.fromstring(f"<body>{solution._repr_html_()}</body>")
    assert [caption.text for caption in page.iter("b")] == ["Position", "Orientation"]
    path = solution.write(tmp_path, plots=False)
    assert path.name == "near-wall.fix.json"
    assert solution.to_dict()["position"]["frame"] == "enu"


def test_the_position_has_units_and_an_uncertainty(solution):
    p, record = solution.position, solution.to_dict()["position"]
    assert (p.east.unit, p.covariance.unit, p.latitude.unit) == (u.m, u.m**2, u.deg)
    np.testing.assert_allclose(u.Quantity([p.east, p.north, p.up]).to_value("m"), solution.position_m)
    assert p.latitude.deg == pytest.approx(record["latitude_deg"])
    assert p.radius95.to_value("m") == solution.radius95_m < p.radius999.to_value("m")
    np.testing.assert_allclose(p.sigma.to_value("m") ** 2, np.diag(solution.covariance_m2))
    along = np.array([np.sin(p.ellipse.azimuth.rad), np.cos(p.ellipse.azimuth.rad)])
    assert along @ solution.covariance_m2 @ along == pytest.approx(p.ellipse.semi_major.value**2)
    assert p.ellipse.semi_minor < p.ellipse.semi_major
    assert re.search(r"^  east +-(6899|6900)\.\d\d m ± [01]\.\d\d m$", repr(p), flags=re.MULTILINE)
    assert "long axis at azimuth" in repr(p)
    assert re.search(r"^  evidence +both$", repr(p), flags=re.MULTILINE)


def test_every_quantity_of_a_section_is_an_attribute(solution):
    record = solution.to_dict()
    for section, value in (("position", solution.position), ("attitude", solution.attitude), ("clock", solution.clock)):
        names = {re.sub("_(m2?|deg|arcsec|s)$", "", key) for key in record[section]}
        assert names <= set(dir(value))
    assert solution.position.protection_level.to_value("m") == record["position"]["protection_level_m"]
    assert solution.attitude.sigma_heading.deg == pytest.approx(record["attitude"]["sigma_heading_deg"])
    with pytest.raises(AttributeError, match="Position has no attribute 'nort'"):
        _ = solution.position.nort


def test_a_method_without_a_posterior_states_no_uncertainty(tmp_path):
    """Near the wall the hull is 4 km off: no number of ours is as large as its errors."""
    solution = startrack.locate(IMAGE, settings=Settings(localizer=Hull()))
    assert solution and np.linalg.norm(solution.position_m[:2] - TRUTH_M) > 2000.0
    p = solution.position
    uncertainty = [*p.covariance.value.ravel(), *p.sigma.value, p.radius95.value, p.radius999.value]
    uncertainty += [solution.radius95_m, p.ellipse.semi_major.value, p.ellipse.semi_minor.value]
    assert np.isinf(uncertainty).all()
    assert "approximate, no circle" in repr(solution) and "±" not in repr(solution)
    assert "95 % within  no circle" in repr(p).replace("    ", "  ") and "±" not in repr(p)
    path = solution.write(tmp_path)  # with the picture
    written = json.loads(path.read_text())
    assert written["position"]["radius95_m"] is None
    Draft202012Validator(SCHEMAS["fix"]).validate(written)


def test_the_attitude_is_a_rotation_and_angles(solution):
    a, record = solution.attitude, solution.to_dict()["attitude"]
    np.testing.assert_allclose(a.rotation.as_matrix(), solution.result.attitude.R_cam_icrs, atol=1e-12)
    np.testing.assert_allclose(a.rotation.inv().apply([0, 0, 1]), solution.boresight.cartesian.xyz.value, atol=1e-12)
    names = ("ra", "dec", "roll", "heading", "pitch", "roll_body")
    assert [getattr(a, name).deg for name in names] == pytest.approx([record[f"{name}_deg"] for name in names])
    assert a.sigma.to_value("arcsec") == pytest.approx(record["sigma_arcsec"])
    np.testing.assert_allclose(a.body.as_quat(canonical=True), record["quat_xyzw_body_enu"], atol=1e-12)
    assert solution.heading == a.heading
    assert a.lens_error_included is record["lens_error_included"] is ("lens taken as exact" not in repr(a))
    assert "heading           205." in repr(a)


def test_stars_alone_give_no_heading():
    found = startrack.identify(IMAGE)
    assert found.attitude is not None and found.attitude.ra.deg == pytest.approx(87.70, abs=0.01)
    assert found.heading is None and found.position is None
    assert "heading" not in repr(found.attitude)


def test_writing_replaces_what_an_earlier_result_left(solution, tmp_path):
    stale = [
        tmp_path / f"near-wall.{end}"
        for end in ("annotated.png", "skyline.png", "wcs", "corr", "stars.ecsv", "skyline.ecsv")
    ]
    for path in stale:
        path.write_text("of an earlier run")
    (tmp_path / "near-wall-2.wcs").write_text("of another image")
    solution.write(tmp_path, plots=False)
    assert not stale[0].exists() and not stale[1].exists()
    assert all(path.read_bytes() != b"of an earlier run" for path in stale[2:])
    assert (tmp_path / "near-wall-2.wcs").read_text() == "of another image"
    solution.write(tmp_path, plots=False)  # of the same image: replaced
    refused = startrack.locate(read_exposure(IMAGE), time="2030-01-01T00:00:00Z")
    result = Refused(reason="no_stars", message="", reached=as_stage(last_value(refused.result), Oriented))
    refused = replace(refused, result=result)
    refused.write(tmp_path, plots=False)
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["near-wall-2.wcs", "near-wall.fix.json"]


def test_a_result_of_another_image_is_kept_without_overwrite(tmp_path):
    first, second = (startrack.detect(np.full((64, 64), level, np.uint16)) for level in (300, 301))
    path = first.write(tmp_path)
    kept = path.read_bytes()
    with pytest.raises(BadInput, match="overwrite=True"):
        second.write(tmp_path)
    assert path.read_bytes() == kept
    first.write(tmp_path)
    second.write(tmp_path, overwrite=True)
    assert path.read_bytes() != kept


def test_each_call_writes_the_record_of_its_kind(tmp_path):
    flat = startrack.identify(np.full((2048, 2048), 300, np.uint16), camera="fisheye-2048")
    assert flat.reason == "no_stars"
    assert flat.to_dict()["format"] == "startrack.identification/1"
    assert flat.write(tmp_path, plots=False).name == "array.identification.json"
    path = startrack.identify(IMAGE).write(tmp_path)
    assert sorted(p.name for p in path.parent.glob("near-wall*")) == [
        f"near-wall{end}" for end in (".annotated.png", ".corr", ".identification.json", ".stars.ecsv", ".wcs")
    ]


def test_identify_and_detect_leave_the_files_of_locate_alone(solution, tmp_path):
    solution.write(tmp_path)
    files = sorted(tmp_path.iterdir())
    before = [path.read_bytes() for path in files]
    startrack.detect(IMAGE).write(tmp_path)
    startrack.identify(IMAGE).write(tmp_path)
    startrack.identify(IMAGE).write(tmp_path)
    assert [path.read_bytes() for path in files] == before
    own = {path.name.removeprefix("near-wall.") for path in set(tmp_path.iterdir()) - set(files)}
    kinds = ("json", "annotated.png", "stars.ecsv", "wcs", "corr")
    assert own == {"detections.json", "detections.annotated.png", *(f"identification.{kind}" for kind in kinds)}


def test_a_picture_without_stars_has_a_reason():
    flat = startrack.locate(
        np.full((2048, 2048), 300, np.uint16), camera="fisheye-2048", terrain="shackleton-thesis",
        time="2030-01-01T00:00:00Z",
    )  # fmt: skip
    assert not flat
    assert flat.reason == "no_stars"
    assert flat.position_m is None


def test_missing_inputs_are_named():
    pixels = np.zeros((64, 64), np.uint16)
    with pytest.raises(BadInput, match="give time=,") as timeless:
        startrack.locate(pixels, camera="fisheye-2048", terrain="shackleton-thesis")
    assert timeless.value.reason == "no_time" and "--" not in str(timeless.value)
    with pytest.raises(BadInput, match="camera="):
        startrack.locate(pixels)
    with pytest.raises(BadInput, match="terrain="):
        startrack.locate(pixels, camera="fisheye-2048")


def test_importing_startrack_loads_nothing_heavy():
    code = "import startrack, sys; print('numpy' in sys.modules, startrack.__version__)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.startswith("False")


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"image": np.zeros((64, 64, 4), np.uint8)}, "bad_image"),
        ({"image": np.zeros((64, 64), complex)}, "bad_image"),
        ({"image": np.full((64, 64), np.nan)}, "bad_image"),
        ({"image": 7}, "bad_image"),
        ({"image": [["a"]]}, "bad_image"),
        ({"image": IMAGE, "time": 2461000.5}, "no_time"),
        ({"image": IMAGE, "time": np.datetime64("NaT")}, "no_time"),
        ({"image": IMAGE, "time": np.datetime64("2030-01-01")}, "no_time"),
        ({"image": IMAGE, "time": Time(["2030-01-01", "2030-01-02"])}, "no_time"),
        ({"image": IMAGE, "time": Time("2030-01-01", scale="local")}, "no_time"),
        ({"image": IMAGE, "time": datetime(2030, 1, 1)}, "no_time"),
        ({"image": np.zeros((64, 64), np.uint16), "camera": "fisheye-2048", "terrain": "kepler"}, "no_time"),
        ({"image": IMAGE, "camera": "lowell-ldt"}, "size_mismatch"),
        ({"image": IMAGE, "camera": 5}, "bad_calibration"),
        ({"image": IMAGE, "terrain": 5}, "bad_terrain"),
    ],
)
def test_invalid_inputs_are_refused_with_a_reason(given, reason):
    with pytest.raises(BadInput) as caught:
        startrack.locate(**given)
    assert caught.value.reason == reason


def test_the_same_rule_holds_for_stars_alone():
    with pytest.raises(BadInput) as caught:
        startrack.identify(np.full((64, 64), 300, np.uint16), camera="fisheye-2048")
    assert caught.value.reason == "size_mismatch"


WRONG_LISTS = {
    "columns": ({"image": np.ones((200, 3)), "camera": "fisheye-2048"}, r"shape \(200, 3\): .* flux=table\[:, 2\]"),
    "generator": ({"image": ((x, x) for x in range(9)), "camera": "fisheye-2048"}, "this is generator"),
    "pairs": ({"image": zip([1, 2], [3, 4], strict=True), "camera": "fisheye-2048"}, "this is zip"),
    "two sizes": ({"image": np.ones((9, 2)), "camera": "fisheye-2048", "size_px": (10, 10)}, "camera has its own"),
    "flux of a file": (
        {"image": IMAGE, "flux": [1.0], "size_px": (9, 9)},
        "^size_px= and flux=: for lists of centroids",
    ),
    "error of a path": ({"image": Path(IMAGE), "sigma_px": 0.2}, "^sigma_px=: for lists of centroids only"),
}


@pytest.mark.parametrize("case", WRONG_LISTS)
def test_the_message_about_centroids_says_what_to_give(case):
    given, message = WRONG_LISTS[case]
    with pytest.raises(ValueError, match=message):
        startrack.identify(**given)


def test_what_is_no_image_is_named_by_its_type():
    with pytest.raises(BadInput, match=r"^generator is neither a file nor an array"):
        startrack.detect(x for x in range(9))


def test_settings_are_settings():
    with pytest.raises(TypeError, match=r"settings= is of type dict: give startrack\.chain\.Settings"):
        startrack.locate(IMAGE, settings={"a": 1})


def test_a_solution_is_equal_to_itself_and_goes_into_sets(solution):
    other = startrack.detect(np.full((64, 64), 300, np.uint16))
    assert solution == solution and solution != other
    assert len({solution, other}) == 2
    assert solution.result != other.result
    for name in ("position", "attitude", "boresight", "time", "stars", "modes"):
        assert getattr(solution, name) is getattr(solution, name)


def test_colours_lists_and_paths_are_pictures():
    pixels = np.full((64, 64, 3), 300, np.uint16)
    assert "mean of its three channels" in exposure_input(pixels, None).warnings[0]
    assert exposure_input(pixels[..., 0].tolist(), None).size_px == (64, 64)
    assert exposure_input(Path(IMAGE), None).name == "near-wall"


def test_a_mask_is_never_lost():
    pixels = np.ma.array(np.arange(64, dtype=np.uint16).reshape(8, 8))
    assert exposure_input(pixels, None).size_px == (8, 8)
    pixels[3, 4:6] = np.ma.masked
    for image in (pixels, Masked(pixels.data, mask=pixels.mask)):
        assert np.array_equal(exposure_input(image, None).mask.masked, pixels.mask)


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_numpy_times_are_utc(unit):
    time = np.datetime64("2029-09-08T03:12:45", unit)
    assert time_input(time) == datetime(2029, 9, 8, 3, 12, 45, tzinfo=UTC)


def test_astropy_times_keep_their_microseconds():
    time = Time("2029-09-08T03:12:45.123456")
    assert time_input(time) == time_input(time.tdb) == datetime(2029, 9, 8, 3, 12, 45, 123456, tzinfo=UTC)
    assert time.precision == 3  # the caller's object is unchanged


def test_fractions_are_no_counts(tmp_path):
    """Scaled to 0 .. 1 the sample can be identified blindly, but not with a camera file that states levels in ADU."""
    exposure = read_exposure(IMAGE)
    pixels = exposure.pixels_adu / np.float32(65535)
    assert "from 0 to 1 are no sensor's counts" in exposure_input(pixels, None).warnings[0]
    with pytest.raises(BadInput, match="fractions from 0 to 1"):
        startrack.locate(pixels, camera=exposure.camera, terrain=exposure.terrain, time=exposure.time_utc)
    assert startrack.identify(pixels, fov=185)
    assert exposure_input(exposure.pixels_adu, None).warnings == ()
    tifffile.imwrite(tmp_path / "a.tif", pixels)
    scaled = read_exposure(tmp_path / "a.tif")
    assert scaled.saturation_adu is None
    assert "from 0 to 1 are no sensor's counts" in scaled.warnings[0]
    with pytest.raises(BadInput, match="fractions from 0 to 1"):
        startrack.detect(scaled, camera="fisheye-2048")


def test_a_field_of_view_replaces_a_camera():
    found = startrack.identify(LOWELL, fov=180 * u.deg)
    assert found
    assert found.result.camera is not None
    assert len(found.result.identification.star) > 1000
    with pytest.raises(ValueError, match="exclude each other"):
        startrack.identify(LOWELL, fov=180, camera="lowell-ldt")
    with pytest.raises(BadInput, match="no field of view: fov='wide'"):
        startrack.identify(IMAGE, fov="wide")
    with pytest.raises(BadInput, match="fov= is -3 degrees"):
        startrack.identify(IMAGE, fov=-3)
    with pytest.raises(BadInput, match=r"give fov=, or an approximate camera="):
        startrack.calibrate([IMAGE])
    with pytest.raises(ValueError, match="heading='north'"):
        startrack.render(heading="north")
