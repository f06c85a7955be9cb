"""Terrain files of several maps of the Earth: projections, levels of heights, and edges of each its own."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from startrack.cli.main import main
from startrack.core.types import BadInput
from startrack.frames import enu_from_latlon
from startrack.terrain import HeightMap, Raster, load_terrain, write_map

pytest.importorskip("pyproj")
pytest.importorskip("rasterio")
pytest.importorskip("matplotlib")
from earth_helpers import PLACE_DEG, SITE, in_projection, jacksboro, march

pytestmark = pytest.mark.usefixtures("own_cache")
GEOID_M, SLOPE_ARCSEC = -30.0, (20.0, -8.0)
FINE_M = np.geomspace(1.0, 24_000.0, 5_000)
AZIMUTHS_RAD = np.arange(0.01, 2 * np.pi, 0.7)


def below_geoid(raster: Raster) -> Raster:
    """The map of heights above the ellipsoid as one of heights above the geoid, of which the constants tell."""
    row_column = np.stack(np.indices(raster.heights_m.shape), axis=-1).astype(float)
    points = enu_from_latlon(SITE, *raster.projection.latlon_from_xy(*raster.xy(row_column)), 300.0)
    geoid = GEOID_M + points[..., :2] @ np.tan(np.radians(np.array(SLOPE_ARCSEC) / 3600.0))
    return replace(raster, heights_m=(raster.heights_m - geoid).astype(np.float32))


def three_maps() -> list[Raster]:
    """4 m posts in UTM, 60 m in a projection of Kentucky, 90 m in longitude and latitude."""
    return [in_projection("EPSG:32616", 4.0, 260), in_projection("EPSG:3088", 60.0, 120), jacksboro()]


def write_terrain(folder: Path, maps: list[Raster], dem: str) -> Path:
    for k, one in enumerate(maps):
        write_map(folder / f"{k}.tif", one)
    names = ", ".join(f'"{k}.tif"' for k in range(len(maps)))
    (folder / "mixed.toml").write_text(
        f"""body = "earth"
[origin]
latitude_deg = {PLACE_DEG[0]}
longitude_deg = {PLACE_DEG[1]}
height_m = 300.0
[dem]
file = [{names}]
height_sigma_m = 0.5
{dem}
[rover]
camera_height_m = 10.0
[search]
radius_m = 300.0
"""
    )
    return folder / "mixed.toml"


@pytest.mark.parametrize("above_geoid", [(), (0,), (1, 2)], ids=["ellipsoid", "near above geoid", "far above geoid"])
def test_maps_of_three_projections_and_two_levels_are_one_ground(tmp_path, above_geoid):
    """Beside points that pyproj puts into the frame of the Earth's centre, on maps all above the ellipsoid."""
    maps = three_maps()
    stored = [below_geoid(one) if k in above_geoid else one for k, one in enumerate(maps)]
    heights = [GEOID_M * (k in above_geoid) for k in range(3)]
    slopes = [list(SLOPE_ARCSEC) if k in above_geoid else [0.0, 0.0] for k in range(3)]
    path = write_terrain(tmp_path, stored, f"geoid_m = {heights}\ngeoid_slope_arcsec = {slopes}")
    terrain, point = load_terrain(path), np.array([120.0, -80.0])
    assert isinstance(terrain, HeightMap)
    tan, away, end = march(maps, point, 10.0, AZIMUTHS_RAD, 0.13, FINE_M)
    inside = (away > 50.0) & (away < end - 150.0)
    off = np.degrees(terrain.horizon_rad(point, AZIMUTHS_RAD) - np.arctan(tan))[inside]
    assert len(off) > 6
    assert (away[inside] > 600.0).any()  # on the ground of the coarse maps too
    assert np.abs(off).max() < 0.005


def test_a_statement_for_another_number_of_maps_is_refused(tmp_path):
    path = write_terrain(tmp_path, three_maps()[:2], "geoid_m = [0.0, 0.0, -30.0]")
    with pytest.raises(BadInput, match=re.escape("dem.geoid_m has 3 entries for 2 maps")):
        load_terrain(path)


