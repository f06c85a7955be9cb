"""Short lists: identified completely and quickly; and parts of the search."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from test_identification import (
    ARCSEC,
    FISHEYE,
    NARROW,
    Frame,
    attitude_error_rad,
    frame,
    make_detections,
    random_positions,
    rays_about,
    sky,
)

from startrack.core.types import NotIdentified
from startrack.estimation.match import (
    BRIGHTER_MAG,
    DIMMED_MAG,
    PX_PER_MAG,
    CandidatePairs,
    PhotometricScale,
    brightness_agreement,
)
from startrack.frames import R_from_rotvec, wahba
from startrack.identification import Identifier
from startrack.identification.attitude_search import AttitudeSearch
from startrack.identification.index import CatalogPatterns, PerObject
from startrack.identification.triangles import are_same_handed, build_pairs, sides_of_few, triangles


def hundred_stars(seed: int, false: int = 20, true: int = 80, noise_px: float = 0.2) -> Frame:
    """The brightest stars of half the sky, and false ones like them."""
    return frame(FISHEYE, seed, brightest=true, hidden=0.0, false=false / true, noise_px=noise_px)


def _skip_attempts(search: AttitudeSearch, tried: int, attitudes: Iterator) -> Iterator:
    search.tried += tried
    return attitudes


@pytest.mark.parametrize("false", [20, 320])
def test_nearly_all_stars_of_a_short_list_are_identified(false: int) -> None:
    named = there = 0
    for seed in range(10):
        truth = hundred_stars(seed, false)
        found = Identifier()(truth.detections, FISHEYE, sky())
        assert found.false_alarm_probability < 1e-30
        assert attitude_error_rad(found, truth) < 40 * ARCSEC
        assert np.array_equal(truth.star[found.detection], found.star)
        named, there = named + len(found), there + np.count_nonzero(truth.star >= 0)
    assert named >= 0.99 * there


def test_a_hundred_stars_do_not_need_the_deep_index(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CatalogPatterns, "deep_index", None)  # using it would raise
    for seed in range(20):
        truth = hundred_stars(100 + seed)
        assert attitude_error_rad(Identifier()(truth.detections, FISHEYE, sky()), truth) < 40 * ARCSEC


def test_every_hypothesis_counts_against_the_answer() -> None:
    xy = random_positions(FISHEYE, 60, np.random.default_rng(1))
    with pytest.raises(NotIdentified, match="chance") as caught:
        Identifier()(make_detections(xy, np.linspace(1, 4, len(xy)), 0.2), FISHEYE, sky())
    assert caught.value.evidence["tried"] > 50
    true = hundred_stars(2)
    few = Identifier()(true.detections, FISHEYE, sky())
    search = AttitudeSearch.hypotheses
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(AttitudeSearch, "hypotheses", lambda self, *how: _skip_attempts(self, 10**6, search(self, *how)))
        many = Identifier()(true.detections, FISHEYE, sky())
    assert many.false_alarm_probability >= few.false_alarm_probability


def test_the_search_refuses_after_a_bounded_number_of_hypotheses() -> None:
    rng = np.random.default_rng(7)
    xy = random_positions(FISHEYE, 100, rng)
    sources = make_detections(xy, np.sort(6 + np.log(rng.random(100)) / 1.08), 0.2)
    with pytest.raises(NotIdentified) as caught:
        Identifier()(sources, FISHEYE, sky())
    assert caught.value.evidence["tried"] < 5000


def test_detections_outside_the_circle_keep_their_numbers_on_the_quick_path() -> None:
    truth = hundred_stars(3)
    corner = np.stack([np.linspace(1, 90, 40), np.linspace(90, 1, 40)], axis=1)
    v = np.concatenate([np.full(40, -3.0), 18.0 - 2.5 * np.log10(truth.detections.flux_e)])
    found = Identifier()(make_detections(np.concatenate([corner, truth.detections.xy_px]), v, 0.2), FISHEYE, sky())
    plain = Identifier()(truth.detections, FISHEYE, sky())
    assert np.array_equal(found.detection, plain.detection + 40)
    assert found.unexplained == plain.unexplained + 40


def test_a_mirrored_short_list_is_named_as_such() -> None:
    truth = hundred_stars(4)
    with pytest.raises(NotIdentified, match="mirror image"):
        Identifier()(truth.detections, replace(FISHEYE, mirrored=True), sky())


def test_pairs_are_those_of_a_brute_force_search() -> None:
    patterns = CatalogPatterns(sky(), 2 * np.pi)
    rays = sky().rays_icrs[[10, 20, 500]] + np.random.default_rng(2).normal(0, 1e-3, (3, 3))
    rays = np.concatenate([rays, sky().rays_icrs[sky().hip == 17702]])  # in the Pleiades: many neighbours
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for count, radius in ((700, 0.02), (3000, 0.02), (len(sky()), 0.004)):
        near = patterns.neighbours(rays, radius, count)
        assert count <= near.depth <= 2 * count + 1000
        distance = np.linalg.norm(rays[:, None] - sky().rays_icrs[None, : near.depth], axis=2)
        expected = np.argwhere(distance < 2 * np.sin(radius / 2))
        assert len(expected) > 3
        assert sorted(zip(near.ray.tolist(), near.star.tolist(), strict=True)) == [tuple(p) for p in expected.tolist()]
        assert near.chord == pytest.approx(distance[near.ray, near.star], abs=1e-12)
        assert np.all(np.diff(near.ray) >= 0)


@pytest.mark.parametrize("fresh", [0, 9])
def test_the_sides_of_few_are_those_of_the_general_search(fresh: int) -> None:
    rays = np.random.default_rng(5).normal((0, 0, 1.5), 1.0, (14, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    vertices, chords = sides_of_few(rays, fresh, 2.0)
    few = {tuple(v): 2 * np.arcsin(c / 2) for v, c in zip(vertices.tolist(), chords, strict=True)}
    assert len(few) == len(list(combinations(range(14), 3))) - len(list(combinations(range(fresh), 3)))
    every = triangles(rays, 0.9)
    fresher = every.take(every.vertices.max(axis=1) >= fresh)
    assert len(fresher) > 15
    for v, sides in zip(fresher.vertices.tolist(), fresher.sides_rad, strict=True):
        assert few[tuple(v)] == pytest.approx(sides, abs=1e-14)
    short = {tuple(v) for v in sides_of_few(rays, fresh, 2 * np.sin(0.45))[0].tolist()}
    assert short == {v for v, sides in few.items() if sides[2] < 0.9}


def test_a_mirror_image_of_a_triangle_has_the_other_hand() -> None:
    one, R = np.random.default_rng(8).normal(size=(20, 3, 3)), R_from_rotvec(np.array([0.3, -1.0, 0.7]))
    assert are_same_handed(one, one @ R.T).all()
    assert not are_same_handed(one, one * [1, -1, 1]).any()


def test_few_rays_have_no_triangle() -> None:
    for n in range(3):
        vertices, sides = sides_of_few(np.eye(3)[:n], 0, 2.0)
        assert vertices.shape == sides.shape == (0, 3)
    assert len(are_same_handed(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))) == 0


def test_wahba_solutions_are_the_best_rotations() -> None:
    rng = np.random.default_rng(6)
    icrs = rng.normal(size=(5, 40, 3))
    icrs /= np.linalg.norm(icrs, axis=-1, keepdims=True)
    R = R_from_rotvec(np.array([0.3, -1.0, 0.7]))
    cam = icrs @ R.T + rng.normal(0, 3e-4, icrs.shape)
    weights = rng.uniform(0.5, 2, (5, 40))
    assert wahba(cam * weights[..., None], icrs) == pytest.approx(wahba(cam, icrs, weights), abs=1e-12)
    flat = icrs * [1, 1, 1e-3]
    assert np.linalg.det(wahba(flat @ R.T, flat)) == pytest.approx(1)


def test_values_kept_per_object_are_released_with_it() -> None:
    calls: list[object] = []

    class Thing:
        pass

    kept = PerObject(lambda thing: calls.append(thing.__class__) or len(calls))
    one, other = Thing(), Thing()
    assert [kept(one), kept(one), kept(other)] == [1, 1, 2]
    del one
    gc.collect()
    assert len(kept._cache) == 1


def pairs_of(detection: list[int], star: list[int], distance_px: list[float], v_mag: list[float]) -> CandidatePairs:
    """Detections all measured at V 3; stars of the magnitudes given."""
    v, none = np.array(v_mag), np.zeros(max(detection) + 1)
    light = PhotometricScale(none + 3.0, none > 0, 6.0, 5.0)
    return CandidatePairs(np.array(detection), np.array(star), np.array(distance_px), v, np.zeros(len(v)), light)


BLENDS = {
    "alone": ([0, 1], [4, 5], [0.1, 0.2], [3.0, 3.1], [4, 5]),
    "with a fainter one": ([0, 0, 1], [4, 5, 6], [0.1, 0.1, 0.1], [3.0, 3.5, 3.0], [4, 6]),
    "the nearer is the fainter": ([0, 0, 1], [4, 5, 6], [0.3, 0.1, 0.1], [3.0, 3.5, 3.0], [4, 6]),
    "as bright as each other": ([0, 0, 1], [4, 5, 6], [0.3, 0.1, 0.1], [3.0, 3.2, 3.0], [6]),
    "as bright, but far off": ([0, 0, 1], [4, 5, 6], [2.0, 0.1, 0.1], [3.1, 3.0, 3.0], [5, 6]),
    "a brighter one, but not there": ([0, 0, 1], [4, 5, 6], [2.0, 0.1, 0.1], [2.4, 3.0, 3.0], [6]),
    "each detected": ([0, 0, 1, 1], [4, 5, 4, 5], [0.1, 1.5, 1.5, 0.1], [3.0, 3.0, 3.0, 3.0], [4, 5]),
    "two claim the same": ([0, 0, 1, 1], [3, 4, 3, 5], [0.3, 0.1, 0.3, 0.1], [2.5, 3.0, 2.5, 3.0], None),
}


@pytest.mark.parametrize("case", BLENDS)
def test_a_blend_is_named_after_the_clearly_brighter_star(case: str) -> None:
    *listed, named = BLENDS[case]
    pairs = pairs_of(*listed)
    plain = pairs.select_unambiguous(pairs.one_to_one_pairs, np.full(len(pairs.one_to_one_pairs), 0.04), 3.0)
    assert len(set(pairs.star[plain].tolist())) == len(set(pairs.detection[plain].tolist())) == len(plain)
    if named is not None:
        assert pairs.star[plain].tolist() == named


def test_pairs_are_the_cheapest_of_their_star_and_of_their_detection() -> None:
    rng = np.random.default_rng(7)
    for _ in range(50):
        detection = np.sort(rng.integers(0, 15, 40))
        star, distance, v_mag = 1000 * rng.integers(0, 20, 40), rng.random(40), rng.normal(5.0, 1.0, 40)
        distance[rng.random(40) < 0.1] = np.inf
        measured, saturated, sigma = (
            rng.normal(5.0, 1.0, 15),
            rng.random(15) < 0.2,
            rng.choice([0.1, np.inf], 40, p=[0.9, 0.1]),
        )
        pairs = CandidatePairs(detection, star, distance, v_mag, sigma, PhotometricScale(measured, saturated, 6.0, 5.0))
        dimmed = measured[detection] - v_mag
        beyond = np.where(saturated[detection] & (dimmed > 0), 0.0, np.maximum(np.abs(dimmed) - 2.0 * sigma, 0.0))
        misfit = beyond / np.where(dimmed > 0, DIMMED_MAG, BRIGHTER_MAG)
        np.testing.assert_allclose(pairs.brightness_misfit, misfit, rtol=1e-14)
        cost = distance + PX_PER_MAG * beyond
        best = [i for i in np.flatnonzero(np.isfinite(cost) & (misfit < 1.0)) if cost[i] == cost[star == star[i]].min()]
        expected = [i for i in best if cost[i] == min(cost[j] for j in best if detection[j] == detection[i])]
        assert pairs.one_to_one_pairs.tolist() == expected
    nothing = CandidatePairs(*np.zeros((2, 0), np.int64), *np.zeros((3, 0)), pairs.scale)
    assert nothing.one_to_one_pairs.tolist() == []


@pytest.mark.parametrize("ascending", [True, False])
def test_the_part_that_agrees_in_brightness_is_that_of_all_pairs(ascending: bool) -> None:
    rng = np.random.default_rng(9)
    v_mag, measured = rng.normal(5, 1, 60), rng.normal(5, 2, 40)
    fainter = measured - v_mag[:, None]
    expected = np.mean((fainter >= -BRIGHTER_MAG) & (fainter < 1.6))
    found = brightness_agreement(np.sort(v_mag) if ascending else v_mag, measured, 1.6)
    assert found == pytest.approx(expected, abs=1e-12)
    assert brightness_agreement(v_mag[:0], measured) == 1.0


@pytest.mark.parametrize("field_sr", [2 * np.pi, 0.5])
def test_triangles_about_a_pivot_are_those_of_a_brute_force_search(field_sr: float) -> None:
    index = build_pairs(sky().take(slice(250 if field_sr > 1 else 800)), field_sr)
    half = 0.6 if field_sr > 1 else 0.3
    rays, tolerance = rays_about(6, half, 3), 0.01 * half
    image, catalogue = index.triangles(rays, tolerance)
    apart = np.linalg.norm(index.rays_icrs[:, None] - index.rays_icrs, axis=2)
    paired = np.zeros(apart.shape, dtype=bool)
    paired[tuple(index.pairs.T)] = True
    expected = set()
    for j, k in combinations(range(1, 6), 2):
        a, b, c = (float(np.linalg.norm(rays[p] - rays[q])) for p, q in ((0, j), (0, k), (j, k)))
        if min(a, b) < index.narrowest:
            continue
        near_a, near_b = (paired & (np.abs(apart - side) < tolerance) for side in (a, b))
        for p in np.flatnonzero(near_a.any(axis=1) & near_b.any(axis=1)):
            for q, r in np.argwhere(np.abs(apart[near_a[p]][:, near_b[p]] - c) < tolerance):
                expected.add((j, k, p, np.flatnonzero(near_a[p])[q], np.flatnonzero(near_b[p])[r]))
    found = set()
    for (pivot, j, k), (p, q, r) in zip(image.tolist(), catalogue.tolist(), strict=True):
        assert pivot == 0
        found.add((j, k, p, q, r) if j < k else (k, j, p, r, q))
    assert found == expected
    assert len(found) == len(image) > 5


def test_eight_stars_of_a_narrow_field_on_the_quick_path() -> None:
    truth = frame(NARROW, 7, brightest=30, limit=8.0, hidden=0.0, false=0.2)
    found = Identifier()(truth.detections, NARROW, sky())
    assert np.array_equal(truth.star[found.detection], found.star)
