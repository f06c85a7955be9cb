"""Stars beyond the catalogue, and the rotation of the sky."""

from datetime import UTC, datetime

import numpy as np
import pytest
from render_helpers import SITE, stars_at

from startrack.catalog import load_catalog
from startrack.core.types import Stars
from startrack.frames import R_enu_icrs, R_from_rotvec, Site, sky_rotvec_rad
from startrack.rendering import draw_field_stars, draw_v_errors

TIME = datetime(2026, 3, 1, 12, tzinfo=UTC)


def test_catalogue_and_field_together_follow_the_counts_of_the_sky():
    catalogue = load_catalog().at(None, None)
    field = draw_field_stars(catalogue, 10.0, rng=np.random.default_rng(1))
    both = Stars.concatenate(catalogue, field)
    # The usual table of star counts (after Allen 1973, Astrophysical Quantities, 3rd ed.); editions differ by 10 %.
    for v, count in ((8, 42_000), (9, 117_000), (10, 324_000)):
        assert (both.v_mag < v).sum() == pytest.approx(count, rel=0.25)
    lacking = [
        np.mean(both.hip[(both.v_mag >= a) & (both.v_mag < b)] == 0) for a, b in ((6.5, 7), (7.25, 7.5), (9, 10))
    ]
    assert 0.005 < lacking[0] < 0.02
    assert 0.05 < lacking[1] < 0.15
    assert lacking[2] > 0.8
    assert field.v_mag.min() >= 6.5
    assert field.v_mag.max() < 10.0
    assert np.all(np.diff(field.v_mag) >= 0)
    np.testing.assert_allclose(np.linalg.norm(field.rays_icrs, axis=1), 1.0, atol=1e-12)
    assert field.catalog_id[:2].tolist() == ["FIELD 1", "FIELD 2"]
    assert not field.hip.any()


def test_field_stars_crowd_in_the_milky_way():
    field = draw_field_stars(load_catalog().at(None, None), 9.0, rng=np.random.default_rng(2))
    galactic_pole = np.array([-0.867666, -0.198076, 0.455984])  # ICRS (ESA SP-1200, vol. 1, eq. 1.5.11)
    low = np.abs(field.rays_icrs @ galactic_pole) < 0.25
    assert low.mean() > 0.30  # an even sky has 0.25 there


def test_without_a_catalogue_the_field_is_even():
    none = stars_at(np.empty((0, 3)), np.empty(0))
    field = draw_field_stars(none, 8.0, rng=np.random.default_rng(3))
    assert np.abs(field.rays_icrs.mean(axis=0)).max() < 5 / np.sqrt(3 * len(field))
    assert len(draw_field_stars(none, 6.0, rng=np.random.default_rng(3))) == 0


def test_errors_are_the_catalogues_and_the_scatter_in_quadrature():
    n = 200_000
    stars = stars_at(np.tile([0.0, 0.0, 1.0], (n, 1)), np.zeros(n))
    stars = Stars(**{**vars(stars), "v_sigma_mag": np.where(np.arange(n) < n // 2, 0.0, 0.04)})
    errors = draw_v_errors(stars, 0.03, rng=np.random.default_rng(4))
    assert errors[: n // 2].std() == pytest.approx(0.03, rel=0.02)
    assert errors[n // 2 :].std() == pytest.approx(0.05, rel=0.02)


def test_the_sky_rotates_once_a_sidereal_day_westward():
    site = Site("earth", np.radians(40.0), 0.0)
    rotvec = sky_rotvec_rad(site, TIME, 600.0)
    assert np.linalg.norm(rotvec) == pytest.approx(7.292115e-5 * 600, rel=1e-4)
    # Stars rotate about the celestial pole (north, 40 degrees up) against the Earth's rotation.
    np.testing.assert_allclose(
        rotvec / np.linalg.norm(rotvec), [0, -np.cos(np.radians(40)), -np.sin(np.radians(40))], atol=2e-3
    )


def test_the_moons_sky_rotates_half_a_degree_an_hour():
    assert np.degrees(np.linalg.norm(sky_rotvec_rad(SITE, TIME, 3600.0))) == pytest.approx(0.549, abs=0.002)


def test_the_rotation_vector_maps_the_start_to_the_end():
    from datetime import timedelta

    site, half = Site("earth", np.radians(-20.0), 1.0), timedelta(seconds=900)
    R = R_from_rotvec(sky_rotvec_rad(site, TIME, 1800.0))
    np.testing.assert_allclose(R @ R_enu_icrs(site, TIME - half), R_enu_icrs(site, TIME + half), atol=1e-12)
