"""Height maps of the Earth: horizons on the ellipsoid, refraction, files, and refusals."""

from __future__ import annotations

import json
import lzma
import re
import struct
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from startrack.cli.main import main
from startrack.core.types import BadInput
from startrack.frames import Site, enu_from_latlon
from startrack.terrain import HeightMap, Raster, Terrain, import_maps, load_terrain, read_map, write_map
from startrack.terrain.derived_maps import DeformedMap
from startrack.terrain.height_map import OFF_MAP
from startrack.terrain.maps.ellipsoid import heights_above_sphere

pytest.importorskip("pyproj")
pytest.importorskip("rasterio")
pytest.importorskip("matplotlib")
import pyproj
from earth_helpers import PLACE_DEG, SITE, in_projection, jacksboro, march

from startrack.terrain.maps.projections import EarthProjection, project_earth

DATA = Path(__file__).parent / "data"
FINE_M = np.geomspace(1.0, 24_000.0, 5_000)
EDGE_M = 150.0  # of a map: rays do not use the last half cell
pytestmark = pytest.mark.usefixtures("own_cache")


def on_earth(*maps: Raster, **changes) -> HeightMap:
    given = {"search_radius_m": 400.0, "camera_height_m": 10.0, "terrestrial_refraction_1": 0.13}
    return HeightMap(site=SITE, maps=maps, **given | changes)


@pytest.mark.slow
@pytest.mark.parametrize(
    "raster",
    [jacksboro, lambda: in_projection("EPSG:32616", 75.0), lambda: in_projection("EPSG:3088", 60.0)],
    ids=["geographic", "UTM", "Kentucky"],
)
@pytest.mark.parametrize("coefficient", [0.0, 0.5])
def test_horizons_are_those_of_points_in_the_frame_of_the_earths_centre(raster, coefficient):
    one = raster()
    terrain = on_earth(one, terrestrial_refraction_1=coefficient, search_radius_m=3000.0)
    azimuths, off = np.arange(0.01, 2 * np.pi, 0.4), []
    for point in np.random.default_rng(3).uniform(-2500, 2500, (4, 2)):
        tan, away, end = march([one], point, 10.0, azimuths, coefficient, FINE_M)
        inside = (away > 50.0) & (away < end - EDGE_M)
        off.append((np.arctan(terrain.horizons(point, azimuths)[0]) - np.arctan(tan))[inside])
    worst = np.degrees(np.concatenate(off))
    assert len(worst) > 40
    assert np.abs(worst).max() < 0.005
    assert np.abs(np.median(worst)) < 3e-4


@pytest.mark.parametrize("code", ["EPSG:4326", "EPSG:32616", "EPSG:32618", "EPSG:3035"])
def test_mountains_100_km_away_stand_as_high_as_geodesy_says(code):
    """Also three zones off (UTM 18), and in the projection of another continent: no degree is too high for them."""
    crs, rng = pyproj.CRS(code), np.random.default_rng(5)
    projection = project_earth(crs, (0.0, 0.0), (SITE.latitude_rad, SITE.longitude_rad))
    projection = EarthProjection(middle_x=PLACE_DEG[1]) if crs.is_geographic else projection
    x, y = (float(v) for v in projection.xy_from_latlon(SITE.latitude_rad, SITE.longitude_rad))
    per_x, per_y = projection.units_per_m(SITE.latitude_rad)
    posts, step = 241, 1000.0
    line = np.arange(posts) - posts // 2
    away = np.hypot(line[:, None], line) * step
    heights = np.where(away > 80_000, 2000 + 300 * rng.standard_normal((posts, posts)), 300.0)
    one = Raster(
        heights_m=heights.astype(np.float32), projection=projection, x0_m=x - posts // 2 * step * per_x,
        y0_m=y + posts // 2 * step * per_y, dx_m=step * per_x, dy_m=-step * per_y, source=code,
    )  # fmt: skip
    azimuths, s = np.arange(0.1, 2 * np.pi, 0.7), np.arange(50.0, 115_000.0, 25.0)
    tan, away_m, _ = march([one], np.array([3000.0, -2000.0]), 10.0, azimuths, 0.13, s)
    found, distance, _ = on_earth(one).horizons(np.array([3000.0, -2000.0]), azimuths)
    assert away_m.min() > 65_000.0
    assert distance == pytest.approx(away_m, abs=100.0)
    assert np.degrees(np.arctan(found) - np.arctan(tan)) == pytest.approx(0.0, abs=5e-4)


