"""Directions and rotations: unit vectors, their angles, aberration; quaternions; attitude of the rover.

Components are on the last axis. Inside the library a rotation is a matrix R_to_from. Quaternions belong to files: order
x, y, z, w (SciPy, ROS). Body axes: x forward, y left, z up. Heading is the azimuth of body x (from north through east);
pitch is nose up positive; roll is right side down positive.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from startrack.core.types import Array

SPEED_OF_LIGHT_M_S = 299_792_458.0  # exact, SI
GIMBAL_LOCK_SIN = 1e-9  # body x this close to the vertical: heading and roll rotate about the same axis
ORTHONORMAL_1 = 1e-6  # largest error of R R^T that still counts as a rotation matrix


def rays_from_azel(azimuth_rad: ArrayLike, elevation_rad: ArrayLike) -> Array:
    """Unit vectors (..., 3) in enu: (sin a cos e, cos a cos e, sin e), a = `azimuth_rad`, e = `elevation_rad` (...).

    The azimuth is counted from north through east.
    """
    a, e = np.asarray(azimuth_rad, dtype=float), np.asarray(elevation_rad, dtype=float)
    rays = np.empty((*np.broadcast_shapes(a.shape, e.shape), 3))
    level = np.cos(e)
    rays[..., 0], rays[..., 1], rays[..., 2] = np.sin(a) * level, np.cos(a) * level, np.sin(e)
    return rays


def length_xy(x: Array, y: Array) -> Array:
    """Length (...) of vectors with components `x`, `y` (...), far from overflow: np.hypot takes seven times as long."""
    return np.sqrt(x * x + y * y)


def azel_from_rays(rays_enu: ArrayLike) -> tuple[Array, Array]:
    """Azimuth in [0, 2 pi) from north through east, and elevation above the horizontal, of `rays_enu` (..., 3) [rad].

    Vectors need not be of unit length. At the zenith the azimuth is not defined.
    """
    east, north, up = np.moveaxis(np.asarray(rays_enu, dtype=float), -1, 0)
    azimuth_rad = np.arctan2(east, north)
    azimuth_rad = azimuth_rad + np.where(azimuth_rad < 0.0, 2 * np.pi, 0.0)
    # A tiny negative angle becomes 2 pi itself.
    azimuth_rad = np.where(azimuth_rad >= 2 * np.pi, 0.0, azimuth_rad)
    return azimuth_rad, np.arctan2(up, length_xy(east, north))


def off_axis_rad(rays: ArrayLike) -> Array:
    """Angle (...) between the vectors `rays` (..., 3) and their frame's z axis [rad], exact at 0 and at pi."""
    given = np.asarray(rays, dtype=float)
    return np.arctan2(length_xy(given[..., 0], given[..., 1]), given[..., 2])


def angle_between_rad(a: ArrayLike, b: ArrayLike) -> Array:
    """Angle (...) between vectors a and b (..., 3) [rad]: atan2(|a x b|, a . b), exact at 0 and at pi."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def aberrate(rays_icrs: ArrayLike, velocity_m_s: ArrayLike) -> Array:
    """Directions (..., 3) for an observer with `velocity_m_s` (3,), from the directions `rays_icrs` (..., 3) at rest.

    With n at rest, b = v / c and g = (1 - b^2)^(-1/2):  (n / g + (1 + n.b / (1 + 1/g)) b) / (1 + n.b).
    Exact for any speed below light's (Explanatory Supplement to the Astronomical Almanac, 3rd ed. 2013, eq. 7.40).
    The bending of light by the Sun is neglected: 4 mas at 90 degrees from it, 0.1 arcsec at 5 degrees.
    """
    rays = np.asarray(rays_icrs, dtype=float)
    beta = np.asarray(velocity_m_s, dtype=float) / SPEED_OF_LIGHT_M_S
    inverse_gamma = np.sqrt(1.0 - beta @ beta)
    factor = 1.0 + (rays @ beta) / (1.0 + inverse_gamma)
    # One component after the other: numpy is slow over axes of three.
    x, y, z = (inverse_gamma * rays[..., axis] + factor * beta[axis] for axis in range(3))
    # Normalised instead of divided by 1 + n.b: rounding in the catalogue's rays must not accumulate.
    length = np.sqrt(x * x + y * y + z * z)
    return np.stack([x / length, y / length, z / length], axis=-1)


def turn_azel(azimuth_rad: Array, elevation_rad: Array, R: Array) -> tuple[Array, Array]:
    """Azimuth and elevation (n,), (n,) of the directions `azimuth_rad`, `elevation_rad` (n,) turned by `R` (3, 3)."""
    return azel_from_rays(rays_from_azel(azimuth_rad, elevation_rad) @ R.T)


def R_from_rotvec(rotvec_rad: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) = exp([w]x) of the rotation vectors w = `rotvec_rad` (..., 3)."""
    from scipy.spatial.transform import Rotation

    w = np.asarray(rotvec_rad, dtype=float)
    return Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(*w.shape[:-1], 3, 3)


