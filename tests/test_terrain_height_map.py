"""Height maps: horizons against another program's and against a march in small steps, cache, files, errors, places."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from map_helpers import SITE, polar_stereographic

from startrack.core.errors import NotLocated
from startrack.core.types import SECTORS, Evidence
from startrack.frames import Site, enu_from_latlon, latlon_from_enu
from startrack.localization import ExactPosterior
from startrack.terrain import (
    EQUIRECTANGULAR,
    STEREOGRAPHIC,
    ForwardingTerrain,
    HeightMap,
    Projection,
    Raster,
    load_terrain,
)
from startrack.terrain import table_cache as cache
from startrack.terrain.derived_maps import DeformedMap, HorizonInterpolator
from startrack.terrain.ground import ground_up_m
from startrack.terrain.map_ends import facts_of_ends
from startrack.terrain.maps.projections import ORTHOGRAPHIC
from startrack.terrain.shape import EXACT_WAVES

DATA = Path(__file__).parent / "data"
pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(scope="module")
def shackleton() -> HeightMap:
    terrain = load_terrain("shackleton")
    assert isinstance(terrain, HeightMap)
    return replace(terrain, search_radius_m=500.0)


def test_horizon_from_the_floor_is_that_of_another_program():
    """lunahorizon traced finer maps (5 to 240 m): the 240 m map clips the crest by some hundredths of a degree."""
    reference = np.genfromtxt(DATA / "shackleton_floor_horizon.csv", delimiter=",", names=True)
    terrain = replace(load_terrain("shackleton"), camera_height_m=2.0)
    place = enu_from_latlon(terrain.site, np.radians(-89.67), np.radians(129.78))[:2]
    found = np.degrees(terrain.horizon_rad(place, np.radians(reference["azimuth_deg"])))
    off = found - reference["elevation_deg"]
    assert abs(off.mean()) < 0.1
    assert off.std() < 0.03
    turned = found[::-1] - reference["elevation_deg"]
    assert turned.std() > 0.3  # a mirrored map would be noticed


def march_horizon_rad(terrain: HeightMap, place: np.ndarray, azimuth: float, step_m: float, end_m: float) -> float:
    """The horizon by small steps, with the numpy surface of `ground_up_m`."""
    s = np.concatenate([np.arange(step_m / 16, 400.0, step_m / 16), np.arange(400.0, end_m, step_m)])
    points = place + s[:, None] * np.array([np.sin(azimuth), np.cos(azimuth)])
    z = ground_up_m(terrain.site, list(terrain.maps), points)
    eye = ground_up_m(terrain.site, list(terrain.maps), place[None])[0] + terrain.camera_height_m
    return float(np.arctan(np.max((z - eye) / s)))


@pytest.mark.parametrize("name", ["shackleton", "kepler"])
def test_horizons_are_those_of_small_steps(name):
    terrain = load_terrain(name)
    rng = np.random.default_rng(1)
    places, azimuths = rng.uniform(-6000, 6000, (25, 2)), rng.uniform(0, 2 * np.pi, 25)
    found = terrain.horizon_rad(places, azimuths)
    slow = [march_horizon_rad(terrain, p, a, 4.0, 30_000.0) for p, a in zip(places, azimuths, strict=True)]
    off = np.degrees(found - slow)
    assert np.sqrt(np.mean(off**2)) < 0.002
    assert off.min() > -0.002  # small steps can only miss the top


def test_the_table_changes_no_horizon(shackleton):
    rng = np.random.default_rng(2)
    places, azimuths = rng.uniform(-500, 500, (300, 2)), rng.uniform(0, 2 * np.pi, 300)
    fresh = replace(shackleton, camera_height_m=1.6)
    before = fresh.horizon_rad(places, azimuths)
    assert not fresh.is_prepared
    fresh.prepare()
    assert np.abs(fresh.horizon_rad(places, azimuths) - before).max() < np.radians(0.001)


@pytest.mark.parametrize(
    "form",
    [
        lambda whole: whole,
        ForwardingTerrain,
        lambda whole: whole.near(np.zeros(2), 200.0, np.linspace(0.0, 6.0, 300)),
        lambda whole: DeformedMap(whole, stretch_1=0.01, vertical_east_rad=1e-3),
        lambda whole: DeformedMap(whole, camera_height_m=0.3),
    ],
    ids=["map", "forwarded", "interpolator", "tilted", "raised"],
)
def test_without_the_table_horizons_are_the_same_bits_before_and_after_it(shackleton, form):
    terrain, azimuths = replace(shackleton, camera_height_m=1.8, search_radius_m=150.0), np.linspace(0.0, 6.0, 300)
    terrain.discard_table()
    places = np.random.default_rng(2).uniform(-100, 100, (20, 1, 2))
    before = form(terrain).without_table().horizon_rad(places, azimuths)
    for one in (terrain, replace(terrain, camera_height_m=1.8 + 0.3)):
        one.prepare()
    assert np.array_equal(form(terrain).without_table().horizon_rad(places, azimuths), before)
    between_nodes = isinstance(form(terrain), HorizonInterpolator)  # 100 m apart, near crests
    assert form(terrain).horizon_rad(places, azimuths) == pytest.approx(before, abs=5e-4 if between_nodes else 1e-4)


def test_far_crests_are_found_with_the_table_too():
    """From Haworth's wall the horizon in the south is 50 to 60 km away."""
    terrain = load_terrain("haworth")
    latitude, longitude = latlon_from_enu(terrain.site, 7082.0, 12_306.0, 0.0)
    site = Site("moon", float(latitude), float(longitude))
    azimuths = np.radians(np.arange(150.5, 220))
    there = replace(terrain, site=site, search_radius_m=90.0)
    before, distance, _ = there.horizons(np.zeros(2), azimuths)
    assert distance.max() > 50_000
    there.prepare()
    assert np.abs(there.horizons(np.zeros(2), azimuths)[0] - before).max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(("half", "turn"), [(60.0, np.radians(0.75)), (10.0, 0.0), (1.0, 0.0)])
