"""Quaternions, for the file edge only: order x, y, z, w (SciPy, ROS); inside the library rotations are matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from startrack.types import Array


def quat_xyzw_from_R(R: ArrayLike) -> Array:
    """Unit quaternion (4,) x, y, z, w of the rotation matrix R (3, 3), such that R_from_quat_xyzw gives R back.

    Of the two signs the one with w > 0; at w = 0 the first component that is not zero is positive (SciPy's canonical
    form). The largest component is found first, so that no angle is weak (Shepperd 1978, J. Guidance 1, 223).

    Raises:
        ValueError: R is not a proper rotation (orthonormal to 1e-6, determinant +1).
    """
    m = np.asarray(R, dtype=float)
    if m.shape != (3, 3) or not np.allclose(m @ m.T, np.eye(3), atol=1e-6) or np.linalg.det(m) < 0:
        raise ValueError("not a rotation matrix")
    x, y, z = np.diag(m)
    # Four times the outer product of the quaternion with itself; its longest row is the quaternion, scaled.
    outer = np.array([
        [1 + x - y - z, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
        [m[0, 1] + m[1, 0], 1 - x + y - z, m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
        [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 - x - y + z, m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1 + x + y + z],
    ])  # fmt: skip
    row = outer[np.argmax(np.diag(outer))]
    q = row / np.linalg.norm(row)
    leading = next(component for component in (q[3], q[0], q[1], q[2]) if component != 0)
    return q if leading > 0 else -q


def R_from_quat_xyzw(quat_xyzw: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of the quaternion (4,) x, y, z, w; its length is divided out.

    Raises:
        ValueError: not four finite numbers, or all of them zero.
    """
    q = np.asarray(quat_xyzw, dtype=float)
    if q.shape != (4,) or not np.isfinite(q).all() or not q.any():
        raise ValueError(f"not a quaternion: {quat_xyzw!r}")
    v, w = q[:3], q[3]
    x, y, z = v
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return ((w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * cross) / (q @ q)
