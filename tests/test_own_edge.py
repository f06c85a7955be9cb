"""Lit ground below the crest: the sky's light then has an edge of its own, and the stars tell the position."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from localization_helpers import slow_chain
from render_helpers import CRATER
from sky_helpers import PX_PER_RAD
from test_localization_refinement import PLACE, sky_rows, star_rows
from test_skyline import CAMERA, PLACES_M, Frame, expose, locate
from test_skyline import CRATER as RENDERED

from startrack.catalog import load_catalog
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Bools, Evidence, Fix, ImageErrors
from startrack.evidence.sky_light import LEVELS
from startrack.evidence.skyline import Skyline, look_through, scale_across, skyline_band
from startrack.frames import azel_from_rays
from startrack.localization import ExactPosterior, WeightedPoints
from startrack.localization.hypothesis import Hypothesis
from startrack.localization.likelihood.neighbourhood import Neighbourhood, OwnEdge, SectorRows
from startrack.localization.likelihood.obstacle_chain import STATES, clear_emissions
from startrack.localization.likelihood.shared_errors import SharedErrors
from startrack.localization.likelihood.skyline_model import SkylineModel
from startrack.localization.likelihood.smooth_skyline import free_log_likelihood, with_own_edge

NATS = 4.0  # of a cell of the light: a sky of 7 %
STARS = 1500  # within 1.1 degrees of the skyline
LIFT_RAD = np.radians(0.03)  # of the light above the skyline
TRUE = PLACE + np.array([1.0, -2.0])
STRIP_PX, STRIP_RAD = 1.6, np.radians(99.0)  # how high and how long the lit strip is


def in_strip(azimuth_rad: Array, middle_rad: float, long_rad: float = STRIP_RAD) -> Bools:
    """(n,) whether azimuths (n,) are in a lit strip."""
    off = (azimuth_rad - middle_rad + np.pi) % (2 * np.pi) - np.pi
    return np.asarray(np.abs(off) <= long_rad / 2)


def fix_with(lower_rad: Array | float, seed: int, with_stars: bool = True) -> Fix:
    """The fix from stars and an edge of the sky's light that is seen too low by (SECTORS * LEVELS,)."""
    rng = np.random.default_rng([19, seed])
    light, stars = sky_rows(TRUE, rng, NATS), star_rows(TRUE, rng, STARS)
    light = replace(light, elevation_rad=light.elevation_rad - lower_rad)
    support = ExactPosterior()(replace(stars, is_first_look=True), CRATER).support
    rows = Evidence.concatenate(light, stars) if with_stars else light
    return ExactPosterior()(replace(rows, support=support), CRATER)


@pytest.mark.parametrize("seed", range(3))
def test_a_lit_strip_below_the_crest_leaves_the_position_to_the_stars(seed: int) -> None:
    lower_px = np.where(in_strip(MIDDLES_RAD, 1.2 + 1.9 * seed), STRIP_PX, 0.0)
    fix = fix_with(np.repeat(lower_px / PX_PER_RAD, LEVELS), seed)
    assert fix.lit is not None and np.mean(fix.lit.likely == in_strip(MIDDLES_RAD, 1.2 + 1.9 * seed)) > 0.95
    assert np.linalg.norm(fix.position_enu_m[:2] - TRUE) < fix.radius999_m


@pytest.mark.parametrize("seed", range(3))
def test_light_that_ends_at_the_skyline_is_not_doubted(seed: int) -> None:
    fix = fix_with(0.0, seed)
    assert fix.lit is None
    assert np.linalg.norm(fix.position_enu_m[:2] - TRUE) < fix.radius999_m


def test_light_alone_has_no_other_edge_than_the_skyline() -> None:
    assert fix_with(0.0, 0, with_stars=False).lit is None


def test_lit_states_are_those_of_stars_at_the_skyline_and_light_by_its_neighbours() -> None:
    """The chain's likelihood is a product of matrices."""
    rng = np.random.default_rng(3)
    sky, stars = sky_rows(TRUE, rng, NATS), star_rows(TRUE, rng, STARS)
    plain = SkylineModel.of(CRATER, Evidence.concatenate(sky, stars), PLACE, 30.0, SharedErrors.of(CRATER, None))
    by_stars = SectorRows(plain.around, stars).profiles
    edge = OwnEdge(
        plain.seen,
        rng.uniform(0.01, 2.0, SECTORS) * np.exp(by_stars.offset - plain.seen.profiles.offset),
        np.ones(SECTORS),
    )
    seen, shifts = replace(plain.seen, edge=edge), np.radians(rng.uniform(-0.05, 0.05, (5, 1)) * np.ones(SECTORS))
    expected = clear_emissions(by_stars, shifts)[0] * edge.light
    np.testing.assert_allclose(seen.emissions(shifts[0])[:, -1], expected)
    by_matrices = slow_chain(np.array([seen.emissions(shift) for shift in shifts]), seen.moves)
    assert np.ptp(by_matrices) > 20.0
    lit = replace(plain, seen=seen, closing=(0, np.arange(STATES)))
    assert lit.log_likelihood_of(shifts) == pytest.approx(by_matrices, abs=0.3)


