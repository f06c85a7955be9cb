"""The best level skyline of a sector, from which its likelihood counts."""

from __future__ import annotations

import numpy as np
import pytest
from localization_helpers import slow_contributions
from scipy.special import ndtr

from startrack.core.types import Evidence
from startrack.localization.sector_likelihood import Sectors


@pytest.mark.parametrize("strength", [0.5, 80.0])
def test_the_ceiling_of_extended_light_is_the_best_level_skyline(strength: float) -> None:
    """A soft edge beats every sum of whole rows: by hundreds of nats where the sky is bright."""
    rng = np.random.default_rng(3)
    n = 900
    azimuth, elevation = rng.uniform(0, np.radians(4.5), n), 0.2 + rng.uniform(-0.01, 0.01, n)
    sigma = np.full(n, 0.0015)
    fraction = ndtr((elevation - 0.2) / sigma)
    value = fraction * np.sqrt(strength) + rng.standard_normal(n)
    evidence = Evidence(
        azimuth_rad=azimuth, elevation_rad=elevation, llr=value * np.sqrt(strength) - strength / 2,
        edge_sigma_rad=sigma, extended_nats=np.full(n, strength),
    )  # fmt: skip
    sectors = Sectors.from_evidence(evidence, np.radians(1.5), 1e-4)
    level = np.linspace(0.19, 0.21, 2001)
    each = slow_contributions(evidence, elevation - level[:, None], sigma)
    for s in range(3):
        best = each[:, sectors.sector == s].sum(axis=1).max()
        assert sectors.ceiling[s] == pytest.approx(best, abs=0.02 * np.sqrt(strength))
    assert not sectors.ceiling[3:].any()