def test_bounds_hold_the_horizons_of_small_steps(shackleton, half, turn):
    small = replace(shackleton, search_radius_m=150.0)
    rng = np.random.default_rng(3)
    centres, azimuths = rng.uniform(-100, 100, (20, 2)), rng.uniform(0, 2 * np.pi, 20)
    low, high = small.horizon_bounds_rad(centres, np.array(half), azimuths, turn)
    places = centres[:, None] + rng.uniform(-half, half, (20, 8, 2))
    turned = azimuths[:, None] + rng.uniform(-turn, turn, (20, 8))
    slow = [
        march_horizon_rad(small, p, a, 8.0, 30_000.0)
        for p, a in zip(places.reshape(-1, 2), turned.ravel(), strict=True)
    ]
    horizon = np.array(slow).reshape(20, 8)
    ok = small.allowed(places)
    assert ok.mean() > 0.9
    assert np.all((low[:, None] - np.radians(0.002) <= horizon) | ~ok)  # small steps can only miss the top
    assert np.all((horizon <= high[:, None] + 1e-6) | ~ok)
    assert np.median(high - low) < np.radians(0.02 * half + 0.3 * (turn > 0))


@pytest.mark.slow
@pytest.mark.parametrize("half", [0.01, 1.5])
def test_bounds_of_sectors_hold_near_a_crest(half):
    """Ground that makes the horizon stands on either side of the middle of a table's cell."""
    terrain = load_terrain("shackleton")
    latitude, longitude = latlon_from_enu(terrain.site, 7361.0, 7000.0, 0.0)
    site = Site("moon", float(latitude), float(longitude))
    crest, rng = replace(terrain, site=site, search_radius_m=350.0), np.random.default_rng(8)
    centres, azimuths = rng.uniform(-245, 245, (400, 1, 2)), (np.arange(240) + 0.5) * 2 * np.pi / 240
    low, high = crest.horizon_bounds_rad(centres, np.array(half), azimuths, np.pi / 240)
    for _ in range(6):
        places = centres + rng.uniform(-half, half, (400, 240, 2))
        horizon = crest.without_table().horizon_rad(places, azimuths + rng.uniform(-1, 1, 240) * np.pi / 240)
        assert np.all(low - 1e-5 <= horizon)
        assert np.all(horizon <= high + 1e-5)


