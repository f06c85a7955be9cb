"""Parts of a camera beside its lens: decentred elements, and the sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array

MAX_DECENTRING_STEPS = 30  # of the inversion
DECENTRING_TOLERANCE_1 = 1e-14  # in focal lengths
MIN_THROUGHPUT_1 = 0.05  # relative to the axis, up to the calibrated angle: no light for evidence below it (3.3 mag)


@dataclass(frozen=True)
class Decentring:
    """(du, dv) = (2 p1 s t + p2 (a^2 + 2 s^2), p1 (a^2 + 2 t^2) + 2 p2 s t), in focal lengths.

    (s, t) = a (cos b, sin b), a the angle off the axis [rad]; added to rho (cos b, sin b). Brown's tangential
    distortion on the angles of a fisheye, as in COLMAP's THIN_PRISM_FISHEYE.

    Source: Brown 1966, Photogrammetric Engineering 32, 444.
    """

    p1: float = 0.0
    p2: float = 0.0

    def __bool__(self) -> bool:
        return bool(self.p1 or self.p2)

    def shift(self, st: Array) -> Array:
        """(du, dv) (..., 2) at the angles `st` = (s, t) (..., 2) [rad]."""
        s, t = st[..., 0], st[..., 1]
        a2 = s * s + t * t
        return np.stack(
            [2 * self.p1 * s * t + self.p2 * (a2 + 2 * s * s), self.p1 * (a2 + 2 * t * t) + 2 * self.p2 * s * t],
            axis=-1,
        )

    def gradient(self, st: Array) -> Array:
        """d (du, dv) / d (s, t) (..., 2, 2), symmetric, at the angles `st` (..., 2) [rad]."""
        s, t = st[..., 0], st[..., 1]
        across = 2 * (self.p1 * s + self.p2 * t)
        return np.stack(
            [
                np.stack([2 * self.p1 * t + 6 * self.p2 * s, across], axis=-1),
                np.stack([across, 6 * self.p1 * t + 2 * self.p2 * s], axis=-1),
            ],
            axis=-2,
        )

    def remove(self, uv: Array, angle_rad: Callable[[Array], Array]) -> Array:
        """Points (u, v) (..., 2) without the shift, from points `uv` with it [focal lengths], by fixed-point steps.

        `angle_rad` inverts the radial law.
        """
        if not self:
            return uv
        wanted = uv.reshape(-1, 2)
        found, moving = wanted.copy(), np.arange(len(wanted))  # those near the law's turning point move longest
        for _ in range(MAX_DECENTRING_STEPS):
            centred = found[moving]
            rho = np.hypot(centred[:, 0], centred[:, 1])
            st = centred * (angle_rad(rho) / np.where(rho > 0, rho, 1.0))[:, None]
            found[moving] = wanted[moving] - self.shift(st)
            moving = moving[np.abs(found[moving] - centred).max(axis=1) >= DECENTRING_TOLERANCE_1]
            if not len(moving):
                break
        return found.reshape(uv.shape)


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Sensor and whole optics: from light to numbers."""

    zero_point_e_per_s: float  # electrons per second of a V = 0 star on the axis, whole PSF
    gain_e_per_adu: float = 1.0
    bias_adu: float = 0.0
    read_noise_e: float = 0.0
    dark_e_per_s: float = 0.0  # per pixel
    saturation_adu: float = 65535.0
    psf_sigma_px: float = 1.0  # Gaussian, before integration over the pixel
    vignetting: tuple[float, float] = (0.0, 0.0)

    def throughput(self, angle_rad: Array) -> Array:
        """Relative throughput max(1 + v1 a^2 + v2 a^4, 0) at the angles a = `angle_rad` off the axis, any shape."""
        a2 = np.square(angle_rad)
        return np.maximum(1.0 + a2 * (self.vignetting[0] + a2 * self.vignetting[1]), 0.0)

    def lowest_throughput(self, angle_rad: float) -> float:
        """Smallest value of 1 + v1 a^2 + v2 a^4 from the axis to `angle_rad`; negative where the polynomial is."""
        v1, v2 = self.vignetting
        ends = [0.0, angle_rad**2]
        if v2 and 0 < -v1 / (2 * v2) < ends[1]:  # a^2 at the polynomial's extremum
            ends.append(-v1 / (2 * v2))
        return min(1.0 + a2 * (v1 + a2 * v2) for a2 in ends)
