"""The lens of one image, by its own stars: how far it differs from its file, and the error that is left.

The file is right to its stated covariance, and beyond that to a displacement of unknown size: a lens that has moved on
the sensor, was focused anew, or was calibrated with fewer parameters than it needs. The size is the one that makes the
stars' pixels most probable; it is zero for a lens that is as its file states.

What a lens model does not hold of one image is a smooth displacement. Residuals of neighbouring stars that agree are no
independent errors: their means do not become small with many stars, and they move the attitude and the lens. The
displacement is a normal process over the frame. Its sizes and lengths, and none at all, are weighted by how probable
they make the residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from startrack.camera import Camera, cap_grid, compensating_rotation, lens_jacobian, with_covariance, with_update
from startrack.core.types import Array, Ints
from startrack.estimation.adjust import Terms
from startrack.estimation.attitude import MIN_FOR_SCATTER, AttitudeFit, Misfit, solve_attitude
from startrack.estimation.prior_choice import PriorChoice, root_of, solve_with_best_prior, solve_with_prior

LENGTHS = (0.25, 0.5, 1.0)  # over which the displacement changes, in halves of the frame's longer side
MISFITS_PX = (0.03, 0.1, 0.3, 1.0)  # of the displacement, RMS per axis
HALF_BOX, WAVES = 2.0, 14  # of the box of the waves, in the same halves; most half waves in it: numerical
FREQUENCY = np.pi / (2.0 * HALF_BOX)  # of one half wave
SMALLEST_PART = 1e-3  # of the largest sigma of a wave: numerical
SIZES_PX = (0.0, 0.1, 0.3, 1.0, 3.0)  # of the displacement, RMS over the calibrated cap; a larger one: another camera
CORRECTION_ROUNDS = 3  # stars that the displacement made outliers come back
SETTLED_LENS_PX = 0.02


def smooth_shifts(camera: Camera, xy_px: Array) -> Array:
    """Shifts (n, 2, 2 k) of pixels (n, 2) by k waves of each axis, in a box about the frame.

    Source: Solin and Sarkka 2020, Statistics and Computing 30, 419 (normal processes by waves of a box).
    """
    size = np.array(camera.size_px)
    place = (xy_px - 0.5 * (size - 1)) / (0.5 * size.max()) + HALF_BOX
    by_x, by_y = np.sin(place[..., None] * np.arange(1, WAVES + 1) * FREQUENCY).transpose(1, 0, 2) / np.sqrt(HALF_BOX)
    i, j = _waves().T
    shapes = by_x[:, i - 1] * by_y[:, j - 1]
    return np.concatenate([shapes[:, None] * axis[:, None] for axis in np.eye(2)], axis=2)


def _waves() -> Ints:
    """Numbers (k, 2) of half waves in the box, along x and y."""
    i, j = np.mgrid[1 : WAVES + 1, 1 : WAVES + 1].reshape(2, -1)
    return np.stack([i, j], axis=1)[np.hypot(i, j) <= WAVES]


def _prior_root(length: float, size_px: float) -> Array:
    """Root (2 k, j) of the coefficients' covariance, with which the displacements are correlated over a `length`."""
    squared = np.sum(np.square(FREQUENCY * _waves()), axis=1)
    one = size_px * np.sqrt(2.0 * np.pi) * length * np.exp(-0.25 * length**2 * squared)
    both = np.tile(one, 2)
    return np.diag(both)[:, both > SMALLEST_PART * both.max()]


def solve_with_misfit(
    camera: Camera, xy_px: Array, covariance_px2: Array, rays_icrs: Array, R_cam_icrs: Array
) -> tuple[Camera, AttitudeFit]:
    """Camera that was fitted to these very stars, and their attitude, with the covariances of its misfit added.

    The rest is that of `solve_attitude`, which also has the arguments and errors. With fewer than 30 stars, or a camera
    without covariance, nothing is added.
    """
    fit = solve_attitude(camera, xy_px, covariance_px2, rays_icrs, R_cam_icrs)
    if camera.covariance is None or np.count_nonzero(fit.used) < MIN_FOR_SCATTER:
        return camera, fit
    rays_cam = rays_icrs[fit.used] @ fit.attitude.R_cam_icrs.T
    order, m = camera.covariance_order, len(camera.covariance_order)
    shifts = smooth_shifts(camera, camera.project_unlimited(rays_cam))
    terms = Terms(
        np.concatenate([lens_jacobian(camera, rays_cam, order), shifts], axis=2),
        camera.jacobian_px_per_rad(rays_cam), np.zeros(len(rays_cam), dtype=np.int64), 1,
    )  # fmt: skip
    blocks = terms.normal_equations(fit.weight, fit.residual_px[fit.used])
    by = blocks.pose_by_lens[0]
    normal, right = blocks.lens + blocks.lens_pose[0] @ by, blocks.lens_right + by.T @ blocks.pose_right[0]
    # The lens follows the displacement with its covariance, or less where that is wider than the stars leave it.
    root = root_of(camera.covariance)
    values, axes = np.linalg.eigh(root.T @ normal[:m, :m] @ root)
    follows = root @ (axes / np.maximum(values, 1.0)) @ axes.T @ root.T
    lens = follows @ normal[:m, m:]
    left = normal[m:, m:] - normal[m:, :m] @ lens
    found = [
        solve_with_prior(0.5 * (left + left.T), right[m:] - lens.T @ right[:m], _prior_root(length, size_px))
        for length, size_px in product(LENGTHS, MISFITS_PX)
    ]
    # About the lens that is stated, without the displacement. Before the residuals none is as probable as all others.
    odds = np.array([np.log(len(found)), *(one[0] for one in found)])
    weight = np.exp(odds - odds.max())
    weight /= weight.sum()
    displacement = root_of(
        sum(part * (one[2] + np.outer(one[1], one[1])) for part, one in zip(weight[1:], found, strict=True))
    )
    misfit = Misfit(displacement, lens @ displacement, (by[:, :m] @ lens - by[:, m:]) @ displacement)
    covariance = fit.attitude.covariance_rad2 + misfit.turn_rad @ misfit.turn_rad.T
    return with_covariance(camera, order, camera.covariance + misfit.lens @ misfit.lens.T), replace(
        fit,
        attitude=replace(fit.attitude, covariance_rad2=covariance),
        covariance_with_lens=fit.covariance_with_lens + misfit.turn_rad @ misfit.lens.T,
        misfit=misfit,
    )


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
    """Likeliest change (m,) of the camera file's parameters, about the `change` that made the camera `corrected`."""
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
