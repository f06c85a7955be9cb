"""Sensor properties from the pixels: gain and read noise, dark level, saturation, PSF width, hot pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from itertools import pairwise

import numpy as np

from startrack.applications.calibration.frame import Frame, has_turned
from startrack.applications.calibration.photon_transfer import PhotonTransfer, fit_photon_transfer
from startrack.applications.calibration.psf_width import measure_psf_widths
from startrack.applications.calibration.region_growing import JointFit
from startrack.camera import Camera
from startrack.core.types import Array, Bools, Exposure, Ints

DARK_BEYOND_1 = 1.06  # of the image circle's radius: the sensor is dark beyond
MIN_DARK_PIXELS = 4000
LARGEST_DARK_SPREAD_1 = 0.2  # of the levels of the dark corners, over their difference from the sky
MIN_SATURATED_PIXELS = 12
MIN_STARS_FOR_WIDTH = 5
HOT_SIGMA = 8.0
MAX_HOT_PIXELS = 20_000
STAR_RADIUS_PX = 3
STILL_PX = 0.3
NEIGHBOURS = np.array([[0, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0]])  # twice the mean of the four


@dataclass(frozen=True, kw_only=True)
class SensorProperties:
    """Measured properties; None where the pictures do not determine them."""

    transfer: PhotonTransfer | None
    same_sky: bool  # whether the sky stood still between the frames of the photon transfer
    bias_adu: float | None
    saturation_adu: float | None
    psf_sigma_px: float | None
    flux_ratio: float  # flux with a star's own width over the flux of the detector
    psf_by_ring_px: tuple[float | None, ...]  # from the axis to the calibrated angle
    hot_px: Array | None  # (n, 2) x, y


def measure_sensor(joint: JointFit, rings: int) -> SensorProperties:
    """Sensor properties from the exposures of a calibration; the PSF in rings."""
    widths = measure_psf_widths(joint)
    pairs, same_sky = _pairs(joint)
    camera = joint.fit.camera
    edges = np.linspace(0.0, camera.calibrated_angle_rad, rings + 1)
    by_ring = tuple(
        float(np.median(widths.sigma_px[inside])) if inside.sum() >= MIN_STARS_FOR_WIDTH else None
        for inside in ((widths.angle_rad >= a) & (widths.angle_rad < b) for a, b in pairwise(edges))
    )
    return SensorProperties(
        transfer=fit_photon_transfer(pairs),
        same_sky=same_sky,
        bias_adu=_dark_level(joint.frames, camera),
        saturation_adu=_saturation_level(joint.frames),
        psf_sigma_px=float(np.median(widths.sigma_px)) if len(widths.sigma_px) >= MIN_STARS_FOR_WIDTH else None,
        flux_ratio=float(np.median(widths.flux_ratio)) if len(widths.sigma_px) >= MIN_STARS_FOR_WIDTH else 1.0,
        psf_by_ring_px=by_ring,
        hot_px=_find_hot_pixels(joint),
    )


def _pairs(joint: JointFit) -> tuple[list[tuple[Exposure, Exposure]], bool]:
    """Successive exposures between which the sky stood still, and True; without such all successive ones, and False."""
    frames, R = joint.frames, joint.fit.R_cam_icrs
    still: list[tuple[Exposure, Exposure]] = []
    moving: list[tuple[Exposure, Exposure]] = []
    for i, (a, b) in enumerate(pairwise(frames)):
        rotation = R[i + 1] @ R[i].T
        angle = float(np.linalg.norm(rotation - rotation.T) / np.sqrt(8.0))
        near = angle * max(joint.fit.camera.focal_px) < STILL_PX and np.trace(rotation) > 0
        (still if near else moving).append((a.exposure, b.exposure))
    return (still, True) if still else (moving, False)


def _dark_level(frames: tuple[Frame, ...], camera: Camera) -> float | None:
    """Level [ADU] of the corners beyond the image circle, where these are uniform and darker than the sky.

    It contains the dark current. The lowest of several frames is taken, because scattered light adds to it.
    """
    width, height = camera.size_px
    x, y = np.meshgrid(np.arange(0, width, 4), np.arange(0, height, 4))
    fx, fy = camera.focal_px
    off = np.hypot((x - camera.centre_px[0]) / fx, (y - camera.centre_px[1]) / fy)
    rim = float(camera.lens.rho(np.array(camera.max_angle_rad)))
    dark, lit = off > DARK_BEYOND_1 * rim, off < 0.8 * rim
    if np.count_nonzero(dark) < MIN_DARK_PIXELS // 16:
        return None
    levels = []
    for frame in frames:
        p = frame.exposure.pixels_adu[::4, ::4]
        level, sky = float(np.median(p[dark])), float(np.median(p[lit]))
        corners = [float(np.median(p[dark & side])) for side in _quarters(x, y, camera) if (dark & side).sum() > 50]
        if max(corners) - min(corners) < LARGEST_DARK_SPREAD_1 * (sky - level):
            levels.append(level)
    return min(levels) if levels else None


def _quarters(x: Ints, y: Ints, camera: Camera) -> list[Bools]:
    right, below = x > camera.centre_px[0], y > camera.centre_px[1]
    return [right & below, right & ~below, ~right & below, ~right & ~below]


def _saturation_level(frames: tuple[Frame, ...]) -> float | None:
    """The largest value [ADU], where several pixels share it; None where nothing is saturated."""
    top = max(float(frame.exposure.recorded_adu.max()) for frame in frames)
    count = sum(int(np.count_nonzero(frame.exposure.recorded_adu >= top)) for frame in frames)
    return top if count >= MIN_SATURATED_PIXELS else None


def _find_hot_pixels(joint: JointFit) -> Array | None:
    """Pixels (n, 2) that stand out in all frames although the sky has turned; None where it has not."""
    first, R = joint.frames[0], joint.fit.R_cam_icrs
    others = [i for i in range(1, len(joint.frames)) if has_turned(R[0], R[i], first.size_px)]
    if not others:
        return None
    least = reduce(np.minimum, (_excess_sigmas(joint, i) for i in (0, *others)))
    y, x = np.nonzero(least > HOT_SIGMA)
    order = np.argsort(-least[y, x], kind="stable")[:MAX_HOT_PIXELS]
    return np.stack([x[order], y[order]], axis=1).astype(np.float64)


def _excess_sigmas(joint: JointFit, i: int) -> Array:
    """How far each pixel (H, W) of frame `i` exceeds those around it, in sigmas of the noise; 0 at identified stars."""
    import cv2

    frame = joint.frames[i]
    image = np.asarray(frame.exposure.pixels_adu)
    excess = image - cv2.medianBlur(image, 5)
    noise = 1.4826 * float(np.median(np.abs(excess[::3, ::3]))) or 1.0
    # The light of a star or planet spreads over neighbouring pixels, that of a hot pixel does not.
    beside = cv2.filter2D(np.maximum(excess, 0.0), -1, NEIGHBOURS)
    sigmas = np.asarray((excess - beside) / noise, dtype=np.float64)
    for px in frame.sources.xy_px[joint.matches[i].detection]:
        x, y = np.rint(px).astype(int)
        reach = STAR_RADIUS_PX
        sigmas[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1] = 0.0
    return sigmas
