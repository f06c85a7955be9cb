"""Open rays handed from whole sectors to their parts: none may be lost."""

from __future__ import annotations

import numpy as np
import pytest
from localization_helpers import slow_contributions
from scipy.special import ndtr

from startrack.localization.prefix_sums import PrefixSums
from startrack.localization.sector_likelihood import Sectors
from startrack.types import Evidence


def test_every_open_ray_of_a_sector_is_open_in_its_part():
    rng = np.random.default_rng(1)
    evidence = Evidence(
        azimuth_rad=rng.uniform(0, 2 * np.pi, 20_000), elevation_rad=rng.uniform(-0.1, 1.5, 20_000),
        llr=rng.normal(0, 5, 20_000), edge_sigma_rad=np.zeros(20_000),
    )  # fmt: skip
    sectors = Sectors.from_evidence(evidence, np.radians(1.5), 1e-4)
    whole, parts = PrefixSums.from_sectors(sectors), PrefixSums.from_sectors(sectors, 4)
    begins = np.concatenate([[0], whole.ends[:-1]])
    first = begins + rng.integers(0, whole.ends - begins + 1, (30, len(begins)))
    last = first + rng.integers(0, whole.ends - first + 1)
    handed = parts.split(whole, first, last)
    for box in range(len(first)):
        open_whole = np.zeros(len(evidence), dtype=bool)
        open_parts = open_whole.copy()
        for a, b in zip(first[box], last[box], strict=True):
            open_whole[a:b] = True
        for a, b in zip(handed[0][box], handed[1][box], strict=True):
            open_parts[a:b] = True
        wanted = set(whole.evidence.llr[open_whole].tolist())
        assert wanted <= set(parts.evidence.llr[open_parts].tolist())
        assert open_parts.sum() <= open_whole.sum() + len(begins)  # one more of each sector at most
    assert parts.sums(handed[0][:0], handed[1][:0])[0].shape == (0, len(begins))  # no box left
    visible = whole.sums(first, last)[0] - parts.sums(*handed)[0]
    extra = parts.sums(*handed)[2] - parts.sums(*handed)[1]
    assert np.all(np.abs(visible) <= extra + 1e-9)


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
