"""Azimuths that something on no map blocks: found in rows of stars, and of no harm to a fix."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from localization_helpers import locate_or_refuse
from test_localization_shape import evidence_at

from startrack.catalog import load_catalog
from startrack.chain import pipeline
from startrack.core.types import Array, Evidence, Fix
from startrack.evidence.star_photometer import visibility_llr
from startrack.localization import ExactPosterior
from startrack.output import result_dict
from startrack.terrain import load_terrain

CRATER = load_terrain("shackleton-thesis")
POSITION_M, NEAR_WALL_M = np.array([3000.0, -4500.0]), np.array([-5000.0, -7500.0])


def rows_seen(seed: int, raised_rad: Any, position_m: Array = POSITION_M) -> Evidence:
    """Rows of stars of 0.5 to 50 sigma above a skyline that is higher by `raised_rad` of the azimuth."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(0, 2 * np.pi, 12_000), np.arcsin(rng.random(12_000))
    snr = 0.5 * rng.random(12_000) ** -0.9
    horizon = CRATER.horizon_rad(position_m[None], azimuth) + raised_rad(azimuth)
    flux = np.where(elevation > horizon, snr, 0.0) + rng.standard_normal(12_000)
    one = np.ones(12_000)
    return Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=visibility_llr(flux, snr, one, one))


def ridge(height_deg: float, from_deg: float, to_deg: float) -> Any:
    def raised(azimuth: Array) -> Array:
        a = np.degrees(azimuth)
        inside = (a - from_deg) % 360 < (to_deg - from_deg) % 360
        return np.where(inside, np.radians(height_deg), 0.0)

    return raised


def triangle(height_deg: float, width_deg: float, middle_deg: float) -> Any:
    """A rise of the skyline that is highest in its middle."""

    def raised(azimuth: Array) -> Array:
        away = np.abs((np.degrees(azimuth) - middle_deg + 180) % 360 - 180)
        return np.radians(height_deg) * np.maximum(1.0 - away / (width_deg / 2), 0.0)

    return raised


def error_m(fix: Fix, place_m: Array) -> float:
    return float(np.linalg.norm(fix.position_enu_m[:2] - place_m))


@pytest.mark.parametrize("seed", [*range(8), *(pytest.param(k, marks=pytest.mark.slow) for k in range(8, 20))])
def test_nothing_is_blocked_where_the_map_is_right(seed):
    fix = ExactPosterior()(rows_seen(seed, ridge(0, 0, 1)), CRATER)
    assert fix.blocked is None
    assert error_m(fix, POSITION_M) < fix.radius999_m


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(("height_deg", "ends_deg"), [(8, (40, 90)), (3, (200, 240)), (10, (340, 20))])
def test_a_ridge_is_found_with_its_azimuths_and_moves_no_fix(seed, height_deg, ends_deg):
    fix = ExactPosterior()(rows_seen(seed, ridge(height_deg, *ends_deg)), CRATER)
    assert error_m(fix, POSITION_M) < fix.radius999_m < 120.0
    ((start, end),) = np.degrees(fix.blocked.ranges_rad)
    for measured, true in ((start, ends_deg[0]), (end, ends_deg[1])):
        assert abs((true - measured + 180) % 360 - 180) <= 3.0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_ridge_of_a_hundred_degrees_is_refused_or_moves_no_fix(seed):
    fix, reason = locate_or_refuse(rows_seen(seed, ridge(3, 200, 300)), CRATER)
    assert reason in (None, "inconsistent_evidence")
    assert fix is None or error_m(fix, POSITION_M) < fix.radius999_m