def test_import_names_the_offset_of_maps_and_states_it(tmp_path, capsys):
    """The near map above the ellipsoid, the far one above the geoid: 30 m apart, until the geoid is stated."""
    near, far = in_projection("EPSG:32616", 8.0, 200), below_geoid(jacksboro())
    for name, one in (("near.tif", near), ("far.tif", far)):
        write_map(tmp_path / name, one)
    words = ["terrain", "import", str(tmp_path / "near.tif"), str(tmp_path / "far.tif"), "--radius", "300"]
    words += ["-o", str(tmp_path / "t.toml"), "--latitude", str(PLACE_DEG[0]), "--longitude", str(PLACE_DEG[1])]
    assert main([*words, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert any("far.tif stands 30 m above near.tif where both are" in text for text in facts["warnings"])
    stated = tomllib.loads((tmp_path / "t.toml").read_text())["dem"]
    assert stated["map_offset_sigma_m"] == pytest.approx(30.0, abs=0.5)
    from test_terrain_earth import grid_of_geoid

    geoid = grid_of_geoid(tmp_path / "geoid.gtx", SLOPE_ARCSEC)
    assert main([*words, "-O", "--json", "--geoid", "ellipsoid", str(geoid)]) == 0
    assert not any("stands" in text for text in json.loads(capsys.readouterr().out)["warnings"])
    stated = tomllib.loads((tmp_path / "t.toml").read_text())["dem"]
    assert stated["geoid_m"] == [0.0, pytest.approx(GEOID_M, abs=0.01)]
    assert "map_offset_sigma_m" not in stated
    assert main([*words, "-O", "--geoid", "ellipsoid", str(geoid), "ellipsoid"]) == 4
    assert "3 grids of the geoid for 2 maps" in capsys.readouterr().err


def test_a_roof_that_is_cut_out_of_the_near_map_and_stated_hides_nothing(tmp_path, capsys):
    """Beside the camera; a map of the far ground, 12 m lower, does not fill it in its place."""
    bare, far = in_projection("EPSG:32616", 4.0, 260), replace(jacksboro(), heights_m=jacksboro().heights_m - 12.0)
    roofed, cut = bare.heights_m.copy(), bare.heights_m.copy()
    roof = (slice(118, 132), slice(125, 140))  # 56 m x 60 m about the origin
    roofed[roof] += 25.0
    cut[roof] = np.nan
    cut[135, 131] = np.nan  # a tree
    point, azimuths = np.zeros(2), np.radians(np.arange(0.0, 360.0, 2.0))

    def horizon_of(heights: np.ndarray, dem: str) -> np.ndarray:
        path = write_terrain(tmp_path, [replace(bare, heights_m=heights), far], dem)
        return np.degrees(load_terrain(path).horizon_rad(point, azimuths))

    true = horizon_of(bare.heights_m, "")
    off = {
        (name, dem): np.median(np.abs(horizon_of(heights, dem) - true))
        for name, heights, dem in (
            ("roofed", roofed, ""), ("cut", cut, ""), ("cut", cut, "cut_out_m = 50.0"),
            ("cut", cut, "cut_out_m = 70.0"),
        )
    }  # fmt: skip
    assert off.pop(("cut", "cut_out_m = 70.0")) < 0.02
    assert min(off.values()) > 0.3  # also where the far map fills the void, which is wider than 50 m
    write_map(tmp_path / "cut.tif", replace(bare, heights_m=cut))
    words = ["terrain", "import", str(tmp_path / "cut.tif"), "-o", str(tmp_path / "t.toml"), "--radius", "300"]
    place = ["--latitude", str(PLACE_DEG[0]), "--longitude", str(PLACE_DEG[1]), "-q"]
    assert main([*words, *place, "--cut-out", "70"]) == 0
    made = load_terrain(tmp_path / "t.toml")
    assert made.ground_m(point) + made.site.height_m == pytest.approx(bare.sample(np.array([130.0, 130.0])), abs=30.0)
    assert tomllib.loads((tmp_path / "t.toml").read_text())["dem"]["cut_out_m"] == 70.0