@pytest.mark.slow
def test_the_bounds_of_a_rough_map_hold_in_every_cell():
    rng, line = np.random.default_rng(5), 20.0 * (np.arange(300) - 149.5)
    rough = np.cumsum(np.cumsum(rng.normal(size=(300, 300)), axis=0), axis=1) * 0.05 + rng.normal(size=(300, 300))
    projection = Projection(kind=STEREOGRAPHIC, latitude_rad=0.5, longitude_rad=0.2)
    raster = Raster(
        heights_m=(rough + 0.1 * np.hypot(line[:, None], line)).astype(np.float32), projection=projection,
        x0_m=line[0], y0_m=-line[0], dx_m=20.0, dy_m=-20.0, source="rough.tif",
    )  # fmt: skip
    terrain = HeightMap(name="rough", site=Site("moon", 0.5, 0.2), maps=(raster,), search_radius_m=600.0)
    square, step = terrain.table.square, 2 * np.pi / 360
    inside = np.flatnonzero(np.hypot(*square.centres_m.T) < 500.0)
    low, high = terrain.table.pyramid[0]
    angles = [(a.reshape(-1, 360)[inside] * np.pi / 65_000 - np.pi / 2) for a in (low, high)]
    for _ in range(20):
        places = square.centres_m[inside][:, None] + rng.uniform(-1, 1, (len(inside), 360, 2)) * square.half_m
        azimuths = (np.arange(360) + rng.random((len(inside), 360))) * step
        horizon = terrain.without_table().horizon_rad(places, azimuths)
        assert np.all(angles[0] <= horizon + 1e-6)
        assert np.all(horizon <= angles[1] + 1e-6)


def test_bounds_do_not_depend_on_what_was_traced_before(shackleton):
    terrain, rng = replace(shackleton, search_radius_m=150.0), np.random.default_rng(6)
    centres, azimuths = rng.uniform(-100, 100, (2000, 2)), rng.uniform(0, 2 * np.pi, 2000)
    half, some = np.array(2.0), rng.permutation(2000)
    for turn in (0.0, np.radians(0.2)):
        fresh = np.array(terrain.horizon_bounds_rad(centres, half, azimuths, turn))
        again = terrain.horizon_bounds_rad(centres[some], half, azimuths[some], turn)
        assert np.array_equal(again, fresh[:, some])
        del terrain.table.__dict__["box_memory"]
        assert np.array_equal(terrain.horizon_bounds_rad(centres, half, azimuths, turn), fresh)


def test_bounds_in_sectors_are_those_of_single_ones(shackleton):
    """Looked up row by row, and from memory, they are the same as one by one, on every level of the table."""
    terrain, rng = replace(shackleton, search_radius_m=150.0), np.random.default_rng(7)
    azimuths = (2 * np.arange(SECTORS) + 1) * np.pi / SECTORS
    for half in (2.0, 20.0, 60.0, 150.0):
        centres = rng.uniform(-60, 60, (30, 2))
        rows = np.array(terrain.horizon_bounds_rad(centres[:, None], np.array(half), azimuths, np.pi / SECTORS))
        each = np.broadcast_to(np.pi / SECTORS, (30, SECTORS))
        assert np.array_equal(terrain.horizon_bounds_rad(centres[:, None], np.array(half), azimuths, each), rows)
        again = terrain.horizon_bounds_rad(centres[::-1, None], np.array(half), azimuths, np.pi / SECTORS)
        assert np.array_equal(np.array(again)[:, ::-1], rows)
        inside = (2 * rng.random((30, SECTORS)) - 1) * np.pi / SECTORS
        places = centres[:, None] + rng.uniform(-half, half, (30, SECTORS, 2))
        horizon = terrain.without_table().horizon_rad(places, azimuths + inside)
        seen = np.asarray(terrain.allowed(places))
        assert np.all((rows[0] <= horizon + 1e-6) | ~seen) and np.all((horizon <= rows[1] + 1e-6) | ~seen)