@pytest.mark.parametrize("has_edge", [False, True])
def test_a_lift_of_the_light_counts_in_the_states_as_in_the_chain(has_edge: bool) -> None:
    """The chain's likelihood at lifts is a product of matrices; the lifts are those of errors of the image."""
    rng = np.random.default_rng(7)
    rows = Evidence.concatenate(sky_rows(TRUE, rng, NATS), star_rows(TRUE, rng, STARS))
    plain = SkylineModel.of(CRATER, rows, PLACE, 30.0, SharedErrors.of(CRATER, None))
    edge = OwnEdge(plain.seen, rng.uniform(0.01, 2.0, SECTORS) * np.exp(-plain.seen.profiles.offset), np.ones(SECTORS))
    seen = replace(plain.seen, edge=edge) if has_edge else plain.seen
    model = replace(plain, seen=seen, closing=(0, np.arange(STATES)))
    shifts, lifts = np.radians(rng.uniform(-0.02, 0.02, (2, 6, 1)) * np.ones(SECTORS))
    found = model.log_likelihood_of(shifts, lifts)
    by_matrices = [seen.emissions(shift, lift) for shift, lift in zip(shifts, lifts, strict=True)]
    assert found == pytest.approx(slow_chain(np.array(by_matrices), seen.moves), abs=0.3)
    assert np.abs(found - model.log_likelihood_of(shifts)).max() > 3.0


def test_a_free_skyline_explains_lifted_light_worse() -> None:
    """As where the rows of the light are raised; light and stars are averaged over the map's error one by one."""
    rng = np.random.default_rng(7)
    rows = Evidence.concatenate(sky_rows(TRUE, rng, NATS), star_rows(TRUE, rng, STARS))
    seen, raised = (
        SkylineModel.of(CRATER, one, PLACE, 30.0, SharedErrors.of(CRATER, None)).seen
        for one in (rows, replace(rows, elevation_rad=rows.elevation_rad + LIFT_RAD * (rows.extended_nats > 0.0)))
    )
    at_map, lift = np.zeros(SECTORS), np.full(SECTORS, -LIFT_RAD)
    best, by_gains, by_rows = (
        free_log_likelihood(*one) for one in ((seen, at_map), (seen, at_map, lift), (raised, at_map))
    )
    assert 5.0 < best - by_rows < best - by_gains < 2.0 * (best - by_rows)


def test_light_far_from_the_stars_has_a_finite_likelihood() -> None:
    """By 25 nats a sector it is likelier with an edge of its own: four sectors are more than a float32 holds."""
    rng = np.random.default_rng(4)
    sky, stars = sky_rows(TRUE, rng, 100.0 * NATS), star_rows(TRUE, rng, 30 * STARS)
    lower = replace(sky, elevation_rad=sky.elevation_rad - 3.5 / PX_PER_RAD)
    rows = Evidence.concatenate(lower, replace(stars, llr=2.0 * stars.llr))
    plain = SkylineModel.of(CRATER, rows, PLACE, 30.0, SharedErrors.of(CRATER, None))
    start = Hypothesis(plain, WeightedPoints(TRUE[None], np.zeros(1), np.zeros(1)))
    model = with_own_edge(start, 30.0)
    assert model is not None and model.seen.edge is not None
    own = model.log_likelihood_of(np.zeros((1, SECTORS)))[0] + model.seen.log_offset
    ends_at_skyline = plain.log_likelihood_of(np.zeros((1, SECTORS)))[0] + plain.seen.log_offset
    assert np.isfinite(own) and own > ends_at_skyline + 100.0
    assert model.seen.edge.lit.min() > 0.9


def test_other_rows_have_no_edge_of_the_former_ones() -> None:
    rng = np.random.default_rng(6)
    rows = Evidence.concatenate(sky_rows(TRUE, rng, NATS), star_rows(TRUE, rng, STARS))
    plain = SkylineModel.of(CRATER, rows, PLACE, 30.0, SharedErrors.of(CRATER, None))
    model = with_own_edge(Hypothesis(plain, WeightedPoints(TRUE[None], np.zeros(1), np.zeros(1))), 30.0)
    assert model is not None
    other = model.with_rows(rows)
    shifts = np.zeros((1, SECTORS))
    assert other.gross == "" and other.log_likelihood_of(shifts) == pytest.approx(plain.log_likelihood_of(shifts))


