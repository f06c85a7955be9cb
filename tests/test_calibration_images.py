"""`startrack calibrate` on pictures: a real all-sky photograph without a camera file, and rendered frames."""

from __future__ import annotations

import csv
import json
import re
import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.io import fits
from horizon_helpers import CAMERA, TIME, painted_frame
from horizon_helpers import SITE as HIGH_SITE
from html_helpers import DESKTOP, SMALL, Window
from jsonschema import ValidationError
from matplotlib.figure import Figure
from schema_helpers import check_printed_schema
from scipy.spatial import cKDTree

from startrack.applications.calibration import calibrate
from startrack.applications.calibration.acceptance import joint_log_p_value
from startrack.applications.calibration.report import _draw_vectors, _report_html, write_report
from startrack.applications.calibration.static_parts import find_obstructions
from startrack.applications.calibration.verify import Verification, verify, verify_dict, verify_line
from startrack.camera import load_camera, save_camera
from startrack.catalog import load_catalog
from startrack.cli.inputs.camera_files import write_camera
from startrack.cli.main import main
from startrack.core.types import BadInput, Exposure, NotIdentified
from startrack.exposure import read_exposure, read_mask, write_exposure
from startrack.frames import Site

ROOT = Path(__file__).parent.parent
PHOTO = ROOT / "sample_images/lowell-2018-08-06.fits.bz2"
SITE = Site("earth", np.radians(34.7443), np.radians(-111.4223), 2361.0)
SITE_FLAG = ("-c", "lowell-ldt", "--site=34.7443,-111.4223,2361")
REFERENCE = Path(__file__).parent / "data/lowell-2018-08-06-stars.csv"


@pytest.fixture(scope="module")
def exposure():
    return read_exposure(PHOTO)


@pytest.fixture(scope="module")
def cold_calibration(exposure):
    """Calibration from the field of view of about 180 degrees alone."""
    return calibrate([exposure], load_catalog().brighter_than(8.0), fov_rad=np.pi, site=SITE, name="cold")


def test_the_photograph_calibrates_from_cold(cold_calibration):
    assert cold_calibration.accepted, [check.name for check in cold_calibration.failed_checks]
    fit = cold_calibration.joint.fit
    assert fit.used.sum() >= 1000
    assert fit.held_out_rms_px <= 0.35  # distance, not per axis
    assert np.degrees(cold_calibration.camera.calibrated_angle_rad) == pytest.approx(83, abs=2)
    assert cold_calibration.camera.decentring  # by 0.3 px: without it the held-out RMS is 0.34 px
    assert not cold_calibration.camera.mirrored


def test_its_stars_are_those_that_were_named_without_startrack(cold_calibration):
    with REFERENCE.open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    px = np.array([[float(row["x_px"]), float(row["y_px"])] for row in rows])
    frame, matched = cold_calibration.joint.frames[0], cold_calibration.joint.matches[0]
    distance, nearest = cKDTree(px).query(frame.sources.xy_px[matched.detection])
    both = distance < 1.5
    assert both.sum() >= 380
    names = np.array([int(row["hip"]) for row in rows])
    assert np.mean(frame.sky.stars.hip[matched.star][both] == names[nearest[both]]) >= 0.995


@pytest.mark.slow
@pytest.mark.parametrize(
    ("signs", "hours"), [((1, 1), 0), ((1, -1), 0), ((-1, 1), 0), ((1, 1), 3)], ids=["right", "lon", "lat", "time"]
)
def test_a_wrong_site_or_time_shows_stars_below_the_horizon(exposure, signs, hours):
    site = Site("earth", signs[0] * SITE.latitude_rad, signs[1] * SITE.longitude_rad, SITE.height_m)
    picture = replace(exposure, time_utc=exposure.time_utc + timedelta(hours=hours))
    found = calibrate([picture], load_catalog().brighter_than(8.0), camera=load_camera("lowell-ldt"), site=site)
    (check,) = (one for one in found.checks if "below the horizon" in one.name)
    assert check.passed == found.accepted == (signs == (1, 1) and hours == 0)
    assert check.reason == "inconsistent_evidence" and "--site (signs) and the time (is it UTC?)" in check.advice
    if check.passed:
        assert check.value == 0
    else:
        assert check.value > 0.02 and found.failed_checks[0] is check


