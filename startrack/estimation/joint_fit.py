"""A lens for several frames: from the stars that a rough camera identifies to all stars of the frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Ints, NotIdentified
from startrack.estimation.frame_matching import Frame, FrameMatches, match_frame, match_frames
from startrack.estimation.lens_fit import MIN_LENS_STARS, WIDEST_GAP_RAD, LensFit, fit_lens
from startrack.estimation.normal_equations import Observations, observations
from startrack.frames import off_axis_rad

RING_RAD = WIDEST_GAP_RAD  # width of the ring added in each round
SMALLEST_GROWTH_RAD = np.radians(0.5)
BRIGHTEST_SOURCES = 1000  # sources used; hot pixels may outnumber the bright stars
JOINT_GATES_PX = (6.0, 4.0, 3.0, 2.0)  # the first while the region grows, the others for all stars
LAST_GATE_SIGMAS = 4.5  # of the residuals, for the last gates
NARROWEST_GATE_PX = 0.8
GROWTH_ROUNDS = 16
FINAL_ROUNDS = 8
SETTLED_FRACTION = 0.003  # change of the number of matches
MIN_FOR_POLYNOMIAL = 25
RAD_PER_COEFFICIENT = np.radians(25.0)
KNOWN_QUANTILE = 0.95


@dataclass(frozen=True)
class JointFit:
    """The lens of several frames with the matches that it was fitted to."""

    frames: tuple[Frame, ...]
    matches: tuple[FrameMatches, ...]
    points: Observations
    fit: LensFit
    gate_px: float
    birge_ratio: float = 1.0  # by which the errors of regions exceed those of their stars; in the lens's covariance


def grow_from_matches(
    frame: Frame, camera: Camera, R_cam_icrs: Array, star: Ints, detection: Ints
) -> tuple[Camera, Array]:
    """Camera and attitude of one frame, grown ring by ring from the matches (star, detection) to the edge of the frame.

    Only bright sources are used: with all of them a gate this wide would give as many wrong matches as right ones.
    Raises NotIdentified where too few stars agree.
    """
    frame = replace(frame, sources=frame.sources.take(slice(BRIGHTEST_SOURCES)))
    bright = np.flatnonzero(detection < BRIGHTEST_SOURCES)
    bright = bright[np.argsort(detection[bright])]
    points = _points((frame,), [(detection[bright], star[bright])])
    off_axis = off_axis_rad(points.rays_icrs @ R_cam_icrs.T)
    known = float(np.quantile(off_axis, KNOWN_QUANTILE)) if len(off_axis) else 0.0
    fit = _fit_points(points, camera, R_cam_icrs[None], _coefficients(known, len(points)))
    for _ in range(GROWTH_ROUNDS):
        within = known + RING_RAD
        matched = match_frame(frame, fit.camera, fit.R_cam_icrs[0], within, JOINT_GATES_PX[0])
        if len(matched) < MIN_LENS_STARS:
            break
        points = _points((frame,), [(matched.detection, matched.star)])
        fit = _fit_points(points, fit.camera, fit.R_cam_icrs, _coefficients(within, len(matched)))
        reached = fit.camera.calibrated_angle_rad
        if reached < known + SMALLEST_GROWTH_RAD:
            break
        known = reached
    return fit.camera, fit.R_cam_icrs[0]


def fit_frames(
    frames: tuple[Frame, ...], camera: Camera, R_cam_icrs: Array, progress: Callable[[str], None] = lambda text: None
) -> JointFit:
    """The lens of all frames together: matches with a shrinking gate and fits, until the matches settle.

    `R_cam_icrs` (frames, 3, 3) and the camera must be right within a few pixels where stars were matched. `progress` is
    called with a text in each of FINAL_ROUNDS or fewer rounds.
    """
    before, gates_px, gate_px = 0, JOINT_GATES_PX[1:], 0.0
    for k in range(FINAL_ROUNDS):
        progress(f"fitting the lens to all images, round {k + 1}")
        first = k < len(gates_px)
        gate_px = gates_px[k] if first else gate_px
        within = camera.calibrated_angle_rad + RING_RAD
        matches = match_frames(frames, camera, R_cam_icrs, within, gate_px)
        points = _points(frames, [(matched.detection, matched.star) for matched in matches])
        fit = _fit_points(points, camera, R_cam_icrs, _coefficients(within) if first else None)
        camera, R_cam_icrs = fit.camera, fit.R_cam_icrs
        total = sum(map(len, matches))
        if k > len(gates_px) and abs(total - before) <= SETTLED_FRACTION * total:
            break
        before = total
        gate_px = float(np.clip(LAST_GATE_SIGMAS * fit.rms_px / np.sqrt(2.0), NARROWEST_GATE_PX, gates_px[-1]))
    return JointFit(frames=frames, matches=matches, points=points, fit=fit, gate_px=gate_px)


def _fit_points(points: Observations, camera: Camera, R_cam_icrs: Array, coefficients: int | None) -> LensFit:
    """Lens and attitudes that fit the observations. Raises NotIdentified where there are none."""
    if not len(points):
        raise NotIdentified("no star lies where the camera predicts it")
    start = replace(camera, covariance=None, covariance_order=())
    return fit_lens(start, R_cam_icrs, points, coefficients=coefficients)


def _points(frames: tuple[Frame, ...], matches: list[tuple[Ints, Ints]]) -> Observations:
    """Observations of the sources and stars of the `frames` that are matched: indices of both, frame by frame."""
    pairs = [(f.sources.take(detection), f.sky.stars.rays_icrs[star])
             for f, (detection, star) in zip(frames, matches, strict=True)]  # fmt: skip
    return observations(
        [found.xy_px for found, _ in pairs], [rays for _, rays in pairs], [found.covariance_px2 for found, _ in pairs]
    )


def _coefficients(angle_rad: float, stars: int | None = None) -> int:
    """Number of the default lens's coefficients that stars out to this angle determine; without `stars` of many."""
    return 1 if stars is not None and stars < MIN_FOR_POLYNOMIAL else 1 + int(angle_rad // RAD_PER_COEFFICIENT)
