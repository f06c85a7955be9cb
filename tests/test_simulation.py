"""Simulated photometry of stars against that of pixels; positions of simulated stars against their stated errors."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from typing import Any

import numpy as np
import pytest
from stage_helpers import as_stage
from star_painter import paint
from test_evidence import without_sources

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import Settings, locate, locate_rays, two_looks
from startrack.chain.measurement import fix_roughly
from startrack.chain.stages import StarRays
from startrack.core.types import BadInput, ClockError
from startrack.evidence import StarPhotometry
from startrack.evidence.photometry import Sources, half_width, measure
from startrack.rendering import Series
from startrack.simulation import Starlight, simulate_rays
from startrack.terrain import load_terrain

SIZE, VARIANCE_E2, SATURATION_E = 256, 100.0, 1e5


class NoNoise:
    """A generator whose normal draws are 0: what is left is the mean."""

    def standard_normal(self, n: int) -> np.ndarray:
        return np.zeros(n)


@pytest.fixture(scope="module")
def series() -> Series:
    camera = load_camera("fisheye-2048")
    camera = replace(camera, size_px=(1024, 1024), focal_px=(326.0, 326.0), centre_px=(511.5, 511.5))
    terrain, catalog = load_terrain("shackleton-thesis"), load_catalog().brighter_than(7.5)
    return Series(camera=camera, terrain=terrain, catalog=catalog, seed=3, faint_v_mag=None)


def crowded_stars(rng: np.random.Generator, n: int = 400) -> Sources:
    margin = half_width(1.0) + 1
    return Sources(
        xy_px=rng.uniform(margin, SIZE - 1 - margin, (n, 2)), flux_e=rng.uniform(20.0, 120.0, n),
        fraction_sigma=np.full(n, 0.03), visible=rng.choice([0.01, 0.5, 0.99], n),
    )  # fmt: skip


def test_mean_and_variance_are_those_of_the_photometry_of_pixels():
    rng = np.random.default_rng(1)
    sources = crowded_stars(rng)
    shines = rng.random(len(sources.flux_e)) < 0.6
    true_e = np.where(shines, sources.flux_e * rng.normal(1.0, 0.03, len(shines)), 0.0)
    noise = np.full((SIZE, SIZE), np.sqrt(VARIANCE_E2), dtype=np.float32)
    image = np.zeros((SIZE, SIZE))
    paint(image, sources.xy_px, true_e, 1.0)
    real = measure(without_sources(image.astype(np.float32), noise), sources)
    starlight = Starlight(sources.xy_px[shines], true_e[shines], 1.0)
    drawn = starlight.measure(sources, np.full(len(shines), VARIANCE_E2), SATURATION_E, rng=NoNoise())  # type: ignore[arg-type]
    assert drawn.flux_e == pytest.approx(real.flux_e, abs=0.05)  # noise: 37 e
    for name in ("variance_e2", "own_shot", "neighbour_variance_e2"):
        assert getattr(drawn, name) == pytest.approx(getattr(real, name), rel=5e-3, abs=0.02), name
    assert drawn.usable.all()


def test_fluxes_scatter_by_the_noise_of_background_and_stars():
    rng = np.random.default_rng(2)
    sources = crowded_stars(rng, 100)
    light = Starlight(sources.xy_px, sources.flux_e, 1.0)
    draws = [light.measure(sources, np.full(100, VARIANCE_E2), SATURATION_E, rng=rng) for _ in range(400)]
    mean = light.measure(sources, np.full(100, VARIANCE_E2), SATURATION_E, rng=NoNoise())  # type: ignore[arg-type]
    least = mean.variance_e2 + mean.own_shot * sources.flux_e  # neighbours shine wholly, not by `visible`
    spread = np.var([draw.flux_e for draw in draws], axis=0)
    assert np.mean(spread / least) == pytest.approx(1.0, abs=0.05)
    assert np.mean([draw.flux_e for draw in draws], axis=0) == pytest.approx(mean.flux_e, abs=12.0)


def test_a_saturated_star_spoils_its_stamp():
    sources = Sources(
        xy_px=np.array([[50.0, 50.0], [53.0, 50.0], [90.0, 90.0]]), flux_e=np.array([9e5, 100.0, 100.0]),
        fraction_sigma=np.full(3, 0.03), visible=np.full(3, 0.99),
    )  # fmt: skip
    light = Starlight(sources.xy_px, sources.flux_e, 1.0)
    found = light.measure(sources, np.full(3, VARIANCE_E2), SATURATION_E, rng=np.random.default_rng(0))
    assert found.usable.tolist() == [False, False, True]


@pytest.mark.slow
def test_positions_of_simulated_stars_err_as_they_state(series: Series):
    nees, inside = [], 0
    for number in range(30):
        scene, rng = series.scene(number)
        fixed = locate_rays(simulate_rays(scene, series.catalog, rng=rng))
        off = (fixed.fix.position_enu_m - scene.position_enu_m)[:2]
        nees.append(off @ np.linalg.solve(fixed.fix.covariance_m2, off))
        inside += bool(np.hypot(*off) < fixed.fix.radius95_m)
        assert np.hypot(*off) < fixed.fix.integrity.protection_level_m
    assert 1.1 < np.mean(nees) < 3.2  # 2 is expected; its standard error is 0.37
    assert inside >= 25


def test_a_wrong_clock_turns_the_rays_and_not_what_is_seen(series: Series):
    scene, _ = series.scene(0)
    right, wrong = (
        simulate_rays(
            scene, series.catalog, rng=np.random.default_rng(1), time_utc=scene.time_utc + timedelta(seconds=late),
            time_sigma_s=3600.0,
        )
        for late in (0.0, 3600.0)
    )  # fmt: skip
    assert right.clock.sigma_s == wrong.clock.sigma_s == 3600.0
    back = wrong.later(-3600.0, np.inf)
    off = (back.photometry.azimuth_rad - right.photometry.azimuth_rad + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(off[right.photometry.elevation_rad < 1.4]).max() < 1e-4
    assert right.photometry.llr == pytest.approx(wrong.photometry.llr, abs=0.1)


@pytest.mark.parametrize("later_s", [0.5, 3600.0])
def test_rays_are_turned_to_the_time_of_their_fix_where_that_moves_them(series: Series, later_s: float):
    """Also by a clock of which one usual error moves nothing."""
    scene, rng = series.scene(0)
    rays = replace(simulate_rays(scene, series.catalog, rng=rng), terrain=load_terrain("shackleton"))
    by_rays = locate_rays(simulate_rays(scene, series.catalog, rng=rng)).fix
    turned, fix = fix_roughly(rays, lambda rows, terrain: replace(by_rays, clock=ClockError(later_s, 5.0)))
    assert fix.clock is not None and fix.clock.offset_s == later_s
    assert turned.clock.offset_s == (later_s if later_s > 1.0 else 0.0)
    moved = np.abs(turned.photometry.azimuth_rad - rays.photometry.azimuth_rad)
    assert (np.median(moved) > 0.005) == (later_s > 1.0)


def test_the_stars_of_an_image_are_located_as_the_pipeline_locates_them(located: Any, monkeypatch: Any):
    monkeypatch.setattr(two_looks, "exceeds_noise", lambda light: False)  # no star is measured anew after a first fix
    monkeypatch.setattr(StarPhotometry, "moving", lambda self, motion_rad: self)  # nor moves
    known, settings = located.result, Settings(evidence_sources="stars")
    catalog = load_catalog().brighter_than(7.0)
    by_stars = locate(known.exposure, known.camera, known.terrain, catalog, settings)
    again = locate_rays(as_stage(by_stars, StarRays))
    assert again.fix.position_enu_m == pytest.approx(by_stars.fix.position_enu_m, abs=1e-9)
    assert again.fix.integrity.protection_level_m == by_stars.fix.integrity.protection_level_m


def test_a_scene_without_ground_or_time_is_refused(series: Series):
    scene, rng = series.scene(0)
    for changed, reason in (({"terrain": None}, "bad_terrain"), ({"time_utc": None}, "no_time")):
        with pytest.raises(BadInput) as cause:
            simulate_rays(replace(scene, **changed), series.catalog, rng=rng)
        assert cause.value.reason == reason
