"""A camera at rest: the joint posterior of one position by all its exposures, with the shared errors carried once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from startrack.applications.tracking.contradictions import smooth_robustly
from startrack.applications.tracking.frame_estimate import LEAST_HALF_M, REACH_SIGMAS, observe_together
from startrack.applications.tracking.frame_model import FrameModel, sample_together
from startrack.applications.tracking.observed_frame import ObservedFrame
from startrack.applications.tracking.track_errors import TrackErrors
from startrack.core.types import Array, BadInput, Ints
from startrack.estimation.observations import UNKNOWN_M, FrameEstimate, Observations, Steps
from startrack.estimation.smoother import Smoothed, smooth
from startrack.terrain import Terrain

STILL_M = 1e-3  # of a camera at rest from exposure to exposure, in the comparison of single fixes


@dataclass(frozen=True, eq=False)
class AtRest:
    """Position after each exposure, and by all."""

    position_m: Array  # (n, 2)
    covariance_m2: Array  # (n, 2, 2)
    smoothed: Smoothed  # of one position, by all exposures
    mode: Ints  # (n,) which mode of each exposure agrees with the others; -1: none


def positions_at_rest(frames: Sequence[ObservedFrame], terrain: Terrain, errors: TrackErrors) -> AtRest:
    """The position by the first exposures together, for each number of them.

    Single fixes that contradict the others are left out. Errors that exposures share are carried once, those of each
    image apart. Raises ValueError where no exposure has a position, and BadInput (inconsistent_evidence) where half of
    those with a single position or more are elsewhere.
    """
    n = len(frames)
    still = Steps(np.zeros((n - 1, 2)), np.full(n - 1, STILL_M))
    agreeing = smooth_robustly([frame.modes for frame in frames], still, terrain.height_sigma_m, may_slip=False)
    mode, by_fixes = agreeing.mode, agreeing.smoothed
    _require_rest(frames, mode)
    position, covariance = np.zeros((n, 2)), np.repeat([UNKNOWN_M**2 * np.eye(2)], n, axis=0)

    def take(k: int, estimate: FrameEstimate) -> Smoothed:
        found = smooth(Observations.of([estimate], terrain.height_sigma_m), Steps.unknown(1))
        position[k:], covariance[k:] = found.position_m[0], found.covariance_m2[0]
        return found

    first, *later = np.flatnonzero(mode >= 0).tolist()
    found = take(first, frames[first].modes[mode[first]])
    reference = by_fixes.position_m[0]
    half = max(REACH_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(found.covariance_m2[0])[1])), LEAST_HALF_M)
    models: list[FrameModel] = []
    for k in (first, *later):
        evidence = frames[k].evidence
        if evidence is not None:
            models.append(FrameModel.near(evidence, terrain, errors, reference, half))
        if k != first:
            points = sample_together(models, reference, by_fixes.covariance_m2[0])
            found = take(k, observe_together(models, points))
    return AtRest(position, covariance, found, mode)


def _require_rest(frames: Sequence[ObservedFrame], mode: Ints) -> None:
    single = np.array([len(frame.modes) == 1 for frame in frames])
    agree, count = int(np.sum(single & (mode >= 0))), int(np.sum(single))
    if count > 1 and 2 * agree <= count:
        raise BadInput(
            "inconsistent_evidence",
            f"only {agree} of {count} images agree on one position: has the camera moved? Then leave --at-rest out",
        )
