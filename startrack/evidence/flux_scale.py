"""The brightness scale of a frame: its zero point, from its identified stars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Detections, Identification, Stars

BRIGHT_SNR = 15.0
MIN_STARS = 5
MIN_SCATTER = 0.02
TREND_SIGNIFICANCE = 5.0


@dataclass(frozen=True)
class FluxScale:
    """Expected flux of a star: 10^(-0.4 (V - zero_mag)) times the lens's throughput and a residual radial trend."""

    zero_mag: float  # V of a star of one electron (or ADU)
    trend_per_rad2: float  # natural log of throughput per squared angle off the axis, beyond the camera file's
    scatter: float  # relative scatter of bright stars about the scale
    stars: int  # that defined it

    def flux_e(self, v_mag: Array, angle_rad: Array, camera: Camera) -> Array:
        """Expected flux (n,) of stars of `v_mag` (n,) at `angle_rad` (n,) off the axis of a `camera`."""
        throughput = camera.sensor.throughput(angle_rad) if camera.sensor is not None else 1.0
        return 10 ** (-0.4 * (v_mag - self.zero_mag)) * throughput * np.exp(self.trend_per_rad2 * np.square(angle_rad))


def flux_scale(detections: Detections, camera: Camera, stars: Stars, found: Identification) -> FluxScale:
    """Scale from the bright identified stars: median, robust scatter, and a radial trend only where it is significant.

    `found` says which of the `detections` is which of the stars; the `camera` has the throughput of the lens.
    """
    d, s = found.detection, found.star
    trusted = (detections.snr[d] > BRIGHT_SNR) & ~detections.saturated[d] & (stars.v_sigma_mag[s] < 0.1)
    if trusted.sum() < MIN_STARS:
        trusted = ~detections.saturated[d] if (~detections.saturated[d]).any() else np.ones(len(d), dtype=bool)
    d, s = d[trusted], s[trusted]
    angle = camera.angle_rad(detections.xy_px[d])
    throughput = camera.sensor.throughput(angle) if camera.sensor is not None else np.ones(len(d))
    log_flux = np.log(detections.flux_e[d] / np.maximum(throughput, 1e-3))
    offset = log_flux + 0.4 * np.log(10) * stars.v_mag[s]
    trend = _trend(offset, np.square(angle))
    rest = offset - trend * np.square(angle)
    middle = float(np.median(rest))
    scatter = 1.4826 * float(np.median(np.abs(rest - middle)))
    noise = float(np.median(detections.flux_sigma_e[d] / detections.flux_e[d]))
    intrinsic = max(float(np.sqrt(max(scatter**2 - noise**2, 0.0))), MIN_SCATTER)
    return FluxScale(middle / (0.4 * np.log(10)), trend, intrinsic, len(d))


def _trend(offset: Array, angle2: Array) -> float:
    """Slope of the offsets over the squared angle, clipped once; 0 unless it is significant."""
    if len(offset) < 30:
        return 0.0
    keep = np.abs(offset - np.median(offset)) < 4 * 1.4826 * np.median(np.abs(offset - np.median(offset))) + 1e-6
    x, y = angle2[keep] - angle2[keep].mean(), offset[keep] - offset[keep].mean()
    spread = float(x @ x)
    if spread <= 0:
        return 0.0
    slope = float(x @ y) / spread
    sigma = float(np.sqrt(np.mean(np.square(y - slope * x)) / spread))
    return slope if abs(slope) > TREND_SIGNIFICANCE * sigma else 0.0
