"""The compiled kernels of terrain against slow references in plain numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from map_helpers import SITE
from scipy.ndimage import zoom

from startrack.kernels.library import kernel
from startrack.terrain import STEREOGRAPHIC, Cylinder, HeightMap, Projection, Raster
from startrack.terrain.cylinder import distance_to_circle
from startrack.terrain.ground import ground_up_m, pack_maps, surfaces
from startrack.terrain.horizon_table import (
    ANGLE_STEP_RAD,
    AZIMUTH_BINS,
    NO_TABLE,
    _largest_of_cells,
    box_bounds,
    sector_bounds,
    trace_horizons,
)

EYE_M = 2.0
pytestmark = pytest.mark.usefixtures("own_cache")


def grid(posts, post_m, heights):
    """A map about the site."""
    half = posts // 2 * post_m
    projection = Projection(kind=STEREOGRAPHIC, latitude_rad=SITE.latitude_rad, longitude_rad=SITE.longitude_rad)
    return Raster(
        heights_m=heights.astype(np.float32), source="rough", projection=projection, dx_m=post_m, dy_m=-post_m,
        x0_m=-half, y0_m=half,
    )  # fmt: skip


@pytest.fixture(scope="module")
def ground() -> HeightMap:
    """A fine map in the middle of a coarse one of the same bilinear ground: no step is between them. A ridge around."""
    line = np.arange(-20, 21) / 3.0
    hills = np.random.default_rng(2).normal(size=(11, 11))
    away = np.hypot(*np.meshgrid(line, line))
    coarse = grid(41, 120.0, 25.0 * zoom(hills, 4.1, order=3)[2:43, 2:43] + 250.0 * np.exp(-((away - 4.0) ** 2)))
    at = np.stack(np.meshgrid(*2 * [14.0 + np.arange(49) / 4.0], indexing="ij"), axis=-1)
    maps = grid(49, 30.0, coarse.sample(at)), coarse
    return HeightMap(name="rough", site=SITE, maps=maps, search_radius_m=100.0, camera_height_m=EYE_M)


def march(ground, points, azimuths, sag, step_m=1.0, far_m=4000.0):
    """Tangent (n,) of the horizon, and the first distance (n,) at which no map has a height, in small steps."""
    s = np.arange(step_m, far_m, step_m)
    up = ground_up_m(ground.site, ground.maps, points) + EYE_M
    tan, edge = np.empty((2, len(points)))
    for k, (point, azimuth) in enumerate(zip(points, azimuths, strict=True)):
        z = ground_up_m(ground.site, ground.maps, point + s[:, None] * np.array([np.sin(azimuth), np.cos(azimuth)]))
        end = np.argmax(np.isnan(z)) if np.isnan(z).any() else len(s)
        tan[k] = ((z[:end] - up[k]) / s[:end] + sag * s[:end]).max()
        edge[k] = s[end] if end < len(s) else np.inf
    return tan, edge


def trace(packed, points, azimuths):
    """Tangents, distances and edges (3, n) by the kernel."""
    found = np.empty((3, len(points)))
    trace_horizons(packed.record, NO_TABLE.record, EYE_M, True, points, azimuths, *found)
    return found


@pytest.mark.parametrize("count", [0, 1, 500])
def test_surfaces_are_those_of_the_maps(ground, count):
    points = np.random.default_rng(count).uniform(-2000.0, 2000.0, (count, 2))
    found = np.empty(count)
    surfaces(ground.ground.record, points, found)
    np.testing.assert_allclose(found, ground_up_m(SITE, ground.maps, points), atol=2e-3)


def test_beyond_the_maps_the_ground_is_level(ground):
    found = np.empty(2)
    surfaces(ground.ground.record, np.array([[9000.0, 0.0], [np.nan, 0.0]]), found)
    np.testing.assert_array_equal(found, 0.0)


@pytest.mark.parametrize("sag", [0.0, 1e-5])
def test_horizons_and_the_ends_of_maps_are_those_of_small_steps(ground, sag):
    rng = np.random.default_rng(4)
    points, azimuths = rng.uniform(-100.0, 100.0, (25, 2)), rng.uniform(-1.0, 7.0, 25)
    tan, distance, edge = trace(replace(ground.ground, sag_per_m=sag), points, azimuths)
    expected, ends = march(ground, points, azimuths, sag)
    np.testing.assert_allclose(tan, expected, atol=5e-3)
    assert (tan > expected - 1e-4).all() and np.median(tan - expected) < 2e-4
    reached = edge < 1e9
    np.testing.assert_allclose(edge[reached], ends[reached], atol=4.0)
    assert (distance <= np.where(reached, edge, 5000.0)).all()


def test_a_trace_ends_at_a_void(ground):
    heights = ground.maps[0].heights_m.copy()
    heights[:18] = np.nan  # from 180 m north of the middle on
    one = replace(ground, maps=(replace(ground.maps[0], heights_m=heights),), search_radius_m=50.0)
    points, azimuths = np.zeros((40, 2)), np.linspace(-1.2, 1.2, 40)
    tan, _, edge = trace(pack_maps(SITE, one.maps, keep_voids=True), points, azimuths)
    expected, ends = march(one, points, azimuths, 0.0)
    assert (edge < 1e9).sum() > 5
    reached = edge < 1e9
    before = ends[reached] - edge[reached]
    assert (before > -1.0).all() and (before < 43.0).all()  # across a cell
    np.testing.assert_allclose(tan[~reached], expected[~reached], atol=5e-3)


@pytest.mark.parametrize("half_m", [0.0, 1.0, 12.0])
def test_bounds_hold_the_horizons_beside_the_edge_of_a_map(ground, half_m):
    """Beside it the ground of a ray and its sight line may lie on different maps."""
    rng = np.random.default_rng(6)
    centres = np.column_stack([rng.uniform(-700.0, 700.0, 300), rng.choice([-700.0, 735.0], 300)])
    azimuths, turn = rng.uniform(0.0, 2 * np.pi, 300), rng.choice([0.0, 4e-3], 300)
    packed, (low, high) = ground.ground, np.empty((2, 300))
    fixed = packed.record, NO_TABLE.record, EYE_M
    box_bounds(*fixed, centres, np.full(300, half_m), azimuths, turn, low, high)
    for _ in range(20):
        points = centres + rng.uniform(-half_m, half_m, (300, 2))
        found = np.arctan(trace(packed, points, azimuths + turn * rng.uniform(-1.0, 1.0, 300))[0])
        assert (low - 3e-5 <= found).all()  # a trace misses kinks of the ground by up to 5 cm of its way
        assert (found <= high + 1e-6).all()


@pytest.mark.parametrize("level", [0, 1, 2])
def test_bounds_over_large_boxes_are_those_of_the_blocks_they_touch(ground, level):
    rng = np.random.default_rng(level)
    across = 4 >> level
    lows, highs = np.sort(rng.integers(0, 65_000, (2, across, across, AZIMUTH_BINS)).astype(np.uint16), axis=0)
    square = replace(NO_TABLE.square, reach_m=100.0, across=4)
    table = replace(NO_TABLE, square=square, values=np.zeros((16, AZIMUTH_BINS, 11), np.uint16))
    centres, half = rng.uniform(-110.0, 110.0, (30, 2)), np.full(30, 110.0 / across)
    azimuths, turn = rng.uniform(-7.0, 7.0, (30, 2)), rng.choice([0.0, 0.02, 4.0], (30, 2))
    low, high = np.empty((2, 30, 2))
    sector_bounds(ground.ground.record, table.record, lows, highs, EYE_M, azimuths, turn, centres, half, low, high)
    edges = np.linspace(-100.0, 100.0, across + 1)
    for k in range(30):
        rows, columns = (
            [n for n in range(across) if edges[n] < at + half[k] and edges[n + 1] > at - half[k]]
            for at in np.clip(centres[k], -100.0, 100.0)
        )
        for m in range(2):
            ends = (azimuths[k, m] + turn[k, m] * np.array([-1.0, 1.0])) * AZIMUTH_BINS / (2 * np.pi)
            bins = np.arange(np.floor(ends[0]), max(np.ceil(ends[1]), np.floor(ends[0]) + 1)).astype(int) % AZIMUTH_BINS
            cells = np.ix_(rows, columns, bins)
            assert low[k, m] == lows[cells].min() * ANGLE_STEP_RAD - np.pi / 2
            assert high[k, m] == highs[cells].max() * ANGLE_STEP_RAD - np.pi / 2


def test_interpolated_horizons_are_bilinear_between_the_nodes(ground):
    rng = np.random.default_rng(8)
    azimuths = np.sort(rng.uniform(0.0, 6.0, 7))
    near = ground.near(np.array([10.0, -20.0]), 30.0, azimuths)
    points = near.centre_m + rng.uniform(-30.0, 30.0, (40, 2))
    nodes, per_height, middle, *_ = near.nodes
    x, y = ((points - near.centre_m) / 30.0 + 1.0).T
    i, j = np.minimum(x.astype(int), 1), np.minimum(y.astype(int), 1)
    west, east = ((j + 1 - y) * nodes[:, n, j] + (y - j) * nodes[:, n, j + 1] for n in (i, i + 1))
    tan = (i + 1 - x) * west + (x - i) * east - per_height[:, None] * (ground.ground_m(points) - middle)
    np.testing.assert_allclose(near.horizon_rad(points[:, None], azimuths), np.arctan(tan).T, atol=1e-12)
    assert near.horizon_rad(np.empty((0, 1, 2)), azimuths).shape == (0, 7)


def test_the_rim_of_a_circle_stands_at_its_distance():
    crater, rng = Cylinder(diameter_m=8000.0, depth_m=900.0, camera_height_m=1.5), np.random.default_rng(9)
    points, azimuths = rng.uniform(-5000.0, 5000.0, (300, 2)), rng.uniform(-7.0, 7.0, 50)
    expected = np.arctan2(898.5, distance_to_circle(points[:, None], azimuths, 4000.0))
    np.testing.assert_allclose(crater.horizon_rad(points[:, None], azimuths), expected, rtol=1e-9)


@pytest.mark.parametrize("rows", [1, 20])
def test_the_largest_of_cells_and_bins(rows):
    rng = np.random.default_rng(rows)
    values, bins = rng.normal(size=(6, 6, 9)).astype(np.float32), rng.integers(0, 9, (rows, 3, 2))
    first = rng.integers(0, 6, (20, 1, 2))
    cells = np.concatenate([first, np.minimum(first + rng.integers(0, 3, (20, 1, 2)), 5)], axis=1)
    cells[5:8] = cells[4]
    found = np.empty((20, 3))
    _largest_of_cells(values, cells, bins, found)
    for k, ((i0, j0), (i1, j1)) in enumerate(cells):
        block = values[i0 : i1 + 1, j0 : j1 + 1]
        expected = [max(block[..., own].max(), 0.0) for own in bins[min(k, rows - 1)]]
        np.testing.assert_array_equal(found[k], expected)


def test_the_maps_of_another_program_are_no_ground(ground):
    call = kernel("surfaces", "ground: ground", "points: float64[n, 2]", "up: out float64[n]")
    with pytest.raises(TypeError, match="record ground"):
        call(NO_TABLE.record, np.zeros((1, 2)), np.zeros(1))
