"""A skyline that was measured elsewhere: its files, its errors, and the position by it."""

import json

import numpy as np
import pytest
from map_helpers import basin

import startrack
from startrack.chain import SkylineErrors, StatedAttitude, skyline_points
from startrack.cli.main import main
from startrack.core.errors import BadInput
from startrack.core.types import MIDDLES_RAD, SECTORS
from startrack.frames import R_from_rotvec, azel_from_rays, turn_azel
from startrack.localization import SkylinePoints, locate_points
from startrack.localization.skyline_points import SeenSkyline, find_peaks

PLACE_M = np.array([150.0, -80.0])
DEG = np.radians(1.0)


def points_of(terrain, place_m, *, sigma_deg=0.03, correlation_deg=1.0, heading=0.0, tilt=0.0, rng=None, step_deg=0.75):
    """The skyline of a place as it is measured: its errors, and those of an attitude, drawn with `rng`."""
    azimuth = np.radians(np.arange(0.05, 360.0, step_deg))
    height = np.ravel(terrain.horizon_rad(place_m[None], azimuth))
    stated = {"sigma_rad": np.full(len(azimuth), sigma_deg * DEG), "correlation_rad": correlation_deg * DEG}
    stated |= {"heading_sigma_rad": heading * DEG, "tilt_sigma_rad": tilt * DEG}
    if rng is not None:
        apart = np.abs(azimuth[:, None] - azimuth)
        like = np.exp(-np.minimum(apart, 2 * np.pi - apart) / (correlation_deg * DEG))
        height = height + sigma_deg * DEG * np.linalg.cholesky(like) @ rng.normal(size=len(azimuth))
        turn, east, north = np.array([heading, tilt, tilt]) * DEG * rng.normal(size=3)
        R = R_from_rotvec([0.0, 0.0, -turn]) @ R_from_rotvec([east, north, 0.0])
        azimuth, height = turn_azel(azimuth, height, R.T)
    return SkylinePoints(azimuth_rad=azimuth, elevation_rad=height, **stated)


def table(rows):
    return "azimuth_deg,elevation_deg,sigma_deg\n" + "".join(",".join(map(str, row)) + "\n" for row in rows)


GOOD = [(a, 3.0 + 0.01 * a, 0.1) for a in range(0, 40, 2)]


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        (table([*GOOD, (50, 1.0, 0.0)]), "sigma above 0"),
        (table([*GOOD, (50, 1.0, "")]), "sigma above 0"),
        (table([*GOOD, (50, 1.0, "inf")]), "finite numbers are expected"),
        (table([*GOOD, (2, 1.0, 0.1)]), "azimuth 2 is given twice"),
        (table([*GOOD, (362, 1.0, 0.1)]), "azimuth 2 is given twice"),
        (table([*GOOD, (50, 90.5, 0.1)]), "beyond 90 degrees"),
        (table(GOOD[:3]), "3 rows with an elevation"),
        ("azimuth,elevation\n1,2\n", "has neither the columns azimuth_deg"),
        ("", "has neither the columns"),
    ],
)
def test_files_of_no_use_are_refused_with_the_cause(tmp_path, capsys, text, cause):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(BadInput, match=cause) as refusal:
        skyline_points(str(path), SkylineErrors())
    assert refusal.value.reason == "bad_image"
    assert main(["locate", "--skyline", str(path), "-t", "shackleton", "-D", str(tmp_path / "out")]) == 4
    assert cause in capsys.readouterr().out and not (tmp_path / "out").exists()


def test_what_a_command_lacks_is_named(tmp_path, capsys):
    path = tmp_path / "line.csv"
    path.write_text("x_px,y_px\n" + "".join(f"{x},100\n" for x in range(100, 120)))
    line = ["locate", "--skyline", str(path), "--json", "-D", str(tmp_path)]
    for more, reason in ([], "bad_terrain"), (["-t", "shackleton"], "no_calibration"):
        assert main([*line, *more]) == 4
        assert json.loads(capsys.readouterr().out)["reason"] == reason
    known = [*line, "-t", "shackleton", "-c", "fisheye-2048"]
    assert main(known) == 4 and "--attitude" in json.loads(capsys.readouterr().out)["message"]
    for wrong in ["--attitude=1,2,3"], ["image.png"], ["--localizer", "hull"]:
        with pytest.raises(SystemExit):
            main([*known, *wrong])
    path.write_text("x_px,y_px\n" + "".join(f"{x},100\n" for x in range(2040, 2060)))
    stated = ["--attitude=10,80,0", "--heading-sigma", "1", "--tilt-sigma", "1"]
    capsys.readouterr()
    assert (
        main([*known, *stated]) == 4 and "not in the calibrated part" in json.loads(capsys.readouterr().out)["message"]
    )


def test_table_of_locate_has_the_skyline_that_it_was_written_from(tmp_path):
    path = tmp_path / "one.skyline.ecsv"
    text = "# %ECSV 1.0\n# ---\nazimuth_deg,elevation_deg,sigma_deg,source\n"
    path.write_text(text + "".join(f"{a},{4 + a / 100},0.2,stars\n" for a in range(20)) + "30,,,\n")
    points = skyline_points(str(path), SkylineErrors(heading_sigma_rad=2.0 * DEG))
    np.testing.assert_allclose(np.degrees(points.elevation_rad), 4 + np.arange(20) / 100)
    assert len(points) == 20 and points.heading_sigma_rad == pytest.approx(np.radians(2.0))


