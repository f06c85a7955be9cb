"""Lens and attitude together, by all named stars: how well a list of stars knows the lens that it was solved with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera
from startrack.camera.parameters import with_covariance, with_update
from startrack.camera.uncertainty import lens_jacobian
from startrack.frames import R_from_rotvec
from startrack.orient import OUTLIER_CHI2, extra_variance_px2, tapered
from startrack.types import Array

ROUNDS = 12
SETTLED_PX = 1e-3
FOCAL_SIGMA, CENTRE_SIGMA = 0.1, 0.06  # known beforehand, in focal lengths
K_SIGMA = (0.1, 0.1, 0.05, 0.02)


@dataclass(frozen=True)
class Joint:
    """The camera with its covariance, and the attitude."""

    camera: Camera
    R_cam_icrs: Array


def fitted_jointly(
    camera: Camera, R_cam_icrs: Array, xy_px: Array, covariance_px2: Array, rays_icrs: Array, *, centre: bool
) -> Joint:
    """Least squares over attitude and lens of stars (n, 3) at pixels (n, 2) with covariances (n, 2, 2).

    `centre`: whether the lens's centre is an unknown too; in a narrow field it is not to be told from a turn, and stays
    the frame's middle. The camera's covariance is the marginal one, the attitude being unknown as well.
    """
    free = ("f", *(("cx", "cy") if centre else ()), *(f"k{n + 1}" for n in range(len(camera.lens.k))))
    prior = np.diag(np.concatenate([np.zeros(3), _sigmas(camera, free) ** -2.0]))
    known, R = replace(camera, max_angle_rad=np.pi), np.array(R_cam_icrs)
    gone, extra = np.zeros(3 + len(free)), 0.0  # steps of all parameters so far, those of the attitude left out
    for _ in range(ROUNDS):
        rays_cam = rays_icrs @ R.T
        residual = xy_px - known.project(rays_cam)[0]
        extra = extra_variance_px2(residual, covariance_px2, len(gone))
        weight: Array = np.linalg.inv(covariance_px2 + extra * np.eye(2)).astype(np.float64)
        chi2 = np.einsum("ni,nij,nj->n", residual, weight, residual)
        weight = tapered(weight, chi2) * (chi2 < OUTLIER_CHI2)[:, None, None]
        jacobian = np.concatenate([known.jacobian_px_per_rad(rays_cam), lens_jacobian(known, rays_cam, free)], axis=2)
        normal = np.einsum("nia,nij,njb->ab", jacobian, weight, jacobian) + prior
        right = np.einsum("nia,nij,nj->a", jacobian, weight, residual) - prior @ gone
        step = _solved(normal, right[:, None])[:, 0]
        R = R_from_rotvec(step[:3]) @ R
        known = with_update(known, dict(zip(free, step[3:].tolist(), strict=True)))
        gone[3:] += step[3:]
        if np.abs(jacobian @ step).max() < SETTLED_PX:
            break
    covariance = _solved(normal, np.eye(len(normal)))[3:, 3:]
    top = known.lens.max_invertible_rad
    within = replace(
        known,
        max_angle_rad=min(camera.max_angle_rad, top),
        calibrated_angle_rad=min(camera.calibrated_angle_rad, top),
    )
    return Joint(with_covariance(within, free, covariance), R)


def _sigmas(camera: Camera, free: tuple[str, ...]) -> Array:
    """How far each parameter may be off beforehand (m,): px, and 1 for k."""
    focal = camera.focal_px[0]
    known = {"f": FOCAL_SIGMA * focal, "cx": CENTRE_SIGMA * focal, "cy": CENTRE_SIGMA * focal}
    known |= {f"k{n + 1}": sigma for n, sigma in enumerate(K_SIGMA)}
    return np.array([known[name] for name in free])


def _solved(normal: Array, right: Array) -> Array:
    """Solutions of the normal equations, whose parameters have units of their own."""
    unit = 1.0 / np.sqrt(np.diag(normal))
    return np.asarray(unit[:, None] * np.linalg.solve(normal * np.outer(unit, unit), right * unit[:, None]))
