"""What a fix would be without each group of directions: contradictions are refused, and the level bounds the error."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from localization_helpers import locate_or_refuse
from test_localization_refinement import CRATER, PX_PER_RAD, sky_rows
from test_localization_shape import TRUE, evidence_at

from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Bools, Explored, Fix
from startrack.localization import ExactPosterior
from startrack.localization.integrity import DIVISIONS, GROUPS, RISK, WRONG_GROUP, _divide
from startrack.output import SCHEMAS, result_dict, verbose_text
from startrack.terrain import Cylinder

WIDTH_RAD = 2 * np.pi / GROUPS


def test_every_obstacle_of_thirty_degrees_is_wholly_in_a_group() -> None:
    groups = _divide() > 0
    assert (groups.sum(axis=0) == DIVISIONS).all()
    wide = SECTORS // 12
    for first in range(SECTORS):
        assert groups[:, (first + np.arange(wide)) % SECTORS].all(axis=1).any()


def error_m(fix: Fix, place_m: tuple[float, float]) -> float:
    return float(np.linalg.norm(fix.position_enu_m[:2] - place_m))


def random_places(seed: int, count: int) -> list[tuple[float, float]]:
    rng = np.random.default_rng(seed)
    radius, angle = 8000 * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return [(float(r * np.cos(a)), float(r * np.sin(a))) for r, a in zip(radius, angle, strict=True)]


@pytest.mark.slow
def test_true_positions_are_within_the_level_and_not_refused() -> None:
    ratios = []
    for number, place in enumerate(random_places(1, 40)):
        fix = ExactPosterior()(evidence_at(place, number), TRUE)
        assert fix.integrity is not None
        level_m = fix.integrity.protection_level_m
        assert error_m(fix, place) <= level_m
        assert level_m >= fix.radius999_m
        ratios.append(level_m / fix.radius999_m)
    assert np.median(ratios) < 3.0
    assert np.mean(np.isfinite(ratios)) > 0.85


@pytest.mark.parametrize("groups", [[2], [2, 4], [0, 3, 6]])
def test_a_level_without_a_group_is_that_of_the_fix_without_its_rows(groups: list[int]) -> None:
    """Sky's light of nearly normal errors: the separation is that of a fix from the other rows."""
    place = np.array([3000.0, -2000.0])
    rows = sky_rows(place, np.random.default_rng(7), 20.0)
    whole = ExactPosterior()(rows, CRATER)
    assert whole.integrity is not None
    sigma = np.sqrt(np.trace(whole.covariance_m2))
    for group in groups:
        first = whole.integrity.first_azimuth_rad[group]
        rest = rows.take((rows.azimuth_rad - first) % (2 * np.pi) > WIDTH_RAD)
        without = ExactPosterior()(rest, CRATER)
        separation = (without.position_enu_m - whole.position_enu_m)[:2]
        assert whole.integrity.separation_m[group] == pytest.approx(separation, abs=0.25 * sigma)
        spread = np.sqrt(2 * np.log(2 * WRONG_GROUP / RISK) * np.linalg.eigvalsh(without.covariance_m2)[1])
        assert whole.integrity.protection_level_m > 0.9 * (np.linalg.norm(separation) + spread)


class _WestOnly(Cylinder):
    """The thesis's crater, east of a line too steep for a rover."""

    def allowed(self, points_m: Array) -> Bools:
        return super().allowed(points_m) & (np.asarray(points_m)[..., 0] <= EASTERN_LIMIT_M)


EASTERN_LIMIT_M = 3000.0


def test_a_position_beside_ground_that_is_not_allowed() -> None:
    west = _WestOnly(**{field.name: getattr(TRUE, field.name) for field in fields(TRUE) if field.init})
    place = (EASTERN_LIMIT_M - 1.0, -2000.0)
    rows = evidence_at(place, 1)
    limited, free = ExactPosterior()(rows, west), ExactPosterior()(rows, TRUE)
    assert limited.position_enu_m[0] < min(free.position_enu_m[0], EASTERN_LIMIT_M)
    assert limited.integrity is not None
    held = limited.integrity.separation_m[np.isfinite(limited.integrity.separation_m[:, 0])]
    assert (limited.position_enu_m[0] + held[:, 0]).max() < EASTERN_LIMIT_M + 0.1 * limited.radius95_m
    assert error_m(limited, place) <= limited.integrity.protection_level_m


