"""Files and pictures of a measured skyline."""

from __future__ import annotations

import configparser
from dataclasses import replace

import cv2
import numpy as np
import pytest
from astropy.table import Table
from horizon_helpers import LOWELL, small_skyline

from startrack.applications.horizon.write import check_outputs, csv_text, interpolate_unknown, nina_text, write_skyline
from startrack.core.errors import BadInput, BadOutput
from startrack.output import Ink, horizon_picture, skyline_picture, skyline_table_text
from startrack.terrain import load_terrain


def test_the_csv_has_a_row_a_degree(tmp_path):
    write_skyline(small_skyline(), LOWELL, (), str(tmp_path / "a.csv"), overwrite=False)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0] == "azimuth_deg,elevation_deg,sigma_deg,is_measured,source,cloud_probability"
    assert len(lines) == 361
    assert lines[1] == "0,,,0,,"
    assert lines[3].split(",")[0] == "2"
    assert float(lines[3].split(",")[1]) == pytest.approx(1.0 + 2 * 9 / 359, abs=1e-4)
    assert csv_text(small_skyline()).endswith("359,10.0000,0.1000,1,both,0.0000\n")


def test_the_ecsv_is_read_by_astropy():
    table = Table.read(skyline_table_text(small_skyline()).splitlines(), format="ascii.ecsv")
    assert len(table) == 360
    assert table["elevation_deg"].unit == "deg"
    assert table["elevation_deg"].mask[[0, 5, 6]].all()
    assert table["source"][10] == "both"


def test_the_nina_file_is_complete():
    rows = [line for line in nina_text(small_skyline()).splitlines() if not line.startswith("#")]
    azimuth, altitude = np.array([row.split(" ") for row in rows], dtype=float).T
    assert azimuth.tolist() == list(range(361))
    assert np.isfinite(altitude).all()
    assert altitude[0] == altitude[360]
    assert altitude[5] == pytest.approx(1.0 + 5 * 9 / 359, abs=1e-3)


def test_azimuths_that_are_interpolated_or_differ_are_marked():
    number = np.arange(360)
    skyline = replace(small_skyline(), source=np.where((number > 39) & (number < 43), "varies", "both"))
    comments = [line for line in nina_text(skyline).splitlines() if line.startswith("#")]
    assert comments[1:3] == ["# 0 to 0: not measured", "# 5 to 6: not measured"]
    assert comments[3] == "# 40 to 42: differs between pictures: the highest edge"
    assert "40,2.0028,0.1000,1,varies,0.0000" in csv_text(skyline).splitlines()


def test_the_stellarium_landscape_is_polygonal(tmp_path):
    write_skyline(small_skyline(), LOWELL, (), f"{tmp_path}/garden/", overwrite=False)
    settings = configparser.ConfigParser()
    settings.read(tmp_path / "garden/landscape.ini")
    assert settings["landscape"]["type"] == "polygonal"
    assert settings["landscape"]["name"] == "garden"
    assert float(settings["location"]["latitude"]) == pytest.approx(34.7443)
    points = np.loadtxt(tmp_path / "garden" / settings["landscape"]["polygonal_horizon_list"])
    assert points.shape == (360, 2)
    assert np.flatnonzero(points[:, 1] < -5.0).tolist() == [0, 5, 6]  # the gaps


def test_the_panorama_is_a_picture(tmp_path):
    write_skyline(small_skyline(), LOWELL, (), str(tmp_path / "a.png"), overwrite=False)
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture.shape[1] > 1000
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


def test_azimuths_that_differ_are_crossed_in_the_panorama():
    """Each with a cross of some pixels, at its elevation, and nowhere else."""
    number = np.arange(360)
    at, few = (number > 39) & (number < 80), (number > 39) & (number < 60)
    plain, some, many = (
        crosses_in(skyline_picture(replace(small_skyline(), source=np.where(which, "varies", "both"))))
        for which in (number < 0, few, at)
    )
    assert len(plain) == 0
    assert len(some) > 5 * few.sum()
    assert len(many) == pytest.approx(2 * len(some), rel=0.1)
    assert np.ptp(many[:, 1]) == pytest.approx(2 * np.ptp(some[:, 1]), rel=0.1)


def test_azimuths_that_are_not_seen_are_hatched_and_named():
    seen = small_skyline()
    gap = (np.arange(360) > 99) & (np.arange(360) < 161)
    hole = replace(seen, elevation_rad=np.where(gap, np.nan, seen.elevation_rad))
    changed = np.flatnonzero((skyline_picture(seen) != skyline_picture(hole)).any(axis=(0, 2)))
    left, right = 64 + np.array([99, 161]) / 360 * (1440 - 64 - 16)  # the plot of this picture
    assert changed.min() >= left - 8 and changed.max() <= right + 8
    assert len(changed) > 0.9 * (right - left)


def test_the_horizon_of_a_terrain_fills_its_picture():
    """From below its lowest elevation on, and not from 0: here it is between 25 and 29 degrees."""
    picture = horizon_picture(load_terrain("shackleton-thesis"), (1000.0, 0.0)).astype(int)
    line = np.argwhere(np.abs(picture - Ink.SKYLINE).sum(axis=-1) < 30)[:, 0]
    assert np.ptp(line) > 0.4 * len(picture)


def crosses_in(picture: np.ndarray) -> np.ndarray:
    """Rows and columns (n, 2) of the pixels in the ink of the crosses."""
    return np.argwhere(np.abs(picture.astype(int) - Ink.HIDDEN).sum(axis=-1) < 60)


def test_unknown_suffixes_and_existing_files_are_refused(tmp_path):
    with pytest.raises(BadInput, match="suffix"):
        check_outputs(str(tmp_path / "a.txt"), overwrite=False)
    (tmp_path / "a.csv").write_text("mine")
    with pytest.raises(BadInput, match="replace it with overwrite=True, or"):
        check_outputs(str(tmp_path / "a.csv"), overwrite=False)
    check_outputs(str(tmp_path / "a.csv"), overwrite=True)


@pytest.mark.parametrize(
    "outputs", ["a.csv a.csv", "a.csv below/../a.csv", "link.csv a.csv", "garden garden/", "b.csv b.csv/"]
)
def test_two_outputs_with_one_path_are_refused(tmp_path, monkeypatch, outputs):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "below").mkdir()
    (tmp_path / "link.csv").symlink_to("a.csv")
    (tmp_path / "a.csv").write_text("mine")
    with pytest.raises(BadOutput, match="two outputs have this path"):
        check_outputs(*outputs.split(), overwrite=True)
    check_outputs("a.csv", "a.hrz", "a", "below", overwrite=True)


def test_no_output_is_written_where_one_cannot_hold_the_skyline(tmp_path):
    nothing = replace(small_skyline(), elevation_rad=np.full(360, np.nan))
    with pytest.raises(BadInput, match="unknown at all azimuths"):
        write_skyline(nothing, LOWELL, (), str(tmp_path / "a.csv"), str(tmp_path / "a.hrz"), overwrite=False)
    assert list(tmp_path.iterdir()) == []


def test_a_skyline_without_any_azimuth_cannot_be_interpolated():
    nothing = replace(small_skyline(), elevation_rad=np.full(360, np.nan))
    with pytest.raises(BadInput):
        interpolate_unknown(nothing)