@pytest.mark.parametrize(
    ("height_deg", "width_deg", "middle_deg"),
    [
        (1.0, 110, 154),
        pytest.param(1.0, 50, 259, marks=pytest.mark.slow),
        pytest.param(0.8, 60, 214, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_a_low_ridge_moves_no_fix(height_deg, width_deg, middle_deg):
    for seed in (3, 4, 5):
        fix = ExactPosterior()(rows_seen(seed, triangle(height_deg, width_deg, middle_deg), NEAR_WALL_M), CRATER)
        assert error_m(fix, NEAR_WALL_M) < fix.radius999_m
        if fix.blocked is not None:
            assert 2 * np.pi * fix.blocked.likely.mean() < np.radians(width_deg + 3)


@pytest.mark.slow
def test_a_skyline_that_rises_over_most_of_the_horizon_is_refused_or_wide() -> None:
    for seed in (1, 2, 3):
        fix, reason = locate_or_refuse(rows_seen(seed, triangle(1.0, 300, 90)), CRATER)
        assert reason in (None, "inconsistent_evidence")
        assert fix is None or error_m(fix, POSITION_M) < fix.radius999_m


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_ground_below_the_map_is_found_with_its_azimuths(seed):
    fix = ExactPosterior()(rows_seen(seed, ridge(-3, 100, 180)), CRATER)
    ((start, end),) = np.degrees(fix.blocked.ranges_rad)
    assert abs(start - 100) <= 4.0
    assert abs(end - 180) <= 4.0
    assert error_m(fix, POSITION_M) < fix.radius999_m


@pytest.mark.parametrize("width_deg", [20, 80, 120])
def test_the_search_keeps_the_true_box_behind_wide_obstacles(width_deg: float) -> None:
    """The model charges an obstacle once, the search each of its sectors: the slack covers the difference."""
    rng = np.random.default_rng(width_deg)
    for height_deg in (0.4, 3.0, 8.0):
        place, start = rng.uniform(-6000, 6000, 2), rng.uniform(0, 360)
        rows = rows_seen(int(rng.integers(1000)), ridge(height_deg, start, (start + width_deg) % 360), place)
        found = ExactPosterior().explore(rows, CRATER)
        assert found.search == "proven"
        assert np.abs(found.centres_m - place).max(axis=1).min() <= found.half_m


def test_a_fix_beside_a_blocked_quarter_is_right(located: Any) -> None:
    known = located.result
    pixels = known.exposure.pixels_adu.copy()
    pixels[:512, :512] = 100.0 + np.rint(2.0 * np.random.default_rng(1).standard_normal((512, 512)))
    exposure = replace(known.exposure, pixels_adu=pixels)
    result = pipeline.locate(exposure, known.camera, known.terrain, load_catalog().brighter_than(7.0))
    assert result.status == "ok", result.message
    assert error_m(result.fix, located.truth.position_enu_m[:2]) < result.fix.radius999_m
    blocked = result_dict(result)["evidence"]["blocked"]
    assert 60.0 < sum((b - a) % 360 for a, b in blocked) < 140.0
    assert any("not the map's skyline" in text for text in result.warnings)
    assert result.fix.blocked.contain(result.photometry.azimuth_rad).any()


@pytest.mark.parametrize(
    "width_deg", [60, pytest.param(90, marks=pytest.mark.slow), pytest.param(120, marks=pytest.mark.slow), 180]
)
@pytest.mark.parametrize("place_m", [(6000.0, -2500.0), (500.0, 400.0), (-4000.0, 5000.0)])
def test_a_wall_to_the_zenith_moves_no_fix(place_m, width_deg):
    """Up to 90 degrees the position is found; behind a wider wall it may be refused, but is not wrong."""
    for seed in range(2):
        rows = evidence_at(place_m, seed)
        behind = np.degrees(rows.azimuth_rad) < width_deg
        fix, _ = locate_or_refuse(replace(rows, llr=np.where(behind, -np.abs(rows.llr), rows.llr)), CRATER)
        assert fix is not None or width_deg > 90
        if fix is not None:
            assert error_m(fix, np.array(place_m)) < fix.radius999_m
            assert 360 * fix.blocked.likely.mean() == pytest.approx(width_deg, abs=6.0)


def test_a_blocked_half_gives_a_wide_circle_or_no_position(located: Any) -> None:
    known = located.result
    rows = known.evidence()
    lost = replace(rows, llr=np.where(rows.azimuth_rad < np.pi, -np.abs(rows.llr), rows.llr))
    fix, _ = locate_or_refuse(lost, known.terrain)
    if fix is None:
        return
    assert error_m(fix, located.truth.position_enu_m[:2]) < fix.radius999_m
    assert fix.radius95_m > known.fix.radius95_m
