"""A crater of uncertain depth and width: estimated with the position; a wrong shape is refused."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from startrack.localization import ExactPosterior, check_consistency
from startrack.localization.consistency import MIN_EXPLAINED_NATS, SureRows
from startrack.localization.explored import Explored
from startrack.localization.nuisance import marginalize_shape
from startrack.terrain import Cylinder, Terrain, load_terrain
from startrack.types import Evidence, NotLocated

TRUE = load_terrain("shackleton-thesis")
PLACES = [(3000.0, -2000.0), (-6500.0, 1000.0), (500.0, 400.0)]


def evidence_at(place_m: tuple[float, float], seed: int) -> Evidence:
    """Six thousand stars over the sky, each with a noisy flux measurement: SNR 1 to 8."""
    assert isinstance(TRUE, Cylinder)
    rng = np.random.default_rng(seed)
    n = 6000
    azimuth, elevation = 2 * np.pi * rng.random(n), np.arcsin(rng.random(n))
    snr = 8 * rng.random(n) ** 2 + 1
    visible = elevation > TRUE.horizon_rad(np.array([place_m]), azimuth)
    flux = snr * visible + rng.standard_normal(n)
    llr = np.clip(snr * flux - snr**2 / 2, -9, 9)
    return Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=llr, edge_sigma_rad=np.zeros(n))


@pytest.mark.parametrize("place_m", PLACES)
def test_the_true_crater_is_consistent(place_m: tuple[float, float]) -> None:
    evidence = evidence_at(place_m, 1)
    check_consistency(evidence, ExactPosterior()(evidence, TRUE), TRUE)


@pytest.mark.parametrize("stretch", [0.96, 1.04])
@pytest.mark.parametrize("place_m", PLACES)
def test_a_crater_too_deep_or_shallow_is_refused(place_m: tuple[float, float], stretch: float) -> None:
    assert isinstance(TRUE, Cylinder)
    evidence, wrong = evidence_at(place_m, 2), replace(TRUE, depth_m=stretch * TRUE.depth_m)
    fix = ExactPosterior()(evidence, wrong)
    with pytest.raises(NotLocated, match=r"horizon about .* time") as refusal:
        check_consistency(evidence, fix, wrong)
    assert refusal.value.reason == "inconsistent_evidence"


@pytest.mark.parametrize("place_m", PLACES)
def test_an_uncertain_depth_is_found_with_the_position(place_m: tuple[float, float]) -> None:
    assert isinstance(TRUE, Cylinder)
    evidence = evidence_at(place_m, 3)
    guess = replace(TRUE, depth_m=TRUE.depth_m + 25.0, depth_sigma_m=20.0)
    method = ExactPosterior()
    fix, fit = method(evidence, guess), method.fit_shape(evidence, guess)
    crater = guess.reshaped(fit.shape)
    assert np.linalg.norm(fix.position_enu_m[:2] - place_m) < fix.radius999_m < 200
    depth_sigma_m = guess.depth_m * np.sqrt(fit.covariance[0, 0])
    assert abs(crater.depth_m - TRUE.depth_m) < 4 * depth_sigma_m
    assert depth_sigma_m < 6
    assert crater.diameter_m == pytest.approx(guess.diameter_m)


def test_the_size_of_a_crater_is_not_estimated() -> None:
    # A crater twice as large and as deep has the same horizon: only the ratio is measured, the scale stays as given.
    assert isinstance(TRUE, Cylinder)
    evidence = evidence_at((4000.0, 3000.0), 4)
    guess = replace(TRUE, depth_sigma_m=20.0, diameter_sigma_m=200.0, search_radius_m=11000.0)
    method = ExactPosterior()
    fix, fit = method(evidence, guess), method.fit_shape(evidence, guess)
    assert np.linalg.norm(fix.position_enu_m[:2] - [4000, 3000]) < fix.radius999_m
    # 1 % of 5 km, narrowed by what the two priors say together of the common scale: 1 % / sqrt(2).
    assert 25 < np.sqrt(np.trace(fix.covariance_m2)) < 50
    assert np.sqrt(fit.covariance[0, 0]) < 0.003  # of depth over diameter


def test_a_position_that_explains_the_stars_badly_is_refused() -> None:
    """The evidence of one position, and a fix elsewhere that no single star contradicts clearly."""
    evidence = evidence_at(PLACES[0], seed=3)
    fix = ExactPosterior()(evidence, TRUE)
    assert SureRows.at_fix(evidence, fix, TRUE).explained_by_sector.mean() > -1.0
    aside = replace(fix, position_enu_m=fix.position_enu_m + np.array([1500.0, 0.0, 0.0]))
    assert SureRows.at_fix(evidence, aside, TRUE).explained_by_sector.mean() < MIN_EXPLAINED_NATS
    with pytest.raises(NotLocated, match=r"explains the strongest rows badly.*most at azimuths"):
        check_consistency(evidence, aside, TRUE)


class BiasedCylinder(Cylinder):
    """A cylinder whose horizon may be too low as a whole, too."""

    common_sigma_rad = float(np.radians(0.03))


def test_an_uncertain_shape_and_a_horizon_bias_are_estimated_together() -> None:
    assert isinstance(TRUE, Cylinder)
    bias_rad = np.radians(0.02)
    evidence = evidence_at(PLACES[0], 4)
    raised = replace(evidence, elevation_rad=evidence.elevation_rad + bias_rad)
    values = {field.name: getattr(TRUE, field.name) for field in fields(TRUE)}
    guess = BiasedCylinder(**values | {"depth_sigma_m": 20.0})
    fix, shape_only = ExactPosterior()(raised, guess), ExactPosterior()(raised, replace(TRUE, depth_sigma_m=20.0))
    assert np.linalg.norm(fix.position_enu_m[:2] - PLACES[0]) < fix.radius999_m < 200
    assert fix.horizon_error_rad != 0.0 == shape_only.horizon_error_rad


def test_a_shape_that_nothing_explains_has_no_share() -> None:
    assert isinstance(TRUE, Cylinder)
    evidence, guess = evidence_at(PLACES[1], 5), replace(TRUE, depth_sigma_m=3.0)
    whole = ExactPosterior()(evidence, guess)
    explored_on: list[Terrain] = []

    def explore_all_but_the_first(evidence: Evidence, terrain: Terrain) -> Explored:
        explored_on.append(terrain)
        if len(explored_on) == 1:
            raise NotLocated("no position explains the stars", reason="inconsistent_evidence")
        return ExactPosterior().explore(evidence, terrain)

    explored, _ = marginalize_shape(explore_all_but_the_first, evidence, guess)
    likeliest = explored.centres_m[np.argmax(explored.log_likelihood)]
    assert np.linalg.norm(likeliest - whole.position_enu_m[:2]) < whole.radius999_m

    def refuse(evidence: Evidence, terrain: Terrain) -> Explored:
        raise NotLocated("no position explains the stars", reason="inconsistent_evidence")

    with pytest.raises(NotLocated, match="no position explains"):
        marginalize_shape(refuse, evidence, guess)


@pytest.mark.parametrize("coverage_deg", [30.0, 60.0])
def test_errors_of_the_horizon_in_a_part_of_the_view_are_refused(coverage_deg: float) -> None:
    """Directions without stars do not count as explained."""
    refused = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        at = np.array([2500.0, -1800.0])
        azimuth, elevation = rng.uniform(0, np.radians(coverage_deg), 6000), np.arcsin(rng.random(6000))
        sector_error = np.radians(0.4) * rng.standard_normal(240)
        horizon = TRUE.horizon_rad(at[None], azimuth) + sector_error[(azimuth / (2 * np.pi) * 240).astype(int)]
        snr = 8 * rng.random(6000) ** 2 + 1
        flux = snr * (elevation > horizon) + rng.standard_normal(6000)
        llr = np.clip(snr * flux - snr**2 / 2, -9, 9)
        evidence = Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=llr)
        try:
            check_consistency(evidence, ExactPosterior()(evidence, TRUE), TRUE)
        except NotLocated:
            refused += 1
    assert refused == 6
