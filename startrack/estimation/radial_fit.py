"""A lens of one bend: its radius, and the compiled fit of attitude, lens and pixel aspect to matched stars.

The bend k is the coefficient of a^3 in the radius at the angle a off the axis: rho(a) = tan(q a) / q with q = sqrt(3 k)
where k > 0, a where k = 0, and sin(q a) / q with q = sqrt(-6 k) where k < 0. Orthographic is k = -1/6, equisolid -1/24,
equidistant 0, stereographic 1/12, pinhole 1/3; real lenses lie between.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import math

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array

PINHOLE_BEND = 1.0 / 3.0
STRAIGHT_BEND = 1e-7  # smaller ones are those of the equidistant lens
STEEPEST_RAD = 1.55  # of the argument of sine or tangent
HALF_WEIGHT_CHI2 = 4.0  # of a match: Cauchy's loss, wrong matches count little
LONGEST_STEP = 0.1  # radians, logarithms of focal length and aspect, bend, focal lengths of the centre
RIDGE = 1e-12  # on the diagonal of the normal equations, whose diagonal is 1
LENS_PARAMETERS = 5  # logarithms of the focal length [px] and of the aspect, bend, centre x and y [px]


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
    return math.sqrt(3.0 * bend) if bend > 0 else math.sqrt(-6.0 * bend)


@njit(inner=True)
def _radius(angle, bend):
    """Radius [focal lengths], its derivatives by the angle and by the bend, and whether it still rises."""
    if abs(bend) < STRAIGHT_BEND:
        return angle, 1.0, angle**3, True
    q = math.sqrt(3.0 * bend) if bend > 0 else math.sqrt(-6.0 * bend)
    x = min(q * angle, STEEPEST_RAD)
    c, s = math.cos(x), math.sin(x)
    if bend > 0:
        radius, slope, by_scale = s / c / q, 1.0 / (c * c), 1.5 / q
    else:
        radius, slope, by_scale = s / q, c, -3.0 / q
    return radius, slope, (angle * slope - radius) / q * by_scale, q * angle < STEEPEST_RAD


@njit(cache=True)
def project_radial(rays_icrs, R, lens, mirror, width, height):
    """Pixels (n, 2) of rays (n, 3), and which lie in the frame and in the image circle."""
    px, inside = np.empty((len(rays_icrs), 2)), np.empty(len(rays_icrs), np.bool_)
    fx, fy = mirror * math.exp(lens[0] + 0.5 * lens[1]), math.exp(lens[0] - 0.5 * lens[1])
    for i in range(len(rays_icrs)):
        x = R[0, 0] * rays_icrs[i, 0] + R[0, 1] * rays_icrs[i, 1] + R[0, 2] * rays_icrs[i, 2]
        y = R[1, 0] * rays_icrs[i, 0] + R[1, 1] * rays_icrs[i, 1] + R[1, 2] * rays_icrs[i, 2]
        z = R[2, 0] * rays_icrs[i, 0] + R[2, 1] * rays_icrs[i, 1] + R[2, 2] * rays_icrs[i, 2]
        off_axis = math.sqrt(x * x + y * y)
        radius, _, _, rises = _radius(math.atan2(off_axis, z), lens[2])
        ratio = radius / max(off_axis, 1e-12)
        px[i, 0], px[i, 1] = lens[3] + fx * x * ratio, lens[4] + fy * y * ratio
        in_frame = -0.5 <= px[i, 0] <= width - 0.5 and -0.5 <= px[i, 1] <= height - 0.5
        inside[i] = rises and in_frame
    return px, inside


@njit(cache=True)
def fit_radial(xy_px, rays_icrs, mirror, sigma_px, steps, free, expected, expected_sigma, R, lens):
    """Gauss-Newton steps of the attitude `R` (3, 3) and of `lens` (5,), which are changed.

    Of matches of pixels (n, 2) and rays (n, 3), some of them wrong: `sigma_px` is the scale of the loss. `mirror` is
    -1 for a mirror image, else 1. `free` (5,): which lens parameters change; `expected` (5,) and `expected_sigma` (5,)
    are known of them before. The sigmas of the centre are in focal lengths.
    """
    m = LENS_PARAMETERS + 3
    for _ in range(steps):
        normal, right, row = np.zeros((m, m)), np.zeros(m), np.empty(m)
        focal = math.exp(lens[0])
        fx, fy = mirror * math.exp(lens[0] + 0.5 * lens[1]), math.exp(lens[0] - 0.5 * lens[1])
        for i in range(len(xy_px)):
            cam = R @ rays_icrs[i]
            off_axis = max(math.sqrt(cam[0] * cam[0] + cam[1] * cam[1]), 1e-12)
            radius, slope, by_bend, _ = _radius(math.atan2(off_axis, cam[2]), lens[2])
            ux, uy, ratio = cam[0] / off_axis, cam[1] / off_axis, radius / off_axis
            left_x = xy_px[i, 0] - lens[3] - fx * radius * ux
            left_y = xy_px[i, 1] - lens[4] - fy * radius * uy
            weight = 1.0 / (1.0 + (left_x * left_x + left_y * left_y) / (sigma_px * sigma_px * HALF_WEIGHT_CHI2))
            for axis in range(2):
                f, u, v, left = (fx, ux, uy, left_x) if axis == 0 else (fy, uy, ux, left_y)
                row[0], row[1] = f * radius * u, (0.5 if axis == 0 else -0.5) * f * radius * u
                row[2], row[3], row[4] = f * by_bend * u, focal * (1 - axis), focal * axis
                # By the ray's components: along the radius, across it, and along the axis.
                own = f * (slope * cam[2] * u * u + ratio * v * v)
                mixed = f * (slope * cam[2] - ratio) * u * v
                dz = -f * slope * off_axis * u
                dx, dy = (own, mixed) if axis == 0 else (mixed, own)
                row[5] = cam[1] * dz - cam[2] * dy
                row[6] = cam[2] * dx - cam[0] * dz
                row[7] = cam[0] * dy - cam[1] * dx
                for a in range(m):
                    right[a] += weight * row[a] * left
                    for b in range(a + 1):
                        normal[a, b] += weight * row[a] * row[b]
        for a in range(LENS_PARAMETERS):
            if free[a]:
                precision = (sigma_px / expected_sigma[a]) ** 2
                normal[a, a] += precision
                right[a] += precision * (expected[a] - lens[a]) / (focal if a > 2 else 1.0)
            else:
                normal[a, :a], normal[a:, a], right[a], normal[a, a] = 0.0, 0.0, 0.0, 1.0
        _solve(normal, right)
        step = np.minimum(np.maximum(right, -LONGEST_STEP), LONGEST_STEP)
        lens[:3] += step[:3]
        lens[3:] += focal * step[3:5]
        R[:] = _rotation(step[5:]) @ R


@njit(inner=True)
def _solve(normal, right):
    """Solve symmetric equations, of which the lower triangle counts, in place: the result is in `right` (n,)."""
    n = len(right)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    for a in range(n):
        for b in range(a + 1):
            normal[a, b] *= unit[a] * unit[b]
        normal[a, a] += RIDGE
        right[a] *= unit[a]
    for a in range(n):  # Cholesky
        for b in range(a + 1):
            rest = normal[a, b]
            for k in range(b):
                rest -= normal[a, k] * normal[b, k]
            normal[a, b] = math.sqrt(max(rest, RIDGE)) if a == b else rest / normal[b, b]
        for k in range(a):
            right[a] -= normal[a, k] * right[k]
        right[a] /= normal[a, a]
    for a in range(n - 1, -1, -1):
        for k in range(a + 1, n):
            right[a] -= normal[k, a] * right[k]
        right[a] /= normal[a, a]
    right *= unit


@njit(inner=True)
def _rotation(vector):
    """The rotation matrix of a rotation vector (3,) (Rodrigues)."""
    angle = math.sqrt(vector @ vector)
    x, y, z = vector / max(angle, 1e-300)
    s, c = math.sin(angle), 1.0 - math.cos(angle)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + s * cross + c * (cross @ cross)
