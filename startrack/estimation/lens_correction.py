"""The lens of one image, by its own stars: how far it differs from its file, and the error that is left.

The file is right to its stated covariance, and beyond that to a displacement of unknown size: a lens that has moved on
the sensor, was focused anew, or was calibrated with fewer parameters than it needs. The size is the one that makes the
stars' pixels most probable; it is zero for a lens that is as its file states.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.camera import Camera, cap_grid, compensating_rotation, lens_jacobian, with_update
from startrack.core.types import Array
from startrack.estimation.attitude import AttitudeFit, solve_attitude
from startrack.estimation.normal_equations import Terms
from startrack.estimation.prior_choice import PriorChoice, root_of, solve_with_best_prior

MIN_CORRECTING_STARS = 30
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
    fit, corrected, total = solve_attitude(camera, xy_px, covariance_px2, rays_icrs, R_cam_icrs), camera, None
    for _ in range(CORRECTION_ROUNDS):
        rays_cam = rays_icrs[fit.used] @ fit.attitude.R_cam_icrs.T
        if len(rays_cam) < MIN_CORRECTING_STARS:
            break
        order, before = _free(camera), np.zeros(len(_free(camera))) if total is None else total
        found = _solve(camera, corrected, order, rays_cam, fit, before)
        changed = with_update(camera, dict(zip(order, found.step.tolist(), strict=True)))
        if (
            found.prior == 0 and camera.covariance is None
        ) or changed.lens.max_invertible_rad < camera.calibrated_angle_rad:
            break
        moved_px = _displacement_px(camera, order, found.step - before)
        total = found.step
        corrected = replace(changed, covariance_order=order, covariance=found.covariance)
        fit = solve_attitude(corrected, xy_px, covariance_px2, rays_icrs, fit.attitude.R_cam_icrs)
        if moved_px < SETTLED_LENS_PX:
            break
    return corrected, fit, 0.0 if total is None else _displacement_px(camera, _free(camera), total)


def _free(camera: Camera) -> tuple[str, ...]:
    """Names of the parameters that may differ from the file."""
    return ("fx", "fy", "cx", "cy", *camera.lens.parameter_names, "p1", "p2")


def _solve(
    camera: Camera, corrected: Camera, order: tuple[str, ...], rays_cam: Array, fit: AttitudeFit, before: Array
) -> PriorChoice:
    """The change (m,) of the `camera`, about the one `before` that made it `corrected`."""
    jacobian = lens_jacobian(corrected, rays_cam, order)
    terms = Terms(jacobian, corrected.jacobian_px_per_rad(rays_cam), np.zeros(len(rays_cam), dtype=np.int64), 1)
    residual = fit.residual_px[fit.used] + jacobian @ before
    blocks = terms.normal_equations(fit.weight, residual)
    by_pose = blocks.lens_pose[0] @ np.linalg.inv(blocks.pose[0])
    normal, right = blocks.lens - by_pose @ blocks.lens_pose[0].T, blocks.lens_right - by_pose @ blocks.pose_right[0]
    stated = np.zeros_like(normal)
    if camera.covariance is not None:
        at = [order.index(name) for name in camera.covariance_order]
        stated[np.ix_(at, at)] = camera.covariance
    by_displacement = np.linalg.pinv(_mean_square(camera, order), hermitian=True, rcond=1e-12) / len(order)
    return solve_with_best_prior(normal, right, [root_of(stated + size**2 * by_displacement) for size in SIZES_PX])


def _mean_square(camera: Camera, order: tuple[str, ...]) -> Array:
    """Matrix (m, m) whose form in a change of the parameters is the mean square displacement [px^2] over the cap."""
    grid = cap_grid(camera.calibrated_angle_rad)
    jacobian = lens_jacobian(camera, grid, order)
    jacobian = jacobian + camera.jacobian_px_per_rad(grid) @ compensating_rotation(camera, order)
    return np.einsum("nik,nil->kl", jacobian, jacobian) / len(grid)


def _displacement_px(camera: Camera, order: tuple[str, ...], step: Array) -> float:
    """RMS over the calibrated cap of the displacement by a `step` (m,) of the parameters, the best rotation removed."""
    return float(np.sqrt(np.maximum(step @ _mean_square(camera, order) @ step, 0.0)))
