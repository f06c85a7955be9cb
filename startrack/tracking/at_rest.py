"""A camera at rest: the evidence of all its exposures in one posterior, which needs no linearization."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from startrack.terrain import Terrain
from startrack.tracking.contradictions import RobustTrack, smooth_robustly
from startrack.tracking.frame_estimate import FrameEstimate, estimate_frame
from startrack.tracking.observe import ObservedFrame
from startrack.tracking.shared import ImageErrors, SharedErrors
from startrack.tracking.smoother import UNKNOWN_M, Observations, Smoothed, Steps, smooth
from startrack.types import Array, BadInput, Evidence, Ints

STILL_M = 1e-3  # of a camera at rest from exposure to exposure, in the comparison of single fixes


@dataclass(frozen=True, eq=False)
class AtRest:
    """Position after each exposure, and by all."""

    position_m: Array  # (n, 2)
    covariance_m2: Array  # (n, 2, 2)
    smoothed: Smoothed  # of one position, by all exposures
    mode: Ints  # (n,) which mode of each exposure agrees with the others; -1: none


def positions_at_rest(frames: Sequence[ObservedFrame], terrain: Terrain, shared: SharedErrors) -> AtRest:
    """The position by the evidence of the first exposures, for each number of them.

    Single fixes that contradict the others are left out. Errors that exposures share (bias, clock, shape, heights of
    posts) are carried once. Raises ValueError where no exposure has a position, and BadInput (inconsistent_evidence)
    where half of those with a single position or more are elsewhere.
    """
    n = len(frames)
    mode = agreeing_fixes([frame.modes for frame in frames], terrain.height_sigma_m).mode
    _require_rest(frames, mode)
    position, covariance = np.zeros((n, 2)), np.repeat([UNKNOWN_M**2 * np.eye(2)], n, axis=0)
    first, *later = np.flatnonzero(mode >= 0).tolist()
    found = _alone(frames[first].modes[mode[first]], terrain)
    position[first:], covariance[first:] = found.position_m[0], found.covariance_m2[0]
    used = [frames[first]]
    for k in later:
        used.append(frames[k])
        found = _alone(_pooled(used, *_combine(frames[k].modes[mode[k]], found), terrain, shared), terrain)
        position[k:], covariance[k:] = found.position_m[0], found.covariance_m2[0]
    return AtRest(position, covariance, found, mode)


def _require_rest(frames: Sequence[ObservedFrame], mode: Ints) -> None:
    single = np.array([len(frame.modes) == 1 for frame in frames])
    agree, count = int(np.sum(single & (mode >= 0))), int(np.sum(single))
    if count > 1 and 2 * agree <= count:
        raise BadInput(
            "inconsistent_evidence",
            f"only {agree} of {count} images agree on one position: has the camera moved? Then leave --at-rest out",
        )


def agreeing_fixes(modes: Sequence[Sequence[FrameEstimate]], height_sigma_m: float) -> RobustTrack:
    """The single fixes as a track that does not move: which of them agree."""
    still = Steps(np.zeros((len(modes) - 1, 2)), np.full(len(modes) - 1, STILL_M))
    return smooth_robustly(modes, still, height_sigma_m, may_slip=False)


def _alone(estimate: FrameEstimate, terrain: Terrain) -> Smoothed:
    return smooth(Observations.of([estimate], terrain.height_sigma_m), Steps.unknown(1))


def _pooled(
    frames: list[ObservedFrame], first_mean: Array, first_covariance: Array, terrain: Terrain, shared: SharedErrors
) -> FrameEstimate:
    """The observation by the rows of all exposures together."""
    rows = Evidence.concatenate(*(frame.evidence for frame in frames if frame.evidence is not None))
    errors = mean_image_errors([frame.image_errors for frame in frames if frame.image_errors is not None])
    return estimate_frame(rows, terrain, shared, first_mean, first_covariance, errors)


def mean_image_errors(errors: Sequence[ImageErrors]) -> ImageErrors | None:
    """Errors of the mean of several exposures, each with its own: None where none has any."""
    if not errors:
        return None
    covariance = np.sum([one.covariance for one in errors], axis=0) / len(errors) ** 2
    raised = np.stack([one.raised_rad for one in errors])
    many = np.maximum(raised.any(axis=2).sum(axis=0), 1)
    return ImageErrors(raised.sum(axis=0) / many[:, None], covariance)


def _combine(newest: FrameEstimate, before: Smoothed) -> tuple[Array, Array]:
    """A first guess: weighted mean of two positions; shared errors as before."""
    known = [np.linalg.inv(c) for c in (newest.covariance[:2, :2], before.covariance_m2[0])]
    covariance = np.zeros_like(newest.covariance)
    covariance[:2, :2] = np.linalg.inv(known[0] + known[1])
    covariance[2:, 2:] = before.shared_covariance
    position = covariance[:2, :2] @ (known[0] @ newest.mean[:2] + known[1] @ before.position_m[0])
    return np.concatenate([position, before.shared]), covariance