def test_a_raised_camera_sees_what_it_sees_without_the_table(shackleton):
    """A first sight line from the table of the camera before it was raised changes nothing but the time."""
    terrain, rng = replace(shackleton, search_radius_m=150.0, camera_height_sigma_m=0.1), np.random.default_rng(8)
    terrain.prepare()
    raised = terrain.with_shape(np.where([one.name == "camera_height_m" for one in terrain.errors.shape], 0.7, 0.0))
    places, azimuths = rng.uniform(-100, 100, (2000, 2)), rng.uniform(0, 2 * np.pi, 2000)
    found = raised.horizon_rad(places, azimuths)
    assert found == pytest.approx(raised.without_table().horizon_rad(places, azimuths), abs=2e-6)
    assert np.abs(found - terrain.horizon_rad(places, azimuths)).max() > 1e-5


def test_the_table_is_kept_and_found_again_by_content(shackleton, caplog):
    terrain = replace(shackleton, camera_height_m=1.7, search_radius_m=150.0)
    table = terrain.table
    key, path = terrain.table_key, terrain.table_path
    assert path.is_file()
    assert [p for p in path.parent.iterdir() if p.name.startswith(".")] == []
    cache.TABLES_IN_MEMORY.pop(key)
    again = replace(terrain)
    assert again.is_prepared
    assert again.table is not table
    assert np.array_equal(again.table.values, table.values)
    assert replace(terrain).table is again.table  # variants with the same table share it
    higher = replace(terrain, camera_height_m=3.0)
    assert higher.table_key != key
    first = terrain.maps[0]
    other = replace(first, heights_m=first.heights_m + np.float32(0.5))
    assert replace(terrain, maps=(other, *terrain.maps[1:])).table_key != key


@pytest.mark.parametrize("fault", ["cut short", "empty", "one bit"])
def test_a_damaged_table_is_made_anew_with_one_line(shackleton, caplog, fault):
    terrain = replace(shackleton, camera_height_m=1.8, search_radius_m=100.0)
    path, values = terrain.table_path, terrain.table.values
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= fault == "one bit"
    path.write_bytes(data[: {"cut short": 1000, "empty": 0}.get(fault)])
    cache.TABLES_IN_MEMORY.pop(terrain.table_key)
    assert np.array_equal(replace(terrain).table.values, values)
    assert caplog.messages.count(f"the table of horizons {path} is damaged: made anew") == 1
    assert cache.read_sealed(path) is not None


def test_of_two_that_need_a_table_one_makes_it(shackleton, monkeypatch):
    """Each thread represents a process: locks belong to open files, not to processes."""
    made, build = [], cache.build_table

    def slow(*arguments):
        made.append(threading.get_ident())
        time.sleep(0.3)
        return build(*arguments)

    monkeypatch.setattr(cache, "build_table", slow)
    terrains = [replace(shackleton, camera_height_m=1.75, search_radius_m=150.0) for _ in range(3)]
    path = terrains[0].table_path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix(".lock").touch()  # left by a process that was killed: nobody holds it
    with ThreadPoolExecutor(3) as pool:
        tables = list(pool.map(lambda terrain: terrain.table, terrains))
    assert len(made) == 1
    assert all(np.array_equal(table.values, tables[0].values) for table in tables)
    assert [p.suffix for p in path.parent.iterdir() if p.stem == path.stem] == [".table"]


@pytest.fixture
def tracer(monkeypatch):
    """The middles of the cells that are traced; `stop_after` so many parts, Ctrl-C follows."""
    traced, fill = SimpleNamespace(cells=[], stop_after=np.inf), cache.fill_table

    def count(ground, centres, *more):
        if len(traced.cells) >= traced.stop_after:
            raise KeyboardInterrupt
        fill(ground, centres, *more)
        traced.cells.append({tuple(centre) for centre in centres})

    monkeypatch.setattr(cache, "fill_table", count)
    monkeypatch.setattr(cache, "seconds_of_table", lambda ground: 1.0)  # which traces some
    monkeypatch.setattr(cache, "PART_CELLS", 2)
    monkeypatch.setattr(cache, "count_cores", lambda: 1)
    return traced


