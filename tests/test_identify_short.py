"""Short lists: the quick path gives the names that the thorough one gives, and its parts are what they say."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest
from test_identify import ARCSEC, FISHEYE, NARROW, Frame, detected, frame, off, scattered, sky

from startrack.identify import Identifier, identifier
from startrack.identify.kept import KeptPerObject
from startrack.identify.lean import _turned
from startrack.identify.near import NearStars, first_of_each
from startrack.identify.triangles import triangles, triangles_of_few
from startrack.orient import rotation, wahba


def hundred(seed: int, false: int = 20, true: int = 80, noise_px: float = 0.2) -> Frame:
    """The brightest stars of half the sky, and false ones like them."""
    return frame(FISHEYE, seed, brightest=true, hidden=0.0, false=false / true, noise_px=noise_px)


@pytest.mark.parametrize("false", [20, 320])
def test_the_quick_path_names_as_the_thorough_one_does(false: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(2):
        truth = hundred(seed, false)
        quick = Identifier()(truth.detections, FISHEYE, sky())
        assert quick.false_alarm_probability < 1e-30
        assert off(quick, truth) < 40 * ARCSEC
        monkeypatch.setattr(identifier, "SHORT_LIST", 0)
        thorough = Identifier()(truth.detections, FISHEYE, sky())
        monkeypatch.undo()
        both = set(zip(quick.detection.tolist(), quick.star.tolist(), strict=True))
        assert len(both ^ set(zip(thorough.detection.tolist(), thorough.star.tolist(), strict=True))) <= 1
        assert abs(quick.unexplained - thorough.unexplained) <= 1
        assert np.all(truth.star[quick.detection] == quick.star)


def test_a_hundred_stars_do_not_need_the_thorough_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(identifier, "Search", None)  # using it would raise
    for seed in range(20):
        truth = hundred(100 + seed)
        found = Identifier()(truth.detections, FISHEYE, sky())
        assert np.array_equal(truth.star[found.detection], found.star)
        assert len(found) >= 0.99 * np.count_nonzero(truth.clear(FISHEYE))


def test_hypotheses_of_the_quick_path_count_against_the_thorough_one(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    class Watched(identifier.Search):
        def __init__(self, *args: object) -> None:
            super().__init__(*args)  # type: ignore[arg-type]
            seen.append(self.tried)

    monkeypatch.setattr(identifier, "Search", Watched)
    xy = scattered(FISHEYE, 60, np.random.default_rng(1))
    with pytest.raises(identifier.NotIdentified, match="chance"):
        Identifier()(detected(xy, np.linspace(1, 4, len(xy)), 0.2), FISHEYE, sky())
    assert min(seen) > 0


def test_detections_outside_the_circle_keep_their_numbers_on_the_quick_path() -> None:
    truth = hundred(3)
    corner = np.stack([np.linspace(1, 90, 40), np.linspace(90, 1, 40)], axis=1)
    v = np.concatenate([np.full(40, -3.0), 18.0 - 2.5 * np.log10(truth.detections.flux_e)])
    found = Identifier()(detected(np.concatenate([corner, truth.detections.xy_px]), v, 0.2), FISHEYE, sky())
    plain = Identifier()(truth.detections, FISHEYE, sky())
    assert np.array_equal(found.detection, plain.detection + 40)
    assert found.unexplained == plain.unexplained + 40


def test_a_mirrored_short_list_is_named_as_such() -> None:
    truth = hundred(4)
    with pytest.raises(identifier.NotIdentified, match="mirror image"):
        Identifier()(truth.detections, replace(FISHEYE, mirrored=True), sky())


def test_pairs_are_those_of_a_brute_force_search() -> None:
    near = NearStars(sky())
    rays = sky().rays_icrs[[10, 20, 500]] + np.random.default_rng(2).normal(0, 1e-3, (3, 3))
    rays = np.concatenate([rays, sky().rays_icrs[sky().hip == 17702]])  # in the Pleiades: many neighbours
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for count, radius in ((700, 0.02), (3000, 0.02), (len(sky()), 0.004)):
        ray, star = near.pairs(rays, radius, count)
        distance = np.linalg.norm(rays[:, None] - sky().rays_icrs[None, :count], axis=2)
        expected = np.argwhere(distance < 2 * np.sin(radius / 2))
        assert len(expected) > 3
        assert sorted(zip(ray.tolist(), star.tolist(), strict=True)) == [tuple(pair) for pair in expected.tolist()]
        assert np.all(np.diff(ray) >= 0)


def test_few_triangles_are_those_of_the_general_search() -> None:
    rays = np.random.default_rng(5).normal((0, 0, 1.5), 1.0, (14, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    every, few = triangles(rays, 0.9), triangles_of_few(rays, 0.9)
    assert len(every) == len(few) > 20
    order, own = np.lexsort(every.vertices.T), np.lexsort(few.vertices.T)
    assert np.array_equal(every.vertices[order], few.vertices[own])
    assert np.array_equal(every.handed[order], few.handed[own])
    assert few.sides_rad[own] == pytest.approx(every.sides_rad[order], abs=1e-14)
    fresh = triangles_of_few(rays, 0.9, 9)
    assert len(fresh) == np.count_nonzero(few.vertices.max(axis=1) >= 9) > 0


def test_one_step_turns_a_near_attitude_onto_the_best_one() -> None:
    rng = np.random.default_rng(6)
    icrs = rng.normal(size=(40, 3))
    icrs /= np.linalg.norm(icrs, axis=1, keepdims=True)
    R = rotation(np.array([0.3, -1.0, 0.7]))
    cam = icrs @ R.T + rng.normal(0, 3e-4, (40, 3))
    cam /= np.linalg.norm(cam, axis=1, keepdims=True)
    weights = rng.uniform(0.5, 2, 40)
    start = rotation(np.array([2e-3, -1e-3, 1e-3])) @ R
    assert _turned(cam, icrs, weights, start) == pytest.approx(wahba(cam, icrs, weights), abs=2e-6)


def test_facts_are_kept_per_object_and_forgotten_with_it() -> None:
    calls: list[object] = []

    class Thing:
        pass

    kept = KeptPerObject(lambda thing: calls.append(thing.__class__) or len(calls))
    one, other = Thing(), Thing()
    assert [kept(one), kept(one), kept(other)] == [1, 1, 2]
    del one
    gc.collect()
    assert len(kept._kept) == 1


def test_the_first_of_each_number() -> None:
    assert first_of_each(np.array([4, 2, 4, 7, 2])).tolist() == [1, 0, 3]
    assert first_of_each(np.zeros(0, dtype=np.int64)).tolist() == []


def test_eight_stars_of_a_narrow_field_on_the_quick_path() -> None:
    truth = frame(NARROW, 7, brightest=30, limit=8.0, hidden=0.0, false=0.2)
    found = Identifier()(truth.detections, NARROW, sky())
    assert np.array_equal(truth.star[found.detection], found.star)
