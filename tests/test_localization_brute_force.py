"""The exact posterior against a plain sum over a fine grid, and the thesis's methods against the thesis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from localization_helpers import search_scores, slow_chain_scores
from scipy.spatial import cKDTree
from scipy.stats import norm

from startrack.core.types import Evidence, Fix, NotLocated
from startrack.localization import ExactPosterior, Hull, PseudoGradient
from startrack.localization.likelihood.skyline_profiles import ROW_NATS
from startrack.localization.search import BEAMS, BoxModel, Proof, log_sum, search_boxes
from startrack.localization.thesis_methods import descend, points_of_rays
from startrack.terrain import Cylinder, load_terrain

THESIS = load_terrain("shackleton-thesis")
assert isinstance(THESIS, Cylinder)
PIT = replace(THESIS, diameter_m=200.0, depth_m=40.0, camera_height_m=0.0, search_radius_m=100.0)
FLOOR_STEP_M, FINE_STEP_M = 2.0, 0.5  # of the grid over the whole floor, and of one about the position
SECTORS = 240  # of 1.5 degrees


def grid(step_m: float = 1.0) -> np.ndarray:
    line = np.arange(-100.0, 100.0, step_m) + step_m / 2
    x, y = np.meshgrid(line, line)
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    return places[np.hypot(*places.T) < 100.0]


def shares(log: np.ndarray) -> np.ndarray:
    """Weights (n,) of sum one, of log-likelihoods (n,)."""
    weight = np.exp(log - log.max())
    return np.asarray(weight / weight.sum())


def log_likelihood(places: np.ndarray, evidence: Evidence) -> np.ndarray:
    """That of the search by sectors, from g - M, g the sum of log(V e^l + 1 - V), written out."""
    below, best = np.zeros((len(places), SECTORS)), np.zeros(SECTORS)
    sector = (evidence.azimuth_rad / (2 * np.pi) * SECTORS).astype(int)
    for s in np.unique(sector):
        gain, ceiling, running = np.zeros(len(places)), 0.0, 0.0
        rays = np.flatnonzero(sector == s)
        for i in rays[np.argsort(-evidence.elevation_rad[rays])]:
            a, e, llr = (
                evidence.azimuth_rad[i],
                evidence.elevation_rad[i],
                np.clip(evidence.llr[i], -ROW_NATS, ROW_NATS),
            )
            along = places @ [np.sin(a), np.cos(a)]
            reach = -along + np.sqrt(along**2 + 100.0**2 - np.sum(places**2, axis=1))  # to the wall
            above = e - np.arctan2(40.0, reach)
            sigma = evidence.edge_sigma_rad[i]
            visible = norm.cdf(above / sigma) if sigma > 0 else (above > 0).astype(float)
            gain += np.log(visible * np.exp(llr) + 1 - visible)
            running += llr
            ceiling = max(ceiling, running)
        below[:, s], best[s] = gain - ceiling, ceiling
    return search_scores(below, best)


def simulate_rays(at_m: np.ndarray, n: int, sigma_rad: float, rng: np.random.Generator) -> Evidence:
    """Rays of signal-to-noise ratio 1 to 4, measured from a position."""
    azimuth, elevation = 2 * np.pi * rng.random(n), np.radians(rng.uniform(5, 75, n))
    snr = rng.uniform(1, 4, n)
    edge = elevation + sigma_rad * rng.normal(size=n)
    light = snr * (edge > PIT.horizon_rad(at_m[None], azimuth)) + rng.normal(size=n)
    return Evidence(
        azimuth_rad=azimuth, elevation_rad=elevation, llr=np.clip(snr * light - snr**2 / 2, -9, 9),
        edge_sigma_rad=np.full(n, sigma_rad),
    )  # fmt: skip


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))])
def test_any_small_problem_agrees_with_the_grid(seed: int) -> None:
    """The whole floor, so that no other place is left out."""
    rng = np.random.default_rng(seed)
    evidence = simulate_rays(rng.uniform(-60, 60, 2), 500, 0.0, rng)
    fix, floor = ExactPosterior()(evidence, PIT), grid(FLOOR_STEP_M)
    at, sigma = fix.position_enu_m[:2], np.sqrt(np.trace(fix.covariance_m2))
    weight = shares(slow_chain_scores(floor, evidence, PIT, at))
    assert fix.dropped_probability < 1e-3
    assert weight[np.linalg.norm(floor - at, axis=1) > 1.1 * fix.radius999_m + FLOOR_STEP_M].sum() < 3e-3
    assert len(fix.modes) == 1 and sigma < 3.0
    line = np.arange(-20.0, 20.0) * FINE_STEP_M
    near = weight @ floor + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    weight, close = shares(slow_chain_scores(near, evidence, PIT, at)), np.linalg.norm(near - at, axis=1)
    mean = weight @ near
    spread = np.einsum("n,ni,nj->ij", weight, near - mean, near - mean)
    # Cells narrower than a step are the grid's own error.
    assert np.linalg.norm(at - mean) < 0.1 * sigma + 0.5 * FINE_STEP_M
    assert fix.covariance_m2 == pytest.approx(spread, abs=0.15 * sigma**2 + FINE_STEP_M**2)
    assert weight[close < 1.1 * fix.radius95_m + FINE_STEP_M].sum() > 0.94
    assert weight[close < 0.85 * fix.radius95_m - FINE_STEP_M].sum() < 0.96


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_the_search_leaves_the_boxes_that_matter(seed: int) -> None:
    """Whatever share is dropped by the search's own likelihood is below its bound, for every threshold."""
    rng = np.random.default_rng(seed)
    evidence = simulate_rays(rng.uniform(-50, 50, 2), 120, 0.0, rng)
    places = grid()
    weight = shares(log_likelihood(places, evidence))
    for nats in (12.0, 20.0, 60.0):
        model = BoxModel.of(evidence, PIT)
        proof = Proof(model, prune_nats=nats, budget_horizons=np.inf)
        found = proof.run(model.fit_places(*model.last_boxes(*BEAMS[0]), most=1))
        assert found is not None
        kept = cKDTree(found.centres_m).query(places, p=np.inf)[0] <= found.half_m
        total = log_sum(found.log_weight) + np.log(4 * found.half_m**2)
        admitted = np.exp(proof.log_dropped - np.logaddexp(proof.log_dropped, total))
        assert weight[~kept].sum() <= admitted + 0.01
    explored, _ = search_boxes(evidence, PIT, 60.0, np.inf)
    kept = cKDTree(explored.centres_m).query(places, p=np.inf)[0] <= explored.half_m
    assert weight[~kept].sum() <= explored.dropped_probability + 0.01


