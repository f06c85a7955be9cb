"""The compiled search gives the general search's answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from startrack.localization import ExactPosterior
from startrack.localization.compiled import applies
from startrack.terrain import Cylinder, load_terrain
from startrack.types import Evidence

TERRAIN = load_terrain("shackleton-thesis")


def noisy_evidence(seed: int, n: int = 1500, edge_sigma_rad: float = 0.0) -> Evidence:
    """Stars with SNR 0.5 to 6 measured from a random place."""
    assert isinstance(TERRAIN, Cylinder)
    rng = np.random.default_rng(seed)
    azimuth, elevation = 2 * np.pi * rng.random(n), np.arcsin(2 * rng.random(n) - 1)
    place = 9000 * np.sqrt(rng.random()) * np.array([1.0, 0.0])
    snr = 0.5 + 5.5 * rng.random(n)
    flux = snr * (elevation > TERRAIN.horizon_rad(place[None], azimuth)) + rng.standard_normal(n)
    return Evidence(
        azimuth_rad=azimuth,
        elevation_rad=elevation,
        llr=np.clip(snr * flux - snr**2 / 2, -9, 9),
        edge_sigma_rad=np.full(n, edge_sigma_rad),
    )


@pytest.mark.parametrize("epsilon", [0.0, 1e-4])
@pytest.mark.parametrize("seed", range(6))
def test_same_fix_as_the_general_search(seed: int, epsilon: float) -> None:
    evidence = noisy_evidence(seed)
    general = ExactPosterior(sector_epsilon=epsilon)(evidence, TERRAIN)
    compiled = ExactPosterior(sector_epsilon=epsilon, compiled=True)(evidence, TERRAIN)
    sigma = np.sqrt(np.trace(general.covariance_m2))
    assert np.linalg.norm(compiled.position_enu_m - general.position_enu_m) < 0.01 * sigma
    np.testing.assert_allclose(compiled.covariance_m2, general.covariance_m2, atol=0.02 * sigma**2)
    assert compiled.radius999_m == pytest.approx(general.radius999_m, rel=0.05)
    assert compiled.ambiguous == general.ambiguous


def test_soft_edges_are_left_to_the_general_search() -> None:
    assert applies(noisy_evidence(1), TERRAIN)
    assert not applies(noisy_evidence(1, edge_sigma_rad=1e-4), TERRAIN)


def test_rays_below_the_horizontal_never_shine_and_do_no_harm() -> None:
    evidence = noisy_evidence(3)
    above = evidence.elevation_rad > 0
    kept = Evidence(**{name: getattr(evidence, name)[above] for name in Evidence.__dataclass_fields__})
    method = ExactPosterior(compiled=True)
    with_all, without = method(evidence, TERRAIN), method(kept, TERRAIN)
    np.testing.assert_allclose(with_all.position_enu_m, without.position_enu_m, atol=1e-6)


def test_a_smaller_search_area_is_kept_to() -> None:
    assert isinstance(TERRAIN, Cylinder)
    evidence = noisy_evidence(0)
    fix = ExactPosterior(compiled=True)(evidence, TERRAIN)
    radius = float(np.hypot(*fix.position_enu_m[:2])) + 400.0
    near = ExactPosterior(compiled=True)(evidence, replace(TERRAIN, search_radius_m=radius))
    # Other boxes, the same posterior.
    sigma = np.sqrt(np.trace(fix.covariance_m2))
    np.testing.assert_allclose(near.position_enu_m, fix.position_enu_m, atol=0.1 * sigma)
