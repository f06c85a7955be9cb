"""Skylines as polygons, their chains in bins, and positions by votes."""

from dataclasses import replace

import numpy as np
import pytest

from startrack.applications.reproduction.published.polygons import (
    BEARING_BINS,
    ELEVATION_BIN_RAD,
    LENGTH_BIN,
    chains_of,
    keys_of,
    near_keys,
    polygon_vertices,
)
from startrack.applications.reproduction.published.skylines import MAP_STEP_M, MapGrid, lit_skyline
from startrack.applications.reproduction.published.stein_medioni import (
    ROUGH_HEADING_RAD,
    TOLERANCES_RAD,
    PolygonTable,
    locate_by_segments,
)
from startrack.applications.reproduction.simulator import crater, draw_positions
from startrack.core.types import SECTORS, NotLocated

CRATER = crater()
STEP_M = 6 * MAP_STEP_M  # of a coarse grid
PLACES = draw_positions(0, 0, 0, 12)


@pytest.fixture(scope="module")
def grid():
    return MapGrid.trace(CRATER, STEP_M)


@pytest.fixture(scope="module")
def table(grid):
    return PolygonTable.index(grid)


def split(heights, low, high, tolerance):
    """Vertices of a polygon between two points, one chord after the other."""
    line = np.interp(np.arange(low, high + 1), [low, high], heights[[low, high]])
    off = np.abs(heights[low : high + 1] - line)
    if off.max() <= tolerance:
        return {low, high}
    middle = low + int(np.argmax(off))
    return split(heights, low, middle, tolerance) | split(heights, middle, high, tolerance)


def test_polygons_are_those_of_a_chord_after_the_other():
    skylines = np.cumsum(np.random.default_rng(0).normal(0, 0.01, (20, SECTORS)), axis=1)
    tolerances = (0.05, 0.02)
    for tolerance, found in zip(tolerances, polygon_vertices(skylines, tolerances), strict=True):
        for own, skyline in zip(found, skylines, strict=True):
            top = int(np.argmax(skyline))
            heights = np.append(np.roll(skyline, -top), skyline[top]).astype(np.float32).astype(float)
            expected = {(k + top) % SECTORS for k in split(heights, 0, SECTORS, tolerance)}
            assert set(np.flatnonzero(own)) == expected


def test_a_chain_has_the_shape_of_two_segments():
    skyline = np.interp(np.arange(SECTORS), [0, 30, 50, 110], np.radians([4.0, 20.0, 10.0, 16.0]), period=SECTORS)
    (vertices,) = polygon_vertices(skyline[None], (np.radians(0.1),))
    assert set(np.flatnonzero(vertices)) == {0, 30, 50, 110}
    _, shapes = chains_of(skyline[None], vertices)
    expected = [30 * BEARING_BINS / SECTORS, 30 / LENGTH_BIN, 20 / LENGTH_BIN,
                *np.radians([4.0, 20.0, 10.0]) / ELEVATION_BIN_RAD]  # fmt: skip
    np.testing.assert_allclose(shapes[1], expected, rtol=1e-6)
    np.testing.assert_allclose(shapes[0, 1:3] * LENGTH_BIN, [SECTORS - 110, 30])


def test_near_bins_hold_every_shape_within_half_a_bin():
    rng = np.random.default_rng(1)
    for shape in rng.uniform(1.0, 11.0, (50, 6)):
        other = shape + rng.uniform(-0.49, 0.49, 6)
        assert keys_of(other[None])[0] in near_keys(shape)


def test_a_position_of_the_grid_has_the_most_votes_for_its_own_skyline(grid, table):
    for k in range(0, len(grid.points_m), 200):
        votes = table.count_votes(grid.horizon_rad[k], len(grid.points_m))
        assert votes[k] == votes.max() > 0


def test_segments_find_the_position_and_a_turn_of_the_heading(grid, table):
    """Round craters do not show the heading: an error of it turns the answer about the middle."""
    for k, place in enumerate(PLACES):
        exact = locate_by_segments(lit_skyline(place, CRATER, rng=np.random.default_rng(k)), grid, table, 0.0)
        assert np.hypot(*(exact - place)) < STEP_M
        turned = lit_skyline(place, CRATER, ROUGH_HEADING_RAD, rng=np.random.default_rng(k))
        rough = locate_by_segments(turned, grid, table)
        assert abs(np.hypot(*rough) - np.hypot(*place)) < STEP_M
        assert np.hypot(*(rough - place)) < 4 * ROUGH_HEADING_RAD * np.hypot(*place) + STEP_M


def test_a_coarse_skyline_with_gaps_is_matched_or_refused(grid, table):
    errors, gap = [], np.arange(SECTORS) % 5 != 2
    for k, place in enumerate(PLACES):
        rng = np.random.default_rng(k)
        lit = lit_skyline(place, CRATER, rng=rng)
        coarse = lit.elevation_rad + rng.normal(0.0, np.radians(0.2), SECTORS)
        skyline = replace(
            lit, elevation_rad=np.where(gap, np.nan, coarse), sigma_rad=np.where(gap, np.inf, np.radians(0.2)),
            source=np.where(gap, "", lit.source),
        )  # fmt: skip
        errors.append(np.hypot(*(locate_by_segments(skyline, grid, table, 0.0) - place)))
    assert np.median(errors) < 2500
    empty = PolygonTable(*(tuple(one[:0] for one in part) for part in (table.keys, table.positions)))
    with pytest.raises(NotLocated, match="no position has a chain"):
        locate_by_segments(skyline, grid, empty)
    assert list(TOLERANCES_RAD) == sorted(TOLERANCES_RAD, reverse=True)  # each polygon splits the one before
