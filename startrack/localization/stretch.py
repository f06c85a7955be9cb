"""The horizon that the stars see beside the terrain's own, made higher or lower by one factor for all azimuths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.nuisance import STEEPNESS_LEEWAY
from startrack.localization.refit import STEPS_M, refitted_gain
from startrack.types import Array, Evidence

STRETCHES = (0.005, 0.01, 0.015, 0.025, 0.05, 0.1)  # relative, both ways
SMALL_STRETCHES = 4  # of these: the others are tried only where these gain
STRETCH_NEARBY_M = 80.0
STRETCH_GAIN_NATS = 4.5  # a true map gains more in 1 of 370; of 240 images with maps 1 % off the least gain was 7.6
FINE_STRETCHES = (0.001, 0.002, 0.003, 0.004, 0.006, 0.008, 0.01)  # the last one is that of another crater
DEPTH_GAIN_NATS = 2.0  # 3 of 60 images of craters as stated gain more, and 42 of 65 with depths 0.1 to 0.5 % off


def shown_steepness(likelihood: PositionLikelihood, position_m: Array) -> float:
    """By how much (relative) the stars show a crater steeper than its file states; 0.0 for the same or another crater.

    The position (2,) is near that of the camera. Steepness is depth by diameter.
    """
    best, gain, _ = _scan(likelihood, position_m, FINE_STRETCHES)
    same = abs(best - 1) < FINE_STRETCHES[-1] * (1 - 1e-9)
    return best - 1 if same and gain > DEPTH_GAIN_NATS else 0.0


def best_stretch(likelihood: PositionLikelihood, position_m: Array) -> tuple[float, float]:
    """The stretch of the horizon that fits best near a position (2,), and how much better [nats] than none.

    tan H -> s tan H for all azimuths, the position free: a wrong depth, width or camera height shows as s != 1, while a
    wrong position cannot. Large stretches are tried only where small ones gain, and more of them than less.
    """
    sizes = STRETCHES[:SMALL_STRETCHES]
    best, gain, at = _scan(likelihood, position_m, sizes)
    if abs(best - 1) > sizes[-1] * (1 - 1e-9):
        best, gain, at = _scan(likelihood, position_m, STRETCHES)
    if gain > STRETCH_GAIN_NATS and not likelihood.in_closed_form:
        e = likelihood.evidence
        gain = min(gain, refitted_gain(likelihood, position_m, replace(e, elevation_rad=_lowered_rad(e, best)), at))
    return best, gain


def _scan(likelihood: PositionLikelihood, position_m: Array, sizes: tuple[float, ...]) -> tuple[float, float, Array]:
    """The best stretch of these sizes (relative, both ways), its gain [nats] over none, and its position (2,)."""
    best, gain, at = 1.0, 0.0, position_m
    local = likelihood.near(position_m, STRETCH_NEARBY_M, sizes[-1] * STEEPNESS_LEEWAY)
    if not len(local.evidence):
        return best, gain, at
    middle, plain = local.climb(position_m, *STEPS_M)
    for sign in (1, -1):
        position = middle
        for stretch in (1 + sign * size for size in sizes):
            position, fit = local.climb(position, *STEPS_M, _lowered_rad(local.evidence, stretch))
            if fit - plain > gain:
                best, gain, at = stretch, fit - plain, position
    return best, gain, at


def _lowered_rad(evidence: Evidence, stretch: float) -> Array:
    """Elevations (n,) [rad] at which the rows stand above the horizon as they do above one stretched by a factor."""
    return np.asarray(np.arctan(np.tan(evidence.elevation_rad) / stretch))
