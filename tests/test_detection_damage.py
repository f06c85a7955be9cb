"""What processing leaves in the noise of a frame, found in frames of pure noise."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from startrack.core.types import Exposure
from startrack.detection import find_damage

NOISE = np.random.default_rng(5).normal(400.0, 20.0, (512, 512))


def cause_in(pixels):
    damage = find_damage(Exposure(pixels_adu=np.rint(pixels).astype(np.float32)))
    return "" if damage is None else damage.cause


def half_dead(pixels):
    return np.where(np.arange(512) < 256, 200.0, pixels)


@pytest.mark.parametrize(
    "pixels", [NOISE, NOISE / 8, np.floor(NOISE / 16) * 16, half_dead(NOISE), np.full((512, 512), 100.0)],
    ids=["16 bits", "8 bits", "steps of 16", "half dead", "flat"],
)  # fmt: skip
def test_noise_of_a_sensor_is_no_damage(pixels):
    assert cause_in(pixels) == ""


@pytest.mark.parametrize("level", [380, 400, 410])
def test_clipping_is_named_with_its_part(level):
    clipped = np.clip(NOISE - level, 0, None)
    assert cause_in(clipped).startswith("values are clipped at 0 ADU")
    part = float(cause_in(clipped).split(": ")[1].split(" ")[0])
    assert part == pytest.approx(100 * np.mean(np.rint(clipped) == 0), abs=1.5)
    assert cause_in(half_dead(clipped)).startswith("values are clipped at 0 ADU")


@pytest.mark.parametrize("filtered", [cv2.GaussianBlur(NOISE, (0, 0), 0.7), cv2.blur(NOISE, (3, 3))], ids=["0.7", "3"])
def test_a_filter_is_named_with_the_correlation(filtered):
    assert "neighbouring pixels correlate" in cause_in(filtered)


def test_a_threshold_takes_the_noise():
    stars = np.where(NOISE > 440.0, NOISE, 0.0)
    assert "noise is lost" in cause_in(stars)


def test_stars_slopes_and_steps_are_no_filter():
    y, x = np.mgrid[:512, :512]
    rng = np.random.default_rng(6)
    light = np.zeros((512, 512))
    at = rng.integers(0, 512, (2, 800))
    light[tuple(at)] = rng.uniform(500, 5000, 800)
    sky = cv2.GaussianBlur(light, (0, 0), 1.0) + 0.2 * x + 30.0 * (y > 200)
    assert cause_in(NOISE + sky) == ""
