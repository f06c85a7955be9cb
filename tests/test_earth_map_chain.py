"""Images of the sky above a height map of the Earth: rendered, located, predicted, and drawn on maps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyproj")
pytest.importorskip("rasterio")
pytest.importorskip("matplotlib")
from earth_helpers import PLACE_DEG, jacksboro

from startrack.cli.main import main
from startrack.frames import latlon_from_enu
from startrack.terrain import load_terrain, write_map

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_cache")]
TIME = ["--time", "2027-01-15T05:00:00"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A terrain whose pictures are rendered: its heights are exact but for their rounding."""
    folder = tmp_path_factory.mktemp("earth")
    write_map(folder / "map.tif", jacksboro(), step_m=1.0, offset_m=0.0)
    place = ["--latitude", str(PLACE_DEG[0]), "--longitude", str(PLACE_DEG[1]), "--radius", "1200"]
    more = ["--sigma", "1.0", "--highest-beyond", "1300", "-q", "-o", str(folder / "ground.toml")]
    assert main(["terrain", "import", str(folder / "map.tif"), *place, *more]) == 0
    path = folder / "ground.toml"
    path.write_text(path.read_text().replace("[dem]", "[dem]\nhorizon_sigma_deg = 0.1"))
    return folder


def test_a_picture_is_located_with_its_latitude_and_longitude(folder):
    terrain, out = str(folder / "ground.toml"), str(folder / "out")
    at = ["--east", "-600", "--north", "150"]
    image = str(folder / "one.png")
    assert main(["render", "-t", terrain, "--seed", "4", *at, *TIME, "--max-tilt", "3", "-o", image, "-q"]) == 0
    assert main(["locate", image, "-t", terrain, "-D", out, "--format", "geojson,kml", "--report", "-q"]) == 0
    fix = json.loads((folder / "out" / "one.fix.json").read_text())
    assert fix["status"] == "ok"
    position = fix["position"]
    error = np.hypot(position["east_m"] + 600, position["north_m"] - 150)
    assert error < position["radius999_m"] < 60.0
    site = load_terrain(terrain).site
    lat, lon = np.degrees(latlon_from_enu(site, position["east_m"], position["north_m"], position["up_m"]))
    assert (position["latitude_deg"], position["longitude_deg"]) == pytest.approx((lat, lon), abs=1e-8)
    drawn = json.loads((folder / "out" / "one.geojson").read_text())
    assert "crs" not in drawn
    point = next(one for one in drawn["features"] if one["geometry"]["type"] == "Point")
    assert point["geometry"]["coordinates"][:2] == pytest.approx([lon, lat], abs=1e-7)
    assert "target=moon" not in (folder / "out" / "one.kml").read_text()


def test_a_picture_by_day_is_named(folder, capsys):
    terrain, image = str(folder / "ground.toml"), str(folder / "day.png")
    day = ["--time", "2027-07-10T17:00:00", "--east", "-600", "--north", "150"]
    assert main(["render", "-t", terrain, "--seed", "4", *day, "-o", image, "-q"]) == 0
    main(["locate", image, "-t", terrain, "-D", str(folder / "day"), "--no-plots"])
    assert "degrees above the horizon of the site" in capsys.readouterr().err


def test_a_prediction_is_a_map_in_the_projection_of_the_terrain(folder):
    import rasterio

    out = folder / "predicted"
    arguments = ["-c", "fisheye-2048", *TIME, "--spacing", "1300", "--draws", "1", "-D", str(out), "-q"]
    assert main(["predict", "-t", str(folder / "ground.toml"), *arguments]) == 0
    with rasterio.open(next(out.glob("*.tif"))) as file:
        assert file.crs.to_epsg() == 4326
        lon, lat = file.xy(file.height // 2, file.width // 2)
        assert (lat, lon) == pytest.approx(PLACE_DEG, abs=1e-4)
        assert np.isfinite(file.read(1)).any()


@pytest.mark.parametrize("moves", [False, True])
def test_a_track_is_better_than_its_first_image(folder, moves):
    terrain, drive = str(folder / "ground.toml"), folder / f"drive-{moves}"
    way = ["--every", "327"]
    if moves:
        (folder / "way.csv").write_text("east_m,north_m\n-600,150\n-480,250\n")
        way += ["--path", str(folder / "way.csv"), "--speed", "0.1"]
    else:
        way += ["--east", "-600", "--north", "150"]
    assert main(["render", "-t", terrain, "-n", "4", "--seed", "6", *way, *TIME, "-D", str(drive), "-q"]) == 0
    motion = ["--odometry", str(drive / "odometry.tum")] if moves else ["--at-rest"]
    assert main(["track", str(drive), *motion, "-D", str(drive / "out"), "-q"]) == 0
    frames = json.loads((drive / "out" / "track.json").read_text())["frames"]
    assert [one["status"] for one in frames] == ["used"] * 4
    for one in frames:
        truth = json.loads((drive / f"{one['image']}.truth.json").read_text())
        error_m = np.hypot(one["east_m"] - truth["east_m"], one["north_m"] - truth["north_m"])
        assert error_m < 1.5 * one["radius95_m"]
        assert one["radius95_m"] < frames[0]["filtered_radius95_m"]