def test_horizons_of_flat_ground_are_those_of_ipw():
    """Sight lines that bend as the Earth does see flat ground.

    IPW's algorithm leaves out the next post and may miss the highest: it never stands higher, and where it has the
    highest post of the line both agree. Its horizons are level at each post, those here at the origin.
    """
    data = np.load(DATA / "lakes_horizons.npz")
    z, first = 2384 + data["dem"].astype(np.float64) * (3581 - 2384) / 65_535, (320_000.0, 4_166_650.0)
    middle = first[0] + 78 * 50.0, first[1] - 84 * 50.0
    projection = project_earth(pyproj.CRS("EPSG:32611"), middle, None)
    one = Raster(
        heights_m=z.astype(np.float32), projection=projection, x0_m=first[0], y0_m=first[1], dx_m=50.0, dy_m=-50.0
    )
    site = Site("earth", *(float(v) for v in projection.latlon_from_xy(*middle)))
    at = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float64) for n in z.shape), indexing="ij"), axis=-1)
    points = enu_from_latlon(site, *projection.latlon_from_xy(*one.xy(at)), z)
    terrain = HeightMap(
        site=site, maps=(one,), search_radius_m=2000.0, terrestrial_refraction_1=0.9999, camera_height_m=0.01
    )
    for name, axis in (("cos_0", 0), ("cos_90", 1)):
        ipw = np.degrees(np.arcsin(1 - data[name] / 65_535.0))
        line = np.moveaxis(z, axis, -1)
        steps = np.arange(line.shape[-1])
        rise = (line[..., None, :] - line[..., None]) / (50.0 * np.maximum(steps - steps[:, None], 1))
        rise[..., steps <= steps[:, None]] = 0.0
        best, crest = np.moveaxis(np.degrees(np.arctan(rise.max(axis=-1))), -1, axis), rise.argmax(axis=-1)
        at_edge = np.moveaxis(crest == line.shape[-1] - 1, -1, axis)  # our maps end before their last post
        edge = np.moveaxis(np.degrees(np.arctan(rise[..., -1])), -1, axis)
        inner = (slice(3, -13), slice(3, -13))
        ahead = np.roll(points, -10, axis=axis)[inner] - points[inner]
        azimuth = np.arctan2(ahead[..., 0], ahead[..., 1]).ravel()
        where = np.ascontiguousarray(points[inner][..., :2].reshape(-1, 2))
        tan = terrain.without_table().horizons(where, azimuth)[0]
        level = (where[:, 0] * np.sin(azimuth) + where[:, 1] * np.cos(azimuth)) / terrain.ground.radius_m
        found = np.maximum(np.degrees(np.arctan(tan) + level), 0.0)
        by_ipw = ipw[inner].ravel()
        known = by_ipw > edge[inner].ravel() + 0.01
        assert known.mean() > 0.6
        assert np.mean(found[known] > by_ipw[known] - 0.05) > 0.999
        same = (np.abs(best - ipw)[inner].ravel() < 0.001) & ~at_edge[inner].ravel()
        assert same.mean() > 0.4
        assert np.mean(np.abs(found - by_ipw)[same] < 0.05) > 0.95


