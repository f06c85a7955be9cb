"""Stars and inertial measurements of a rover at rest: an extended Kalman filter.

Built from the description in Kua 2008, section 2.1 (its reference [8], Malay et al.), not from the paper: the filter
combines celestial navigation with a high quality inertial measurement unit; 400 m at rest. The state is position,
velocity, tilt of the platform and biases of the accelerometers, each in east and north. At rest a bias cannot be told
from a displacement: it is the error that averaging leaves, 47 arcseconds of tilt for the published 400 m on the Moon.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.applications.reproduction.published.vertical import draw_tilt_rad, vertical_at
from startrack.core.types import Array
from startrack.frames import Site, sphere_radius_m
from startrack.output import ARCSEC_PER_RAD

REST_TILT_ARCSEC = 47.0  # mean tilt that the bias amounts to: 400 m on the Moon
LUNAR_GRAVITY_M_S2 = 1.625  # at the surface, GM / r^2 of the 1737.4 km sphere
REST_EPOCHS = 300  # measurements at rest: five minutes
EPOCH_S = 1.0  # between two of them
STAR_FIX_RAD = 2.0 / ARCSEC_PER_RAD  # sigma of the platform's tilt by one picture of stars
FORCE_SIGMA_M_S2 = 20.0 / ARCSEC_PER_RAD * LUNAR_GRAVITY_M_S2  # of one reading: 1" after averaging
REST_SIGMA_M_S = 1e-3  # of the statement that the rover does not move
START_SIGMAS = (1e6, 0.1, 0.02, 47.0 / ARCSEC_PER_RAD * LUNAR_GRAVITY_M_S2)  # m, m/s, rad, m/s^2: nothing known
WALK_SIGMAS = (0.0, 1e-5, 1e-3 / ARCSEC_PER_RAD, 0.0)  # of one epoch: the gyroscopes' drift between two star fixes


@dataclass(frozen=True)
class RestReadings:
    """Readings of a rover at rest: per epoch, the platform's tilt by stars and the horizontal specific force."""

    tilt_rad: Array  # (n, 2)
    force_m_s2: Array  # (n, 2) in the platform's axes
    error_rad: Array  # (2,) by which bias and averaged noise turn the vertical: the drawn truth, not an input


def draw_readings(truth_m: Array, site: Site, *, rng: np.random.Generator) -> RestReadings:
    """The readings at `truth_m` (2,): the bias, the platform's tilt and the noise are drawn."""
    bias = draw_tilt_rad(REST_TILT_ARCSEC, rng=rng) * LUNAR_GRAVITY_M_S2
    walk = np.cumsum(WALK_SIGMAS[2] * rng.standard_normal((REST_EPOCHS, 2)), axis=0)
    platform = np.radians(0.5) * rng.standard_normal(2) + walk
    stars = STAR_FIX_RAD * rng.standard_normal((REST_EPOCHS, 2))
    noise = FORCE_SIGMA_M_S2 * rng.standard_normal((REST_EPOCHS, 2))
    up = vertical_at(truth_m, site)
    force = LUNAR_GRAVITY_M_S2 * (up[:2] - platform * up[2]) + bias + noise
    error = (bias + noise.mean(axis=0)) / LUNAR_GRAVITY_M_S2 + stars.mean(axis=0)
    return RestReadings(platform + stars, force, error)


def locate_at_rest(readings: RestReadings, site: Site) -> Array:
    """Position (2,) [m] in the enu of a `site` after all `readings`, by the extended Kalman filter."""
    state, covariance = np.zeros(8), np.diag(np.repeat(np.square(START_SIGMAS), 2))
    motion, walk = np.eye(8), np.diag(np.repeat(np.square(WALK_SIGMAS), 2))
    motion[[0, 1], [2, 3]] = EPOCH_S
    noise = np.diag(np.repeat(np.square([STAR_FIX_RAD, FORCE_SIGMA_M_S2, REST_SIGMA_M_S]), 2))
    for tilt, force in zip(readings.tilt_rad, readings.force_m_s2, strict=True):
        state, covariance = motion @ state, motion @ covariance @ motion.T + walk
        predicted, jacobian = _predict_readings(state, site)
        gain = np.linalg.solve(jacobian @ covariance @ jacobian.T + noise, jacobian @ covariance).T
        state = state + gain @ (np.concatenate([tilt, force, np.zeros(2)]) - predicted)
        kept = np.eye(8) - gain @ jacobian
        covariance = kept @ covariance @ kept.T + gain @ noise @ gain.T  # Joseph's form: it stays positive
    return state[:2]


def _predict_readings(state: Array, site: Site) -> tuple[Array, Array]:
    """Tilt, force and velocity (6,) that a `state` (8,) predicts, and their derivatives (6, 8) by it."""
    radius_m, unit = sphere_radius_m(site), np.eye(2)
    position, velocity, tilt, bias = state.reshape(4, 2)
    up = vertical_at(np.clip(position, -0.5 * radius_m, 0.5 * radius_m), site)
    force = LUNAR_GRAVITY_M_S2 * (up[:2] - tilt * up[2]) + bias
    jacobian = np.zeros((6, 8))
    jacobian[0:2, 4:6] = jacobian[4:6, 2:4] = jacobian[2:4, 6:8] = unit
    jacobian[2:4, 0:2] = LUNAR_GRAVITY_M_S2 * (unit + np.outer(tilt, up[:2]) / up[2]) / radius_m
    jacobian[2:4, 4:6] = -LUNAR_GRAVITY_M_S2 * up[2] * unit
    return np.concatenate([tilt, force, velocity]), jacobian
