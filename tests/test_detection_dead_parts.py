"""Dead parts of a sensor: found as rectangles of one value, and left out as if they were masked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from startrack.catalog import load_catalog
from startrack.chain import pipeline
from startrack.detection import find_damage
from startrack.detection.damage import find_dead_parts
from startrack.output import result_dict

HEIGHT, WIDTH = 700, 900
PARTS = {
    "left half": np.s_[:, :450], "quadrant": np.s_[350:, 450:], "band of rows": np.s_[100:180, :],
    "column block": np.s_[:, 500:600], "inner block": np.s_[200:420, 300:610],
}  # fmt: skip


def noise(sigma: float = 4.0) -> Any:
    """A frame of rounded noise about 100 ADU with 200 stars, some saturated."""
    rng = np.random.default_rng(8)
    frame = 100.0 + sigma * rng.standard_normal((HEIGHT, WIDTH))
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for _ in range(200):
        at = rng.uniform(0, [WIDTH, HEIGHT])
        box = np.s_[max(int(at[1]) - 15, 0) : int(at[1]) + 15, max(int(at[0]) - 15, 0) : int(at[0]) + 15]
        distance2 = (x[box] - at[0]) ** 2 + (y[box] - at[1]) ** 2
        frame[box] += 10 ** rng.uniform(2, 6) * np.exp(-distance2 / (2 * 1.5**2))
    return np.minimum(np.rint(frame), 4095.0).astype(np.float32)


@pytest.mark.parametrize("value", [0.0, 100.0, 60.0])
@pytest.mark.parametrize("part", PARTS)
def test_a_rectangle_of_one_value_is_found_to_the_pixel(part, value):
    frame, expected = noise(), np.zeros((HEIGHT, WIDTH), dtype=bool)
    expected[PARTS[part]] = True
    frame[expected] = value
    found = find_dead_parts(frame)
    assert found is not None and not (expected & ~found).any()
    assert np.count_nonzero(found & ~expected) <= HEIGHT + WIDTH  # beside an edge a pixel may hold the value by chance


@pytest.mark.parametrize("change", ["none", "clipped", "calm", "one value", "lamp", "dark ground"])
def test_nothing_else_is_a_dead_part(change):
    frame = noise(0.2 if change == "calm" else 4.0)
    if change == "clipped":
        frame = np.maximum(frame - 100.0, 0.0)
    if change == "one value":
        frame[:] = 100.0
    if change == "lamp":
        frame[:300, :300] = 4095.0
    if change == "dark ground":  # no rectangle
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        frame[y > 500 + 100 * np.sin(x / 150)] = 90.0
    assert find_dead_parts(frame) is None


def test_a_dead_half_costs_its_azimuths_and_is_stated(located: Any) -> None:
    known = getattr(located, "result", located)
    pixels = known.exposure.pixels_adu.copy()
    pixels[:, : pixels.shape[1] // 2] = 0.0
    exposure = replace(known.exposure, pixels_adu=pixels)
    result = pipeline.locate(exposure, known.camera, known.terrain, load_catalog().brighter_than(7.0))
    assert result.status == "ok", result.message
    error = np.hypot(*(result.fix.position_enu_m - located.truth.position_enu_m)[:2])
    assert error < result.fix.radius999_m
    assert any("50 % of the image holds one value" in text for text in result.warnings)
    assert result_dict(result)["provenance"]["mask_sha256"] is None
    assert find_damage(exposure, known.camera) is None