def test_a_stopped_build_goes_on_where_it_was(shackleton, tracer):
    terrain = replace(shackleton, camera_height_m=1.9, search_radius_m=200.0)
    terrain.prepare()
    calm, whole = terrain.table_path.read_bytes(), set().union(*tracer.cells)
    terrain.discard_table()
    tracer.cells, tracer.stop_after = [], 3
    with pytest.raises(KeyboardInterrupt):
        replace(terrain).prepare()
    before, tracer.cells, tracer.stop_after = tracer.cells, [], 1
    with pytest.raises(KeyboardInterrupt):
        replace(terrain, camera_height_m=1.91).prepare()
    assert tracer.cells == before[:1]  # nothing is taken from another table
    kept = sorted(terrain.table_path.parent.glob(f"{terrain.table_path.stem}-*"))
    assert len(kept) == 3
    kept[0].write_bytes(kept[0].read_bytes()[:-1])  # damaged
    tracer.cells, tracer.stop_after = [], np.inf
    replace(terrain).prepare()
    assert terrain.table_path.read_bytes() == calm
    assert sum(cells in before for cells in tracer.cells) == 1
    assert set().union(*before, *tracer.cells) == whole
    assert list(terrain.table_path.parent.glob(f"{terrain.table_path.stem}-*")) == []


@pytest.mark.slow
def test_each_variant_of_a_terrain_keeps_its_own_table(shackleton):
    table = shackleton.table
    higher = replace(shackleton, camera_height_m=30.0, search_radius_m=200.0)
    other = higher.table
    assert other.square.reach_m < table.square.reach_m
    assert shackleton.table is table
    assert higher.table is other
    assert replace(shackleton, height_sigma_m=3.0).table is table  # the errors are no part of it


def evidence_at(terrain, place, rng, error_rad=0.0, rays=4000) -> Evidence:
    """Rays near the skyline of a position, with large ratios, of which one in a hundred is wrong."""
    azimuth = rng.uniform(0, 2 * np.pi, rays)
    horizon = terrain.horizon_rad(np.asarray(place)[None], azimuth) + error_rad
    elevation = horizon + rng.uniform(-0.1, 0.1, rays)
    llr = np.where((elevation > horizon) ^ (rng.random(rays) < 0.01), 4.0, -4.0)
    return Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=llr, edge_sigma_rad=np.full(rays, 1e-5))


def test_a_position_is_found_within_its_stated_error(shackleton):
    exact = replace(shackleton, height_sigma_m=0.0, horizon_sigma_common_rad=0.0, waves_sigma_rad=EXACT_WAVES)
    rng, nees = np.random.default_rng(4), []
    for _ in range(4):
        place = rng.uniform(-300, 300, 2)
        fix = ExactPosterior()(evidence_at(exact, place, rng), exact)
        off = fix.position_enu_m[:2] - place
        assert np.hypot(*off) < fix.radius999_m < 25.0
        nees.append(off @ np.linalg.solve(fix.covariance_m2, off))
        assert fix.position_enu_m[2] == pytest.approx(exact.ground_m(fix.position_enu_m[None, :2])[0] + 1.5)
    assert 0.3 < np.mean(nees) < 5


def test_a_common_error_is_estimated_with_the_position_and_widens_its_covariance(shackleton):
    rng, place, error = np.random.default_rng(5), np.array([420.0, -130.0]), np.radians(0.08)
    evidence = evidence_at(shackleton, place, rng, error)
    unknown = replace(shackleton, height_sigma_m=0.0, horizon_sigma_common_rad=np.radians(0.1))
    known = replace(unknown, horizon_sigma_common_rad=0.0)
    fix = ExactPosterior()(evidence, unknown)
    assert np.hypot(*(fix.position_enu_m[:2] - place)) < fix.radius999_m
    assert fix.horizon_error_rad == pytest.approx(error, abs=np.radians(0.02))
    told = ExactPosterior()(replace(evidence, elevation_rad=evidence.elevation_rad - error), known)
    assert np.trace(fix.covariance_m2) > np.trace(told.covariance_m2)


