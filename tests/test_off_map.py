"""A horizon that meets the edge of a map is marked in everything that shows it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from map_helpers import POST_M, basin

from startrack.cli.main import main
from startrack.output.html.details import read_ecsv
from startrack.output.picture.panorama import UNKNOWN
from startrack.terrain import HeightMap, load_terrain, write_map

pytest.importorskip("rasterio")
pytestmark = pytest.mark.usefixtures("own_cache")
END_M, HIGHEST_M = 1080.0, 500.0  # the map ends so far in the north, before the higher ridge; what may stand beyond


@pytest.fixture
def cropped(tmp_path: Path) -> Path:
    """The terrain file of `basin` without its north, and a skyline of the whole one as it was measured."""
    whole = basin()
    raster = whole.maps[0]
    rows = round((raster.y0_m - END_M) / POST_M)
    write_map(tmp_path / "north.tif", raster.crop(slice(rows, None), slice(0, None)))
    (tmp_path / "north.toml").write_text(
        f"""name = "north"
body = "moon"
[origin]
latitude_deg = {np.degrees(whole.site.latitude_rad)}
longitude_deg = {np.degrees(whole.site.longitude_rad)}
[dem]
file = "north.tif"
height_sigma_m = 4.0
highest_beyond_m = {HIGHEST_M}
[search]
radius_m = 300.0
"""
    )
    azimuth = np.arange(0.0, 360.0, 1.0)
    elevation = np.degrees(whole.horizon_rad(np.array([[40.0, -60.0]]), np.radians(azimuth)))
    rows_deg = np.stack([azimuth, elevation, np.full(360, 0.05)], axis=1)
    np.savetxt(tmp_path / "seen.csv", rows_deg, "%.4f", ",", header="azimuth_deg,elevation_deg,sigma_deg", comments="")
    return tmp_path / "north.toml"


def shows_unknown(path: Path) -> bool:
    """Whether a picture has the colour of what ground off the maps could hide."""
    picture = cv2.imread(str(path))[..., ::-1].astype(int)
    return bool(np.count_nonzero(np.abs(picture - np.array(UNKNOWN)).max(axis=2) < 3) > 500)


def is_north(azimuth_deg: np.ndarray) -> np.ndarray:
    return np.abs((np.asarray(azimuth_deg) + 180.0) % 360.0 - 180.0) < 30.0


def test_what_terrain_show_prints_and_draws_has_the_mark(cropped, tmp_path, capsys):
    show = ["terrain", "show", str(cropped), "--at", "40", "-60", "-D", str(tmp_path)]
    assert main([*show, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    ((start, end),) = facts["horizon_off_map_deg"]
    assert start > 270.0 and end < 90.0
    assert facts["maps_end"]["missing"]
    assert shows_unknown(tmp_path / "north.horizon.png")
    assert main(show) == 0
    assert "off map      azimuths" in capsys.readouterr().out
    basin_file = load_terrain(cropped)
    assert isinstance(basin_file, HeightMap)
    known = replace(basin_file, highest_beyond_m=-np.inf, maps=basin().maps)
    assert known.unknown_below_rad(np.zeros(1)) < known.horizon_rad(np.zeros(2), np.zeros(1))


def test_what_locate_writes_has_the_mark(cropped, tmp_path, capsys):
    """Also where the true ridge, that is not on the map, stands above the map's skyline: it is no evidence."""
    line = ["locate", "--skyline", str(tmp_path / "seen.csv"), "-t", str(cropped), "-D", str(tmp_path), "--json"]
    assert main([*line, "--explain"]) == 0
    record = json.loads(capsys.readouterr().out)
    ((start, end),) = record["evidence"]["off_map"]
    assert start > 270.0 and end < 90.0
    assert any("the maps end, and ground off the map could stand" in text for text in record["warnings"])
    assert any(text.startswith("a wider map: at azimuths") for text in record["explain"])
    away_m = np.hypot(record["position"]["east_m"] - 40.0, record["position"]["north_m"] + 60.0)
    assert away_m < record["position"]["radius999_m"]
    _, rows = read_ecsv(tmp_path / "seen.skyline.ecsv")
    marked = np.array([row["off_map"] == "True" for row in rows])
    azimuth = np.array([float(row["azimuth_deg"]) for row in rows])
    assert marked[is_north(azimuth)].all()
    assert not marked[is_north(azimuth + 180.0)].any()
    assert shows_unknown(tmp_path / "seen.skyline.png")
    assert main(["report", str(tmp_path), "-o", str(tmp_path / "page.html")]) == 0
    data = re.search(r'id="detail-0">(.*?)</script>', (tmp_path / "page.html").read_text())
    assert data is not None
    detail = json.loads(data[1])
    unknown = np.array([one is not None for one in detail["unknown"]])
    around = np.linspace(0.0, 360.0, len(unknown))
    assert unknown[is_north(around)].all()
    assert not unknown[is_north(around + 180.0)].any()
