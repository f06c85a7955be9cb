"""What the pixels say of the sensor: gain and read noise, level without light, saturation, PSF width, hot pixels."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from startrack.calibration.frame import Frame
from startrack.calibration.noise import Transfer, photon_transfer
from startrack.calibration.region_growing import Joint
from startrack.calibration.static_sources import has_turned
from startrack.calibration.widths import star_widths
from startrack.camera import Camera
from startrack.types import Array, Bools, Exposure, Ints

DARK_BEYOND = 1.06  # of the image circle's radius: where no light should be
FEWEST_DARK = 4000
DARK_PART = 0.2  # spread of the dark corners over their distance from the sky's level, at most
FEWEST_SATURATED = 12
HOT_SIGMA = 8.0
MOST_HOT = 20_000
STAR_PX = 3.0
STILL_PX = 0.3
NEIGHBOURS = np.array([[0, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0]])  # twice the mean of the four


@dataclass(frozen=True, kw_only=True)
class SensorFacts:
    """Measured properties; None where the pictures do not tell."""

    transfer: Transfer | None
    same_sky: bool  # whether photon transfer compares frames between which the sky stood still
    bias_adu: float | None
    saturation_adu: float | None
    psf_sigma_px: float | None
    light_1: float  # flux with a star's own width over the flux that the detector found
    psf_by_ring_px: tuple[float | None, ...]  # from the axis to the calibrated angle
    hot_px: Array | None  # (n, 2) x, y


def measured_sensor(joint: Joint, rings: int) -> SensorFacts:
    """All that the exposures of a calibration tell of the sensor."""
    widths = star_widths(joint)
    pairs, same_sky = _pairs(joint)
    camera = joint.fit.camera
    edges = np.linspace(0.0, camera.calibrated_angle_rad, rings + 1)
    by_ring = tuple(
        float(np.median(widths.sigma_px[inside])) if inside.sum() >= 5 else None
        for inside in ((widths.angle_rad >= a) & (widths.angle_rad < b) for a, b in pairwise(edges))
    )
    return SensorFacts(
        transfer=photon_transfer(pairs),
        same_sky=same_sky,
        bias_adu=_dark_level(joint.frames, camera),
        saturation_adu=_saturation(joint.frames),
        psf_sigma_px=float(np.median(widths.sigma_px)) if len(widths.sigma_px) >= 5 else None,
        light_1=float(np.median(widths.light_1)) if len(widths.sigma_px) >= 5 else 1.0,
        psf_by_ring_px=by_ring,
        hot_px=_hot(joint),
    )


def _pairs(joint: Joint) -> tuple[list[tuple[Exposure, Exposure]], bool]:
    """Neighbouring exposures between which the sky stood still; all neighbours where there are none such."""
    frames, R = joint.frames, joint.fit.R_cam_icrs
    still: list[tuple[Exposure, Exposure]] = []
    moving: list[tuple[Exposure, Exposure]] = []
    for i, (a, b) in enumerate(pairwise(frames)):
        turn = R[i + 1] @ R[i].T
        angle = float(np.linalg.norm(turn - turn.T) / np.sqrt(8.0))
        near = angle * max(joint.fit.camera.focal_px) < STILL_PX and np.trace(turn) > 0
        (still if near else moving).append((a.exposure, b.exposure))
    return (still, True) if still else (moving, False)


def _dark_level(frames: tuple[Frame, ...], camera: Camera) -> float | None:
    """Level [ADU] of the corners beyond the image circle, if there are any and they are flat and darker than the sky.

    Dark current of the exposure is in it; of several frames the darkest counts, for scattered light adds.
    """
    width, height = camera.size_px
    x, y = np.meshgrid(np.arange(0, width, 4), np.arange(0, height, 4))
    fx, fy = camera.focal_px
    off = np.hypot((x - camera.centre_px[0]) / fx, (y - camera.centre_px[1]) / fy)
    rim = float(camera.lens.rho(np.array(camera.max_angle_rad)))
    dark, lit = off > DARK_BEYOND * rim, off < 0.8 * rim
    if np.count_nonzero(dark) < FEWEST_DARK // 16:
        return None
    levels = []
    for frame in frames:
        p = frame.exposure.pixels_adu[::4, ::4]
        level, sky = float(np.median(p[dark])), float(np.median(p[lit]))
        corners = [float(np.median(p[dark & side])) for side in _quarters(x, y, camera) if (dark & side).sum() > 50]
        if max(corners) - min(corners) < DARK_PART * (sky - level):
            levels.append(level)
    return min(levels) if levels else None


def _quarters(x: Ints, y: Ints, camera: Camera) -> list[Bools]:
    right, below = x > camera.centre_px[0], y > camera.centre_px[1]
    return [right & below, right & ~below, ~right & below, ~right & ~below]


def _saturation(frames: tuple[Frame, ...]) -> float | None:
    """The largest value [ADU], where several pixels share it; None where nothing is saturated."""
    top = max(float(frame.exposure.pixels_adu.max()) for frame in frames)
    count = sum(int(np.count_nonzero(frame.exposure.pixels_adu >= top)) for frame in frames)
    return top if count >= FEWEST_SATURATED else None


def _hot(joint: Joint) -> Array | None:
    """Pixels (n, 2) that stand out in every frame though the sky has turned; None where it has not."""
    import cv2

    first, R = joint.frames[0], joint.fit.R_cam_icrs
    others = [i for i in range(1, len(joint.frames)) if has_turned(R[0], R[i], first.size_px)]
    if not others:
        return None
    least: Array | None = None
    for i in (0, *others):
        frame = joint.frames[i]
        image = np.asarray(frame.exposure.pixels_adu)
        excess = image - cv2.medianBlur(image, 5)
        noise = 1.4826 * float(np.median(np.abs(excess[::3, ::3]))) or 1.0
        # A star, the Earth or a planet lights the neighbours too, a hot pixel does not.
        beside = cv2.filter2D(np.maximum(excess, 0.0), -1, NEIGHBOURS)
        standing = np.asarray((excess - beside) / noise, dtype=np.float64)
        for px in frame.detections.xy_px[joint.matches[i].detection]:
            x, y = np.rint(px).astype(int)
            reach = int(STAR_PX)
            standing[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1] = 0.0
        least = standing if least is None else np.minimum(least, standing)
    assert least is not None
    y, x = np.nonzero(least > HOT_SIGMA)
    order = np.argsort(-least[y, x], kind="stable")[:MOST_HOT]
    return np.stack([x[order], y[order]], axis=1).astype(np.float64)