@pytest.mark.slow
def test_bounds_hold_every_horizon_of_a_box_under_refraction():
    terrain = on_earth(in_projection("EPSG:32616", 75.0), terrestrial_refraction_1=0.8, search_radius_m=150.0)
    rng = np.random.default_rng(6)
    n, half = 400, rng.choice([0.5, 4.0, 20.0], 400)
    centres, azimuths = rng.uniform(-80, 80, (n, 2)), rng.uniform(0, 2 * np.pi, n)
    for turn in (0.0, 0.001, 0.01):
        low, high = terrain.horizon_bounds_rad(centres, half, azimuths, turn)
        for _ in range(6):
            points = centres + rng.uniform(-1, 1, (n, 2)) * half[:, None]
            turned = azimuths + rng.uniform(-1, 1, n) * turn
            tan, away, _ = terrain.horizons(points, turned)
            crest = points + away[:, None] * np.stack([np.sin(turned), np.cos(turned)], axis=-1)
            inside = np.abs(crest).max(axis=1) < 9_900.0  # not in the last cells of the map
            assert inside.mean() > 0.8
            assert (np.arctan(tan) >= low - 3e-6)[inside].all()
            assert (np.arctan(tan) <= high + 3e-6)[inside].all()


def test_the_error_of_refraction_is_the_change_of_the_horizon():
    terrain = on_earth(jacksboro(), terrestrial_refraction_sigma_1=None, height_sigma_m=0.0)
    names = [error.name for error in terrain.errors.shape]
    assert "terrestrial_refraction_1" in names
    one = names.index("terrestrial_refraction_1")
    assert terrain.errors.shape[one].sigma == 0.1
    assert terrain.errors.shape[one].is_stated
    azimuths = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    values = np.zeros(len(names))
    values[one] = 0.05
    other = terrain.with_shape(values).without_table()
    assert isinstance(other, DeformedMap)
    change = other.horizon_rad(np.zeros(2), azimuths) - terrain.without_table().horizon_rad(np.zeros(2), azimuths)
    slope = terrain.errors.slopes_rad(np.zeros(2), azimuths)[one]
    assert slope.max() > 1e-4
    assert change == pytest.approx(0.05 * slope, abs=1e-6)


def test_the_sphere_follows_the_ellipsoid():
    """Within a micrometre at the origin, and by d^2 / 2 (1/R - 1/N) to the east of it (N: the prime vertical)."""
    raster = replace(jacksboro(), heights_m=np.full_like(jacksboro().heights_m, 250.0))
    above = heights_above_sphere(raster, SITE)
    row, column = (round(float(v)) for v in raster.row_column(SITE.latitude_rad, SITE.longitude_rad))
    assert above[row, column] == pytest.approx(250.0 - SITE.height_m, abs=1e-3)
    a, e2 = 6_378_137.0, 0.00669437999014
    w2 = 1 - e2 * np.sin(SITE.latitude_rad) ** 2
    meridian, normal = a * (1 - e2) / w2**1.5, a / np.sqrt(w2)
    d = enu_from_latlon(SITE, *raster.projection.latlon_from_xy(*raster.xy(np.array([row, 0.0]))))[0]
    wanted = d**2 / 2 * (1 / np.sqrt(meridian * normal) - 1 / normal)
    assert above[row, 0] - above[row, column] == pytest.approx(wanted, abs=2e-3)


def st_helens(folder: Path) -> Path:
    path = folder / "st-helens.dem"
    path.write_bytes(lzma.decompress((DATA / "st-helens.dem.xz").read_bytes()))
    return path