@pytest.mark.slow
def test_errors_with_an_obstacle_are_refused_or_within_the_level() -> None:
    """Rows over 40 degrees, hidden up to 3 degrees above the skyline: most fixes are right, and none is beyond."""
    rng, right = np.random.default_rng(3), 0
    for number, place in enumerate(random_places(2, 24)):
        rows, first = evidence_at(place, number), rng.uniform(0, 2 * np.pi)
        above = rows.elevation_rad - TRUE.horizon_rad(np.array([place]), rows.azimuth_rad)
        behind = ((rows.azimuth_rad - first) % (2 * np.pi) < np.radians(40)) & (above > 0) & (above < np.radians(3))
        rows = replace(rows, llr=np.where(behind, -np.abs(rows.llr), rows.llr))
        fix, _ = locate_or_refuse(rows, TRUE)
        if fix is None:
            continue
        assert fix.integrity is None or error_m(fix, place) <= fix.integrity.protection_level_m
        right += error_m(fix, place) < fix.radius999_m
    assert right >= 22


@pytest.mark.parametrize("raised_px", [0.0, 0.7, 1.5, 6.0])
def test_a_skyline_raised_over_forty_degrees_is_within_the_level_or_refused(raised_px: float) -> None:
    """Cells of the sky's light."""
    place = np.array([3000.0, -2000.0])
    rows = sky_rows(place, np.random.default_rng(4), 20.0)
    behind = (rows.azimuth_rad - np.radians(100)) % (2 * np.pi) < np.radians(40)
    moved = replace(rows, elevation_rad=rows.elevation_rad + behind * raised_px / PX_PER_RAD)
    fix, reason = locate_or_refuse(moved, CRATER)
    if fix is None:
        assert reason == "inconsistent_evidence" and raised_px
        return
    assert fix.integrity is not None
    assert error_m(fix, (3000.0, -2000.0)) <= fix.integrity.protection_level_m < 4 * fix.radius999_m


@pytest.mark.parametrize(("groups", "is_bounded"), [([2, 4], True), ([6], False)])
def test_the_groups_named_are_those_that_hold_the_rows(groups: list[int], is_bounded: bool) -> None:
    place = np.array([3000.0, -2000.0])
    line = np.linspace(-120.0, 120.0, 25)
    about = Explored(
        place + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2), 5.0, np.zeros(625), 0.0, "proven"
    )
    rows = replace(sky_rows(place, np.random.default_rng(5), 60.0), support=about)
    part = rows.take(np.isin((rows.azimuth_rad / WIDTH_RAD).astype(int), groups))
    assert len(np.unique(part.azimuth_rad)) == len(groups) * len(MIDDLES_RAD) // GROUPS
    fix = ExactPosterior()(part, CRATER)
    found = fix.integrity
    assert found is not None
    assert set(found.carriers()) <= set(groups)
    assert found.part[groups].sum() == pytest.approx(1.0, abs=1e-6)
    assert np.isfinite(found.protection_level_m) == is_bounded


def test_results_state_the_level(located) -> None:
    record = result_dict(located.result)
    Draft202012Validator(SCHEMAS["fix"]).validate(json.loads(json.dumps(record)))
    position = record["position"]
    assert position["protection_level_m"] >= position["radius999_m"]
    assert position["protection_risk"] == RISK
    assert all(last - first == 45.0 for first, last in position["carried_by"])
    assert 1 <= len(position["carried_by"]) <= GROUPS // 2
    assert f"protection {position['protection_level_m']:.1f} m" in " ".join(verbose_text(located.result).split())


@pytest.mark.parametrize("level_m", [np.inf, None])
def test_an_unknown_level_is_null(located, level_m: float | None) -> None:
    """Infinite: one group alone holds the fix; None: not assessed."""
    integrity = None if level_m is None else replace(located.result.fix.integrity, protection_level_m=level_m)
    record = result_dict(replace(located.result, fix=replace(located.result.fix, integrity=integrity)))
    Draft202012Validator(SCHEMAS["fix"]).validate(json.loads(json.dumps(record)))
    assert record["position"]["protection_level_m"] is None
    assert (record["position"]["carried_by"] is None) == (level_m is None)