def test_without_a_site_there_is_no_horizon(exposure):
    found = calibrate([exposure], load_catalog().brighter_than(7.0), camera=load_camera("lowell-ldt"))
    assert not any("below the horizon" in check.name for check in found.checks)


def test_chance_gives_no_such_number_of_matches(cold_calibration):
    assert joint_log_p_value(cold_calibration.joint) < np.log(1e-100)


@pytest.mark.slow
def test_the_mirror_image_is_solved_and_reported_as_mirrored(exposure):
    flipped = replace(exposure, pixels_adu=exposure.pixels_adu[:, ::-1].copy())
    found = calibrate([flipped], load_catalog().brighter_than(7.0), camera=load_camera("lowell-ldt"), site=SITE)
    assert found.accepted
    assert found.camera.mirrored
    opposite = next(gate.value for gate in found.checks if gate.name.startswith("opposite"))
    assert opposite > 50


def test_a_mast_in_the_photograph_is_proposed_for_the_mask(exposure, tmp_path, capsys):
    pixels = np.array(exposure.pixels_adu)
    across = np.abs(np.arange(1392) - 760) < 70
    pixels[560:, across] = np.rint(np.random.default_rng(1).normal(2300.0, 15.0, (480, across.sum())))
    write_exposure(tmp_path / "frame.fits", replace(exposure, pixels_adu=pixels))
    camera = tmp_path / "camera.toml"
    assert main(["calibrate", str(tmp_path / "frame.fits"), "-o", str(camera), "--no-plots", *SITE_FLAG]) == 0
    assert 'mask = "camera.mask.png"' in capsys.readouterr().out
    assert load_camera(camera).mask is None  # it is proposed, not applied
    masked = read_mask(tmp_path / "camera.mask.png").masked
    assert np.mean(masked[560:750, across]) > 0.9
    clear = np.zeros(1392, dtype=bool)
    clear[340:1130] = ~across[340:1130]  # a dome and a tree stand beside
    assert not masked[:700, clear].any()  # trees stand lower in the image


@pytest.mark.slow
def test_a_picture_whose_stars_and_sources_differ_is_left_out_and_named(exposure):
    """Two thirds of the sky behind cloud, with 220 lamps there."""
    rng, pixels = np.random.default_rng(4), exposure.pixels_adu.copy()
    y, x = np.indices(pixels.shape) - np.array(pixels.shape)[:, None, None] / 2
    hidden = np.abs(np.arctan2(y, x)) < np.radians(120)
    level = float(np.median(pixels[hidden]))
    pixels[hidden] = level * (1 + 0.02 * rng.standard_normal(hidden.sum()))
    lamps, places = np.zeros_like(pixels), np.argwhere(hidden & (np.hypot(x, y) < 0.4 * min(pixels.shape)))
    lamps[tuple(places[rng.integers(0, len(places), 220)].T)] = 120_000 * rng.uniform(0.3, 1.0, 220)
    spoiled = replace(exposure, name="spoiled.fits", pixels_adu=pixels + cv2.GaussianBlur(lamps, (0, 0), 1.0))
    found = calibrate(
        [exposure, spoiled], load_catalog().brighter_than(8.0), camera=load_camera("lowell-ldt"), site=SITE
    )
    assert found.accepted and len(found.joint.frames) == 1
    (refused,) = found.refused
    assert (refused.name, refused.reason) == ("spoiled.fits", "inconsistent_evidence")
    assert "60 % is the least" in refused.message


def test_a_picture_of_another_size_is_a_size_mismatch(exposure):
    smaller = replace(exposure, pixels_adu=exposure.pixels_adu[:-2].copy())
    with pytest.raises(BadInput) as refusal:
        calibrate([exposure, smaller], load_catalog(), fov_rad=np.pi)
    assert refusal.value.reason == "size_mismatch"


def test_without_a_time_nothing_is_guessed(exposure):
    with pytest.raises(BadInput) as refusal:
        calibrate([replace(exposure, time_utc=None)], load_catalog(), fov_rad=np.pi)
    assert refusal.value.reason == "no_time"


