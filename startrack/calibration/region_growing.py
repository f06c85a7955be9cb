"""Inside out: from the stars that a rough camera names to all stars of the frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.calibration.fit import FEWEST, LensFit, fit_lens
from startrack.calibration.frame import Frame
from startrack.calibration.matching import Matched, match_frame
from startrack.calibration.observations import Observations
from startrack.camera import Camera
from startrack.identification.match import taken
from startrack.types import Array, Ints, NotIdentified

STEP_RAD = np.radians(8.0)
FIRST_GATE_PX = 6.0
BRIGHTEST = 1000  # hot pixels may outnumber the bright stars
GATES_PX = (4.0, 3.0, 2.0)
LAST_GATE = 4.5  # times the residuals' sigma
NARROWEST_GATE_PX = 0.8
GROWTH_ROUNDS = 16
FINAL_ROUNDS = 8
SETTLED_PART = 0.003
MANY = 100


@dataclass(frozen=True)
class Joint:
    """The lens of several frames with the matches it rests on."""

    frames: tuple[Frame, ...]
    matches: tuple[Matched, ...]
    points: Observations
    fit: LensFit
    gate_px: float


def grown(frame: Frame, camera: Camera, R_cam_icrs: Array, star: Ints, detection: Ints) -> tuple[Camera, Array]:
    """Camera and attitude of one frame, from the given matches outwards, ring by ring to the edge of the frame.

    By its bright sources: among all of them a gate this wide would find a wrong star as often as the right one.
    Raises NotIdentified where too few stars agree.
    """
    frame = replace(frame, detections=taken(frame.detections, slice(BRIGHTEST)))
    star, detection = star[detection < BRIGHTEST], detection[detection < BRIGHTEST]
    rays = frame.sky.stars.rays_icrs[star] @ R_cam_icrs.T
    known = _outer(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]))
    fit = _fit((frame,), (_pairs(detection, star),), camera, R_cam_icrs[None], order=_order(known, len(star)))
    for _ in range(GROWTH_ROUNDS):
        reach = known + STEP_RAD
        matched = match_frame(frame, fit.camera, fit.R_cam_icrs[0], reach, FIRST_GATE_PX)
        if len(matched) < FEWEST:
            break
        fit = _fit((frame,), (matched,), fit.camera, fit.R_cam_icrs, order=_order(reach, len(matched)))
        moved_on = fit.camera.calibrated_angle_rad
        if moved_on < known + np.radians(0.5):
            break
        known = moved_on
    return fit.camera, fit.R_cam_icrs[0]


def joint(frames: tuple[Frame, ...], camera: Camera, R_cam_icrs: Array) -> Joint:
    """All frames together: match with a shrinking gate and fit, until the matches settle.

    `R_cam_icrs` (frames, 3, 3) and the camera must be right to a few pixels where stars were matched.
    """
    fit: LensFit | None = None
    before = 0
    gate = GATES_PX[0]
    for k in range(FINAL_ROUNDS):
        gate = GATES_PX[k] if k < len(GATES_PX) else _gate(fit)
        within = camera.calibrated_angle_rad + STEP_RAD
        matches = tuple(
            match_frame(frame, camera, R, within, gate) for frame, R in zip(frames, R_cam_icrs, strict=True)
        )
        fit = _fit(frames, matches, camera, R_cam_icrs, order=None if k >= len(GATES_PX) else _order(within, MANY))
        camera, R_cam_icrs = fit.camera, fit.R_cam_icrs
        total = sum(map(len, matches))
        if k > len(GATES_PX) and abs(total - before) <= SETTLED_PART * total:
            break
        before = total
    assert fit is not None
    return Joint(frames=frames, matches=matches, points=_points(frames, matches), fit=fit, gate_px=gate)


def _gate(fit: LensFit | None) -> float:
    assert fit is not None
    return float(np.clip(LAST_GATE * fit.rms_px / np.sqrt(2.0), NARROWEST_GATE_PX, GATES_PX[-1]))


def _fit(
    frames: tuple[Frame, ...], matches: tuple[Matched, ...], camera: Camera, R_cam_icrs: Array, order: int | None
) -> LensFit:
    points = _points(frames, matches)
    if not len(points):
        raise NotIdentified("no star lies where the camera puts it")
    return fit_lens(replace(camera, covariance=None, covariance_order=()), R_cam_icrs, points, order=order)


def _points(frames: tuple[Frame, ...], matches: tuple[Matched, ...]) -> Observations:
    pairs = list(zip(frames, matches, strict=True))
    return Observations(
        image=np.repeat(np.arange(len(pairs)), [len(m) for _, m in pairs]),
        xy_px=np.concatenate([f.detections.xy_px[m.detection] for f, m in pairs]),
        covariance_px2=np.concatenate([f.detections.covariance_px2[m.detection] for f, m in pairs]),
        rays_icrs=np.concatenate([f.sky.stars.rays_icrs[m.star] for f, m in pairs]),
    )


def _pairs(detection: Ints, star: Ints) -> Matched:
    order = np.argsort(detection)
    return Matched(detection[order], star[order], 0, 0, 0, 0)


def _outer(angle_rad: Array) -> float:
    return float(np.quantile(angle_rad, 0.95)) if len(angle_rad) else 0.0


def _order(reach_rad: float, count: int) -> int:
    """Terms of the polynomial that stars out to this angle can bear."""
    return int(np.clip(1 + np.degrees(reach_rad) // 25, 1, 4)) if count >= 25 else 1