def test_a_usgs_dem_is_read_and_its_datum_and_ends_are_named(tmp_path):
    path = st_helens(tmp_path)
    raster = read_map(path)
    assert raster.facts() | {"post_m": 30.0} == {
        "file": "st-helens.dem", "posts": [468, 327], "post_m": 30.0, "projection": "NAD27 / UTM zone 10N",
        "lowest_m": 682.0, "highest_m": 2543.0,
    }  # fmt: skip
    assert np.isnan(raster.heights_m).any()  # beyond the slanted edges of the sheet
    out = tmp_path / "crater.toml"
    place = {"latitude_rad": np.radians(46.2027), "longitude_rad": np.radians(-122.189)}
    made = import_maps([path], out, **place, half_m=[30_000.0], radius_m=200.0)
    assert any("ground beyond could stand up to" in line for line in made.warnings)
    assert any("NAD27" in line and "WGS 84" in line for line in made.warnings)
    terrain = load_terrain(out)
    assert any("NAD27" in line for line in terrain.errors.warnings())
    horizon = np.degrees(terrain.horizon_rad(np.zeros(2), np.radians(np.arange(0.0, 360.0, 5.0))))
    assert horizon.max() > 25.0
    assert -8.0 < horizon[0] < 3.0  # the crater is open to the north
    masked = terrain.warnings()[: -len(terrain.errors.warnings())]
    assert len(masked) >= 1
    assert all(OFF_MAP in line for line in masked)
    assert not terrain.is_informative(np.array([0.0]), np.radians([10.0]))[0]
    known = replace(terrain, highest_beyond_m=2600.0)
    assert known.is_informative(np.array([0.0]), np.radians([10.0]))[0]
    assert known.is_informative(np.array([0.0]), np.radians([25.0]))[0]


def test_a_void_is_filled_by_a_coarser_map_and_else_ends_the_known_ground():
    fine = in_projection("EPSG:32616", 75.0)
    heights = fine.heights_m.copy()
    heights[:120] = np.nan  # to the north, from 1.5 km on
    holed = replace(fine, heights_m=heights)
    alone, filled = (on_earth(*maps, highest_beyond_m=1200.0) for maps in ((holed,), (holed, jacksboro())))
    whole = on_earth(fine, highest_beyond_m=1200.0)
    point = np.zeros(2)
    edge = alone.with_voids().horizons(point, np.array([0.0, np.pi]))[2]
    assert edge[0] == pytest.approx(1500.0, abs=80.0)
    assert edge[1] > 5000.0
    azimuths = np.linspace(-0.6, 0.6, 13)
    off = filled.horizon_rad(point, azimuths) - whole.horizon_rad(point, azimuths)
    assert np.degrees(np.abs(off)).max() < 0.2  # the posts of another grid


def tile_of_srtm(folder: Path) -> Path:
    """The heights of `jacksboro` as a tile; the rest is void."""
    source = jacksboro()
    tile = np.full((1201, 1201), -32_768, dtype=">i2")
    column, row = round((source.x0_m + 85) * 1200), round((37 - source.y0_m) * 1200)
    tile[row : row + 344, column : column + 403] = source.heights_m
    path = folder / "N36W085.hgt"
    tile.tofile(path)
    return path


def test_a_tile_of_srtm_is_the_map_that_it_was_made_of(tmp_path):
    path = tile_of_srtm(tmp_path)
    write_map(tmp_path / "jacksboro.tif", jacksboro(), step_m=1.0, offset_m=0.0)
    near = SITE.latitude_rad, SITE.longitude_rad
    tile, tiff = read_map(path, near=near), read_map(tmp_path / "jacksboro.tif", near=near)
    assert np.nanmax(tile.heights_m) == tiff.heights_m.max() == 1076.0
    for one in (tile, tiff):
        assert one.sample(one.row_column(*map(np.array, near))) == pytest.approx(550.0, abs=15.0)
    by_tiff = on_earth(tiff).horizon_rad(np.zeros(2), np.arange(0, 6.0, 0.5))
    assert np.degrees(by_tiff.max()) > 5.0


