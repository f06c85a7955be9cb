"""Edges and voids of maps, wrong maps, craters of another scale: an answer or a reason, never an exception."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from edge_helpers import CHANGES, RIGHT, draw_rays, draw_scene
from hazard_helpers import catalog_to, rays_of, small_camera

from startrack.chain import StarRays, locate_rays
from startrack.core.types import SECTORS, Fix, NoSolution
from startrack.localization.likelihood.neighbourhood import Neighbourhood
from startrack.localization.search import BoxModel, Place, Proof
from startrack.rendering import Series
from startrack.simulation import simulate_rays
from startrack.terrain import NO_POST, Cylinder, load_terrain

pytestmark = pytest.mark.usefixtures("own_cache")


def finite_fix(rays: StarRays) -> Fix | None:
    """The fix of `rays`, whose numbers are finite; None where they are refused. No warning is raised."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            fix = locate_rays(rays).fix
        except NoSolution:  # each has a reason
            return None
    assert np.isfinite([*fix.position_enu_m, *fix.covariance_m2.ravel(), fix.radius95_m, fix.radius999_m]).all()
    return fix


def answer_is_honest(seed: int, change: str) -> None:
    """An image on a map with a `change` has a finite fix or a reason; on a right map the fix is not far outside."""
    drawn = draw_rays(seed, change)
    if drawn is None:
        return
    rays, scene = drawn
    fix = finite_fix(rays)
    if fix is not None and change in RIGHT and not fix.ambiguous and fix.search == "proven":
        off_m = float(np.hypot(*(fix.position_enu_m - scene.position_enu_m)[:2]))
        assert off_m < 1.5 * fix.radius999_m, (seed, change, off_m, fix.radius999_m)


@pytest.mark.parametrize(("seed", "change"), [(7, "metres"), (15, "crop"), (24, "void")])
def test_an_image_on_a_map_with_edges_has_an_answer_or_a_reason(seed: int, change: str) -> None:
    answer_is_honest(seed, change)


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES)
def test_many_images_on_maps_with_edges_have_an_answer_or_a_reason(change: str) -> None:
    for seed in (9, 19, 100, 101) if change in RIGHT else (9, 100):  # the position on a wrong map is not compared
        answer_is_honest(seed, change)


def test_where_no_post_makes_the_skyline_it_is_the_maps_with_the_error_of_a_post() -> None:
    """Seen from a peak, ground falls to the edge of its map, and the crest is the edge."""
    _, truth, _, _ = draw_scene(19)
    terrain, azimuth = replace(truth, height_sigma_m=0.5), (np.arange(240) + 0.5) * np.pi / 120
    place = np.array([0.5 * terrain.search_radius_m, 0.0])
    crests = terrain.errors.expected_crests(place, azimuth)
    assert crests is not None
    bare = crests.post[:, 0] == NO_POST
    assert 20 < np.count_nonzero(bare) < 200
    tan, distance, _ = terrain.horizons(place, azimuth)
    sigma = 0.5 / distance / (1.0 + tan**2)
    assert crests.rise_rad[bare] == pytest.approx(0.0, abs=1e-12)
    assert crests.own_sigma_rad[bare] == pytest.approx(sigma[bare])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = Neighbourhood(terrain, place, 20.0).map_sigma_rad
    assert np.isfinite(found).all()
    assert (found[bare] >= sigma[bare] * (1 - 1e-9)).all()


def test_no_evidence_is_taken_where_ground_off_the_map_could_hide_it_from_anywhere() -> None:
    """Rays from the very rim of the search area, beside which the map ends."""
    _, truth, _, _ = draw_scene(19)
    edge_m = min(-truth.maps[0].x0_m, truth.maps[0].x0_m + 39 * truth.maps[0].dx_m)
    terrain = replace(truth, search_radius_m=0.97 * edge_m)
    azimuth = np.radians(np.arange(0.5, 360.0))
    places = terrain.search_radius_m * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=-1)[::7]
    tan, _, end_m = terrain.with_voids().horizons(places[:, None], azimuth)
    up = terrain.ground_m(places) + terrain.camera_height_m
    beyond = np.arctan((terrain.ground.highest_m - up[:, None]) / np.maximum(end_m, 1.0) - 1e-3)
    hidden = (end_m < 1e9) & (beyond > np.arctan(tan))
    assert hidden.any()
    told = terrain.is_informative(np.broadcast_to(azimuth, beyond.shape), np.where(hidden, beyond - 0.05, 1.5))
    assert np.mean(told[hidden]) < 0.02


def test_a_search_whose_best_place_is_in_no_box_is_about_that_place() -> None:
    """The boxes are tested at points: one that holds a good position between them may be left out."""
    rays, _ = rays_of("shackleton-thesis", (3000.0, 1000.0), 3)
    place = Place(np.array([3000.0, 1000.0]), 25.0 * np.eye(2), 0.0, np.zeros(SECTORS), 0.0)
    found = Proof(BoxModel.of(rays.evidence(), rays.terrain), -1e6, 1e5).run([place])
    assert found.search == "beam"
    assert np.abs(found.centres_m - place.position_m).max() <= 256.0


OTHER_CRATERS = {
    "kilometres deep, as metres": {"depth_m": 2.0}, "kilometres wide": {"diameter_m": 20.0},
    "both": {"depth_m": 2.0, "diameter_m": 20.0}, "feet": {"depth_m": 6561.7}, "wide search": {"search_radius_m": 3e4},
    "camera at the rim": {"camera_height_m": 1999.9},
}  # fmt: skip


def crater_is_honest(change: str, seed: int) -> None:
    """An image in the thesis's crater on a file of another one, from a place that is often beside the wall."""
    truth, rng = load_terrain("shackleton-thesis"), np.random.default_rng(seed)
    assert isinstance(truth, Cylinder)
    away_m, turn = truth.radius_m * rng.choice([0.3, 0.9, 0.9999]), rng.uniform(0.0, 2 * np.pi)
    series = Series(
        camera=small_camera(), terrain=truth, catalog=catalog_to(6.5), seed=seed, faint_v_mag=6.5,
        east_m=float(away_m * np.sin(turn)), north_m=float(away_m * np.cos(turn)),
    )  # fmt: skip
    crater = replace(truth, **OTHER_CRATERS[change], depth_sigma_m=None, diameter_sigma_m=None)
    rays = simulate_rays(series.scene(0)[0], catalog_to(6.5), crater, rng=rng)
    finite_fix(rays)


def test_a_crater_file_in_kilometres_has_an_answer_or_a_reason() -> None:
    crater_is_honest("kilometres deep, as metres", 1)


@pytest.mark.slow
@pytest.mark.parametrize(("change", "seed"), list(product(OTHER_CRATERS, range(5))))
def test_crater_files_of_other_scales_have_an_answer_or_a_reason(change: str, seed: int) -> None:
    crater_is_honest(change, seed)
