"""Sources that keep their pixel while the sky turns are not stars: hot pixels, dust, lamps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.calibration.frame import Frame
from startrack.types import Array, Bools, Detections

SAME_PX = 0.7
TURNED_PX = 4.0  # by which the sky must have moved in the image before the same pixel is suspicious


def without_fixed(frames: tuple[Frame, ...], R_cam_icrs: Array) -> tuple[Frame, ...]:
    """The frames without sources that lie at the same pixel of another frame whose sky is turned."""
    return tuple(
        replace(frame, detections=_kept(frame.detections, ~_fixed(i, frames, R_cam_icrs)))
        for i, frame in enumerate(frames)
    )


def has_turned(one: Array, other: Array, size_px: tuple[int, int]) -> bool:
    """Whether the sky stands clearly elsewhere in the image at two attitudes (3, 3), but near the axis of the turn."""
    turn = other @ one.T
    angle = np.arctan2(np.linalg.norm(turn - turn.T) / np.sqrt(8.0), (np.trace(turn) - 1.0) / 2.0)
    return bool(angle * max(size_px) / 4.0 > TURNED_PX)


def _fixed(i: int, frames: tuple[Frame, ...], R_cam_icrs: Array) -> Bools:
    from scipy.spatial import cKDTree

    xy = frames[i].detections.xy_px
    fixed = np.zeros(len(xy), dtype=bool)
    for j, other in enumerate(frames):
        if j == i:
            continue
        if has_turned(R_cam_icrs[i], R_cam_icrs[j], other.size_px):
            distance, _ = cKDTree(other.detections.xy_px).query(xy, distance_upper_bound=SAME_PX)
            fixed |= np.isfinite(distance)
    return fixed


def _kept(found: Detections, which: Bools) -> Detections:
    names = ("xy_px", "covariance_px2", "flux_e", "flux_sigma_e", "snr", "saturated")
    return replace(found, **{name: getattr(found, name)[which] for name in names})
