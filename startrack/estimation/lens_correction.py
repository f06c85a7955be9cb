"""The lens of one image, by its own stars: how far it differs from its file, and the error that is left.

The file is right to its stated covariance, and beyond that to a displacement of unknown size: a lens that has moved on
the sensor, was focused anew, or was calibrated with fewer parameters than it needs. The size is the one that makes the
stars' pixels most probable; it is zero for a lens that is as its file states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from startrack.camera import Camera, cap_grid, compensating_rotation, lens_jacobian, with_update
from startrack.core.types import Array
from startrack.estimation.attitude import MIN_FOR_SCATTER, AttitudeFit, solve_attitude
from startrack.estimation.normal_equations import Terms
from startrack.estimation.prior_choice import PriorChoice, root_of, solve_with_best_prior

SIZES_PX = (0.0, 0.1, 0.3, 1.0, 3.0)  # of the displacement, RMS over the calibrated cap; a larger one: another camera
CORRECTION_ROUNDS = 3  # stars that the displacement made outliers come back
SETTLED_LENS_PX = 0.02


def correct_lens(
    camera: Camera, xy_px: Array, covariance_px2: Array, rays_icrs: Array, R_cam_icrs: Array
) -> tuple[Camera, AttitudeFit, float]:
    """The camera corrected by the stars of one image, their attitude, and the correction [px], RMS over the cap.

    `xy_px` (n, 2), `covariance_px2` (n, 2, 2), `rays_icrs` (n, 3) and `R_cam_icrs` (3, 3) are those of
    `solve_attitude`. The corrected camera has the covariance that is left. Raises NotIdentified as `solve_attitude`.
    """
    order = ("fx", "fy", "cx", "cy", *camera.lens.parameter_names, "p1", "p2")
    fit, corrected = solve_attitude(camera, xy_px, covariance_px2, rays_icrs, R_cam_icrs), camera
    change = np.zeros(len(order))
    if np.count_nonzero(fit.used) < MIN_FOR_SCATTER:
        return camera, fit, 0.0
    mean_square = _mean_square(camera, order)
    roots = _prior_roots(camera, order, mean_square)
    for _ in range(CORRECTION_ROUNDS):
        rays_cam = rays_icrs[fit.used] @ fit.attitude.R_cam_icrs.T
        if len(rays_cam) < MIN_FOR_SCATTER:
            break
        found = _solve(corrected, order, rays_cam, fit, change, roots)
        changed = with_update(camera, dict(zip(order, found.step.tolist(), strict=True)))
        is_as_stated = found.prior == 0 and camera.covariance is None
        if is_as_stated or changed.lens.max_invertible_rad < camera.calibrated_angle_rad:
            break
        moved_px = _displacement_px(mean_square, found.step - change)
        change = found.step
        corrected = replace(changed, covariance_order=order, covariance=found.covariance)
        fit = solve_attitude(corrected, xy_px, covariance_px2, rays_icrs, fit.attitude.R_cam_icrs)
        if moved_px < SETTLED_LENS_PX:
            break
    return corrected, fit, _displacement_px(mean_square, change)


def _solve(
    corrected: Camera, order: tuple[str, ...], rays_cam: Array, fit: AttitudeFit, change: Array, roots: Sequence[Array]
) -> PriorChoice:
    """The change (m,) of the camera file, about the `change` that made the camera `corrected`."""
    jacobian = lens_jacobian(corrected, rays_cam, order)
    terms = Terms(jacobian, corrected.jacobian_px_per_rad(rays_cam), np.zeros(len(rays_cam), dtype=np.int64), 1)
    blocks = terms.normal_equations(fit.weight, fit.residual_px[fit.used] + jacobian @ change)
    by_pose = blocks.lens_pose[0] @ np.linalg.inv(blocks.pose[0])
    normal, right = blocks.lens - by_pose @ blocks.lens_pose[0].T, blocks.lens_right - by_pose @ blocks.pose_right[0]
    return solve_with_best_prior(normal, right, roots)


def _prior_roots(camera: Camera, order: tuple[str, ...], mean_square: Array) -> list[Array]:
    """Roots (m, m) of the priors: the stated covariance, and displacements of each size beside it."""
    stated = np.zeros_like(mean_square)
    if camera.covariance is not None:
        at = [order.index(name) for name in camera.covariance_order]
        stated[np.ix_(at, at)] = camera.covariance
    by_displacement = np.linalg.pinv(mean_square, hermitian=True, rcond=1e-12) / len(order)
    return [root_of(stated + size**2 * by_displacement) for size in SIZES_PX]


def _mean_square(camera: Camera, order: tuple[str, ...]) -> Array:
    """Matrix (m, m) whose form in a change of the parameters is the mean square displacement [px^2] over the cap."""
    grid = cap_grid(camera.calibrated_angle_rad)
    jacobian = lens_jacobian(camera, grid, order)
    jacobian = jacobian + camera.jacobian_px_per_rad(grid) @ compensating_rotation(camera, order)
    return np.einsum("nik,nil->kl", jacobian, jacobian) / len(grid)


def _displacement_px(mean_square: Array, step: Array) -> float:
    """RMS over the calibrated cap of the displacement by a `step` (m,) of the parameters, the best rotation removed."""
    return float(np.sqrt(np.maximum(step @ mean_square @ step, 0.0)))