def test_noise_is_refused_with_advice(exposure):
    rng = np.random.default_rng(0)
    noise = replace(exposure, pixels_adu=rng.normal(1000, 20, (300, 400)).astype(np.float32))
    with pytest.raises(NotIdentified, match="point source") as refusal:
        calibrate([noise], load_catalog(), camera=replace(load_camera("lowell-ldt"), size_px=(400, 300)))
    assert refusal.value.reason == "no_stars"


@pytest.mark.parametrize("command", ["calibrate", "calibrate board --pattern 9x6"])
@pytest.mark.parametrize("suffix", [".toml", ".calibration.json", ".report.html", ".report.png", ".mask.png",
                                    ".hot-pixels.csv"])  # fmt: skip
def test_an_existing_file_is_refused_before_the_images_are_read(command, suffix, tmp_path, capsys):
    former = (tmp_path / "mine.toml").with_suffix(suffix)
    former.write_text("before")
    words = [*command.split(), str(tmp_path / "none.png"), "-o", str(tmp_path / "mine.toml")]
    assert main(words) == 2
    message = capsys.readouterr().err
    assert f"{former}: exists already: replace it with -O, or write elsewhere" in message
    assert "overwrite=True" not in message
    assert main([*words, "-O"]) == 4  # the image is read
    assert "none.png" in capsys.readouterr().err
    assert former.read_text() == "before"


def test_the_record_of_a_refused_calibration_is_replaced(tmp_path):
    """A picture without stars has left a record; the next attempt under the same name needs no flag."""
    picture = Exposure(pixels_adu=np.full((60, 80), 100.0, np.float32), time_utc=datetime(2026, 1, 1, tzinfo=UTC))
    write_exposure(tmp_path / "flat.png", picture)
    for _ in range(2):
        assert main(["calibrate", str(tmp_path / "flat.png"), "--fov", "180", "-o", str(tmp_path / "a.toml")]) == 3
        refused = json.loads((tmp_path / "a.calibration.json").read_text())
        assert refused["status"] == "refused"
        check_printed_schema("calibration", refused)


def test_mask_and_hot_pixels_of_the_former_calibration_are_removed(cold_calibration, tmp_path):
    """Except a mask that the new calibration used."""
    found = replace(cold_calibration, obstructed=None, no_mask_because="")
    mask, hot = tmp_path / "new.mask.png", tmp_path / "new.hot-pixels.csv"
    for used_masks, is_kept in (([str(mask)], True), ([None], False)):
        mask.write_text("former")
        hot.write_text("former")
        assert write_camera(tmp_path / "new.toml", found, used_masks) == ""
        assert (mask.exists(), hot.exists()) == (is_kept, False)
    found = replace(cold_calibration, obstructed=np.eye(1040, 1392, dtype=bool))
    assert 'mask = "new.mask.png"' in write_camera(tmp_path / "new.toml", found, [])
    assert read_mask(mask).masked.sum() == 1040


@pytest.fixture(scope="module")
def written_files(tmp_path_factory):
    """Output of the command for the photograph, from a camera file that is 2 % and 6 px off."""
    folder = tmp_path_factory.mktemp("calibration")
    camera = load_camera("lowell-ldt")
    rough = replace(camera, focal_px=(343.0, 343.0), centre_px=(camera.centre_px[0] + 6, camera.centre_px[1] - 5))
    save_camera(rough, folder / "rough.toml")
    words = [
        str(PHOTO),
        "-c",
        str(folder / "rough.toml"),
        "--site=34.7443,-111.4223,2361",
        "-o",
        str(folder / "new.toml"),
    ]
    assert main(["calibrate", *words, "--gain", "0.4", "-q"]) == 0
    return folder


def test_the_command_writes_camera_record_and_report(written_files):
    camera = load_camera(written_files / "new.toml")
    assert camera.covariance_order[:4] == ("fx", "fy", "cx", "cy")
    rays = camera.unproject(np.array([[709.0, 489.0], [1100.0, 489.0], [709.0, 60.0]]))
    assert 0 < camera.projection_sigma_px(rays).max() < 0.05
    record = json.loads((written_files / "new.calibration.json").read_text())
    assert (record["status"], record["reason"]) == ("ok", None)
    assert record["lens"]["held_out_rms_px"] < 0.35
    assert all(gate["passed"] for gate in record["gates"])
    page = (written_files / "new.report.html").read_text()
    assert "accepted" in page
    assert not re.search(r'(src|href)="(?!data:|#main)', page)  # nothing is fetched
    assert (written_files / "new.report.png").read_bytes().startswith(b"\x89PNG")


