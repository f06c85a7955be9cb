"""What a fix would be without each group of directions: contradictions are refused, and the level bounds the error."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from test_localization_refinement import CRATER, PX_PER_RAD, sky_rows
from test_localization_shape import TRUE, evidence_at

from startrack.evidence.sky_light import MIDDLES_RAD
from startrack.localization import ExactPosterior, Integrity
from startrack.localization.integrity import (
    COARSE,
    DIVISIONS,
    GROUPS,
    NEGLIGIBLE_SIGMAS,
    RISK,
    WRONG_GROUP,
    _assess,
    _divide,
    _grid,
    _GridScores,
    _match_grid,
    _moments,
    assess_integrity,
)
from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.refinement import refine_fix
from startrack.output import result_dict, verbose_text
from startrack.output.schema import SCHEMAS
from startrack.terrain import Cylinder
from startrack.types import Array, Bools, Evidence, Fix, NotLocated

SECTORS = 240
WIDTH_RAD = 2 * np.pi / GROUPS


def linear_rows(seed: int) -> tuple[Array, Array]:
    """Slopes (SECTORS, 2) [1/m] of normalised rows, and their residuals (SECTORS,) at the middle."""
    rng = np.random.default_rng(seed)
    azimuth = 2 * np.pi * (np.arange(SECTORS) + 0.5) / SECTORS
    slopes = np.stack([np.cos(azimuth), 0.6 * np.sin(azimuth)], axis=1) * rng.uniform(0.02, 0.08, (SECTORS, 1))
    return slopes, rng.standard_normal(SECTORS)


def least_squares(slopes: Array, residual: Array) -> tuple[Array, Array]:
    return np.linalg.lstsq(slopes, residual, rcond=None)[0], np.linalg.inv(slopes.T @ slopes)


def fix_with(covariance_m2: Array) -> Fix:
    fix = ExactPosterior()(evidence_at((3000.0, -2000.0), 1), TRUE)
    return replace(fix, covariance_m2=covariance_m2, radius999_m=1e-3)


@pytest.mark.parametrize("shared_m2", [0.0, 4.0])
def test_of_a_normal_posterior_they_are_the_solutions_of_least_squares(shared_m2: float) -> None:
    """Against numpy's least squares without the rows of each group; `shared_m2` is an error of all directions."""
    slopes, residual = linear_rows(1)
    best, covariance = least_squares(slopes, residual)
    fix = fix_with(covariance + shared_m2 * np.eye(2))
    found = _assess(lambda at: -0.5 * np.square(residual - (at + best) @ slopes.T), covariance, _divide(SECTORS), fix)
    assert len(found.first_azimuth_rad) == DIVISIONS * GROUPS
    middle, levels = 2 * np.pi * (np.arange(SECTORS) + 0.5) / SECTORS, []
    for first, separation, chi2 in zip(found.first_azimuth_rad, found.separation_m, found.chi2, strict=True):
        rest = (middle - first) % (2 * np.pi) > WIDTH_RAD
        assert np.count_nonzero(rest) == SECTORS - SECTORS // GROUPS
        without, its_covariance = least_squares(slopes[rest], residual[rest])
        assert separation == pytest.approx(without - best, abs=1e-3)
        scatter = its_covariance - covariance + shared_m2 * np.eye(2) + NEGLIGIBLE_SIGMAS**2 * fix.covariance_m2
        assert chi2 == pytest.approx(separation @ np.linalg.solve(scatter, separation), rel=1e-2)
        largest = np.linalg.eigvalsh(its_covariance + shared_m2 * np.eye(2))[1]
        levels.append(np.linalg.norm(without - best) + np.sqrt(2 * np.log(2 * WRONG_GROUP / RISK) * largest))
    assert found.protection_level_m == pytest.approx(max(levels), rel=1e-3)
    assert found.part.sum() == pytest.approx(1.0)


def test_every_obstacle_of_thirty_degrees_is_wholly_in_a_group() -> None:
    groups = _divide(SECTORS) > 0
    assert (groups.sum(axis=0) == DIVISIONS).all()
    wide = SECTORS // 12
    for first in range(SECTORS):
        assert groups[:, (first + np.arange(wide)) % SECTORS].all(axis=1).any()


