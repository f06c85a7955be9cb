"""The exposure as a picture: scaled to fit, noise calmed, stretched so that faint stars show beside bright ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from startrack.camera import Camera
from startrack.detect import electrons
from startrack.report.palette import PAPER, SKY_BRIGHT, SKY_DARK, STARLIGHT, WALL, Colour
from startrack.types import Array, Bools

if TYPE_CHECKING:
    from startrack.pipeline import Result

Image = NDArray[np.float32]
LONGEST_SIDE_PX = 1400
SHORTEST_SIDE_PX = 900
SMOOTHING_PX = 1.0  # where the PSF is not known
CALM_SNR = 2.6  # fainter light than that is taken for noise and left out
KNEE_SNR, GLARE_SNR = 5.0, 400.0  # where the stretch turns from linear to logarithmic, and where it ends
EDGE_PX = 20.0
BACKGROUND_STEP = 6
WALL_SHADE = 0.75  # how far the wall's colour replaces the sky's
MADE_OF_NOISE = 0.6745  # median of the absolute value of a standard normal variable


@dataclass(frozen=True)
class View:
    """Where pixels of the exposure lie on the canvas: xy_canvas = origin + scale (xy + 1/2) - 1/2."""

    scale: float
    origin: tuple[float, float]
    size: tuple[int, int]  # (W, H) on the canvas

    def at(self, xy_px: ArrayLike) -> Array:
        """Canvas places (..., 2) of pixels (..., 2)."""
        return np.asarray(self.origin) + self.scale * (np.asarray(xy_px, dtype=float) + 0.5) - 0.5

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom on the canvas."""
        x, y = self.origin
        return x, y, x + self.size[0] - 1, y + self.size[1] - 1


def fitted(size_px: tuple[int, int]) -> tuple[float, tuple[int, int]]:
    """Scale, and size (W, H) of an exposure on the canvas."""
    scale = LONGEST_SIDE_PX / max(size_px)
    if scale > 1:  # small frames grow only until they can be read
        scale = max(1.0, min(scale, SHORTEST_SIDE_PX / min(size_px)))
    return scale, (max(1, round(size_px[0] * scale)), max(1, round(size_px[1] * scale)))


def backdrop(result: Result, size: tuple[int, int], wall: Image | None = None) -> NDArray[np.uint8]:
    """The exposure as (H, W, 3) of the given size (W, H); beyond the image circle is paper.

    `wall` (H, W) is 1 where terrain stands before the sky: it is shown darker than the exposure has it.
    """
    inside_px = np.full(size[::-1], np.inf, dtype=np.float32)
    if result.camera is not None and result.camera.size_px == result.exposure.size_px:
        inside_px = _inside_px(result.camera, size)
    sky, light = _layers(result, size, inside_px > EDGE_PX)
    picture = _between(_rgb(SKY_DARK), _rgb(SKY_BRIGHT), sky)
    if wall is not None:
        picture = _between(picture, _rgb(WALL), wall * np.float32(WALL_SHADE))
    # Next to the circle's edge the background is not known well, and what is left of it is no light.
    light *= np.clip(inside_px / np.float32(EDGE_PX), 0, 1)
    picture = _between(picture, _rgb(STARLIGHT), light)
    picture = _between(_rgb(PAPER), picture, np.clip(inside_px + np.float32(0.5), 0, 1))
    return np.asarray(picture.astype(np.uint8))


def _layers(result: Result, size: tuple[int, int], inside: Bools) -> tuple[Image, Image]:
    """Smooth background and point-like light, each (H, W) from 0 to 1; the background is known `inside` (H, W)."""
    found = result.detections
    if found is not None:
        image, _ = electrons(result.exposure, result.camera)
        residual, smooth = image - found.background_e, _resized(found.background_e, size)
    else:
        # Without detections nothing is known of the background: the frame as it is, about its median.
        pixels = result.exposure.pixels_adu
        residual = pixels - np.float32(np.median(pixels[::4, ::4]))
        smooth = np.zeros(size[::-1], dtype=np.float32)
    width_px = float(np.clip(found.psf_sigma_px if found is not None else SMOOTHING_PX, 0.5, 3.0))
    point = _resized(np.asarray(cv2.GaussianBlur(residual, (0, 0), width_px), dtype=np.float32), size)
    noise = max(float(np.median(np.abs(point[::4, ::4]))) / MADE_OF_NOISE, 1e-6)
    light = np.arcsinh(np.maximum(point * np.float32(1 / noise) - np.float32(CALM_SNR), 0) / np.float32(KNEE_SNR))
    light = np.minimum(light / np.float32(np.arcsinh(GLARE_SNR / KNEE_SNR)), 1)
    return _sky(smooth, inside, noise), np.power(light, np.float32(0.75))


def _sky(smooth: Image, inside: Bools, noise: float) -> Image:
    """The background from 0 (dark) to 1 (bright), carried on beyond where it is known."""
    step = BACKGROUND_STEP
    coarse, known = smooth[::step, ::step], inside[::step, ::step].astype(np.float32)
    if not known.any():
        return np.zeros_like(smooth)
    spread = cv2.GaussianBlur(coarse * known, (0, 0), 4.0) / np.maximum(cv2.GaussianBlur(known, (0, 0), 4.0), 1e-3)
    coarse = np.where(known > 0, coarse, spread)
    low, high = np.percentile(coarse[known > 0], [2, 98])
    # A background that is flatter than the noise shall look flat.
    sky = (coarse - np.float32(low)) / np.float32(max(high - low, 3 * noise))
    return np.asarray(cv2.resize(np.clip(sky, 0, 1), smooth.shape[::-1], interpolation=cv2.INTER_LINEAR))


def _inside_px(camera: Camera, size: tuple[int, int]) -> Image:
    """Distance to the edge of the image circle (H, W) [canvas px], negative beyond it."""
    edge = camera.lens.rho(np.array(min(camera.max_angle_rad, camera.lens.max_invertible_rad)))
    scale = size[0] / camera.size_px[0]
    x, y = (
        (((np.arange(n) + 0.5) / scale - 0.5 - centre) / focal).astype(np.float32)
        for n, centre, focal in zip(size, camera.centre_px, camera.focal_px, strict=True)
    )
    radius = np.sqrt(x[None, :] ** 2 + y[:, None] ** 2)
    return np.asarray((np.float32(edge) - radius) * np.float32(min(camera.focal_px) * scale))


def _between(a: Image, b: Image, part_of_b: Image) -> Image:
    return a + part_of_b[:, :, None] * (b - a)


def _rgb(colour: Colour) -> Image:
    return np.array(colour, dtype=np.float32)


def _resized(image: Image, size: tuple[int, int]) -> Image:
    smaller = size[0] <= image.shape[1]
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR))
