"""How errors of crests correlate, and the waves that they make of the horizon, on errors of known covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from map_helpers import polar_stereographic

from startrack.core.types import Array
from startrack.frames import Site
from startrack.terrain import HeightMap, Raster
from startrack.terrain.imports.comparison import (
    CREST_AZIMUTHS,
    Correlation,
    CrestErrors,
    average_posts,
    correlate,
    correlate_with_coarser,
    measure_waves,
    standing_positions,
)

RIM_M, POST_M, DRAWS = 10_000.0, 240.0, 60
AZIMUTHS = np.arange(CREST_AZIMUTHS) * 2 * np.pi / CREST_AZIMUTHS
RIM = RIM_M * np.stack([np.sin(AZIMUTHS), np.cos(AZIMUTHS)], axis=-1)
WAVE = np.arange(1, 9)


def draw_errors(correlation: Correlation, white_m: float) -> CrestErrors:
    """Errors of a round rim with a bias of 16 m, drawn anew for each position."""
    rng = np.random.default_rng(7)
    apart = np.hypot(*np.moveaxis(RIM[:, None] - RIM, -1, 0))
    root = np.linalg.cholesky(np.exp(-apart / correlation.length_m))
    drawn = correlation.sigma_m * rng.normal(size=(DRAWS, len(RIM))) @ root.T
    return CrestErrors(
        higher_m=16.0 + drawn + rng.normal(0.0, white_m, drawn.shape), crests_m=np.tile(RIM, (DRAWS, 1, 1)),
        inside=np.ones(drawn.shape, dtype=bool),
    )  # fmt: skip


def waves_of(errors: CrestErrors) -> Array:
    """Standard deviations of the coefficients of the drawn errors themselves."""
    terms = np.fft.rfft(errors.higher_m, axis=1)[:, 1:9] * 2 / len(RIM)
    return np.asarray(np.sqrt(np.mean(np.abs(terms) ** 2, axis=0) / 2))


def test_waves_of_a_round_rim_are_the_closed_ones():
    """A covariance that falls with the chord, 2 R sin(lag / 2): |sin(x / 2)| has the terms -4 / pi / (4 m^2 - 1)."""
    wide = Correlation(sigma_m=4.0, length_m=1e4 * RIM_M)
    closed = 4.0 * np.sqrt(2 * RIM_M / wide.length_m * 4 / np.pi / (4 * WAVE**2 - 1))
    np.testing.assert_allclose(wide.waves_m(RIM[None]), closed, rtol=0.05)  # steps of 4 degrees at wave 8


def test_the_correlation_of_drawn_errors_is_found_beside_those_of_single_posts():
    true = Correlation(sigma_m=4.0, length_m=4000.0)
    errors = draw_errors(true, white_m=5.0)
    found = correlate(errors, POST_M)
    assert found is not None
    white_m = 5.0 * np.sqrt(2 / len(RIM))
    np.testing.assert_allclose(found.waves_m(RIM[None]), true.waves_m(RIM[None]), rtol=0.25)
    np.testing.assert_allclose(np.hypot(found.waves_m(RIM[None]), white_m), waves_of(errors), rtol=0.25)


def test_errors_of_single_posts_are_not_counted_twice():
    errors = draw_errors(Correlation(sigma_m=1e-6, length_m=1000.0), white_m=5.0)
    found = correlate(errors, POST_M)
    assert found is not None
    assert np.all(found.waves_m(RIM[None]) < 0.3 * waves_of(errors))


def test_a_position_that_sees_few_crests_does_not_count():
    errors = draw_errors(Correlation(sigma_m=4.0, length_m=4000.0), white_m=5.0)
    few = np.zeros_like(errors.inside)
    few[:, :5] = True
    assert correlate(replace(errors, inside=few), POST_M) is None


@pytest.fixture(scope="module")
def crater() -> HeightMap:
    """A crater 20 km wide on rough ground: posts 200 m apart clip its rim, which is sharper in the south, by more."""
    rng, n = np.random.default_rng(3), 1024
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.rfftfreq(n), indexing="ij"))
    wave[0, 0] = np.inf
    rough = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(n, n))) * wave**-1.8)[:640, :640]
    line = 50.0 * (np.arange(640) - 319.5)
    distance = np.hypot(line[:, None], line)
    sharp_m = 1800.0 + 800.0 * -line[:, None] / distance
    fine = 2000.0 * np.exp(-(((distance - RIM_M) / sharp_m) ** 2)) + rough * 8 / np.diff(rough, axis=0).std()
    plane = polar_stereographic()
    ground = Raster(
        heights_m=fine.astype(np.float32), projection=plane, x0_m=line[0], y0_m=-line[0], dx_m=50.0, dy_m=-50.0
    )
    site = Site("moon", plane.latitude_rad, plane.longitude_rad)
    return HeightMap(
        site=site, maps=(average_posts(ground, 4),), search_radius_m=5000.0, height_sigma_m=4.0,
    )  # fmt: skip


def test_means_of_posts_stand_in_their_middle(crater):
    (one,) = crater.maps
    coarser = average_posts(one, 3)
    at = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), indexing="ij"), axis=-1)
    np.testing.assert_allclose(coarser.xy(at), one.xy(3 * at + 1))
    assert coarser.heights_m[2, 5] == pytest.approx(one.heights_m[6:9, 15:18].mean(), rel=1e-5)


def test_waves_of_a_map_without_a_finer_one_scale_with_the_error_of_heights(crater):
    waves_rad, source = measure_waves(crater, None)
    assert "made coarser" in source
    assert np.all(np.diff(waves_rad) < 0.0)
    angle_rad = crater.height_sigma_m * crater.crest_rad_per_m
    assert 0.05 * angle_rad < waves_rad[0] < angle_rad
    twice_rad, _ = measure_waves(replace(crater, height_sigma_m=8.0), None)
    np.testing.assert_allclose(twice_rad, 2 * waves_rad)
    assert not measure_waves(replace(crater, height_sigma_m=0.0), None)[0].any()


def test_a_finer_map_that_shows_larger_waves_counts(crater):
    own = correlate_with_coarser(crater.maps[0], crater, crater.height_sigma_m)
    assert own is not None
    larger = replace(own, sigma_m=3 * own.sigma_m)
    waves_rad, source = measure_waves(crater, larger)
    np.testing.assert_allclose(waves_rad, 3 * own.waves_rad(crater))
    assert "by the map and the finer map;" in source


def test_a_rover_stands_where_the_ground_is_flat(crater):
    positions = standing_positions(crater)
    assert np.all(np.degrees(crater.slope_rad(positions)) < 20.0)
    assert len(positions) == 150


def test_crests_that_show_no_correlation_state_the_least_waves(crater):
    flat = replace(crater.maps[0], heights_m=np.random.default_rng(2).normal(0.0, 30.0, (160, 160)).astype(np.float32))
    terrain = replace(crater, maps=(flat,))
    waves_rad, source = measure_waves(terrain, None)
    least_rad = 0.15 * terrain.height_sigma_m * terrain.crest_rad_per_m
    assert source
    assert least_rad <= waves_rad[0] < 1.5 * least_rad
