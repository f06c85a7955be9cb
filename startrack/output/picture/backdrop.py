"""The exposure as a picture: scaled to fit, noise calmed, stretched so that faint stars show beside bright ones."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from startrack.camera import Camera
from startrack.chain import Detected, Inputs, Located
from startrack.core.statistics import robust_sigma
from startrack.core.types import Array, Bools
from startrack.frames import azel_from_rays
from startrack.output.picture.canvas import Box, Ink
from startrack.output.values import horizon_at_fix

Image = NDArray[np.float32]
LONGEST_SIDE_PX, SHORTEST_SIDE_PX = 1400, 900
MOST_ENLARGED = 4.0  # beyond it a picture shows no more, and a tiny one takes as long to draw as a large one
SMOOTHING_PX = (0.5, 3.0)  # of the display, as wide as the PSF within these
KNEE_SNR, GLARE_SNR = 5.0, 400.0  # where the stretch turns from linear to logarithmic, and where it ends
CALM_SNR = KNEE_SNR / 2  # fainter light than that is treated as noise and left out
STAR_PX = 15  # on the canvas: wider sources are not stars
SAMPLE = 4  # levels are taken from every fourth pixel
WALL_SHADE = 0.75  # how far the wall's colour replaces the sky's
EDGE_RAD = 0.003  # width of its edge
SPIKE_SIGMAS = 8.0
SPIKE_NEIGHBOUR = 0.3  # a star's neighbouring pixel has more of its light where the PSF is MIN_PSF_PX or wider
MIN_PSF_PX = 0.7
AZIMUTHS_RAD = np.linspace(0.0, 2 * np.pi, 1441)
NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)


@dataclass(frozen=True)
class View:
    """Pixels of the exposure on the canvas: xy_canvas = origin + scale (xy + 1/2) - 1/2."""

    scale: float
    origin: tuple[float, float]
    size: tuple[int, int]  # (W, H) on the canvas

    def canvas_px(self, xy_px: ArrayLike) -> Array:
        """Canvas pixels (..., 2) of pixels (..., 2)."""
        return np.asarray(self.origin) + self.scale * (np.asarray(xy_px, dtype=float) + 0.5) - 0.5

    @property
    def box(self) -> Box:
        """Left, top, right, bottom on the canvas."""
        x, y = self.origin
        return x, y, x + self.size[0] - 1, y + self.size[1] - 1


def fit_to_canvas(size_px: tuple[int, int]) -> tuple[float, tuple[int, int]]:
    """Scale, and size (W, H) of an exposure on the canvas."""
    scale = LONGEST_SIDE_PX / max(size_px)
    if scale > 1:  # small frames grow only until they can be read
        scale = max(1.0, min(scale, SHORTEST_SIDE_PX / min(size_px), MOST_ENLARGED))
    return scale, (max(1, round(size_px[0] * scale)), max(1, round(size_px[1] * scale)))


def bare_picture(value: Inputs) -> NDArray[np.uint8]:
    """The exposure (H, W, 3) as the picture of a stage's `value` shows it, red, green, blue, without any mark.

    Beyond the image circle is paper. Where terrain hides the sky it is shown darker than in the exposure.
    """
    _, size = fit_to_canvas(value.exposure.size_px)
    inside_px = np.full(size[::-1], np.inf, dtype=np.float32)
    if value.camera is not None and value.camera.size_px == value.exposure.size_px:
        inside_px = _distance_to_edge_px(value.camera, size)
    sky, light = _background_and_light(value, size, inside_px > STAR_PX / 2)
    # Next to the circle's edge the background is not known well, and its residual is not light.
    light *= np.clip(inside_px / np.float32(STAR_PX / 2), 0, 1)
    shade = _wall_mask(value, size) * np.float32(WALL_SHADE) if isinstance(value, Located) else np.float32(0.0)
    lit = np.clip(inside_px + np.float32(0.5), 0, 1)
    channels = []
    for dark, bright, rock, star, paper in zip(
        Ink.SKY_DARK, Ink.SKY_BRIGHT, Ink.WALL, Ink.STARLIGHT, Ink.PAPER, strict=True
    ):
        channel = dark + sky * np.float32(bright - dark)
        channel += shade * (np.float32(rock) - channel)
        channel += light * (np.float32(star) - channel)
        channels.append((paper + lit * (channel - np.float32(paper))).astype(np.uint8))
    return np.asarray(cv2.merge(channels))


def _wall_mask(value: Located, size: tuple[int, int]) -> Image:
    """1 below the skyline of the fix and 0 above it, (H, W) of a picture of the `size` (W, H)."""
    cells = [np.arange(0.5, -(-n // SAMPLE)) * n / -(-n // SAMPLE) for n in size]
    scale = np.array(value.camera.size_px) / size
    xy_px = np.stack(np.meshgrid(*cells), axis=-1) * scale - 0.5
    azimuth, elevation = azel_from_rays(value.camera.unproject(xy_px) @ value.R_cam_enu)
    below = np.interp(azimuth, AZIMUTHS_RAD, horizon_at_fix(value, AZIMUTHS_RAD)) - elevation
    # The signed distance is what may be interpolated; cut off afterwards, it gives a sharp and smooth edge.
    below_rad = np.asarray(cv2.resize(below.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))
    return np.clip(below_rad * np.float32(1 / EDGE_RAD) + np.float32(0.5), 0, 1)


def _background_and_light(value: Inputs, size: tuple[int, int], inside: Bools) -> tuple[Image, Image]:
    """Smooth background and point-like light, each (H, W) from 0 to 1; the background is known `inside` (H, W).

    The detector's background bridges the skyline in blocks; a median as wide as some stars keeps the skyline's step.
    """
    scale = size[0] / value.exposure.size_px[0]
    width_px = scale * (value.detections.psf_sigma_px if isinstance(value, Detected) else 1.0)
    method = cv2.INTER_AREA if scale <= 1 else cv2.INTER_LINEAR
    pixels = cv2.resize(remove_hot_pixels(value.exposure.pixels_adu, width_px / scale), size, interpolation=method)
    image = np.asarray(cv2.GaussianBlur(pixels, (0, 0), float(np.clip(width_px, *SMOOTHING_PX))), dtype=np.float32)
    sample, known = image[::SAMPLE, ::SAMPLE], inside[::SAMPLE, ::SAMPLE]
    low, high = (float(level) for level in np.percentile(sample[known] if known.any() else sample, [0.5, 99.0]))
    step = max(high - low, 1e-6) / 255
    levels = np.clip((image - np.float32(low)) * np.float32(1 / step) + np.float32(0.5), 0, 255).astype(np.uint8)
    smooth = cv2.medianBlur(levels, STAR_PX).astype(np.float32) * np.float32(step) + np.float32(low)
    light = image - smooth
    noise = max(robust_sigma(light[::SAMPLE, ::SAMPLE][known], 0.0) if known.any() else 0.0, 1e-6)
    light = np.maximum(light * np.float32(1 / noise) - np.float32(CALM_SNR), 0)
    lit = np.flatnonzero(light)
    bent = np.arcsinh(light.flat[lit] / np.float32(KNEE_SNR)) / np.float32(np.arcsinh(GLARE_SNR / KNEE_SNR))
    light.flat[lit] = np.power(np.minimum(bent, 1), np.float32(0.75))
    dark, bright = np.percentile(smooth[::SAMPLE, ::SAMPLE][known] if known.any() else smooth, [2, 98])
    # A background that is flatter than the noise shall look flat.
    sky = (smooth - np.float32(dark)) / np.float32(max(bright - dark, CALM_SNR * noise))
    return np.clip(sky, 0, 1), light


def remove_hot_pixels(pixels_adu: Image, psf_sigma_px: float) -> Image:
    """The exposure with lone bright pixels, sharper than any star, replaced by the median of their neighbours."""
    if psf_sigma_px < MIN_PSF_PX:
        return pixels_adu
    middle = np.asarray(cv2.medianBlur(pixels_adu, 3), dtype=np.float32)
    noise = robust_sigma(pixels_adu[::SAMPLE, ::SAMPLE] - middle[::SAMPLE, ::SAMPLE], 0.0)
    # Seen from the darkest pixel about: within a wide star the median is the star's own light.
    darkest = cv2.erode(pixels_adu, np.ones((5, 5), np.uint8))
    excess, beside = cv2.subtract(pixels_adu, darkest), cv2.dilate(pixels_adu, NEIGHBOURS)
    bright = np.flatnonzero(excess > SPIKE_SIGMAS * max(noise, 1e-6))
    lone = bright[beside.flat[bright] - darkest.flat[bright] < SPIKE_NEIGHBOUR * excess.flat[bright]]
    cleaned = pixels_adu.copy()
    cleaned.flat[lone] = middle.flat[lone]
    return cleaned


def _distance_to_edge_px(camera: Camera, size: tuple[int, int]) -> Image:
    """Distance to the edge of the image circle (H, W) [canvas px], negative beyond it."""
    edge = camera.lens.rho(np.array(min(camera.max_angle_rad, camera.lens.max_invertible_rad)))
    scale = size[0] / camera.size_px[0]
    x, y = (
        (((np.arange(n) + 0.5) / scale - 0.5 - centre) / focal).astype(np.float32)
        for n, centre, focal in zip(size, camera.centre_px, camera.focal_px, strict=True)
    )
    radius = np.sqrt(x[None, :] ** 2 + y[:, None] ** 2)
    return np.asarray((np.float32(edge) - radius) * np.float32(min(camera.focal_px) * scale))