def test_the_residuals_stand_on_the_photograph(cold_calibration):
    axes = Figure().subplots()
    _draw_vectors(axes, cold_calibration)
    (photograph,), (arrows,) = axes.images, axes.collections
    exposure = cold_calibration.joint.frames[0].exposure
    np.testing.assert_array_equal(photograph.get_array(), exposure.pixels_adu)
    width, height = exposure.size_px
    assert photograph.get_extent() == [-0.5, width - 0.5, height - 0.5, -0.5] == [*axes.get_xlim(), *axes.get_ylim()]
    assert photograph.get_zorder() < arrows.get_zorder()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [DESKTOP, SMALL])
def test_axe_finds_nothing_in_the_report(chromium, axe, cold_calibration, tmp_path, size, scheme):
    write_report(tmp_path / "a.toml", cold_calibration)
    w = Window(chromium, tmp_path / "a.report.html", size, scheme)
    assert w.violations(axe) == []
    assert w.has_no_overflow()
    words = w.page.locator("main").inner_text()
    assert "below 1e-300" in words and "log10" not in words and "Dark theme" not in words
    w.close()


def test_the_report_says_what_to_do_where_a_check_failed(cold_calibration):
    check = replace(cold_calibration.checks[0], passed=False, advice="take <more> pictures")
    failed = replace(cold_calibration, checks=(check, *cold_calibration.checks[1:]))
    for found, is_told in ((failed, True), (cold_calibration, False)):
        text = _report_html(found, b"")
        assert ("take &lt;more&gt; pictures" in text) == ("what to do" in text) == is_told
        assert len(re.findall("<td", text.partition("<tbody>")[2].partition("</tr>")[0])) == (4 if is_told else 3)


