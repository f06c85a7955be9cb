"""One depth of a crater for all frames of a track: freed where its file is wrong, and frames that show another one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from startrack.sky_refinement import MOST_STEEPER
from startrack.terrain import Cylinder, Terrain
from startrack.tracking.frame_estimate import FrameEstimate
from startrack.tracking.observe import ObservedFrame
from startrack.tracking.shared import STEEPNESS, SharedErrors

FREE_SIGMA_1 = 0.5 * MOST_STEEPER  # relative, of a depth that the images estimate: two of these are the largest error
MOST_SIGMAS = 5.0  # between the depth of one frame and that of the others
LEAST_SHARE = 0.5  # of the variance of the depth, that a frame must take away to be compared

Measured = tuple[float, float]  # a depth and its variance, in standard deviations of the prior


def free_depth(terrain: Terrain) -> Terrain:
    """The `terrain` with a depth that the images estimate.

    Its standard deviation does not depend on the image that showed the error: the order of images does not matter.
    """
    if not isinstance(terrain, Cylinder):
        raise TypeError(f"{type(terrain).__name__}: only a cylinder has a depth")
    return replace(terrain, depth_sigma_m=FREE_SIGMA_1 * terrain.depth_m)


def drop_other_depths(frames: Sequence[ObservedFrame], shared: SharedErrors) -> Sequence[ObservedFrame]:
    """The frames, refused (inconsistent_evidence) where they show another depth of the crater than the others.

    The frame that the others contradict most is left out first; of two that contradict each other, the later one.
    """
    if STEEPNESS not in shared.names:
        return frames
    at = shared.names.index(STEEPNESS)
    depths = {k: one for k, frame in enumerate(frames) if (one := _depth(frame.modes, at)) is not None}
    other: dict[int, Measured] = {}
    while len(depths) > 1:
        away = _sigmas_off(list(depths.values()))
        number, worst = max(zip(depths, away, strict=True), key=lambda one: (round(one[1], 6), one[0]))
        if worst < MOST_SIGMAS:
            break
        other[number] = depths.pop(number)
    return [_refuse(frame, other[k], depths, shared) if k in other else frame for k, frame in enumerate(frames)]


def _refuse(frame: ObservedFrame, shown: Measured, depths: dict[int, Measured], shared: SharedErrors) -> ObservedFrame:
    percent = 100.0 * float(shared.sigma[shared.names.index(STEEPNESS)])
    message = (
        f"it shows a depth {percent * shown[0]:+.2f} % off that of the terrain file, the other frames "
        f"{percent * _mean(list(depths.values()))[0]:+.2f} %"
    )
    return replace(frame, modes=(), reason="inconsistent_evidence", message=message)


def _depth(modes: Sequence[FrameEstimate], at: int) -> Measured | None:
    """The depth that a frame with a single mode shows by itself, without the prior; None where it shows none."""
    if len(modes) != 1:
        return None
    k = 2 + at
    share, variance = float(modes[0].response[k, k]), float(modes[0].covariance[k, k])
    return None if share < LEAST_SHARE else (float(modes[0].mean[k]) / share, variance / share)


def _mean(depths: Sequence[Measured]) -> Measured:
    """Weighted mean and its variance."""
    value, variance = np.array(depths).T
    return float(np.average(value, weights=1.0 / variance)), float(1.0 / np.sum(1.0 / variance))


def _sigmas_off(depths: Sequence[Measured]) -> list[float]:
    """Difference of each of two or more depths from the mean of the others, in standard deviations."""
    value, variance = np.array(depths).T
    weight = 1.0 / variance
    rest = weight.sum() - weight
    mean = ((weight @ value) - weight * value) / rest
    return list(np.abs(value - mean) / np.sqrt(variance + 1.0 / rest))
