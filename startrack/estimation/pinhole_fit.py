"""Attitude, focal length and one distortion term of a narrow field's frame fitted to matched stars, compiled."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import math

import numpy as np

from startrack.core.kernels import njit

HALF_WEIGHT_CHI2 = 4.0  # of a match: Cauchy's loss, wrong matches count little
LONGEST_STEP = 0.1  # radians, logarithm of the focal length, distortion
RIDGE = 1e-12  # on the diagonal of the normal equations, whose diagonal is 1


@njit(cache=True)
def fit_pinhole(xy_px, rays_icrs, centre_px, mirror, sigma_px, steps, is_distorted, R, lens):
    """Gauss-Newton steps of the attitude `R` (3, 3) and of `lens`: focal length [px], distortion. Both are changed.

    Of matches of pixels (n, 2) and rays (n, 3), some of them wrong: `sigma_px` is the scale of the loss. `mirror` is
    -1 for a mirror image, else 1. The distortion is a part of the radius [focal lengths] per cube of the angle off the
    axis, beyond the tangent; it is fitted where `is_distorted`. The rotation's effect on the distortion is left out.
    """
    for _ in range(steps):
        normal, right = np.zeros((5, 5)), np.zeros(5)
        fx, fy = mirror * lens[0], lens[0]
        for i in range(len(xy_px)):
            cam = R @ rays_icrs[i]
            u, v = cam[0] / cam[2], cam[1] / cam[2]
            radius = math.sqrt(u * u + v * v)
            cube = math.atan(radius) ** 3 / max(radius, 1e-12)
            ratio = 1.0 + lens[1] * cube
            jacobian = (
                (fx * u * ratio, fx * u * cube, -fx * u * v, fx * (1.0 + u * u), -fx * v),
                (fy * v * ratio, fy * v * cube, -fy * (1.0 + v * v), fy * u * v, fy * u),
            )
            left = (xy_px[i, 0] - fx * u * ratio - centre_px[0], xy_px[i, 1] - fy * v * ratio - centre_px[1])
            chi2 = (left[0] * left[0] + left[1] * left[1]) / (sigma_px * sigma_px)
            weight = 1.0 / (1.0 + chi2 / HALF_WEIGHT_CHI2)
            for axis in range(2):
                for a in range(5):
                    right[a] += weight * jacobian[axis][a] * left[axis]
                    for b in range(a + 1):
                        normal[a, b] += weight * jacobian[axis][a] * jacobian[axis][b]
        if not is_distorted:
            normal[1, 0], normal[2:, 1], right[1], normal[1, 1] = 0.0, 0.0, 0.0, 1.0
        _solve(normal, right)
        step = np.minimum(np.maximum(right, -LONGEST_STEP), LONGEST_STEP)
        lens[0] *= math.exp(step[0])
        lens[1] += step[1]
        R[:] = _rotation(step[2:]) @ R  # behind the logarithm of the focal length and the distortion


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
