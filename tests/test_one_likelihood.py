"""One log-likelihood of a skyline in all parts of the program: what one star counts, asked of the code."""

from __future__ import annotations

import numpy as np
import pytest

from startrack.core.types import MIDDLES_RAD, SECTORS, Evidence
from startrack.localization import ROW_NATS
from startrack.localization.likelihood.skyline_profiles import profiles_of
from startrack.localization.search import sum_contributions
from startrack.localization.search_profiles import SearchProfiles
from startrack.output.html.details import PAGE_SECTORS, _nats_by_sector

SECTOR = 60


def star_at(elevation_rad: float, llr: float) -> Evidence:
    """One star in the middle of a sector."""
    return Evidence(azimuth_rad=MIDDLES_RAD[[SECTOR]], elevation_rad=np.array([elevation_rad]), llr=np.array([llr]))


def step_of(profiles: object) -> float:
    """By how much the log-likelihood of a sector changes where the skyline passes its star."""
    k = profiles.first[SECTOR]  # type: ignore[attr-defined]
    return float(profiles.left[k] - profiles.left[k + 1])  # type: ignore[attr-defined]


@pytest.mark.parametrize("llr", [-40.0, -2.0, 2.0, 40.0])
def test_a_star_counts_alike_in_every_likelihood(llr: float) -> None:
    counted = float(np.clip(llr, -ROW_NATS, ROW_NATS))
    star = star_at(0.2, llr)
    published = profiles_of(star, np.array([0.05]), np.zeros(SECTORS))
    search = SearchProfiles.of(star)
    assert step_of(published) == pytest.approx(counted)
    assert search.visible[SECTOR, 0] == pytest.approx(counted)
    assert search.best[SECTOR] == pytest.approx(max(counted, 0.0))
    assert sum_contributions(star, np.array([0.05]))[SECTOR] == pytest.approx(counted)
    page = _nats_by_sector(star.azimuth_rad, np.array([0.05]), star.llr)
    assert page[SECTOR * PAGE_SECTORS // SECTORS] == pytest.approx(min(counted, 0.0))
