"""Kannala-Brandt fisheye lens: the radius as an odd polynomial of the angle off the axis."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from startrack.types import Array

MOST_STEPS = 60  # near the turning point Newton's steps only halve the error
ROUNDING_RAD = 1e-15
TURNING_SEARCH_RAD = np.pi


@dataclass(frozen=True)
class KannalaBrandt:
    """rho = a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9, a = angle off the axis [rad], rho in units of the focal length.

    Without coefficients this is the pure equidistant lens. Valid past 90 degrees, up to the polynomial's first turning
    point. Source: Kannala & Brandt 2006, IEEE TPAMI 28, 1335, eq. 6 (with k of the linear term absorbed by the focal
    length).
    """

    k: tuple[float, ...] = ()
    model: str = field(default="kannala_brandt", init=False)

    def rho(self, angle_rad: Array) -> Array:
        """Radius [focal lengths] at the angles off the axis [rad], any shape."""
        a2 = np.square(angle_rad)
        poly = np.zeros_like(a2)
        for k in reversed(self.k):
            poly = (poly + k) * a2
        return angle_rad * (1.0 + poly)

    def slope(self, angle_rad: Array) -> Array:
        """d rho / d angle [1/rad]."""
        a2 = np.square(angle_rad)
        poly = np.zeros_like(a2)
        for n in range(len(self.k), 0, -1):
            poly = (poly + (2 * n + 1) * self.k[n - 1]) * a2
        return 1.0 + poly

    @cached_property
    def max_invertible_rad(self) -> float:
        """Angle at which the polynomial first turns back [rad]; pi where it never does."""
        a = np.linspace(0.0, TURNING_SEARCH_RAD, 4001)
        turned = np.flatnonzero(self.slope(a) <= 0)
        return float(a[turned[0] - 1]) if len(turned) else TURNING_SEARCH_RAD

    def angle_rad(self, rho: Array) -> Array:
        """Angle off the axis [rad] at the radii [focal lengths]: the exact inverse, by safeguarded Newton steps.

        Radii beyond the turning point give the turning angle itself.
        """
        rho = np.asarray(rho, dtype=np.float64)
        top = self.max_invertible_rad
        if not any(self.k):
            return np.minimum(rho, top)
        low = np.zeros_like(rho)
        high = np.full_like(rho, top)
        a = np.clip(rho, 0.0, top)
        for _ in range(MOST_STEPS):
            miss = self.rho(a) - rho
            low = np.where(miss < 0, a, low)
            high = np.where(miss < 0, high, a)
            slope = self.slope(a)
            step = np.divide(miss, slope, out=np.full_like(miss, np.inf), where=slope > 0)
            newton = a - step
            # A step that leaves the bracket is replaced by bisection, so the polynomial's shape cannot mislead it.
            moved = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
            settled = (np.abs(moved - a) <= ROUNDING_RAD) | (np.abs(miss) <= ROUNDING_RAD)
            a = moved
            if np.all(settled):
                break
        return a