def assess(rows: Evidence) -> tuple[Fix, Integrity]:
    fix = ExactPosterior()(rows, TRUE)
    return fix, assess_integrity(rows, fix.position_enu_m[:2], fix.covariance_m2, fix, TRUE)


def error_m(fix: Fix, place_m: tuple[float, float]) -> float:
    return float(np.linalg.norm(fix.position_enu_m[:2] - place_m))


def random_places(seed: int, count: int) -> list[tuple[float, float]]:
    rng = np.random.default_rng(seed)
    radius, angle = 8000 * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return [(float(r * np.cos(a)), float(r * np.sin(a))) for r, a in zip(radius, angle, strict=True)]


def test_true_positions_are_within_the_level_and_not_refused() -> None:
    ratios = []
    for number, place in enumerate(random_places(1, 40)):
        fix, found = assess(evidence_at(place, number))
        assert error_m(fix, place) <= found.protection_level_m
        assert found.protection_level_m >= fix.radius999_m
        ratios.append(found.protection_level_m / fix.radius999_m)
    assert np.median(ratios) < 3.0
    assert np.mean(np.isfinite(ratios)) > 0.85


class _WestOnly(Cylinder):
    """The thesis's crater, east of a line too steep for a rover."""

    def allowed(self, points_m: Array) -> Bools:
        return super().allowed(points_m) & (np.asarray(points_m)[..., 0] <= EASTERN_LIMIT_M)


EASTERN_LIMIT_M = 3000.0


def test_positions_that_are_not_allowed_do_not_count() -> None:
    """Half of a normal posterior is beyond the limit: the mean of the other half is at sqrt(2 / pi) sigma."""
    covariance, fine = np.array([[9.0, 2.0], [2.0, 4.0]]), (6.0, 41)
    offsets_m, is_rim = _grid(covariance, *fine, lambda at: at[:, 0] <= 0.0)
    log = -0.5 * np.einsum("ni,ij,nj->n", offsets_m, np.linalg.inv(covariance), offsets_m)
    (mean,), (spread,) = _moments(offsets_m, log[:, None])
    assert mean[0] == pytest.approx(-3.0 * np.sqrt(2 / np.pi), abs=0.5)
    assert spread[0, 0] < 0.5 * covariance[0, 0]
    assert len(offsets_m) == len(is_rim) < len(_grid(covariance, *fine, lambda at: at[:, 0] < np.inf)[0])


def test_a_position_beside_ground_that_is_not_allowed() -> None:
    west = _WestOnly(**{field.name: getattr(TRUE, field.name) for field in fields(TRUE) if field.init})
    rows = evidence_at((EASTERN_LIMIT_M - 1.0, -2000.0), 1)
    fix = ExactPosterior()(rows, TRUE)
    east_m = {}
    for terrain in (west, TRUE):
        scores = _GridScores(PositionLikelihood.from_evidence(rows, terrain))
        centre_m, covariance_m2, by_sector = _match_grid(scores, fix.position_enu_m[:2], fix.covariance_m2)
        offsets_m, _ = _grid(covariance_m2, *COARSE, lambda at, c=centre_m, t=terrain: t.allowed(c + at))
        assert len(offsets_m) == len(by_sector)
        east_m[type(terrain)] = centre_m[0] + _moments(offsets_m, by_sector.sum(axis=1)[:, None])[0][0][0]
    assert east_m[_WestOnly] < min(east_m[Cylinder], EASTERN_LIMIT_M)


