"""The sensor: charge that is not light (hot pixels, cosmic rays), and its readout with noise, gain and saturation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Sensor
from startrack.core.types import Array
from startrack.rendering.scene import HotPixels
from startrack.rendering.sources import splat

ADC_MAX_ADU = 65535.0  # 16 bits
POISSON_UP_TO_E = 64.0  # above it the normal distribution is used (skewness under 1/8), five times as fast
HOT_E_PER_S = (50.0, 50_000.0)  # dark current of hot pixels: even in its logarithm, from barely visible to glaring
TRACK_MEAN_PX = 6.0  # exponential length: most rays pass steeply, a few graze along the chip
TRACK_LONGEST_PX = 80.0
TRACK_E_PER_PX = 150.0  # median charge along a track, log-normal; a muon leaves about 80 e per micrometre of silicon
TRACK_LOG_SIGMA = 0.8
TRACK_SIGMA_PX = 0.35  # charge spreads over neighbours by diffusion, much less than light does
TRACK_STEP_PX = 0.25


def draw_hot_pixels(size_px: tuple[int, int], count: int, *, rng: np.random.Generator) -> HotPixels:
    """`count` random pixels (`rng`) of a sensor of `size_px` (W, H), dark currents log-uniform in HOT_E_PER_S."""
    width, height = size_px
    index = rng.choice(width * height, size=min(count, width * height), replace=False)
    low, high = np.log(HOT_E_PER_S)
    return HotPixels(
        xy_px=np.stack([index % width, index // width], axis=-1),
        dark_e_per_s=np.exp(rng.uniform(low, high, len(index))),
    )


def add_hot_pixels(image_e: Array, hot: HotPixels, exposure_s: float) -> None:
    """Add to the image (H, W) [e] the hot pixels' dark charge. Raises ValueError where one is off the frame."""
    height, width = image_e.shape
    if np.any((hot.xy_px < 0) | (hot.xy_px >= [width, height])):
        raise ValueError("a hot pixel is off the frame")
    np.add.at(image_e, (hot.xy_px[:, 1], hot.xy_px[:, 0]), hot.dark_e_per_s * exposure_s)


def add_cosmic_rays(image_e: Array, count: int, *, rng: np.random.Generator) -> None:
    """Add to the image (H, W) [e] `count` straight tracks at random positions, directions, lengths and charges."""
    height, width = image_e.shape
    for _ in range(count):
        centre = rng.uniform([-0.5, -0.5], [width - 0.5, height - 0.5])
        direction = rng.uniform(0, np.pi)
        length = min(rng.exponential(TRACK_MEAN_PX), TRACK_LONGEST_PX)
        e_per_px = TRACK_E_PER_PX * np.exp(TRACK_LOG_SIGMA * rng.standard_normal())
        points = max(1, int(np.ceil(length / TRACK_STEP_PX)))
        along = (np.arange(points) + 0.5) / points * length - length / 2
        xy_px = centre + along[:, None] * np.array([np.cos(direction), np.sin(direction)])
        # A steep ray still crosses the depth of one pixel.
        splat(image_e, xy_px, np.full(points, e_per_px * max(length, 1.0) / points), TRACK_SIGMA_PX)


def photons(mean_e: Array, *, rng: np.random.Generator) -> NDArray[np.float32]:
    """Poisson-distributed electrons (H, W) about the mean (H, W) [e]; rounded normal draws from 64 e on."""
    bright = mean_e > POISSON_UP_TO_E
    electrons = np.empty(mean_e.shape, dtype=np.float32)
    electrons[~bright] = rng.poisson(mean_e[~bright])
    mean = mean_e[bright]
    electrons[bright] = np.maximum(np.rint(mean + np.sqrt(mean) * rng.standard_normal(len(mean))), 0.0)
    return electrons


def read_out(mean_e: Array, sensor: Sensor, *, rng: np.random.Generator) -> NDArray[np.float32]:
    """Numbers (H, W) [ADU, whole] that the sensor gives for the mean electrons (H, W) of light and dark current.

    adu = round((Poisson(mean) + N(0, read noise)) / gain + bias), clipped to 0..saturation and to 16 bits.
    """
    electrons = photons(mean_e, rng=rng)
    if sensor.read_noise_e > 0:
        electrons += np.float32(sensor.read_noise_e) * rng.standard_normal(mean_e.shape, dtype=np.float32)
    adu = np.rint(electrons / np.float32(sensor.gain_e_per_adu) + np.float32(sensor.bias_adu))
    return np.clip(adu, 0.0, min(sensor.saturation_adu, ADC_MAX_ADU)).astype(np.float32, copy=False)
