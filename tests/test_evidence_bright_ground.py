"""Ground darker or brighter than the sky, or as it: its levels, the skyline above it, stars beside it, a frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hazard_helpers import catalog_to
from scipy.special import ndtr
from scipy.stats import norm
from sky_helpers import EDGE_PX, GROUND_E, NOISE_E, level_horizon, paint_pixels

from startrack.camera import load_camera
from startrack.chain import Located, pipeline
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Detections, SmoothImage
from startrack.evidence import Sources, measure
from startrack.evidence.sky_levels import ANY_SIGMAS, BORDER_PROBABILITY, DRIFT, GROUND, SKY, patch_levels
from startrack.evidence.sky_light import SkyLight, measure_sky_light, sectors_with_step
from startrack.rendering import Series, render
from startrack.terrain import GroundBrightness, TerrainFile, load_terrain

SKY_E, RANDOM = 90.0, {"low": 0.3, "high": 3.0}


def test_levels_are_those_of_a_chain_on_a_fine_grid() -> None:
    """Forward and backward passes over 2000 levels; the ring is cut where the passes have forgotten their start."""
    rng = np.random.default_rng(1)
    own = np.repeat([4.0, 9.0, 8.2, -3.0], 9) + rng.normal(0, 0.5, 36)
    variance = np.where(rng.random(36) < 0.1, np.inf, 0.25)
    width = 2.0 * np.ptp(own[np.isfinite(variance)]) + ANY_SIGMAS * 0.5
    level = np.median(own[np.isfinite(variance)]) + np.linspace(-0.5, 0.5, 2001) * width
    step = level[1] - level[0]
    drift = norm.pdf(level[:, None], level, DRIFT * 0.5) * step
    seen = np.where(np.isfinite(variance)[:, None], norm.pdf(level, own[:, None], 0.5), 1.0)

    def messages(order: list[int]) -> Array:
        found, message = np.empty((36, len(level))), np.full(len(level), 1.0 / len(level))
        for k in 2 * order:
            found[k] = message
            after = message * seen[k]
            after /= after.sum()
            message = (1.0 - BORDER_PROBABILITY) * drift @ after + BORDER_PROBABILITY / len(level)
        return found

    posterior = messages(list(range(36))) * seen * messages(list(range(35, -1, -1)))
    expected = posterior @ level / posterior.sum(axis=1)
    np.testing.assert_allclose(patch_levels(own, variance), expected, atol=0.02)


def test_constant_ground_has_a_level_of_twenty_sectors() -> None:
    rng = np.random.default_rng(2)
    levels = np.array([patch_levels(rng.normal(100.0, 0.7, SECTORS), np.full(SECTORS, 0.49)) for _ in range(40)])
    assert np.std(levels) == pytest.approx(0.7 / np.sqrt(20.0), rel=0.15)
    assert abs(levels.mean() - 100.0) < 0.05


def patchy_sky(seed: int, size_deg: float, sky_e: float = SKY_E) -> tuple[SkyLight, Array, Array]:
    """Pixels below a sky of `sky_e` and ground of random brightness; the true steps and borders (SECTORS,)."""
    rng = np.random.default_rng([seed, 7])
    ground = GroundBrightness.of({**RANDOM, "size_deg": size_deg, "seed": seed})
    pixels = paint_pixels(rng, 0.0)
    visible = ndtr(pixels.height_px / EDGE_PX)
    light = GROUND_E + sky_e * (visible + (1.0 - visible) * ground(pixels.azimuth_rad))
    noise = NOISE_E * rng.normal(size=len(light))
    ends = ground(MIDDLES_RAD[:, None] + np.radians([-0.74, 0.74]))
    border = np.abs(np.diff(ends, axis=1)[:, 0]) > 0
    sky = measure_sky_light(replace(pixels, light_e=light + noise), level_horizon)
    return sky, sky_e * (1.0 - ground(MIDDLES_RAD)), border


@pytest.mark.parametrize("size_deg", [5.0, 20.0, 60.0])
def test_the_skyline_above_patches_of_any_brightness_is_found_within_its_sigma(size_deg: float) -> None:
    z, low, count = [], [], 0
    for seed in range(6):
        sky, step_e, border = patchy_sky(seed, size_deg)
        error = (sky.levels.step_e - step_e)[~border] / np.sqrt(sky.levels.variance_e2[:, ~border].sum(axis=0))
        assert np.sqrt(np.mean(np.square(error))) < 1.1
        known = np.isfinite(sky.shift_sigma_px)
        count += np.count_nonzero(known)
        assert sectors_with_step(sky).sum() > 200
        assert (sky.levels.step_e[known & ~border] * step_e[known & ~border] > 0).all()
        z.append((sky.shift_px / np.sqrt(sky.variance_px2))[known])
        low.append((step_e < 0)[known])
    joined, brighter = np.concatenate(z), np.concatenate(low)
    assert count > 0.8 * 6 * SECTORS and 0.5 < brighter.mean() < 0.9
    assert np.mean(np.square(joined)) == pytest.approx(0.9, abs=0.3)
    for side in (joined[brighter], joined[~brighter]):
        assert abs(side.mean()) < 0.2


def test_rows_of_brighter_ground_have_the_likelihood_of_their_pixels() -> None:
    """The sky's light turned upside down: the same rows, mirrored."""
    pixels = paint_pixels(np.random.default_rng(3), SKY_E)
    darker = measure_sky_light(pixels, level_horizon)
    brighter = measure_sky_light(replace(pixels, light_e=2 * GROUND_E - pixels.light_e), level_horizon)
    np.testing.assert_allclose(brighter.levels.step_e, -darker.levels.step_e, atol=0.05)
    np.testing.assert_allclose(brighter.shift_px, darker.shift_px, atol=0.01)
    np.testing.assert_allclose(brighter.extended_nats, darker.extended_nats, rtol=0.01, atol=0.5)


