"""The sky at the middle of a picture: where it is with its error, and the scale and rotation there.

The axis of a lens found with the stars may be wrong by degrees in a narrow field, where a shift of the lens's centre
looks like a rotation of the camera. What the middle of the picture shows is not: both errors cancel there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from startrack.camera import lens_jacobian
from startrack.catalog import catalog_rays
from startrack.chain import Oriented
from startrack.core.types import Array
from startrack.estimation.lens_correction import smooth_shifts
from startrack.output.values import turn_rad

HALF_STEP_PX = 0.5  # of the numerical derivative of the sky by pixels


@dataclass(frozen=True)
class Middle:
    """Direction (ICRS, as in the catalogue: without aberration and refraction) at a picture's middle pixel."""

    ra_rad: float  # in [0, 2 pi)
    dec_rad: float
    sigma_rad: float  # standard deviation per axis
    scale_rad_per_px: float  # geometric mean of the two axes
    rotation_rad: float  # position angle of image up, from north through east, in [0, 2 pi)


def middle_px(value: Oriented) -> Array:
    """The middle (2,) of a picture; pixel centres are at integers."""
    return 0.5 * (np.array(value.camera.size_px) - 1.0)


def has_middle(value: Any) -> bool:
    """Whether a `value` of the pipeline has an attitude and a lens that shows the picture's middle."""
    if not isinstance(value, Oriented):
        return False
    camera = value.camera
    return bool(camera.angle_rad(middle_px(value)) < min(camera.max_angle_rad, camera.lens.max_invertible_rad))


def sky_at_middle(value: Oriented) -> Middle:
    """The sky at the middle of the picture of a `value` that has one.

    The error is that of attitude and lens together, with their correlation: of a lens fitted to the picture's own stars
    they nearly cancel.
    """
    camera, middle = value.camera, middle_px(value)
    step = HALF_STEP_PX * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    rays_cam = camera.unproject(middle + step)
    here, right, left, below, above = catalog_rays(
        rays_cam @ value.attitude.R_cam_icrs, value.exposure.time_utc, value.site
    )
    ra, dec = turn_rad(here[1], here[0]), float(np.arctan2(here[2], np.hypot(here[0], here[1])))
    axes = np.array([
        [-np.sin(ra), np.cos(ra), 0.0], [-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)],
    ])  # east, north  # fmt: skip
    by_px = axes @ np.stack([right - left, below - above], axis=1) / (2.0 * HALF_STEP_PX)
    up = -by_px[:, 1]
    covariance = by_px @ covariance_px2(value, rays_cam[0]) @ by_px.T
    return Middle(
        ra_rad=ra,
        dec_rad=dec,
        sigma_rad=float(np.sqrt(0.5 * np.trace(covariance))),
        scale_rad_per_px=float(np.sqrt(abs(np.linalg.det(by_px)))),
        rotation_rad=turn_rad(up[0], up[1]),
    )


def covariance_px2(value: Oriented, ray_cam: Array) -> Array:
    """Covariance (2, 2) [px^2] of the pixel at which a `value`'s camera and attitude place a direction.

    `ray_cam` (3,) is that direction.
    """
    camera, fit = value.camera, value.attitude_fit
    by_turn = camera.jacobian_px_per_rad(ray_cam)
    covariance = by_turn @ value.attitude.covariance_rad2 @ by_turn.T
    if camera.covariance is not None:
        by_lens = lens_jacobian(camera, ray_cam, camera.covariance_order)
        mixed = by_turn @ fit.covariance_with_lens @ by_lens.T
        covariance = covariance + by_lens @ camera.covariance @ by_lens.T + mixed + mixed.T
        if fit.misfit is not None:  # what attitude and lens do not follow
            here = smooth_shifts(camera, camera.project_unlimited(ray_cam[None]))[0] @ fit.misfit.displacement_px
            follows = by_turn @ fit.misfit.turn_rad + by_lens @ fit.misfit.lens
            covariance = covariance + here @ here.T - here @ follows.T - follows @ here.T
    return np.asarray(covariance)


def in_middle(part: str, per_unit: float) -> Callable[[Oriented], float]:
    """The `part` of the sky at the middle, times `per_unit`, of a value that has one."""
    return lambda value: float(getattr(sky_at_middle(value), part) * per_unit)