def test_import_writes_a_terrain_of_the_earth(tmp_path, capsys):
    write_map(tmp_path / "utm.tif", in_projection("EPSG:32616", 75.0))
    out = tmp_path / "mine.toml"
    place = ["--latitude", str(PLACE_DEG[0]), "--longitude", str(PLACE_DEG[1]), "--radius", "400"]
    assert main(["terrain", "import", str(tmp_path / "utm.tif"), "-o", str(out), *place, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["body"] == "earth"
    assert facts["maps"][0]["projection"] == "WGS 84 / UTM zone 16N"
    terrain = load_terrain(out)
    assert terrain.site.height_m == pytest.approx(550.0, abs=15.0)
    assert terrain.terrestrial_refraction_1 == 0.13
    shared = {error.name: error.sigma for error in terrain.errors.shape}
    assert {name: sigma for name, sigma in shared.items() if name.startswith(("vertical", "terrestrial"))} == {
        "vertical_east_rad": pytest.approx(np.radians(0.003)), "vertical_north_rad": pytest.approx(np.radians(0.003)),
        "terrestrial_refraction_1": 0.1,
    }  # fmt: skip
    hgt = import_maps(
        [tile_of_srtm(tmp_path)], tmp_path / "tile.toml", latitude_rad=SITE.latitude_rad,
        longitude_rad=SITE.longitude_rad, half_m=[10_000.0], radius_m=400.0,
    )  # fmt: skip
    assert hgt.errors.origin == "product"
    assert hgt.errors.height_sigma_m > 5.3
    assert "SRTM" in hgt.errors.comment


def test_a_stated_geoid_tilts_the_ground():
    """The geoid rises by 20 arcsec to the east: the horizon there stands that much higher, in the west lower."""
    from startrack.terrain.maps.ellipsoid import above_ellipsoid

    plain = on_earth(jacksboro())
    tilted = on_earth(above_ellipsoid(jacksboro(), SITE, -30.0, [20.0, 0.0]))
    azimuths = np.array([np.pi / 2, 3 * np.pi / 2])
    change = tilted.horizon_rad(np.zeros(2), azimuths) - plain.horizon_rad(np.zeros(2), azimuths)
    tan = np.tan(plain.horizon_rad(np.zeros(2), azimuths))
    wanted = np.radians(20 / 3600) * np.array([1.0, -1.0]) / (1 + tan**2)
    assert change == pytest.approx(wanted, abs=3e-6)


def grid_of_geoid(path: Path, slope_arcsec: tuple[float, float]) -> Path:
    """A grid (GTX) of two degrees about SITE: -30 m there, with this slope to the east and the north."""
    latitude_deg, longitude_deg = np.degrees([SITE.latitude_rad, SITE.longitude_rad])
    line = np.linspace(-1.0, 1.0, 41)
    metres = 6_378_137.0 * np.radians(line)
    rise = np.tan(np.radians(np.array(slope_arcsec) / 3600.0))
    heights = -30.0 + rise[0] * metres * np.cos(SITE.latitude_rad) + rise[1] * metres[:, None]
    head = struct.pack(">4d2i", latitude_deg - 1, longitude_deg - 1, 0.05, 0.05, 41, 41)
    path.write_bytes(head + heights.astype(">f4").tobytes())
    return path


def test_import_states_the_geoid_of_a_grid(tmp_path, capsys):
    write_map(tmp_path / "utm.tif", in_projection("EPSG:32616", 75.0))
    words = ["terrain", "import", str(tmp_path / "utm.tif"), "-o", str(tmp_path / "mine.toml"), "--radius", "400"]
    words += ["--latitude", str(PLACE_DEG[0]), "--longitude", str(PLACE_DEG[1]), "-q", "--geoid"]
    assert main([*words, "no_such_grid.tif"]) == 4
    assert "projsync --file no_such_grid.tif" in capsys.readouterr().err
    far = grid_of_geoid(tmp_path / "far.gtx", (0.0, 0.0)).read_bytes()
    (tmp_path / "far.gtx").write_bytes(struct.pack(">2d", 10.0, 10.0) + far[16:])
    assert main([*words, str(tmp_path / "far.gtx")]) == 4
    assert "does not reach the origin" in capsys.readouterr().err
    assert main([*words, str(grid_of_geoid(tmp_path / "geoid.gtx", (20.0, -8.0)))]) == 0
    stated = tomllib.loads((tmp_path / "mine.toml").read_text())["dem"]
    assert stated["geoid_m"] == pytest.approx(-30.0, abs=0.01)
    assert stated["geoid_slope_arcsec"] == pytest.approx([20.0, -8.0], abs=0.2)


BAD = [
    ({"body": "moon"}, "a map of the Earth"), ({"dem": {"scale": 30.0}}, "not of the Earth's ground"),
    ({"origin": {"height_m": 551.0 * 0.3048}}, "one of them is in feet"),
    ({"origin": {"latitude_deg": 40.0}}, "origin is not on this map: .* 36.59, longitude -84.25, .* 30.1 km x 31.8 km"),
    ({"search": {"radius_m": 20_000.0}}, "cover"),
    ({"air": {"terrestrial_refraction": 2.0}}, "terrestrial_refraction"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "named"), BAD, ids=lambda v: str(v)[:30])
def test_what_cannot_be_used_is_refused_and_named(changes, named, tmp_path):
    write_map(tmp_path / "a.tif", jacksboro())
    d = {
        "format": 1, "body": "earth", "origin": {"latitude_deg": PLACE_DEG[0], "longitude_deg": PLACE_DEG[1]},
        "dem": {"file": "a.tif", "height_sigma_m": 1.0}, "search": {"radius_m": 400.0},
    }  # fmt: skip
    for name, value in changes.items():
        d[name] = {**d.get(name, {}), **value} if isinstance(value, dict) else value
    (tmp_path / "a.toml").write_text(tomli_w.dumps(d))
    with pytest.raises(BadInput, match=named):
        load_terrain(tmp_path / "a.toml")


def test_heights_in_feet_are_named_by_their_range(tmp_path):
    """Following the advice gives the heights, also of steps with an offset."""
    true_m = jacksboro().heights_m * 4.0
    write_map(tmp_path / "feet.tif", replace(jacksboro(), heights_m=(true_m / 0.3048).astype(np.float32)))
    with pytest.raises(BadInput, match=r"are they feet\? Then state --scale .* --offset") as refusal:
        read_map(tmp_path / "feet.tif")
    advice = re.findall(r"(scale|offset_m) = ([\d.]+)", str(refusal.value))
    read = read_map(tmp_path / "feet.tif", **{key: float(value) for key, value in advice})
    assert np.abs(read.heights_m - true_m).max() < 0.2


def test_what_is_for_the_earth_is_refused_on_the_moon(tmp_path):
    moon = {"format": 1, "body": "moon", "origin": {"latitude_deg": -90.0, "longitude_deg": 0.0}}
    for more in ({"air": {}}, {}):
        dem = {"file": "none.tif", **({} if more else {"geoid_slope_arcsec": [1.0, 0.0]})}
        (tmp_path / "a.toml").write_text(tomli_w.dumps(moon | {"dem": dem} | more))
        with pytest.raises(BadInput, match="is for the Earth"):
            load_terrain(tmp_path / "a.toml")


def test_a_projection_that_no_polynomial_fits_is_refused():
    """Longitude and latitude 30 km from a pole."""
    x0, y0 = -180.0, 89.9
    near_pole = Raster(
        heights_m=np.zeros((81, 361), np.float32), projection=EarthProjection(), x0_m=x0, y0_m=y0, dx_m=1.0, dy_m=-0.01
    )
    terrain = HeightMap(site=Site("earth", np.radians(89.5), 0.0), maps=(near_pole,), search_radius_m=300.0)
    with pytest.raises(BadInput, match="bends too much"):
        terrain.horizons(np.zeros(2), np.zeros(1))


def test_the_moon_has_no_air():
    terrain = load_terrain("kepler")
    assert isinstance(terrain, Terrain)
    assert terrain.ground.sag_per_m == 0.0
    assert terrain.terrestrial_refraction_sigma_1 == 0.0
