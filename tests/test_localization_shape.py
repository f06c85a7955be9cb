"""A crater of uncertain depth and width: estimated with the position; a wrong shape is refused."""

from __future__ import annotations

from copy import copy
from dataclasses import fields, replace

import numpy as np
import pytest

from startrack.core.types import Array, Evidence, NotLocated
from startrack.localization import ExactPosterior
from startrack.localization.importance_sampling import moments
from startrack.localization.joint_posterior import sample_posterior
from startrack.localization.likelihood.shared_errors import SharedErrors
from startrack.terrain import Cylinder, GroundErrors, load_terrain

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
    for seed in range(1, 6):
        fix = ExactPosterior()(evidence_at(place_m, seed), TRUE)
        assert np.linalg.norm(fix.position_enu_m[:2] - place_m) < fix.radius999_m


@pytest.mark.parametrize("stretch", [0.96, 1.04])
@pytest.mark.parametrize("place_m", PLACES)
def test_a_crater_too_deep_or_shallow_is_refused(place_m: tuple[float, float], stretch: float) -> None:
    assert isinstance(TRUE, Cylinder)
    evidence, wrong = evidence_at(place_m, 2), replace(TRUE, depth_m=stretch * TRUE.depth_m)
    with pytest.raises(NotLocated, match=r"(unlike the map's|on no map) .* time") as refusal:
        ExactPosterior()(evidence, wrong)
    assert refusal.value.reason == "inconsistent_evidence"


def shared_of(guess: Cylinder, evidence: Evidence) -> tuple[Array, Array]:
    """Mean (k,) of the errors of the shape by the evidence, and their standard deviations."""
    method = ExactPosterior()
    found = sample_posterior(evidence, method.explore(evidence, guess), guess)[0]
    mean, covariance = moments(found.values, np.exp(found.copies_log_weight - found.copies_log_weight.max()))
    return mean, np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("place_m", PLACES)
def test_an_uncertain_depth_is_found_with_the_position(place_m: tuple[float, float]) -> None:
    assert isinstance(TRUE, Cylinder)
    evidence = evidence_at(place_m, 3)
    guess = replace(TRUE, depth_m=TRUE.depth_m + 25.0, depth_sigma_m=20.0)
    fix = ExactPosterior()(evidence, guess)
    assert np.linalg.norm(fix.position_enu_m[:2] - place_m) < fix.radius999_m < 200
    (deeper,), (sigma,) = shared_of(guess, evidence)
    depth_m, depth_sigma_m = guess.depth_m * (1 + deeper), guess.depth_m * sigma
    assert abs(depth_m - TRUE.depth_m) < 4 * depth_sigma_m
    assert depth_sigma_m < 6


def test_the_size_of_a_crater_is_not_estimated() -> None:
    # A crater twice as large and as deep has the same horizon: only the ratio is measured, the scale stays as given.
    assert isinstance(TRUE, Cylinder)
    evidence = evidence_at((4000.0, 3000.0), 4)
    guess = replace(TRUE, depth_sigma_m=20.0, diameter_sigma_m=200.0, search_radius_m=11000.0)
    fix = ExactPosterior()(evidence, guess)
    assert np.linalg.norm(fix.position_enu_m[:2] - [4000, 3000]) < fix.radius999_m
    # 1 % of 5 km, narrowed by what the two priors say together of the common scale: 1 % / sqrt(2).
    assert 25 < np.sqrt(np.trace(fix.covariance_m2)) < 50


class BiasedCylinder(Cylinder):
    """A cylinder whose horizon may be too low as a whole, too."""

    @property
    def errors(self) -> GroundErrors:
        errors = copy(super().errors)
        errors.__dict__["common_sigma_rad"] = float(np.radians(0.03))
        return errors


def test_an_uncertain_shape_and_a_horizon_bias_are_estimated_together() -> None:
    assert isinstance(TRUE, Cylinder)
    bias_rad = np.radians(0.02)
    evidence = evidence_at(PLACES[0], 4)
    raised = replace(evidence, elevation_rad=evidence.elevation_rad + bias_rad)
    values = {field.name: getattr(TRUE, field.name) for field in fields(TRUE)}
    guess = BiasedCylinder(**values | {"depth_sigma_m": 20.0})
    fix = ExactPosterior()(raised, guess)
    assert np.linalg.norm(fix.position_enu_m[:2] - PLACES[0]) < fix.radius999_m < 200


@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 6), marks=pytest.mark.slow)], ids=["one", "five"])
@pytest.mark.parametrize("coverage_deg", [30.0, 60.0])
def test_errors_of_the_horizon_in_a_part_of_the_view_are_refused(coverage_deg: float, seeds: range) -> None:
    """Directions without stars do not count as explained."""
    refused = 0
    for seed in seeds:
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
            ExactPosterior()(evidence, TRUE)
        except NotLocated:
            refused += 1
    assert refused == len(seeds)


def test_an_error_of_the_width_scales_the_position_with_the_crater() -> None:
    """Seen from positions before the scaling, the skyline rises as the slopes say; `with_shape` makes the ground."""
    assert isinstance(TRUE, Cylinder)
    silent = replace(TRUE, depth_sigma_m=1.0, diameter_sigma_m=1.0, ellipse_sigma_1=0.0, rim_tilt_sigma_rad=0.0)
    errors, azimuth, place = SharedErrors.of(silent, None), np.linspace(0.0, 6.0, 50), np.array([4000.0, -5000.0])
    level = silent.horizon_rad(place[None], azimuth).ravel()
    by_name = dict(
        zip((one.name for one in silent.errors.shape), silent.errors.slopes_rad(place, azimuth), strict=True)
    )
    slopes = errors.slopes_rad(silent, place, azimuth, level, by_name)
    for number, one in enumerate(errors.listed):
        values = 1e-3 * (np.arange(len(errors)) == number)
        (moved,) = errors.true_positions(place[None], values[None])
        named = {error.name: value for error, value in zip(errors.listed, values, strict=True)}
        ground = silent.with_shape(np.array([named.get(error.name, 0.0) for error in silent.errors.shape]))
        rise = ground.horizon_rad(moved[None], azimuth).ravel() - level
        np.testing.assert_allclose(rise, 1e-3 * slopes[number], atol=2e-3 * np.abs(rise).max(), err_msg=one.name)
        assert np.allclose(moved, place * (1.001 if one.name == "diameter_1" else 1.0))
