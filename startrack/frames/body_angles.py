"""Heading, pitch and roll of the rover's body, and the rotation that they name.

Body axes: x forward, y left, z up. World: enu. Heading is the azimuth of body x (from north through east); pitch is
nose up positive; roll is right side down positive.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from startrack.types import Array

GIMBAL_LOCK_SIN = 1e-9  # body x this close to the vertical: heading and roll turn about the same axis


def R_body_enu_from_heading_pitch_roll(heading_rad: float, pitch_rad: float, roll_rad: float) -> Array:
    """Rotation (3, 3) from enu to body: its rows are body x, y, z (forward, left, up) in enu.

    With the level axes f = (sin h, cos h, 0), l = (-cos h, sin h, 0) and up u:
    x = f cos p + u sin p;  z0 = u cos p - f sin p;  y = l cos r + z0 sin r;  z = z0 cos r - l sin r.
    """
    sin_h, cos_h = np.sin(heading_rad), np.cos(heading_rad)
    sin_p, cos_p = np.sin(pitch_rad), np.cos(pitch_rad)
    sin_r, cos_r = np.sin(roll_rad), np.cos(roll_rad)
    forward, left, up = np.array([[sin_h, cos_h, 0.0], [-cos_h, sin_h, 0.0], [0.0, 0.0, 1.0]])
    unrolled_up = up * cos_p - forward * sin_p
    return np.array([
        forward * cos_p + up * sin_p,
        left * cos_r + unrolled_up * sin_r,
        unrolled_up * cos_r - left * sin_r,
    ])  # fmt: skip


def heading_pitch_roll_from_R_body_enu(R_body_enu: ArrayLike) -> tuple[float, float, float]:
    """Heading in [0, 2 pi), pitch in [-pi/2, pi/2] and roll in (-pi, pi] of the rotation (3, 3) [rad].

    Inverse of R_body_enu_from_heading_pitch_roll. With the nose straight up or down only the sum of heading and roll
    means anything: roll is then given as 0.
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