def light_strip(
    frame: Frame, light_e: float, long_rad: float = STRIP_RAD, between_px: tuple[float, float] = (-STRIP_PX, 0.0)
) -> Frame:
    """The frame with more light, or less, in a strip between two heights above the crest."""
    truth, shape = frame.truth, frame.exposure.pixels_adu.shape
    crest = Skyline.trace(truth.position_enu_m[:2], RENDERED)
    band = skyline_band(shape, CAMERA, truth.R_cam_enu, crest, 12.0)
    pixel, rays_cam = look_through(band, CAMERA)
    azimuth, elevation = azel_from_rays(rays_cam @ truth.R_cam_enu)
    height = (elevation - crest(azimuth)) * scale_across(CAMERA, truth.R_cam_enu, crest)(azimuth)
    strip = np.zeros(shape)
    low, high = between_px
    strip.ravel()[pixel] = np.clip(high - height + 0.5, 0, 1) * np.clip(height - low + 0.5, 0, 1)
    strip.ravel()[pixel] *= in_strip(azimuth, 2.0, long_rad)
    assert CAMERA.sensor is not None
    adu = light_e * cv2.GaussianBlur(strip, (0, 0), CAMERA.sensor.psf_sigma_px) / CAMERA.sensor.gain_e_per_adu
    return replace(frame, exposure=replace(frame.exposure, pixels_adu=(frame.exposure.pixels_adu + adu).astype("f4")))


def test_an_image_of_a_lit_strip_is_located_by_its_stars_there() -> None:
    catalog = load_catalog().brighter_than(7.0)
    lit = light_strip(expose(catalog, PLACES_M["halfway"], 21.0), 12.0)
    found = locate(lit, catalog)
    assert found.status == "ok"
    assert "its edge is not the skyline" in found.sky_unused
    strip, used = in_strip(MIDDLES_RAD, 2.0), found.sky_at_skyline.used
    assert np.mean(used[strip]) < 0.2 and np.mean(used[~strip]) > 0.5  # its ends are vague
    assert np.mean(found.sky.used[strip]) > 0.5
    assert lit.error_m(found) < found.fix.radius999_m


@pytest.mark.parametrize("dark_px", [1.6, 2.6])
def test_light_with_another_edge_all_around_tells_nothing_of_the_position(dark_px: float) -> None:
    """The errors of the image, which raise light and not stars, are not drawn to that edge either."""
    catalog = load_catalog().brighter_than(7.0)
    dark = light_strip(expose(catalog, PLACES_M["halfway"], 21.0), -150.0, 2 * np.pi, (0.0, dark_px))
    found = locate(dark, catalog)
    assert found.status == "ok"
    assert found.evidence_source == "stars"
    assert dark.error_m(found) < found.fix.radius999_m
    assert found.fix.integrity.protection_level_m < 200.0


@pytest.mark.parametrize("lit", [0.0, 0.5, 1.0])
def test_the_linear_model_leaves_light_with_another_edge_out(lit: float) -> None:
    """Moments of a mixture, and errors of the image that raise the light alone."""
    rng = np.random.default_rng(5)
    sky, stars = sky_rows(TRUE, rng, NATS), star_rows(TRUE, rng, STARS)
    raised = ImageErrors(np.ones((SECTORS, 1)), np.zeros(1), np.eye(1), np.full(SECTORS, 1e-8))
    plain = SectorRows(Neighbourhood(CRATER, PLACE, 30.0), Evidence.concatenate(sky, stars), raised)
    alone = SectorRows(plain.around, stars)
    seen = replace(plain, edge=OwnEdge(plain, np.ones(SECTORS), np.full(SECTORS, lit)))
    np.testing.assert_allclose(seen.image_rise, (1.0 - lit) * plain.image_rise)
    drawn = rng.random(200_000) < lit
    first, second = (one.moments for one in (plain, alone))
    heights = np.where(drawn, *(
        rng.normal(one.mean_rad[0], np.sqrt(one.variance_rad2[0]), len(drawn)) for one in (second, first)
    ))  # fmt: skip
    assert seen.moments.mean_rad[0] == pytest.approx(heights.mean(), abs=5e-3 * heights.std())
    assert seen.moments.variance_rad2[0] == pytest.approx(heights.var(), rel=0.02)


def test_a_wrong_lens_under_a_bright_sky_has_circles_that_hold_the_truth() -> None:
    """A focal length that is wrong by 0.2 %: refused, or the truth is in the circle."""
    tilted = replace(CAMERA, focal_px=(CAMERA.focal_px[0] * 1.002, CAMERA.focal_px[1] * 1.002))
    catalog = load_catalog().brighter_than(7.0)
    frame = expose(catalog, PLACES_M["halfway"], 19.0, camera=tilted)
    found = locate(frame, catalog)
    assert found.status == "refused" or frame.error_m(found) < found.fix.radius999_m
