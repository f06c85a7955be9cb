"""Radii along a path with odometry: against the normal equations written out."""

from __future__ import annotations

import json

import numpy as np
import pytest
from astropy.table import Table
from jsonschema import Draft202012Validator

from startrack.applications.prediction import PREDICTION
from startrack.applications.prediction.run import add_odometry, ellipse_m2
from startrack.cli.main import main
from startrack.estimation.observations import OdometryErrors

POSITION_M = np.array([[0.0, 0.0], [300.0, 0.0], [300.0, 400.0], [700.0, 400.0], [700.0, 900.0]])
SIGMA_1, FLOOR_M = 0.02, 3.0


def cells_of(major, minor, azimuth_deg):
    major = np.array(major, dtype=float)
    return {
        "sigma_major_m": major, "sigma_minor_m": np.array(minor, dtype=float), "azimuth_deg": np.array(azimuth_deg),
        "radius95_m": 2.2 * major,
    }  # fmt: skip


def normal_equations(covariances, frames):
    """Covariance (2, 2) of each of the first `frames` positions, by images with `covariances` and the moves.

    The last two unknowns are the errors of scale and of heading that all moves share.
    """
    H = np.zeros((2 * frames + 2, 2 * frames + 2))
    H[-2:, -2:] = np.eye(2) / SIGMA_1**2
    for k in range(frames):
        part = slice(2 * k, 2 * k + 2)
        if covariances[k] is not None:
            H[part, part] += np.linalg.inv(covariances[k])
    for k, (east, north) in enumerate(np.diff(POSITION_M[:frames], axis=0)):
        length, difference = np.hypot(east, north), np.zeros((2, 2 * frames + 2))
        difference[:, -2:] = -np.array([[east, -north], [north, east]])
        difference[:, 2 * k : 2 * k + 2], difference[:, 2 * k + 2 : 2 * k + 4] = -np.eye(2), np.eye(2)
        H += difference.T @ difference / ((SIGMA_1 * length) ** 2 + FLOOR_M**2)
    whole = np.linalg.inv(H)
    return [whole[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(frames)]


def share_within(covariance, radius_m):
    points = np.random.default_rng(1).multivariate_normal(np.zeros(2), covariance, 100_000)
    return np.mean(np.hypot(*points.T) < radius_m)


def test_ellipses_are_turned_from_north_to_east():
    covariance = ellipse_m2(cells_of([5.0], [1.0], [30.0]))[0]
    along = np.array([np.sin(np.radians(30)), np.cos(np.radians(30))])
    assert along @ covariance @ along == pytest.approx(25.0)
    assert np.linalg.det(covariance) == pytest.approx(25.0)


def test_radii_are_those_of_least_squares():
    """The second place has no position; the moves alone lead there."""
    cells = cells_of([8.0, np.nan, 15.0, 5.0, 20.0], [6.0, np.nan, 4.0, 5.0, 10.0], [20.0, np.nan, 110.0, 0.0, 70.0])
    found = add_odometry(POSITION_M, cells, OdometryErrors(SIGMA_1, FLOOR_M))
    covariances = [None if np.isnan(one).any() else one for one in ellipse_m2(cells)]
    for k, covariance in enumerate(normal_equations(covariances, 5)):
        assert share_within(covariance, found["radius95_smoothed_m"][k]) == pytest.approx(0.95, abs=0.003)
        so_far = normal_equations(covariances, k + 1)[-1]
        assert share_within(so_far, found["radius95_filtered_m"][k]) == pytest.approx(0.95, abs=0.003)
    assert np.array_equal(found["radius95_m"], cells["radius95_m"], equal_nan=True)


def test_before_the_first_position_only_later_images_help():
    cells = cells_of([np.nan, 6.0, 6.0, 6.0, 6.0], [np.nan, 6.0, 6.0, 6.0, 6.0], [np.nan, 0.0, 0.0, 0.0, 0.0])
    found = add_odometry(POSITION_M, cells, OdometryErrors(SIGMA_1, FLOOR_M))
    assert np.isnan(found["radius95_filtered_m"]).tolist() == [True, False, False, False, False]
    assert np.isfinite(found["radius95_smoothed_m"]).all()
    nowhere = add_odometry(POSITION_M, cells_of(*np.full((3, 5), np.nan)), OdometryErrors(SIGMA_1, FLOOR_M))
    assert np.isnan(nowhere["radius95_filtered_m"]).all()
    assert np.isnan(nowhere["radius95_smoothed_m"]).all()


FLAGS = ["predict", "-t", "shackleton-thesis", "-c", "fisheye-2048", "--time", "2030-06-01T00:00:00"]


def test_a_path_add_odometry_has_two_more_columns(tmp_path, capsys):
    path, out = tmp_path / "waypoints.csv", tmp_path / "out"
    path.write_text("east_m,north_m\n0,0\n1000,0\n")
    flags = ["--exposure", "0.2", "--draws", "1", "--spacing", "500", "-j", "1", "-D", str(out)]
    assert main([*FLAGS, *flags, "--path", str(path), "--odometry-sigma", "0.01"]) == 0
    assert "with odometry: median 95 % radius" in capsys.readouterr().out
    table = Table.read(out / "predict.ecsv")
    alone, filtered, smoothed = (table[f"radius95_{name}m"] for name in ("", "filtered_", "smoothed_"))
    assert filtered[0] == pytest.approx(alone[0], rel=0.2)  # of the ellipse, and the median of the draws
    assert np.all(smoothed < filtered * 1.001)
    assert np.all(smoothed < alone)
    record = json.loads((out / "predict.json").read_text())
    Draft202012Validator(PREDICTION).validate(record)
    assert record["odometry"]["median_radius95_smoothed_m"] == pytest.approx(np.median(smoothed), rel=1e-5)
    assert (out / "predict.png").exists()


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (["--odometry-sigma", "0.02"], "needs --path"),
        (["--path", "w.csv", "--odometry-floor", "1"], "needs --odometry-sigma"),
        (["--path", "w.csv", "--odometry-sigma", "0", "--odometry-floor", "0"], "without errors"),
    ],
)
def test_flags_of_odometry_go_with_a_path(flags, text, capsys):
    with pytest.raises(SystemExit, match="2"):
        main([*FLAGS, *flags])
    assert text in capsys.readouterr().err
