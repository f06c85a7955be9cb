"""Readout of the sensor: shot noise, read noise, gain, bias, saturation, rounding."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Sensor
from startrack.core.types import Array

ADC_MAX_ADU = 65535.0  # 16 bits
POISSON_UP_TO_E = 64.0  # above it the normal distribution is used (skewness under 1/8), five times as fast


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
    return quantise(electrons, sensor)


def quantise(electrons: NDArray[np.floating], sensor: Sensor) -> NDArray[np.float32]:
    """Electrons (H, W) as whole numbers [ADU]: gain, bias, rounding and clipping without noise."""
    adu = np.rint(electrons / np.float32(sensor.gain_e_per_adu) + np.float32(sensor.bias_adu))
    return np.clip(adu, 0.0, min(sensor.saturation_adu, ADC_MAX_ADU)).astype(np.float32, copy=False)
