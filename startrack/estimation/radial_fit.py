"""A lens of one bend: its radius, and the fit of attitude, lens and pixel aspect to matched stars.

The bend k is the coefficient of a^3 in the radius at the angle a off the axis: rho(a) = tan(q a) / q with q = sqrt(3 k)
where k > 0, a where k = 0, and sin(q a) / q with q = sqrt(-6 k) where k < 0. Orthographic is k = -1/6, equisolid -1/24,
equidistant 0, stereographic 1/12, pinhole 1/3; real lenses lie between.
"""

from __future__ import annotations

import math

import numpy as np

from startrack.core.types import Array, Bools
from startrack.kernels.library import kernel

PINHOLE_BEND = 1.0 / 3.0
STRAIGHT_BEND = 1e-7  # smaller ones are those of the equidistant lens; in radial_fit.c too, as STEEPEST_RAD
STEEPEST_RAD = 1.55  # of the argument of sine or tangent
HALF_WEIGHT_CHI2 = 4.0  # of a match: Cauchy's loss, wrong matches count little
LONGEST_STEP = 0.1  # radians, logarithms of focal length and aspect, bend, focal lengths of the centre
RIDGE = 1e-12  # on the diagonal of the normal equations, whose diagonal is 1


def radius_of(angle_rad: Array, bend: float) -> Array:
    """Radius [focal lengths] at the angles (...) off the axis."""
    if abs(bend) < STRAIGHT_BEND:
        return np.asarray(angle_rad)
    q = _argument_scale(bend)
    x = np.minimum(q * np.asarray(angle_rad), STEEPEST_RAD)
    return np.asarray((np.tan(x) if bend > 0 else np.sin(x)) / q)


def angle_of(radius: Array, bend: float) -> Array:
    """Angle (...) off the axis [rad] at the radii [focal lengths]; the largest one beyond the image circle."""
    if abs(bend) < STRAIGHT_BEND:
        return np.minimum(radius, math.pi)
    q = _argument_scale(bend)
    x = q * np.asarray(radius)
    return np.asarray((np.arctan(x) if bend > 0 else np.arcsin(np.minimum(x, math.sin(STEEPEST_RAD)))) / q)


def largest_angle_rad(bend: float) -> float:
    """The angle off the axis [rad] up to which the radius rises."""
    return math.pi if abs(bend) < STRAIGHT_BEND else min(math.pi, STEEPEST_RAD / _argument_scale(bend))


def _argument_scale(bend: float) -> float:
    """Scale q of the angle in the tangent or the sine of a lens of this bend."""
    return math.sqrt(3.0 * bend) if bend > 0 else math.sqrt(-6.0 * bend)


def project_radial(
    rays_icrs: Array, R: Array, lens: Array, mirror: float, width: int, height: int
) -> tuple[Array, Bools]:
    """Pixels (n, 2) of rays (n, 3), and whether they lie in the frame and in the image circle."""
    px, inside = np.empty((len(rays_icrs), 2)), np.empty(len(rays_icrs), bool)
    _project_radial(*map(np.ascontiguousarray, (rays_icrs, R)), lens, mirror, width, height, px, inside)
    return px, inside


def fit_radial(
    xy_px: Array, rays_icrs: Array, mirror: float, sigma_px: float, steps: int, free: Bools, expected: Array,
    expected_sigma: Array, R: Array, lens: Array,
) -> None:  # fmt: skip
    """Change the attitude `R` (3, 3) and the `lens` (5,) in place by Gauss-Newton steps.

    The matches are pixels (n, 2) and rays (n, 3), some of them wrong: `sigma_px` is the scale of the loss. `mirror` is
    -1 for a mirror image, else 1. `free` (5,): which lens parameters change; `expected` (5,) and `expected_sigma` (5,)
    are known of them before. The sigmas of the centre are in focal lengths.
    """
    _fit_radial(
        *map(np.ascontiguousarray, (xy_px, rays_icrs)), mirror, sigma_px, HALF_WEIGHT_CHI2, steps, free, expected,
        expected_sigma, LONGEST_STEP, RIDGE, R, lens,
    )  # fmt: skip


_project_radial = kernel(
    "project_radial", "rays_icrs: float64[n, 3]", "R: float64[3, 3]", "lens: float64[5]", "mirror: float64",
    "width: float64", "height: float64", "px: out float64[n, 2]", "inside: out bool[n]",
)  # fmt: skip
_fit_radial = kernel(
    "fit_radial", "xy_px: float64[n, 2]", "rays_icrs: float64[n, 3]", "mirror: float64", "sigma_px: float64",
    "half_chi2: float64", "steps: int64", "free: bool[5]", "expected: float64[5]", "expected_sigma: float64[5]",
    "longest: float64", "ridge: float64", "R: out float64[3, 3]", "lens: out float64[5]",
)  # fmt: skip
