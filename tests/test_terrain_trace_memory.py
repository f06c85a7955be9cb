"""Bounds and horizons that are kept: the bits that were traced, whatever was asked before."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from startrack.terrain.trace_memory import MAX_AZIMUTHS, MAX_SKYLINES, SLOTS, BoxMemory, SkylineMemory


class Tracer:
    """Two numbers that depend on all inputs, and how many were computed."""

    def __init__(self):
        self.traced = 0

    def __call__(self, centres, half, azimuths, low, high):
        self.traced += len(low)
        low[:], high[:] = self.bounds(centres, half, azimuths)

    @staticmethod
    def bounds(centres, half, azimuths):
        low = np.sin(centres[:, 0]) + 3.0 * centres[:, 1] + np.sqrt(half) + azimuths**3
        return np.array([low, low + half])

    def horizons(self, points, azimuths):
        self.traced += len(points)
        return points[:, 0] + azimuths, points[:, 1] * azimuths, azimuths**2


def boxes(rng, n):
    return rng.uniform(-1e4, 1e4, (n, 2)), rng.choice([5.0, 2.5], n), rng.uniform(0, 2 * np.pi, n)


def fill(memory, tracer, inputs):
    found = np.full((2, len(inputs[1])), np.nan)
    memory.fill(tracer, *inputs, *found)
    return found


def test_what_is_kept_is_what_was_traced():
    memory, tracer, inputs = BoxMemory(), Tracer(), boxes(np.random.default_rng(1), 5000)
    first = fill(memory, tracer, inputs)
    assert tracer.traced == 5000
    np.testing.assert_array_equal(first, Tracer.bounds(*inputs))
    np.testing.assert_array_equal(fill(memory, tracer, inputs), first)
    assert tracer.traced < 5300  # some slots are shared


def test_more_boxes_than_slots_replace_each_other_and_are_still_right():
    memory, tracer, rng = BoxMemory(), Tracer(), np.random.default_rng(2)
    asked = [boxes(rng, SLOTS // 2) for _ in range(5)]
    for inputs in [*asked, *asked[::-1]]:
        np.testing.assert_array_equal(fill(memory, tracer, inputs), Tracer.bounds(*inputs))
    assert 5 * SLOTS // 2 < tracer.traced < 5 * SLOTS  # some, not all, were kept


def test_each_of_the_four_numbers_of_a_box_counts():
    memory, tracer = BoxMemory(), Tracer()
    one = np.array([[10.0, 20.0]]), np.array([5.0]), np.array([1.0])
    fill(memory, tracer, one)
    for changed in ((one[0] + [0, 1e-9], *one[1:]), (one[0] + [1e-9, 0], *one[1:]), (one[0], one[1] / 2, one[2]),
                    (*one[:2], np.nextafter(one[2], 2.0))):  # fmt: skip
        np.testing.assert_array_equal(fill(memory, tracer, changed), Tracer.bounds(*changed))
    assert tracer.traced == 5


def test_threads_share_the_memory():
    memory, tracer, rng = BoxMemory(), Tracer(), np.random.default_rng(3)
    inputs = boxes(rng, 20_000)
    parts = [rng.permutation(20_000)[:5000] for _ in range(40)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda part: fill(memory, tracer, [a[part] for a in inputs]), parts))
    for part, bounds in zip(parts, found, strict=True):
        np.testing.assert_array_equal(bounds, Tracer.bounds(*(a[part] for a in inputs)))


def test_the_last_skylines_are_kept_and_cannot_be_changed_by_callers():
    memory, tracer, azimuths = SkylineMemory(), Tracer(), np.linspace(0, 6, 200)

    def skyline(east):
        return memory.horizons(tracer.horizons, np.tile([east, 1.0], (200, 1)), azimuths)

    wanted = [a.copy() for a in skyline(0.0)]
    skyline(0.0)[0][:] = 0.0
    np.testing.assert_array_equal(skyline(0.0), wanted)
    assert tracer.traced == 200
    for east in range(1, MAX_SKYLINES + 1):
        skyline(float(east))
    before = tracer.traced
    np.testing.assert_array_equal(skyline(0.0), wanted)
    assert tracer.traced == before + 200


def test_single_rays_different_points_and_very_many_azimuths_are_not_kept():
    memory, tracer = SkylineMemory(), Tracer()
    for points in (np.zeros((5, 2)), np.random.default_rng(4).normal(size=(200, 2)), np.zeros((MAX_AZIMUTHS + 1, 2))):
        before = tracer.traced
        for _ in range(2):
            memory.horizons(tracer.horizons, points, np.linspace(0, 6, len(points)))
        assert tracer.traced == before + 2 * len(points)


def test_another_process_begins_with_an_empty_memory():
    memory, tracer, inputs = BoxMemory(), Tracer(), boxes(np.random.default_rng(5), 100)
    fill(memory, tracer, inputs)
    packed = pickle.dumps(memory)
    assert len(packed) < 1000
    fill(pickle.loads(packed), tracer, inputs)
    assert tracer.traced == 200