def test_sigma_follows_from_posts_and_distance(shackleton):
    sigma = replace(shackleton, height_sigma_m=5.0).errors.sigma_rad(np.zeros((1, 2)), np.array([0.5]))
    horizon = shackleton.horizon_rad(np.zeros((1, 2)), np.array([0.5]))
    assert sigma[0] == pytest.approx(5.0 * np.cos(horizon[0]) ** 2 / 10_000, rel=0.1)  # the crest is some 10 km off


def test_rays_that_run_off_the_map_give_no_evidence(shackleton):
    inner = shackleton.maps[0].crop_around(shackleton.site.latitude_rad, shackleton.site.longitude_rad, 4000.0)
    small = replace(shackleton, maps=(inner,), search_radius_m=300.0)
    azimuth = np.radians(np.arange(0, 360, 5.0))
    assert not small.is_informative(azimuth, small.horizon_rad(np.zeros(2), azimuth)).any()
    assert small.is_informative(azimuth, np.full(len(azimuth), np.radians(80.0))).all()
    assert shackleton.is_informative(azimuth, np.zeros(len(azimuth))).all()
    low = small.horizon_rad(np.zeros(2), azimuth)
    assert set(small.mask_reason(azimuth, low)) == {"ground off the map"}
    assert set(small.mask_reason(azimuth, np.full(len(azimuth), np.radians(80.0)))) == {""}
    (line,) = small.warnings()
    assert line.startswith("azimuths 0 to 360 degrees: the maps end")
    assert shackleton.warnings() == []
    blind = evidence_at(small, np.zeros(2), np.random.default_rng(6), -0.2)
    with pytest.raises(NotLocated):
        ExactPosterior()(blind, small)


def test_glare_removes_the_evidence_of_its_azimuths(shackleton):
    lit = replace(shackleton, glare_rad=((np.radians(350), np.radians(20)),))
    told = lit.is_informative(np.radians([349.0, 351.0, 0.0, 19.0, 21.0, 180.0]), np.full(6, 0.5))
    assert told.tolist() == [True, False, False, False, True, True]
    why = lit.mask_reason(np.radians([349.0, 351.0]), np.full(2, 0.5))
    assert why.tolist() == ["", "glare of a lit rim"]
    (line,) = lit.warnings()
    assert line.startswith("azimuths 350 to 20 degrees: no evidence")


@pytest.mark.parametrize("first_m", [3120.0, 3600.0, 4080.0, 9840.0])
def test_a_void_near_the_search_area_is_the_nearest_end_of_wide_maps(first_m):
    """One of 720 m on a map of 290 km; the ground between posts of which one is a void is not known."""
    post_m, half = 240.0, 600
    heights = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.float32)
    column = half + round(first_m / post_m)
    heights[half - 2 : half + 3, column : column + 3] = np.nan
    projection = Projection(kind=STEREOGRAPHIC, latitude_rad=SITE.latitude_rad, longitude_rad=SITE.longitude_rad)
    raster = Raster(
        heights_m=heights, dx_m=post_m, dy_m=-post_m, projection=projection, x0_m=-half * post_m, y0_m=half * post_m
    )
    wide = HeightMap(name="wide", site=SITE, maps=(raster,), search_radius_m=2800.0)
    facts = facts_of_ends(wide, np.full(360, -np.pi / 2))
    assert abs(facts["nearest_azimuth_deg"] - 90) < 20  # one of those that see it
    assert -1.0 <= facts["nearest_m"] - (first_m - post_m) <= post_m + 1.0