def test_the_report_without_matplotlib_names_the_extra(cold_calibration, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # importing it fails, and it is not found
    note = write_report(tmp_path / "a.toml", cold_calibration)
    assert note.startswith("a.report.html: no picture: ") and "pip install '.[plots]'" in note
    assert [path.name for path in tmp_path.iterdir()] == ["a.report.html"]
    page = (tmp_path / "a.report.html").read_text()
    assert "accepted" in page and "the extra plots" in page and "<img" not in page


def test_the_sensor_is_measured_where_the_picture_allows(written_files):
    sensor = load_camera(written_files / "new.toml").sensor
    assert sensor is not None
    assert sensor.gain_e_per_adu == 0.4  # given
    assert 2300 < sensor.bias_adu < 2450  # dark corners; the frame's own minimum is 2192
    assert sensor.vignetting[0] < 0
    notes = json.loads((written_files / "new.calibration.json").read_text())["photometry"]["notes"]
    assert any("read noise: not measured" in note for note in notes)


def test_every_key_of_the_record_is_explained(written_files):
    formats = (ROOT / "docs/formats.md").read_text(encoding="utf-8")
    record = json.loads((written_files / "new.calibration.json").read_text())
    keys = (
        (set(record) - {"lens", "coverage"})
        | set(record["gates"][0])
        | set(record["images"][0])
        | set(record["photometry"]["light"])
    )
    keys |= {f"lens.{key}" for key in record["lens"]} | set(record["lens"]["models"][0])
    keys |= {f"coverage.{key}" for key in record["coverage"]} | set(record["photometry"])
    assert [key for key in sorted(keys) if f"`{key}`" not in formats] == []


def test_the_records_fit_their_schema(written_files):
    record = json.loads((written_files / "new.calibration.json").read_text())
    check_printed_schema("calibration", record)
    for key, wrong in (("camera", {}), ("gates", [{"name": "a"}]), ("format", "startrack.fix/1"), ("refused", None)):
        with pytest.raises(ValidationError):
            check_printed_schema("calibration", record | {key: wrong})


def test_verify_and_show(written_files, capsys):
    photo, site = str(PHOTO), "--site=34.7443,-111.4223,2361"
    assert main(["calibrate", "verify", photo, "-c", str(written_files / "new.toml"), site, "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["status"], record["image"]) == ("ok", PHOTO.name)
    check_printed_schema("verification", record)
    with pytest.raises(ValidationError, match="stars"):
        check_printed_schema("verification", {key: record[key] for key in record if key != "stars"})
    assert record["map_change_px"] < 0.05
    assert main(["calibrate", "show", str(written_files / "new.toml")]) == 0
    assert "decentring" in capsys.readouterr().out


def test_a_lens_that_has_changed_does_not_verify(written_files, exposure):
    camera = load_camera(written_files / "new.toml")
    moved = replace(camera, focal_px=(camera.focal_px[0] * 1.004, camera.focal_px[1] * 1.004))
    found = verify(exposure, moved, load_catalog().brighter_than(7.0), SITE)
    assert not found.is_valid
    record = verify_dict(found)
    assert record["reason"] == "inconsistent_evidence"
    assert record["focal_change"] == pytest.approx(-0.004, abs=0.0015)
    assert record["map_change_px"] > 0.4


@pytest.mark.parametrize(
    ("site", "file_has_site", "advice"),
    [(None, True, "give --site LAT,LON[,M] here"), (None, None, "give --site here too"),
     (SITE, False, "verify it without --site"), (SITE, True, "the lens has changed: calibrate again"),
     (SITE, None, "the lens has changed: calibrate again"), (None, False, "the lens has changed: calibrate again")],
)  # fmt: skip
def test_a_refused_file_is_asked_for_the_site_that_it_was_made_with(cold_calibration, site, file_has_site, advice):
    camera = cold_calibration.camera
    found = Verification(
        image="a", camera=camera, fresh=camera, stars=100, rms_px=0.2, change_px=1.0, change_sigma_px=0.05,
        largest_px=2.0, has_site=site is not None, file_has_site=file_has_site,
    )  # fmt: skip
    assert verify_dict(found)["message"].endswith(advice) and advice in verify_line(found)
    approximate = replace(found, camera=replace(camera, covariance=None), has_site=True, file_has_site=None)
    assert "states no error of its own: calibrate again" in approximate.message
    small = replace(found, change_px=0.1)
    assert small.message == ""
    open_question = advice != "the lens has changed: calibrate again"
    assert ("--site" in verify_line(small)) == open_question == bool(verify_dict(small)["warnings"])


@pytest.mark.parametrize(
    ("header", "flag", "warns"),
    [({"OBSLAT": 34.4773, "OBSLONG": -111.4332}, "34.7443,-111.4223", True),
     ({"OBSLAT": 34.74, "OBSLONG": -111.42}, "34.7443,-111.4223", False),
     ({"SITELAT": "34 44 39.5", "SITELONG": "111:25:20"}, "34.7443,-111.4223", False),  # to the west
     ({"SITELAT": "-34 44 39.5", "SITELONG": "111:25:20"}, "34.7443,-111.4223", True),
     ({"LAT-OBS": "somewhere", "LONG-OBS": 3}, "34.7443,-111.4223", False), ({}, "34.7443,-111.4223", False)],
)  # fmt: skip
def test_a_site_of_the_header_that_differs_from_the_flag_is_named(tmp_path, capsys, header, flag, warns):
    unit = fits.PrimaryHDU(np.random.default_rng(1).integers(90, 110, (200, 200)).astype(np.int16))
    unit.header.update({"DATE-AVG": "2018-08-06T05:17:34", **header})
    unit.writeto(tmp_path / "a.fits")
    main(["calibrate", str(tmp_path / "a.fits"), "--fov", "180", f"--site={flag}", "-o", str(tmp_path / "a.toml")])
    err = capsys.readouterr().err
    assert ("degrees from --site" in err) == warns, err
    if warns:
        assert "is used" in err and "a: the header's site" in err


def test_a_lost_sign_of_the_longitude_is_named(tmp_path, capsys):
    unit = fits.PrimaryHDU(np.random.default_rng(1).integers(90, 110, (200, 200)).astype(np.int16))
    unit.header.update({"DATE-AVG": "2018-08-06T05:17:34", "OBSLAT": 34.4773, "OBSLONG": -111.4332})
    unit.writeto(tmp_path / "a.fits")
    time = ["--time", "2018-08-06T19:17:34"]
    main(["calibrate", str(tmp_path / "a.fits"), "--fov", "180", "--site=34.7443,111.4223", *time, "-D", str(tmp_path)])
    err = capsys.readouterr().err
    assert "degrees from --site" in err and "with the other sign of the longitude 0.3; east is positive" in err
    assert "14:00:00 (h:mm:ss) after that of the file" in err


def test_a_picture_by_day_is_named(tmp_path, capsys):
    unit = fits.PrimaryHDU(np.random.default_rng(1).integers(90, 110, (200, 200)).astype(np.int16))
    unit.header["DATE-AVG"] = "2018-08-06T19:17:34"
    unit.writeto(tmp_path / "a.fits")
    main(["calibrate", str(tmp_path / "a.fits"), "--fov", "180", "--site=34.7443,-111.4223", "-D", str(tmp_path)])
    assert re.search(r"the Sun stands 7\d degrees above the horizon of the site, .*UTC", capsys.readouterr().err)


@pytest.mark.slow
def test_verify_finds_what_the_record_states(written_files, exposure, tmp_path, capsys):
    """The lens of the photograph is scaled so that it must be refused; the site in the record decides on the advice."""
    camera = load_camera(written_files / "new.toml")
    moved = replace(camera, focal_px=(camera.focal_px[0] * 1.004, camera.focal_px[1] * 1.004), refraction="")
    save_camera(moved, tmp_path / "a.toml")
    words = ["calibrate", "verify", str(PHOTO), "-c", str(tmp_path / "a.toml")]
    assert main(words) == 3
    assert "if the file was made with --site" in capsys.readouterr().out
    record = (written_files / "new.calibration.json").read_text()
    (tmp_path / "a.calibration.json").write_text(record)
    assert main(words) == 3
    assert "was made with a site" in capsys.readouterr().out
    (tmp_path / "a.calibration.json").unlink()
    save_camera(replace(moved, refraction=camera.refraction), tmp_path / "a.toml")  # the file itself states it
    assert main(words) == 3
    assert "was made with a site" in capsys.readouterr().out
    assert main([*words, "--site=34.7443,111.4223,2361"]) == 3
    assert "stars are below the horizon of this site" in capsys.readouterr().out
    assert main([*words, "--json", "--site=34.7443,111.4223,2361"]) == 3
    check_printed_schema("verification", json.loads(capsys.readouterr().out))
    with pytest.raises(SystemExit):
        main(["calibrate", "verify", "--help"])
    assert "verify needs --site too" in " ".join(capsys.readouterr().out.split())


def test_convert_by_command(written_files, capsys):
    new, back = str(written_files / "new.toml"), str(written_files / "back.toml")
    assert main(["calibrate", "convert", new, "--to", "colmap", "-o", str(written_files / "cameras.txt")]) == 0
    assert main(["calibrate", "convert", str(written_files / "cameras.txt"), "--from", "colmap", "-o", back]) == 0
    one, other = load_camera(new), load_camera(back)
    px = np.array([[300.0, 500.0], [710.0, 100.0], [1100.0, 700.0]])
    np.testing.assert_allclose(other.project(one.unproject(px))[0], px, atol=1e-6)
    assert main(["calibrate", "convert", new, "--to", "ros", "-o", str(written_files / "ros.yaml")]) == 0
    assert "no decentring" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ([], 4),  # neither --fov nor -c, and the image names a camera only in its sidecar
        (["--fov", "180", "--site", "somewhere"], 2),
        (["--fov", "-3"], 2),
    ],
)
def test_wrong_usage_is_refused(words, code, tmp_path, capsys):
    image = tmp_path / "sky.fits.bz2"
    image.write_bytes(PHOTO.read_bytes())
    if code == 2:
        with pytest.raises(SystemExit) as stopped:
            main(["calibrate", str(image), *words, "-D", str(tmp_path)])
        assert stopped.value.code == 2
    else:
        assert main(["calibrate", str(image), *words, "-D", str(tmp_path)]) == code
        assert "--fov" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        "--gain 1e308", "--gain 1e-300", "--gain nan", "--gain 0", "--read-noise 1e308", "--read-noise -1",
        "--bias 1e308", "--bias inf", "--exposure 1e308", "--exposure 0", "--fov 1e308", "--fov nan", "--site 1e308,0",
        "--site nan,nan",
        "--site 91,0", "--site 34", "--site 1,2,3,4", "--site 34,-111,1e308", "--site 34,x", "--name two\nlines",
        f"--name {'x' * 250}", f"-o {'x' * 250}.toml",
    ],
    ids=lambda words: words[:24],
)  # fmt: skip
def test_values_of_flags_beyond_all_limits_are_wrong_usage(words, tmp_path, capsys):
    """In one line that names the flag, before any image is read."""
    flag, value = words.split(" ", 1)
    with pytest.raises(SystemExit) as stopped:
        main(["calibrate", str(tmp_path / "none.png"), f"{flag}={value}" if flag[1] == "-" else flag + value])
    cause = capsys.readouterr().err.splitlines()[0]
    assert stopped.value.code == 2
    assert cause.startswith("startrack calibrate: error: ")
    assert flag.strip("-") in cause or "--output" in cause
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words", ["--pattern 0x0", "--pattern -3x5", "--pattern 100000x100000", "--pattern 9",
              "--pattern 9x6 --marker 1e308", "--pattern 9x6 --marker nan"],
)  # fmt: skip
def test_impossible_boards_are_wrong_usage(words, tmp_path, capsys):
    flags = [f"{flag}={value}" for flag, value in zip(*[iter(words.split())] * 2, strict=True)]
    with pytest.raises(SystemExit) as stopped:
        main(["calibrate", "board", str(tmp_path / "none.png"), *flags])
    assert stopped.value.code == 2
    assert words.split()[-2] in capsys.readouterr().err


