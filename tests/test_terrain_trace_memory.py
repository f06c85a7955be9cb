"""Bounds of the horizon that are kept: the bits that were traced, whatever was asked before."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from startrack.terrain.horizon_table import SLOTS, BoxMemory


class Tracer:
    """How many bounds were computed."""

    def __init__(self):
        self.traced = 0


def bounds(boxes):
    """(2, n, 2) that depend on all numbers (n, 5)."""
    low = np.sin(boxes[:, 0]) + 3.0 * boxes[:, 1] + np.sqrt(boxes[:, 2]) + boxes[:, 3] ** 3
    low = low[:, None] + [0.0, 0.5]
    return np.array([low, low + boxes[:, 2:3] + boxes[:, 4:5]])


def boxes(rng, n):
    inputs = (rng.uniform(-1e4, 1e4, (n, 2)), rng.choice([5.0, 2.5], n), rng.uniform(0, 2 * np.pi, n), rng.random(n))
    return np.column_stack(inputs)


def fill(memory, tracer, inputs):
    found = np.full((2, len(inputs), 2), np.nan)

    def compute(missing):
        tracer.traced += np.count_nonzero(missing)
        return bounds(inputs[missing])

    memory.fill(inputs, *found, compute)
    return found


def test_what_is_kept_is_what_was_traced():
    memory, tracer, inputs = BoxMemory(SLOTS, 5, 2), Tracer(), boxes(np.random.default_rng(1), 5000)
    first = fill(memory, tracer, inputs)
    assert tracer.traced == 5000
    np.testing.assert_array_equal(first, bounds(inputs))
    np.testing.assert_array_equal(fill(memory, tracer, inputs), first)
    assert tracer.traced < 5300  # some slots are shared


def test_more_boxes_than_slots_replace_each_other_and_are_still_right():
    memory, tracer, rng = BoxMemory(SLOTS, 5, 2), Tracer(), np.random.default_rng(2)
    asked = [boxes(rng, SLOTS // 2) for _ in range(5)]
    for inputs in [*asked, *asked[::-1]]:
        np.testing.assert_array_equal(fill(memory, tracer, inputs), bounds(inputs))
    assert 5 * SLOTS // 2 < tracer.traced < 5 * SLOTS  # some, not all, were kept


@pytest.mark.parametrize("number", range(5))
def test_each_number_of_a_box_counts(number):
    memory, tracer = BoxMemory(SLOTS, 5, 2), Tracer()
    one = np.array([[10.0, 20.0, 5.0, 1.0, 0.1]])
    other = one.copy()
    other[0, number] = np.nextafter(one[0, number], np.inf)
    for inputs in (one, other):
        np.testing.assert_array_equal(fill(memory, tracer, inputs), bounds(inputs))
    assert tracer.traced == 2


def test_threads_share_the_memory():
    memory, tracer, rng = BoxMemory(SLOTS, 5, 2), Tracer(), np.random.default_rng(3)
    inputs = boxes(rng, 20_000)
    parts = [rng.permutation(20_000)[:5000] for _ in range(40)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda part: fill(memory, tracer, inputs[part]), parts))
    for part, kept in zip(parts, found, strict=True):
        np.testing.assert_array_equal(kept, bounds(inputs[part]))


def test_another_process_begins_with_an_empty_memory():
    memory, tracer, inputs = BoxMemory(SLOTS, 5, 2), Tracer(), boxes(np.random.default_rng(5), 100)
    fill(memory, tracer, inputs)
    packed = pickle.dumps(memory)
    assert len(packed) < 1000
    fill(pickle.loads(packed), tracer, inputs)
    assert tracer.traced == 200
