"""The skyline of a fixed camera: painted frames with a known skyline, a real photograph, refusals."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from horizon_helpers import CAMERA, LOWELL, SITE, TIME, painted_frame, skyline_deg, small_skyline
from jsonschema import Draft202012Validator

import startrack
from startrack.applications import horizon
from startrack.applications.horizon import frames as horizon_frames
from startrack.applications.horizon import measure_skyline, predicted_visible
from startrack.applications.horizon.frames import orient_frames
from startrack.applications.horizon.measure import PLACE_SIGMA_RAD, join_skylines, measure_frames
from startrack.applications.horizon.posterior import limit_llr
from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.cli.inputs.horizon import UNTESTED
from startrack.cli.main import main
from startrack.core.errors import BadInput, NoSolution
from startrack.core.types import MeasuredSkyline
from startrack.estimation.frame_matching import fit_frames
from startrack.exposure import read_exposure
from startrack.frames import Site
from startrack.output import SCHEMAS

ROOT = Path(__file__).parent.parent
PHOTO = ROOT / "sample_images/lowell-2018-08-06.fits.bz2"
LOWELL_FLAG = "--site=34.7443,-111.4223,2361"


@pytest.fixture(scope="module")
def catalog():
    return load_catalog()


@pytest.fixture(scope="module")
def two_frames():
    return [painted_frame(1), painted_frame(2, TIME + timedelta(hours=3))]


@pytest.fixture(scope="module")
def overcast():
    return painted_frame(3, with_stars=False)


@pytest.fixture(scope="module")
def painted(two_frames, catalog):
    return measure_skyline(two_frames[:1], catalog, SITE, camera=CAMERA).skyline


@pytest.fixture(scope="module")
def painted_later(two_frames, catalog):
    return measure_skyline(two_frames[1:], catalog, SITE, camera=CAMERA).skyline


@pytest.fixture(scope="module")
def measured_photo(catalog):
    return measure_skyline([read_exposure(PHOTO)], catalog, LOWELL, camera=load_camera("lowell-ldt"))


@pytest.fixture(scope="module")
def photographed(measured_photo):
    return measured_photo.skyline


def error_deg(skyline):
    """Errors (n,) of the known azimuths, and their indices; the truth is the mean over each bin."""
    within = np.arange(-0.5, 0.5, 0.02) + 0.01
    true = skyline_deg((np.arange(360.0)[:, None] + within) % 360).mean(axis=1)
    known = np.flatnonzero(skyline.known)
    return np.degrees(skyline.elevation_rad[known]) - true[known], known


def test_a_painted_skyline_is_found(painted):
    error, known = error_deg(painted)
    assert len(known) > 300
    assert np.median(np.abs(error)) < 0.05
    smooth = painted.sigma_rad[known] <= np.radians(0.1)
    assert smooth.sum() > 250
    assert np.sqrt(np.mean(np.square(error[smooth]))) < 0.05
    assert abs(error[smooth].mean()) < 0.02


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def check_sigmas(skylines: list[MeasuredSkyline]) -> None:
    """The errors of two painted frames are the same part of their sigmas, to a factor of some 1.5 either way.

    Their ground is evenly lit: on hills they lack the error PLACE_SIGMA_RAD.
    """
    hills, others, teeth = [], [], []
    for skyline in skylines:
        error, known = error_deg(skyline)
        sigma = np.degrees(skyline.sigma_rad[known])
        smooth = ~((known > 95) & (known < 130)) & ~((known > 195) & (known < 265))  # not at the dome and the teeth
        teeth.append((error / sigma)[(known > 202) & (known < 258)])
        hills.append((error / sigma)[smooth])
        others.append(error[smooth] / np.sqrt(np.square(sigma) - np.degrees(PLACE_SIGMA_RAD) ** 2)[smooth])
    assert 0.17 < rms(np.concatenate(hills)) < 0.36  # 0.25
    assert 0.45 < rms(np.concatenate(others)) < 0.95  # 0.64
    assert 0.9 < rms(np.concatenate(teeth)) < 1.9  # 1.3
    assert np.mean(np.abs(np.concatenate(teeth)) < 3) > 0.95


def test_its_sigmas_are_honest(painted, painted_later):
    check_sigmas([painted, painted_later])


@pytest.mark.filterwarnings("ignore:invalid value encountered in sqrt")
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_sigmas_of_another_size_are_not(painted, painted_later, factor):
    with pytest.raises(AssertionError):
        check_sigmas([replace(one, sigma_rad=factor * one.sigma_rad) for one in (painted, painted_later)])


@pytest.mark.slow
def test_nights_are_combined(two_frames, catalog, painted):
    found = measure_skyline(two_frames, catalog, SITE, camera=CAMERA)
    assert [frame.name for frame in found.frames] == ["frame-1", "frame-2"]
    error, _ = error_deg(found.skyline)
    assert np.median(np.abs(error)) < 0.05
    assert found.skyline.known.sum() >= painted.known.sum() - 10


@pytest.mark.slow
def test_an_overcast_night_is_left_out_and_alone_refused(overcast, two_frames, catalog):
    frames, left_out = orient_frames([overcast, two_frames[0]], catalog, SITE, camera=CAMERA, fov_rad=None)
    assert [frame.name for frame in frames] == ["frame-1"]
    assert [one.name for one in left_out] == ["frame-3"]
    with pytest.raises(NoSolution, match="frame-3"):
        measure_frames((), left_out, SITE)


@pytest.mark.slow
def test_without_a_camera_file_the_lens_is_found(two_frames, catalog, painted):
    found = measure_skyline(two_frames[:1], catalog, SITE, fov_rad=np.radians(180)).skyline
    both = found.known & painted.known
    difference = np.degrees(found.elevation_rad - painted.elevation_rad)[both]
    assert both.sum() > 280
    assert np.median(np.abs(difference)) < 0.05


@pytest.mark.slow
def test_the_real_skyline_follows_hills_and_trees(photographed):
    elevation, sigma = np.degrees(photographed.elevation_rad), np.degrees(photographed.sigma_rad)
    assert photographed.known.sum() > 200
    assert (sigma <= 0.1).sum() > 110
    hills = np.interp([30, 40, 50, 60], np.arange(360), np.nan_to_num(elevation))
    np.testing.assert_allclose(hills, [1.4, 0.97, 0.2, -0.43], atol=0.3)  # read off the picture
    tree = elevation[100:107]
    np.testing.assert_allclose(tree[np.isfinite(tree)], 15.6, atol=0.6)
    assert set(photographed.source) <= {"", "stars", "sky light", "both"}


def test_stars_are_predicted_by_two_sigma(photographed):
    visible, sure = predicted_visible(photographed, np.radians([50.0, 50.0, 50.0]), np.radians([10.0, 0.2, -4.0]))
    assert visible[[0, 2]].tolist() == [True, False]
    assert sure.tolist() == [True, False, True]


def test_stars_are_predicted_between_azimuths():
    skyline = small_skyline()
    height = np.degrees(skyline.elevation_rad[100]) + 0.5 * 9 / 359  # the skyline midway to the next azimuth
    visible, _ = predicted_visible(skyline, np.radians([100.5, 100.5]), np.radians([height + 0.005, height - 0.005]))
    assert visible.tolist() == [True, False]


def test_the_sharp_edge_below_a_city_glow_is_found(photographed):
    """Near the border of the view; the glow above it fades gradually."""
    np.testing.assert_allclose(np.degrees(photographed.elevation_rad[198:212]), -0.9, atol=0.15)


def test_one_night_agrees_with_the_published_stars(photographed):
    """All stars that were matched without startrack are above the skyline."""
    lines = (ROOT / "tests/data/lowell-2018-08-06-stars.csv").read_text(encoding="utf-8").splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    azimuth = np.radians([float(row["az_deg"]) for row in rows])
    elevation = np.radians([float(row["alt_deg_refracted"]) for row in rows])
    visible, sure = predicted_visible(photographed, azimuth, elevation)
    assert sure.sum() > 200
    assert visible[sure].mean() > 0.97


def test_missing_stars_are_weaker_evidence_under_clouds():
    llr = np.array([-9.0, 9.0])
    clear, cloudy = limit_llr(llr, np.array(0.01), 0.01), limit_llr(llr, np.array(0.5), 0.01)
    assert clear[0] == pytest.approx(np.log(0.01), abs=0.05)
    assert cloudy[0] == pytest.approx(np.log(0.5), abs=0.05)
    assert clear[1] == pytest.approx(-np.log(0.01), abs=0.1)


def test_the_brightest_star_counts_as_much_as_a_bright_one():
    bright, brightest = limit_llr(np.array([100.0, 1e5]), np.array(0.01), 0.01)
    assert brightest == bright == pytest.approx(np.log(0.99 / 0.01))


def altered(raised_deg: float, azimuths: slice, known: bool = True) -> MeasuredSkyline:
    """The small skyline, raised at some azimuths or unknown there."""
    skyline, elevation = small_skyline(), np.array(small_skyline().elevation_rad)
    elevation[azimuths] = elevation[azimuths] + np.radians(raised_deg) if known else np.nan
    sigma = np.where(np.isnan(elevation), np.inf, np.radians(0.1))
    return replace(skyline, elevation_rad=elevation, sigma_rad=sigma)


def test_what_moves_between_pictures_is_reported_with_the_higher_edge():
    low, high = small_skyline(), altered(5.0, slice(100, 107))
    for pictures in ([low, high, low], [high, low, low]):
        found = join_skylines(low, pictures)
        assert np.flatnonzero(found.source == "varies").tolist() == list(range(100, 107))
        np.testing.assert_array_equal(found.elevation_rad, high.elevation_rad)
    rng = np.random.default_rng(3)
    noisy = [replace(low, elevation_rad=low.elevation_rad + rng.normal(0, low.sigma_rad.min(), 360)) for _ in range(4)]
    assert np.count_nonzero(join_skylines(low, noisy).source == "varies") <= 2


def test_more_pictures_never_know_fewer_azimuths():
    none, some = altered(0.0, slice(None), known=False), altered(0.0, slice(50, 200), known=False)
    for together in (none, some):
        found = join_skylines(together, [some, none])
        assert np.all(found.known >= some.known)
        np.testing.assert_array_equal(found.elevation_rad, some.elevation_rad)


def test_the_command_writes_files_of_one_computation_and_the_record(tmp_path, capsys, monkeypatch):
    fitted = []
    monkeypatch.setattr(horizon_frames, "fit_frames", lambda *args: fitted.append(args) or fit_frames(*args))
    names = "a.hrz", "a.csv", "garden/"
    outputs = [word for name in names for word in ("-o", f"{tmp_path}/{name}")]
    assert main(["horizon", str(PHOTO), *outputs, LOWELL_FLAG, "-c", "lowell-ldt", "--json"]) == 0
    assert len(fitted) == 1
    record = json.loads(capsys.readouterr().out)
    assert record["format"] == "startrack.horizon/1"
    assert record["status"] == "ok"
    assert record["azimuths"]["known"] > 200
    assert "of the 360 interpolated" in record["message"] and record["message"].endswith(UNTESTED)
    Draft202012Validator(SCHEMAS["horizon"]).validate(record)
    assert set(record) <= set(SCHEMAS["horizon"]["properties"])
    files = {tmp_path / name for name in ("a.hrz", "a.csv", "garden/landscape.ini", "garden/horizon.txt")}
    files.add(tmp_path / "a.hrz.png")
    assert {*map(Path, record["files"])} == files == {path for path in tmp_path.rglob("*") if path.is_file()}
    measured = np.genfromtxt(tmp_path / "a.csv", delimiter=",", skip_header=1)[:, 1]
    known = np.isfinite(measured)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "a.hrz")[:360, 1][known], measured[known], atol=6e-4)
    # Each is checked before the work.
    assert main(["horizon", str(PHOTO), "-o", f"{tmp_path}/b.csv", *outputs, LOWELL_FLAG, "-c", "lowell-ldt"]) == 2
    assert len(fitted) == 1 and not (tmp_path / "b.csv").exists()


def test_the_folder_of_results_and_no_plots_hold(measured_photo, tmp_path, monkeypatch, capsys):
    oriented = measured_photo.frames, measured_photo.left_out
    monkeypatch.setattr(horizon, "orient_frames", lambda *args, **more: oriented)
    monkeypatch.setattr(horizon, "measure_frames", lambda *args: measured_photo)
    monkeypatch.chdir(tmp_path)
    words = ["horizon", str(PHOTO), "-o", "a.csv", "-D", "out", LOWELL_FLAG, "-c", "lowell-ldt"]
    assert main([*words, "--no-plots"]) == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.csv"]
    assert main([*words, "-O"]) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"a.csv", "a.csv.png"}
    assert capsys.readouterr().err.splitlines()[-1] == "files out/a.csv, out/a.csv.png"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_the_advice_of_a_wrong_site_is_about_the_site(tmp_path, capsys):
    words = ["-o", str(tmp_path / "a.hrz"), "--site=-34.7443,-111.4223", "-c", "lowell-ldt"]
    assert main(["horizon", str(PHOTO), *words, "--json"]) == 3
    advice = json.loads(capsys.readouterr().out)["advice"]
    assert "site" in advice and "terrain" not in advice and "boulder" not in advice
    assert main(["horizon", str(PHOTO), *words]) == 3
    assert "terrain" not in capsys.readouterr().out


def test_without_site_or_time_it_is_bad_input(tmp_path, capsys):
    assert main(["horizon", str(PHOTO), "-o", str(tmp_path / "a.csv")]) == 4
    assert "--site" in capsys.readouterr().out
    import cv2

    cv2.imwrite(str(tmp_path / "flat.png"), np.zeros((60, 80), np.uint8))
    assert (
        main(["horizon", str(tmp_path / "flat.png"), "-o", str(tmp_path / "a.csv"), "--fov", "180", LOWELL_FLAG]) == 4
    )
    assert "no_time" in capsys.readouterr().out
    assert not (tmp_path / "a.csv").exists()


def test_a_picture_of_another_body_is_refused(two_frames, catalog, tmp_path, capsys):
    """The terrain that an image names identifies the body."""
    lunar = replace(two_frames[0], terrain="shackleton-thesis")
    with pytest.raises(
        BadInput, match="shackleton-thesis, which is on the Moon, but the site is on the Earth"
    ) as cause:
        measure_skyline([lunar], catalog, SITE, camera=CAMERA)
    assert cause.value.reason == "bad_terrain"
    words = [str(ROOT / "sample_images/near-centre.png"), LOWELL_FLAG]
    for command in (["horizon", "-o", str(tmp_path / "a.csv")], ["calibrate", "-o", str(tmp_path / "a.toml")]):
        assert main([*command, *words]) == 4
        assert "on the Moon" in "".join(capsys.readouterr())
    assert list(tmp_path.iterdir()) == []


def test_the_library_has_it_and_checks_its_arguments():
    with pytest.raises(ValueError, match="exclude"):
        startrack.measure_horizon([PHOTO], site=LOWELL, camera="lowell-ldt", fov=180)
    with pytest.raises(ValueError, match="moon"):
        startrack.measure_horizon([PHOTO], site=Site("moon", 0.0, 0.0), fov=180)
    with pytest.raises(ValueError, match="no image"):
        startrack.measure_horizon([], site=LOWELL, fov=180)


@pytest.mark.parametrize(
    ("site", "late_h"), [((-34.7443, -111.4223), 0.0), ((34.7443, 111.4223), 0.0), ((34.7443, -111.4223), 3.0)]
)
def test_stars_below_the_horizon_show_a_wrong_site_or_time(site, late_h):
    stated, photo = Site("earth", *np.radians(site), 2361.0), read_exposure(PHOTO)
    photo = replace(photo, time_utc=photo.time_utc + timedelta(hours=late_h))
    with pytest.raises(BadInput, match="identified stars are below the horizon") as refusal:
        orient_frames([photo], load_catalog(), stated, camera=load_camera("lowell-ldt"), fov_rad=None)
    assert refusal.value.reason == "inconsistent_evidence"
