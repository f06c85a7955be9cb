"""Region growing: from the stars that a rough camera identifies outwards to all stars of the frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.applications.calibration.frame import Frame
from startrack.applications.calibration.lens_fit import MIN_STARS, LensFit, fit_lens
from startrack.applications.calibration.matching import NO_BRIGHT_STARS, FrameMatches, match_frame
from startrack.camera import Camera
from startrack.core.types import Array, Ints, NotIdentified
from startrack.estimation.normal_equations import Observations

RING_RAD = np.radians(8.0)  # width of the ring added in each round
SMALLEST_GROWTH_RAD = np.radians(0.5)
FIRST_GATE_PX = 6.0
BRIGHTEST_SOURCES = 1000  # sources used; hot pixels may outnumber the bright stars
GATES_PX = (4.0, 3.0, 2.0)
GATE_SIGMAS = 4.5  # of the residuals, for the last gates
NARROWEST_GATE_PX = 0.8
GROWTH_ROUNDS = 16
FINAL_ROUNDS = 8
SETTLED_FRACTION = 0.003  # change of the number of matches
ALL_ORDERS_STARS = 100  # number of stars from which the order of the polynomial follows from the angle alone
MIN_FOR_POLYNOMIAL = 25
DEGREES_PER_COEFFICIENT = 25
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
    star, detection = star[detection < BRIGHTEST_SOURCES], detection[detection < BRIGHTEST_SOURCES]
    rays = frame.sky.stars.rays_icrs[star] @ R_cam_icrs.T
    known = _outer_angle(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]))
    fit = _fit(
        (frame,), (_pairs(detection, star),), camera, R_cam_icrs[None], coefficients=_coefficients(known, len(star))
    )
    for _ in range(GROWTH_ROUNDS):
        within = known + RING_RAD
        matched = match_frame(frame, fit.camera, fit.R_cam_icrs[0], within, FIRST_GATE_PX)
        if len(matched) < MIN_STARS:
            break
        fit = _fit((frame,), (matched,), fit.camera, fit.R_cam_icrs, coefficients=_coefficients(within, len(matched)))
        reached = fit.camera.calibrated_angle_rad
        if reached < known + SMALLEST_GROWTH_RAD:
            break
        known = reached
    return fit.camera, fit.R_cam_icrs[0]


def fit_frames(frames: tuple[Frame, ...], camera: Camera, R_cam_icrs: Array) -> JointFit:
    """The lens of all frames together: matches with a shrinking gate and fits, until the matches settle.

    `R_cam_icrs` (frames, 3, 3) and the camera must be right within a few pixels where stars were matched.
    """
    before, gate_px = 0, GATES_PX[0]
    for k in range(FINAL_ROUNDS):
        first = k < len(GATES_PX)
        gate_px = GATES_PX[k] if first else gate_px
        within = camera.calibrated_angle_rad + RING_RAD
        matches = tuple(
            match_frame(frame, camera, R, within, gate_px) for frame, R in zip(frames, R_cam_icrs, strict=True)
        )
        fit = _fit(frames, matches, camera, R_cam_icrs, _coefficients(within, ALL_ORDERS_STARS) if first else None)
        camera, R_cam_icrs = fit.camera, fit.R_cam_icrs
        total = sum(map(len, matches))
        if k > len(GATES_PX) and abs(total - before) <= SETTLED_FRACTION * total:
            break
        before, gate_px = total, _gate_px(fit)
    return JointFit(frames=frames, matches=matches, points=_points(frames, matches), fit=fit, gate_px=gate_px)


def _gate_px(fit: LensFit) -> float:
    return float(np.clip(GATE_SIGMAS * fit.rms_px / np.sqrt(2.0), NARROWEST_GATE_PX, GATES_PX[-1]))


def _fit(
    frames: tuple[Frame, ...],
    matches: tuple[FrameMatches, ...],
    camera: Camera,
    R_cam_icrs: Array,
    coefficients: int | None,
) -> LensFit:  # fmt: skip
    points = _points(frames, matches)
    if not len(points):
        raise NotIdentified("no star lies where the camera predicts it")
    return fit_lens(
        replace(camera, covariance=None, covariance_order=()), R_cam_icrs, points, coefficients=coefficients
    )


def _points(frames: tuple[Frame, ...], matches: tuple[FrameMatches, ...]) -> Observations:
    pairs = list(zip(frames, matches, strict=True))
    return Observations(
        image=np.repeat(np.arange(len(pairs)), [len(m) for _, m in pairs]),
        xy_px=np.concatenate([f.sources.xy_px[m.detection] for f, m in pairs]),
        covariance_px2=np.concatenate([f.sources.covariance_px2[m.detection] for f, m in pairs]),
        rays_icrs=np.concatenate([f.sky.stars.rays_icrs[m.star] for f, m in pairs]),
    )


def _pairs(detection: Ints, star: Ints) -> FrameMatches:
    order = np.argsort(detection)
    return FrameMatches(detection[order], star[order], 0, 0, 0, 0, NO_BRIGHT_STARS)


def _outer_angle(angle_rad: Array) -> float:
    return float(np.quantile(angle_rad, KNOWN_QUANTILE)) if len(angle_rad) else 0.0


def _coefficients(angle_rad: float, stars: int) -> int:
    """Number of k that stars out to this angle determine."""
    if stars < MIN_FOR_POLYNOMIAL:
        return 1
    return int(np.clip(1 + np.degrees(angle_rad) // DEGREES_PER_COEFFICIENT, 1, 4))
