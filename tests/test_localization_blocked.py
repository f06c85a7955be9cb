"""Azimuths that something on no map blocks: found in rows of stars, and left out of a fix."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from startrack import pipeline
from startrack.blocked_view import leave_out_blocked
from startrack.catalog import load_catalog
from startrack.evidence.likelihood_ratio import visibility_llr
from startrack.localization import ExactPosterior, check_consistency, find_blocked
from startrack.localization.blocked import COUNT
from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.ridge import CENTRE_STEP, HALF_WIDTHS, HEIGHTS_RAD, level_table, rise_gains
from startrack.output.record import result_dict
from startrack.terrain import load_terrain
from startrack.types import Array, Evidence, NotLocated

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


def error_m(fix: Any) -> float:
    return float(np.linalg.norm(fix.position_enu_m[:2] - NEAR_WALL_M))


@pytest.fixture(scope="module")
def fix() -> Any:
    return ExactPosterior()(rows_seen(0, ridge(0, 0, 1)), CRATER)


@pytest.mark.parametrize("seed", range(20))
def test_nothing_is_blocked_where_the_map_is_right(fix, seed):
    assert find_blocked(rows_seen(seed, ridge(0, 0, 1)), fix, CRATER) is None


@pytest.mark.parametrize(("height_deg", "ends_deg"), [(8, (40, 90)), (3, (200, 300)), (10, (340, 20))])
def test_a_ridge_is_found_with_its_azimuths(fix, height_deg, ends_deg):
    found = find_blocked(rows_seen(1, ridge(height_deg, *ends_deg)), fix, CRATER)
    ((start, end),) = np.degrees(found.ranges_rad)
    width = (ends_deg[1] - ends_deg[0]) % 360
    for measured, true, sign in ((start, ends_deg[0], 1), (end, ends_deg[1], -1)):
        outside = sign * ((true - measured + 180) % 360 - 180)
        assert -1.5 <= outside <= 4.5 + 0.2 * width
    assert found.width_rad == pytest.approx(np.radians((end - start) % 360))


@pytest.mark.parametrize(
    ("height_deg", "width_deg", "middle_deg", "displaces"),
    [(1.0, 110, 154, True), (1.0, 50, 259, False), (0.8, 60, 214, False)],
)
def test_a_low_ridge_is_found_beside_the_fix_that_it_displaces(height_deg, width_deg, middle_deg, displaces):
    rows = rows_seen(3, triangle(height_deg, width_deg, middle_deg), NEAR_WALL_M)
    first = ExactPosterior()(rows, CRATER)
    assert (error_m(first) > first.radius999_m) == displaces
    found = find_blocked(rows, first, CRATER)
    assert found.risen and found.whole[int(middle_deg / 360 * COUNT)]
    assert found.width_rad < np.radians(width_deg + 30)
    right = ExactPosterior()(rows.take(~found.hides(rows.azimuth_rad, rows.elevation_rad)), CRATER)
    assert error_m(right) < right.radius95_m


def test_the_gain_of_a_rise_is_that_of_rows_under_a_raised_skyline(fix):
    rows = rows_seen(4, triangle(0.8, 84, 120))
    above = rows.elevation_rad - CRATER.horizon_rad(POSITION_M[None], rows.azimuth_rad)
    gains = rise_gains(level_table(rows, above, np.zeros(len(rows)), COUNT))
    step_deg = 360 / COUNT

    def score(raised: Any) -> float:
        lowered = replace(rows, elevation_rad=rows.elevation_rad - raised(rows.azimuth_rad))
        return float(PositionLikelihood.from_evidence(lowered, CRATER).exact_scores(POSITION_M[None])[0])

    plain = score(lambda azimuth: 0.0 * azimuth)
    for centre, width, height in [(20, 3, 4), (20, 2, 3), (10, 1, 2), (45, 4, 1)]:
        middle_deg = (centre * CENTRE_STEP + 0.5) * step_deg
        rise = triangle(np.degrees(HEIGHTS_RAD[height]), 2 * HALF_WIDTHS[width] * step_deg, middle_deg)
        assert gains[centre, width, height] == pytest.approx(score(rise) - plain, rel=0.2, abs=4.0)
    assert np.unravel_index(np.argmax(gains), gains.shape)[0] == pytest.approx(20, abs=1)


def test_a_skyline_that_rises_over_too_much_of_the_horizon_is_refused(located: Any) -> None:
    known = getattr(located, "result", located)
    rows, fix = known.evidence(), known.fix
    above = rows.elevation_rad - known.terrain.horizon_rad(fix.position_enu_m[None, :2], rows.azimuth_rad)
    hidden = above < triangle(1.0, 200, 90)(rows.azimuth_rad)

    class Raised:
        def __getattr__(self, name: str) -> Any:
            return getattr(known, name)

        def evidence(self) -> Evidence:
            return replace(rows, llr=np.where(hidden, -np.abs(rows.llr), rows.llr))

    with pytest.raises(NotLocated, match="higher than the map's") as refusal:
        leave_out_blocked(Raised(), fix, ExactPosterior())
    assert refusal.value.reason == "inconsistent_evidence"


def test_ground_below_the_map_is_not_blocked(fix):
    assert find_blocked(rows_seen(2, ridge(-3, 100, 180)), fix, CRATER) is None


def test_a_fix_leaves_a_ridge_out_and_is_right(located: Any) -> None:
    known = getattr(located, "result", located)
    pixels = known.exposure.pixels_adu.copy()
    pixels[:512, :512] = 100.0 + np.rint(2.0 * np.random.default_rng(1).standard_normal((512, 512)))
    exposure = replace(known.exposure, pixels_adu=pixels)
    result = pipeline.locate(exposure, known.camera, known.terrain, load_catalog().brighter_than(7.0))
    assert result.status == "ok", result.message
    error = np.hypot(*(result.fix.position_enu_m - located.truth.position_enu_m)[:2])
    assert error < result.fix.radius999_m
    blocked = result_dict(result)["evidence"]["blocked"]
    assert 60.0 < sum((b - a) % 360 for a, b in blocked) < 140.0
    assert any("blocked and left out" in text for text in result.warnings)
    hidden = result.blocked.hides(result.light.azimuth_rad, result.light.elevation_rad)
    assert hidden.any() and not result.light.usable[hidden].any()
    assert "blocked" in result.light.causes


def test_a_blocked_half_is_not_left_out(located: Any) -> None:
    known = getattr(located, "result", located)
    rows = known.evidence()
    lost = replace(rows, llr=np.where(rows.azimuth_rad < np.pi, -np.abs(rows.llr), rows.llr))

    class Blind:
        def __getattr__(self, name: str) -> Any:
            return getattr(known, name)

        def evidence(self) -> Evidence:
            return lost

    assert isinstance(leave_out_blocked(Blind(), known.fix, ExactPosterior()), Blind)
    with pytest.raises(NotLocated):
        check_consistency(lost, known.fix, known.terrain)