def nearest_rotation(profile: Array) -> Array:
    """The rotations R (..., 3, 3) that maximise trace(R^T profile) for the matrices `profile` (..., 3, 3).

    With profile = sum w to from^T this is the solution of Wahba's problem.
    Source: Markley 1988, J. Astronaut. Sci. 36, 245 (singular value decomposition of the attitude profile matrix).
    """
    u, _, vt = np.linalg.svd(profile)
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return np.asarray(u @ vt)


def wahba(rays_to: Array, rays_from: Array, weights: Array | None = None) -> Array:
    """R_to_from (..., 3, 3) that minimises sum w |rays_to - R rays_from|^2 over the rays (..., n, 3).

    The `weights` w (..., n) default to 1. Poorly determined where all rays have nearly the same direction.
    """
    weighted = rays_to if weights is None else np.asarray(weights)[..., None] * rays_to
    return nearest_rotation(np.swapaxes(weighted, -1, -2) @ rays_from)


def quat_xyzw_from_R(R: ArrayLike) -> Array:
    """Unit quaternion (4,) x, y, z, w of the rotation matrix R (3, 3), such that R_from_quat_xyzw gives R back.

    Of the two signs the one with w > 0; at w = 0 the first component that is not zero is positive (SciPy's canonical
    form).

    Raises:
        ValueError: R is not a proper rotation (orthonormal to 1e-6, determinant +1).
    """
    from scipy.spatial.transform import Rotation

    m = np.asarray(R, dtype=float)
    if m.shape != (3, 3) or not np.allclose(m @ m.T, np.eye(3), atol=ORTHONORMAL_1) or np.linalg.det(m) < 0:
        raise ValueError("not a rotation matrix")
    return Rotation.from_matrix(m).as_quat(canonical=True)


def R_from_quat_xyzw(quat_xyzw: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of the quaternion `quat_xyzw` (4,), which need not be of unit length.

    Raises:
        ValueError: not four finite numbers, or all of them zero.
    """
    from scipy.spatial.transform import Rotation

    q = np.asarray(quat_xyzw, dtype=float)
    if q.shape != (4,) or not np.isfinite(q).all() or not q.any():
        raise ValueError(f"not a quaternion: {quat_xyzw!r}")
    return Rotation.from_quat(q / np.abs(q).max()).as_matrix()


def R_body_enu_from_heading_pitch_roll(heading_rad: float, pitch_rad: float, roll_rad: float) -> Array:
    """Rotation (3, 3) from enu to body: its rows are body x, y, z (forward, left, up) in enu.

    Yaw pi/2 - `heading_rad`, pitch -`pitch_rad` and roll `roll_rad` about the body's z, y and x axes (ROS REP 103).
    """
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("ZYX", [np.pi / 2 - heading_rad, -pitch_rad, roll_rad]).as_matrix().T


def heading_pitch_roll_from_R_body_enu(R_body_enu: ArrayLike) -> tuple[float, float, float]:
    """Heading in [0, 2 pi), pitch in [-pi/2, pi/2] and roll in (-pi, pi] of `R_body_enu` (3, 3) [rad].

    Inverse of R_body_enu_from_heading_pitch_roll. With the nose straight up or down only the sum of heading and roll
    is defined: roll is then given as 0.
    """
    forward, left, up = np.asarray(R_body_enu, dtype=float)
    level = np.hypot(forward[0], forward[1])
    pitch = np.arctan2(forward[2], level)
    if level < GIMBAL_LOCK_SIN:
        heading, roll = np.arctan2(left[1], -left[0]), 0.0
    else:
        heading, roll = np.arctan2(forward[0], forward[1]), np.arctan2(left[2], up[2])
    heading = heading % (2 * np.pi)
    return float(heading if heading < 2 * np.pi else 0.0), float(pitch), float(roll)


def tum_line(time_s: float, position_m: Array, R_frame_body: Array) -> str:
    """The line of one pose at `time_s` (Unix seconds, UTC) in any frame: time tx ty tz qx qy qz qw, which evo reads.

    `position_m` (3,) is the body's position in the frame, `R_frame_body` (3, 3) the rotation from body to frame.
    Lines of increasing times sort as text.

    Source: Sturm et al. 2012, A benchmark for the evaluation of RGB-D SLAM systems, IROS.
    """
    numbers = [*position_m, *quat_xyzw_from_R(R_frame_body)]
    return f"{time_s:017.6f} " + " ".join(f"{number:.9f}" for number in numbers) + "\n"