def test_azimuths_where_the_maps_end_are_listed_as_ranges(shackleton):
    """A map that ends close by in the east and far off elsewhere."""
    whole = shackleton.maps[0].crop_around(shackleton.site.latitude_rad, shackleton.site.longitude_rad, 30_000.0)
    azimuth = np.radians(np.arange(0.5, 360))
    place = np.zeros(2)
    for columns in (slice(0, whole.heights_m.shape[1] // 2 + 20), slice(None)):
        cut = replace(shackleton, maps=(whole.crop(slice(None), columns),), search_radius_m=200.0)
        silent = ~cut.is_informative(azimuth, cut.horizon_rad(place, azimuth))
        lines = cut.warnings()
        assert bool(lines) == bool(silent.any())
        said = np.zeros(360, dtype=bool)
        for line in lines:
            first, last = (int(word) for word in line.split(" degrees")[0].removeprefix("azimuths ").split(" to "))
            said[np.arange(first, last if last > first else last + 360) % 360] = True
        assert not np.any(silent & ~said)
        assert (columns == slice(None)) == (not lines)


@pytest.mark.parametrize(
    "projection",
    [
        polar_stereographic(),
        polar_stereographic(south=False, longitude_rad=0.3, true_scale_latitude_rad=np.radians(80)),
        Projection(kind=STEREOGRAPHIC, latitude_rad=0.4, longitude_rad=-1.0, scale=0.99, false_x_m=10.0),
        Projection(kind=ORTHOGRAPHIC, latitude_rad=np.radians(8.12), longitude_rad=np.radians(-38.01)),
        Projection(kind=EQUIRECTANGULAR, longitude_rad=3.0, scale=0.9, false_y_m=-5.0),
    ],
    ids=lambda p: f"{p.kind}-{p.latitude_rad:.1f}",
)
def test_projections_are_those_of_proj(projection):
    pyproj = pytest.importorskip("pyproj")
    p = projection
    words = {
        STEREOGRAPHIC: f"+proj=stere +lat_0={np.degrees(p.latitude_rad)} +k_0={p.scale}",
        ORTHOGRAPHIC: f"+proj=ortho +lat_0={np.degrees(p.latitude_rad)}",
        EQUIRECTANGULAR: f"+proj=eqc +lat_ts={np.degrees(np.arccos(min(p.scale, 1.0)))}",
    }[p.kind]
    words += f" +lon_0={np.degrees(p.longitude_rad)} +x_0={p.false_x_m} +y_0={p.false_y_m} +R=1737400"
    rng = np.random.default_rng(7)
    near = (
        np.clip(p.latitude_rad + rng.uniform(-0.2, 0.2, 50), -1.55, 1.55),
        p.longitude_rad + rng.uniform(-0.3, 0.3, 50),
    )
    x, y = pyproj.Proj(words)(np.degrees(near[1]), np.degrees(near[0]))
    found = p.xy_from_latlon(*near)
    assert found[0] == pytest.approx(np.array(x), abs=1e-4)
    assert found[1] == pytest.approx(np.array(y), abs=1e-4)
    back = p.latlon_from_xy(*found)
    assert back[0] == pytest.approx(near[0], abs=1e-12)
    assert np.sin(back[1] - near[1]) == pytest.approx(0, abs=1e-11)


def test_ground_is_the_maps_height_on_the_sphere():
    flat = Raster(
        heights_m=np.full((60, 60), -1000.0, dtype=np.float32), projection=polar_stereographic(), x0_m=-15_000.0,
        y0_m=15_000.0, dx_m=500.0, dy_m=-500.0,
    )  # fmt: skip
    terrain = HeightMap(name="flat", site=Site("moon", -np.pi / 2, 0.0), maps=(flat,), search_radius_m=5000.0)
    ground = terrain.ground_m(np.array([[0.0, 0.0], [3000.0, 4000.0]]))
    assert ground[0] == pytest.approx(-1000.0, abs=1e-6)
    assert ground[1] == pytest.approx(np.sqrt(1_736_400.0**2 - 5000.0**2) - 1_737_400.0, abs=1e-3)
    there = replace(terrain, camera_height_m=300.0)  # no ground beyond the map's end, 20 km off
    assert there.horizon_rad(np.zeros(2), np.array([np.pi / 4]))[0] == pytest.approx(-0.0205, abs=0.001)
    # On a smooth sphere the horizon dips by sqrt(2 h / R); here seen to where the map ends or beyond
    dip = terrain.horizon_rad(np.zeros(2), np.array([1.0]))[0]
    assert dip == pytest.approx(-np.sqrt(2 * 1.5 / 1_736_400.0), rel=2e-2)