def beside_edge(offset_px: float, step_e: float, flux_e: float, seed: int) -> tuple[Detections, Sources]:
    """600 stars of a `flux_e`, each `offset_px` above the edge of ground brighter by `step_e`; a PSF of 1 px."""
    side, n = 25, 600
    rng, at = np.random.default_rng(seed), np.arange(side) - side // 2
    across, down = np.meshgrid(at, at)
    light = step_e * ndtr((down - offset_px) / EDGE_PX) + flux_e / (2 * np.pi * EDGE_PX**2) * np.exp(
        -0.5 * (across**2 + down**2) / EDGE_PX**2
    )
    image = (GROUND_E + np.tile(light, (1, n)) + rng.normal(0, NOISE_E, (side, side * n))).astype(np.float32)
    flat = SmoothImage.of(np.full_like(image, GROUND_E + 0.5 * step_e)), SmoothImage.of(np.full_like(image, NOISE_E))
    detections = Detections(
        xy_px=np.zeros((0, 2)), covariance_px2=np.zeros((0, 2, 2)), flux_e=np.zeros(0), flux_sigma_e=np.zeros(0),
        snr=np.zeros(0), saturated=np.zeros(0, dtype=bool), psf_sigma_px=1.0, image_e=image, background=flat[0],
        noise=flat[1], dead=np.zeros(image.shape, dtype=bool),
    )  # fmt: skip
    xy_px = np.column_stack([side // 2 + side * np.arange(n), np.full(n, side // 2)]).astype(np.float64)
    sources = Sources(xy_px=xy_px, flux_e=np.zeros(n), fraction_sigma=np.zeros(n), visible=np.zeros(n))
    return detections, sources


@pytest.mark.parametrize("step_e", [-60.0, 0.0, 60.0])
@pytest.mark.parametrize("offset_px", [-4.0, -2.5, 0.0, 2.5, 4.0])
def test_stars_beside_an_edge_are_measured_within_their_sigma(offset_px: float, step_e: float) -> None:
    detections, sources = beside_edge(offset_px, step_e, 0.0, seed=5)
    found = measure(detections, sources)
    z = found.flux_e[found.usable] / np.sqrt(found.variance_e2[found.usable])
    assert np.sqrt(np.mean(np.square(z))) < (1.06 if step_e == 0 else 1.5)
    if step_e == 0:
        assert np.std(z) == pytest.approx(1.0, abs=0.07)


def test_a_frame_with_moonlit_snow_is_located() -> None:
    terrain = load_terrain("shackleton-thesis")
    snow = GroundBrightness.of({**RANDOM, "size_deg": 20.0, "seed": 3})
    series = Series(
        camera=load_camera("fisheye-2048"), terrain=replace(terrain, file=TerrainFile(ground_brightness=snow)),
        catalog=catalog_to(8.0),
        seed=11, east_m=2500.0, north_m=-1200.0, faint_v_mag=None, sky_v_mag_arcsec2=20.0,
    )  # fmt: skip
    scene, rng = series.scene(0)
    exposure, truth = render(scene, rng=rng)
    located = pipeline.locate(exposure, series.camera, terrain, catalog_to(8.0))
    assert isinstance(located, Located)
    assert located.sky_at_skyline is not None
    level = located.sky.light.levels.level_e
    assert np.mean(level[SKY] < level[GROUND]) == pytest.approx(0.6, abs=0.3)
    off_m = np.hypot(*(located.fix.position_enu_m - truth.position_enu_m)[:2])
    assert off_m < located.fix.radius999_m < 30.0