def test_attitude_in_degrees_points_where_it_says():
    R = StatedAttitude.of_angles(*np.radians([70.0, 10.0, 0.0])).R_cam_enu
    np.testing.assert_allclose(np.degrees(azel_from_rays(R[2])), (70.0, 10.0))
    assert -R[1, 2] == pytest.approx(np.cos(np.radians(10.0)))  # the image's top is up
    turned = StatedAttitude.of_angles(*np.radians([70.0, 10.0, 5.0])).R_cam_enu
    np.testing.assert_allclose(turned[2], R[2], atol=1e-12)
    assert turned[0, 2] == pytest.approx(-np.sin(np.radians(5.0)) * np.cos(np.radians(10.0)))  # its right side is down


def test_correlated_errors_of_neighbours_do_not_average_away():
    even = {"azimuth_rad": np.radians(np.arange(0.0, 360.0, 0.1)), "elevation_rad": np.zeros(3600)}
    even["sigma_rad"] = np.full(3600, DEG)
    alone = SkylinePoints(**even, correlation_rad=0.0).variance_rad2
    np.testing.assert_allclose(alone, DEG**2 / 15)
    wide = SkylinePoints(**even, correlation_rad=DEG).variance_rad2
    white = DEG**2 * 2.0 / 1.5  # the spectrum of exp(-distance / 1 degree) at zero, in sectors of 1.5 degrees
    np.testing.assert_allclose(wide, white, rtol=0.01)


def test_rows_are_normal_near_the_height_that_was_measured():
    terrain = basin(0.0)
    seen = SeenSkyline.at(points_of(terrain, PLACE_M, correlation_deg=0.0, step_deg=1.5), terrain, PLACE_M, np.zeros(3))
    from localization_helpers import log_at

    from startrack.localization.likelihood.skyline_profiles import profiles_of

    rows = seen.rows()
    height = np.ravel(terrain.horizon_rad(PLACE_M[None], MIDDLES_RAD))
    profiles = profiles_of(rows, rows.elevation_rad - np.repeat(height, 13), np.zeros(SECTORS))
    middle = seen.above_rad[7]
    for sigmas, lost in (1.0, 0.5), (2.0, 2.0), (3.0, 4.5):
        found = [log_at(profiles, 7, middle + side * sigmas * 0.03 * DEG) for side in (0.0, -1.0, 1.0)]
        assert found[0] - found[1] == pytest.approx(lost, rel=0.12)
        assert found[0] - found[2] == pytest.approx(lost, rel=0.12)


@pytest.mark.parametrize("heading", [8.0, pytest.param(180.0, marks=pytest.mark.slow)])
def test_place_and_attitude_are_found_where_neither_is_known(heading):
    terrain, rng = basin(), np.random.default_rng(5)
    points = points_of(terrain, PLACE_M, heading=heading, tilt=2.0, rng=rng)
    best = find_peaks(points.thinned(), terrain)[0]
    off = best.seen.position_m - PLACE_M
    assert off @ np.linalg.solve(best.covariance[:2, :2], off) < 20.0
    fix, _ = locate_points(points, terrain)
    assert np.linalg.norm(fix.position_enu_m[:2] - PLACE_M) < fix.radius999_m


def test_narrow_skyline_is_refused():
    terrain = basin()
    points = points_of(terrain, PLACE_M)
    few = points.take(points.azimuth_rad < 0.4)
    with pytest.raises(startrack.NoSolution, match="24 degrees of the skyline") as refusal:
        locate_points(few, terrain)
    assert refusal.value.reason == "insufficient_geometry"


def test_command_writes_a_result_without_stars(tmp_path, capsys):
    terrain = startrack.load_terrain("shackleton-thesis")
    points = points_of(terrain, np.array([3000.0, -1000.0]), rng=np.random.default_rng(1))
    rows = np.degrees(np.stack([points.azimuth_rad, points.elevation_rad, points.sigma_rad], axis=1))
    path = tmp_path / "mine.csv"
    np.savetxt(path, rows, "%.5f", ",", header="azimuth_deg,elevation_deg,sigma_deg", comments="")
    line = ["locate", "--skyline", str(path), "-t", "shackleton-thesis", "-D", str(tmp_path / "out"), "--json"]
    assert main([*line, "--format", "geojson"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["status"] == "ok" and record["position"]["evidence"] == "skyline" and record["attitude"] is None
    found = record["position"]
    assert np.hypot(found["east_m"] - 3000.0, found["north_m"] + 1000.0) < found["radius999_m"]
    written = {one.name for one in (tmp_path / "out").iterdir()}
    assert written == {"mine.fix.json", "mine.geojson", "mine.skyline.ecsv", "mine.skyline.png"}
    solution = startrack.locate_skyline(rows, terrain="shackleton-thesis")
    assert solution.position.east.value == pytest.approx(found["east_m"], abs=0.5) and solution.attitude is None


@pytest.mark.slow
def test_circles_hold_their_part_of_true_places():
    terrain, rng = basin(0.0), np.random.default_rng(8)
    nees, within = [], []
    for _ in range(60):
        place_m = rng.uniform(-200.0, 200.0, 2)
        fix, _ = locate_points(points_of(terrain, place_m, heading=0.1, tilt=0.1, rng=rng), terrain)
        off = fix.position_enu_m[:2] - place_m
        nees.append(off @ np.linalg.solve(fix.covariance_m2, off))
        within.append(np.linalg.norm(off) < np.array([fix.radius95_m, fix.radius999_m]))
    assert 0.7 < np.mean(nees) < 2.6  # mean 2; neighbours count as alike around the whole compass, so below is right
    assert np.mean(within, axis=0)[0] > 0.88 and np.mean(within, axis=0)[1] > 0.98