def test_dark_spots_of_noise_are_not_proposed_for_the_mask(cold_calibration):
    joint = cold_calibration.joint
    exposure = joint.frames[0].exposure
    noise = np.random.default_rng(0).normal(0.0, 1000.0, exposure.pixels_adu.shape)  # 1.6 times the light of the sky
    noisy = replace(joint.frames[0], exposure=replace(exposure, pixels_adu=exposure.pixels_adu + noise))
    masked, _ = find_obstructions(joint, [noisy], 2370.0)
    assert masked[880:920, 600:760].mean() > 0.1  # a tree
    assert masked[100:750, 340:1130].mean() < 0.001


def test_why_no_mask_is_proposed_is_said(cold_calibration, tmp_path):
    """Of a picture without a known level, or of clouds: of all stars half are missing, or all in half of the sky."""
    joint = cold_calibration.joint
    found, why = find_obstructions(joint, joint.frames, None)
    assert found is None and "--bias" in why
    frame = joint.frames[0]
    for seen in (np.arange(len(frame.sources)) % 2 == 0, frame.sources.xy_px[:, 0] > 700):
        found, why = find_obstructions(joint, [replace(frame, sources=frame.sources.take(seen))], 2000.0)
        assert found is None and "a clear, dark night is needed" in why
    silent = replace(cold_calibration, obstructed=None, no_mask_because=why)
    assert write_camera(tmp_path / "new.toml", silent, []) == f"no mask is proposed: {why}"


def test_pictures_of_a_fixed_camera_with_a_wrong_time_are_left_out_or_refused():
    stars = load_catalog().brighter_than(8.0)
    frames = [painted_frame(k + 1, TIME + timedelta(hours=hours)) for k, hours in enumerate((0.0, 3.0, 5.0))]
    frames[1] = replace(frames[1], time_utc=frames[1].time_utc + timedelta(hours=1))
    found = calibrate(frames, stars, camera=CAMERA, site=HIGH_SITE)
    [out] = found.refused
    assert (out.name, out.reason) == ("frame-2", "inconsistent_evidence") and len(found.joint.frames) == 2
    assert "turned by 15.0 degrees about the celestial pole against most pictures" in out.message
    no_majority = r"no majority of the 2 pictures.*turned by 15.0 degrees about the celestial"
    with pytest.raises(NotIdentified, match=no_majority) as refusal:  # as by `horizon`: exit code 3, with a record
        calibrate(frames[:2], stars, camera=CAMERA, site=HIGH_SITE)
    assert refusal.value.reason == "inconsistent_evidence"