def test_errors_with_an_obstacle_are_refused_or_within_the_level() -> None:
    """Rows over 40 degrees, hidden up to 3 degrees above the skyline."""
    rng, refused, far = np.random.default_rng(3), 0, 0
    for number, place in enumerate(random_places(2, 24)):
        rows, first = evidence_at(place, number), rng.uniform(0, 2 * np.pi)
        above = rows.elevation_rad - TRUE.horizon_rad(np.array([place]), rows.azimuth_rad)
        behind = ((rows.azimuth_rad - first) % (2 * np.pi) < np.radians(40)) & (above > 0) & (above < np.radians(3))
        rows = replace(rows, llr=np.where(behind, -np.abs(rows.llr), rows.llr))
        try:
            fix, found = assess(rows)
        except NotLocated:
            refused += 1
            continue
        assert error_m(fix, place) <= found.protection_level_m
        far += error_m(fix, place) > fix.radius999_m
    assert refused + far > 0  # else the obstacles would show nothing


def refined(rows: Evidence, place: Array) -> Fix:
    return refine_fix(rows, fix_with(np.eye(2)), CRATER, place, 9.0 * np.eye(2), np.zeros((2, 2)), 0.0)


@pytest.mark.parametrize(("raised_px", "is_refused"), [(0.0, False), (0.7, False), (1.5, True)])
def test_a_skyline_raised_over_forty_degrees_is_within_the_level_or_refused(raised_px: float, is_refused: bool) -> None:
    """Cells of the sky's light; at 1.5 px the error is twice the radius of the 99.9 % circle."""
    place = np.array([3000.0, -2000.0])
    rows = sky_rows(place, np.random.default_rng(4), 20.0)
    behind = (rows.azimuth_rad - np.radians(100)) % (2 * np.pi) < np.radians(40)
    moved = replace(rows, elevation_rad=rows.elevation_rad + behind * raised_px / PX_PER_RAD)
    fix = refined(moved, place)
    if not is_refused:
        found = assess_integrity(moved, fix.position_enu_m[:2], fix.covariance_m2, fix, CRATER)
        assert error_m(fix, (3000.0, -2000.0)) <= found.protection_level_m < 2 * fix.radius999_m
        return
    assert error_m(fix, (3000.0, -2000.0)) > 1.5 * fix.radius999_m
    with pytest.raises(NotLocated, match=r"without the azimuths \d+ to \d+ degrees") as refusal:
        assess_integrity(moved, fix.position_enu_m[:2], fix.covariance_m2, fix, CRATER)
    assert refusal.value.reason == "inconsistent_evidence"
    first = int(str(refusal.value).split("azimuths ")[1].split()[0])
    assert 85 <= first <= 115


@pytest.mark.parametrize(("groups", "is_bounded"), [([2, 4], True), ([6], False)])
def test_the_groups_named_are_those_that_hold_the_rows(groups: list[int], is_bounded: bool) -> None:
    place = np.array([3000.0, -2000.0])
    rows = sky_rows(place, np.random.default_rng(5), 20.0)
    part = rows.take(np.isin((rows.azimuth_rad / WIDTH_RAD).astype(int), groups))
    assert len(np.unique(part.azimuth_rad)) == len(groups) * len(MIDDLES_RAD) // GROUPS
    fix = refined(part, place)
    found = assess_integrity(part, fix.position_enu_m[:2], fix.covariance_m2, fix, CRATER)
    assert set(found.carriers()) <= set(groups)
    assert found.part[groups].sum() == pytest.approx(1.0, abs=1e-6)
    assert np.isfinite(found.protection_level_m) == is_bounded


def test_a_guess_of_the_covariance_does_not_matter() -> None:
    place = np.array([3000.0, -2000.0])
    rows = sky_rows(place, np.random.default_rng(6), 20.0)
    fix, levels = refined(rows, place), []
    for factor in (0.05, 1.0, 30.0):
        levels.append(assess_integrity(rows, place, factor * fix.covariance_m2, fix, CRATER).protection_level_m)
    assert levels == pytest.approx([levels[1]] * 3, rel=0.02)


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
    integrity = None if level_m is None else replace(located.result.integrity, protection_level_m=level_m)
    record = result_dict(replace(located.result, integrity=integrity))
    Draft202012Validator(SCHEMAS["fix"]).validate(json.loads(json.dumps(record)))
    assert record["position"]["protection_level_m"] is None
    assert (record["position"]["carried_by"] is None) == (level_m is None)
