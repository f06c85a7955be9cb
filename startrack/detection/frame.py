"""Input of every step of detection: the frame without its background, its noise, its unusable pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.core.types import Bools, Exposure, Image, Ints, SmoothImage
from startrack.kernels.library import kernel
from startrack.psf import stamp_radius

Pixels = NDArray[np.floating[Any]]  # stamps, in either precision
SATURATED_FRACTION = 0.98
MIN_BINNED_SIGMA_PX = 1.8  # PSF width from which the frame is binned
RESIDUAL_FRACTION = 0.1  # of a known star's signal: error of its subtraction
MODEL_ERROR = 0.03  # of a star's signal: difference between real PSFs and the Gaussian


@dataclass(frozen=True)
class SourceNoise:
    """Variance that a source's own signal s adds to a pixel: per_unit s + (model_error s)^2."""

    per_unit: float  # photon noise: 1 for electrons, 1 / gain for ADU, 0 where it is not known
    model_error: float = MODEL_ERROR


@dataclass(frozen=True)
class Frame:
    """Exposure prepared for detection."""

    image: Image
    background: SmoothImage
    noise: SmoothImage  # standard deviation of one pixel
    dead: NDArray[np.bool_] | None  # saturated: no weight in fits; None where no pixel is
    source_noise: SourceNoise
    masked: Bools | None = None  # filled with its surroundings; a star that touches it is left out
    found: Image | None = None  # signal of the known stars, where their wings cover much of the frame

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (H, W) of the image."""
        return self.image.shape[0], self.image.shape[1]

    @property
    def light_and_noise(self) -> tuple[Any, ...]:
        """The arguments LIGHT_AND_NOISE of kernels that compare the image with its background and noise."""
        found = np.empty((0, self.shape[1]), np.float32) if self.found is None else np.ascontiguousarray(self.found)
        return (
            np.ascontiguousarray(self.image), self.background.rows, self.noise.rows, self.noise.side, found,
            self.source_noise.per_unit, RESIDUAL_FRACTION,
        )  # fmt: skip

    def cut_light(self, centres: Ints, radius: int) -> tuple[Image, Image]:
        """Stamps (n, s, s) without their background, and their variance without the sources' own signal.

        s is 2 `radius` + 1. Raises ValueError unless the stamps around the pixels `centres` (n, 2), x and y, lie in
        the image.
        """
        if not lie_inside(centres, self.shape, radius).all():
            raise ValueError(f"a stamp of radius {radius} reaches beyond the frame of {self.shape} pixels")
        light, variance = np.empty((2, len(centres), 2 * radius + 1, 2 * radius + 1), dtype=np.float32)
        _cut_light(*self.light_and_noise[:4], centres, light, variance)
        return light, variance

    def usable_pixels(self, centres: Ints, radius: int) -> Bools | None:
        """Stamps (n, s, s) of the pixels that may be used; None where all may."""
        return None if self.dead is None else ~cut_stamps(self.dead, centres, radius)


def electrons(exposure: Exposure, camera: Camera | None) -> tuple[Image, NDArray[np.bool_]]:
    """The exposure in electrons above bias (ADU without the gain of a `camera`), and the mask of saturated pixels.

    Saturation shows in the counts as recorded, before dark frame and flat field.
    """
    pixels_adu, recorded_adu = (np.ascontiguousarray(p) for p in (exposure.pixels_adu, exposure.recorded_adu))
    correction = exposure.correction
    ceiling = exposure.saturation_adu or np.inf
    sensor = None if camera is None else camera.sensor
    highest = SATURATED_FRACTION * (ceiling if sensor is None else min(ceiling, sensor.saturation_adu))
    gain, bias_e, image = 1.0, np.zeros((1, 1), dtype=np.float32), pixels_adu
    if sensor is not None and (sensor.gain_e_per_adu != 1.0 or sensor.bias_adu != 0.0):
        gain, image = sensor.gain_e_per_adu, np.empty_like(pixels_adu)
        bias_e += np.float32(sensor.bias_adu * sensor.gain_e_per_adu)
        if correction is not None and correction.scales_black and correction.sensitivity_1 is not None:
            bias_e = bias_e / correction.sensitivity_1
    saturated = np.zeros(recorded_adu.shape, dtype=np.bool_)
    converted = np.empty((0, image.shape[1]), np.float32) if image is pixels_adu else image
    _convert_counts(pixels_adu, recorded_adu, gain, bias_e, highest, converted, saturated)
    return image, saturated


def cut_stamps(image: NDArray[Any], centres: Ints, radius: int) -> NDArray[Any]:
    """Cut-outs (n, 2r+1, 2r+1) of the image around the integer pixels (n, 2) (x, y), which must be `radius` inside."""
    side = 2 * radius + 1
    height, width = image.shape
    positions = np.lib.stride_tricks.as_strided(
        image, (height - side + 1, width - side + 1, side, side), image.strides * 2, writeable=False
    )
    return np.ascontiguousarray(positions[centres[:, 1] - radius, centres[:, 0] - radius])


def lie_inside(pixels: Ints, shape: tuple[int, int], margin: int) -> Bools:
    """Whether pixels (n, 2), x and y, lie `margin` inside a frame of this shape (H, W)."""
    last = np.array([shape[1], shape[0]]) - 1 - margin
    return np.asarray(((pixels >= margin) & (pixels <= last)).all(axis=1))


def radius_for(sigma_px: float) -> int:
    """Half width [px] of the fitting stamp: the star and a rim of background for the local level."""
    return stamp_radius(sigma_px) + 1


def binning_factor(sigma_px: float) -> int:
    """Side [px] of the squares that a frame is binned by: a power of two; the binned PSF is 0.9 px or wider."""
    return 1 if sigma_px < MIN_BINNED_SIGMA_PX else int(2 ** np.floor(np.log2(2.0 * sigma_px / MIN_BINNED_SIGMA_PX)))


def bin_frame(frame: Frame, side: int) -> Frame:
    """The frame binned by sums over squares; incomplete squares at the right and lower borders are left out.

    A square is unusable if any of its pixels is.
    """
    if side == 1:
        return frame
    height, width = (side * (length // side) for length in frame.shape)
    whole = slice(0, height), slice(0, width)
    dead = None
    if frame.dead is not None:
        dead = np.asarray(frame.dead[whole].reshape(height // side, side, width // side, side).any(axis=(1, 3)))
    found = None if frame.found is None else _sums(frame.found[whole], side)
    # Background and noise are smooth: one pixel of a square represents its mean.
    middle = slice(side // 2, height, side), slice(side // 2, width, side)
    background, noise = (
        SmoothImage(smooth.whole()[middle] * np.float32(factor), 1, height // side)
        for smooth, factor in ((frame.background, side**2), (frame.noise, side))
    )
    return Frame(_sums(frame.image[whole], side), background, noise, dead, frame.source_noise, found=found)


def _sums(image: Image, side: int) -> Image:
    """Sums (H / side, W / side) of an image (H, W) over squares."""
    size = image.shape[1] // side, image.shape[0] // side
    small: Any = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small * np.float32(side * side), dtype=np.float32)


# Of an image with its background and noise, and of known stars' light with its noise.
LIGHT_AND_NOISE = (
    "image: float32[height, width]", "background: float32[blocks >= 1, width]", "noise: float32[blocks, width]",
    "side: int64", "found: float32[known, width]", "per_unit: float32", "found_error: float32",
)  # fmt: skip
_cut_light = kernel(
    "cut_light", *LIGHT_AND_NOISE[:4], "centres: int64[n, 2]", "light: out float32[n, stamp, stamp]",
    "variance: out float32[n, stamp, stamp]",
)  # fmt: skip
_convert_counts = kernel(
    "convert_counts", "pixels_adu: float32[height, width]", "recorded_adu: float32[height, width]", "gain: float32",
    "bias_e: float32[bias_rows, bias_columns]", "highest_adu: float32", "image: out float32[converted, width]",
    "saturated: out bool[height, width]",
)  # fmt: skip
