"""The shipped craters: positions are found from rays about their skylines, with the errors that the files state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from startrack.core.types import Evidence
from startrack.frames import Site, latlon_from_enu
from startrack.localization import ExactPosterior
from startrack.terrain import load_terrain

pytestmark = pytest.mark.usefixtures("own_cache")
PLACES = {  # east and north [m]: centres of the search areas
    "haworth floor": (-2515.0, 5192.0), "de-gerlache floor": (-434.0, -6059.0), "faustini floor": (1000.0, -2000.0),
    "kepler floor": (-521.0, -7271.0), "kepler wall": (9647.0, -1547.0),
}  # fmt: skip
FIRST_PLACES = {"haworth floor", "kepler floor"}  # a polar map and one far from the pole


@pytest.mark.parametrize(
    "where", [pytest.param(name, marks=[] if name in FIRST_PLACES else pytest.mark.slow) for name in PLACES]
)
def test_a_position_in_a_shipped_crater_is_found(where):
    terrain = load_terrain(f"{where.split()[0]}-rendered")
    latitude, longitude = latlon_from_enu(terrain.site, *PLACES[where], 0.0)
    terrain = replace(terrain, site=Site("moon", float(latitude), float(longitude)), search_radius_m=250.0)
    rays = 1200 if where.startswith("kepler") else 3000  # wide craters with low rims give less information
    rng, place = np.random.default_rng(3), np.array([110.0, -70.0])
    azimuth = rng.uniform(0, 2 * np.pi, rays)
    above = rng.uniform(-0.1, 0.1, rays)
    llr = np.where((above > 0) ^ (rng.random(rays) < 0.01), 4.0, -4.0)
    evidence = Evidence(
        azimuth_rad=azimuth, elevation_rad=terrain.horizon_rad(place[None], azimuth) + above, llr=llr,
        edge_sigma_rad=np.full(rays, 1e-5),
    )  # fmt: skip
    fix = ExactPosterior()(evidence, terrain)
    assert not fix.ambiguous
    assert np.hypot(*(fix.position_enu_m[:2] - place)) < fix.radius999_m < 150.0