@pytest.mark.parametrize("n", [1, 5, 7])
def test_a_few_rays_are_refused(n: int) -> None:
    evidence = simulate_rays(np.zeros(2), n, 0.0, np.random.default_rng(1))
    with pytest.raises(NotLocated, match=f"only {n} rays") as caught:
        ExactPosterior()(evidence, PIT)
    assert caught.value.reason == "insufficient_geometry"


def thesis_list(rng: np.random.Generator) -> tuple[Evidence, np.ndarray]:
    """2142 stars, uniform over the sky, and which of them are visible from a position uniform on the floor."""
    azimuth, elevation = 2 * np.pi * rng.random(2142), np.arcsin(rng.random(2142))
    r, turn = THESIS.radius_m * np.sqrt(rng.random()), 2 * np.pi * rng.random()
    at = r * np.array([np.sin(turn), np.cos(turn)])
    seen = elevation > THESIS.horizon_rad(at[None], azimuth)
    llr = np.where(seen, 9.0, -9.0)
    return Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=llr, edge_sigma_rad=np.zeros(2142)), at


def errors_of(method: Hull | PseudoGradient, draws: int) -> np.ndarray:
    def error(fix: Fix, at: np.ndarray) -> float:
        return float(np.linalg.norm(fix.position_enu_m[:2] - at))

    pairs = [thesis_list(np.random.default_rng([7, k])) for k in range(draws)]
    return np.array([error(method(evidence, THESIS), at) for evidence, at in pairs])


def test_the_hull_is_as_far_off_as_in_the_thesis() -> None:
    """Kua 2008, section 3.1.1: mean 637 m, s.d. 275 m, at most 1735 m."""
    errors = errors_of(Hull(), 400)
    assert errors.mean() == pytest.approx(637, rel=0.08)
    assert errors.std() == pytest.approx(275, rel=0.25)
    assert errors.max() < 2200


def test_the_pseudo_gradient_is_as_good_as_in_the_thesis() -> None:
    """Kua 2008, table 3.1: mean 34.2 m, s.d. 31.1 m, at most 358 m; 0.6 % never settle."""
    errors = errors_of(PseudoGradient(), 300)
    assert 24 < errors.mean() < 38
    assert errors.std() < 40
    assert np.percentile(errors, 99) < 200


def test_a_settled_descent_has_reproduced_the_list() -> None:
    settled = 0
    for k in range(60):
        evidence, at = thesis_list(np.random.default_rng([8, k]))
        points = points_of_rays(THESIS.wall_m, evidence.azimuth_rad, evidence.elevation_rad)
        seen = evidence.llr > 0
        place, done = descend(points, seen, at + np.array([200.0, -300.0]), THESIS.radius_m, 1.0, 400)
        settled += done
        if done:
            assert np.array_equal(evidence.elevation_rad > THESIS.horizon_rad(place[None], evidence.azimuth_rad), seen)
    assert settled >= 57
