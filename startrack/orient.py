"""Attitude from matched rays: the optimal rotation with its covariance, the lens's own errors included."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import Camera
from startrack.camera.uncertainty import lens_jacobian
from startrack.frames import R_from_rotvec
from startrack.types import Array, Attitude, Bools, NotIdentified

CHI2_2DOF_MEDIAN = 1.3863
OUTLIER_CHI2 = 16.0  # 4 sigma in each axis: one good star in 3000 is lost
ROUNDS = 12
FEWEST_FOR_SCATTER = 30


@dataclass(frozen=True, kw_only=True)
class AttitudeFit:
    """Attitude and what the stars say of it."""

    attitude: Attitude
    residual_px: Array  # (n, 2) measured minus predicted
    used: Bools  # (n,)
    rms_px: float  # of the used stars, per axis
    extra_sigma_px: float  # error per axis beyond the stated centroid errors (lens, blends, catalogue)


def solve_attitude(
    camera: Camera, xy_px: Array, covariance_px2: Array, rays_icrs: Array, R_cam_icrs: Array
) -> AttitudeFit:
    """Attitude minimising the normalised distance of measured (n, 2) from predicted pixels, outliers rejected.

    Gauss-Newton from `R_cam_icrs` with the stars' centroid covariances (n, 2, 2); an error common to all stars (blends,
    lens, catalogue) is estimated from the scatter and added to every centroid, so that the covariance is honest. What
    the camera's own covariance leaves open of the lens turns all stars alike, so that no scatter shows it: it is added
    to the attitude's. Raises NotIdentified with fewer than 3 stars left.
    """
    R = np.array(R_cam_icrs)
    n = len(xy_px)
    used = np.ones(n, dtype=bool)
    extra = 0.0
    for _ in range(ROUNDS):
        rays_cam = rays_icrs @ R.T
        predicted, _ = camera.project(rays_cam)
        residual = xy_px - predicted
        weight: Array = np.linalg.inv(covariance_px2 + extra * np.eye(2)).astype(np.float64)
        chi2 = np.einsum("ni,nij,nj->n", residual, weight, residual)
        used = chi2 < OUTLIER_CHI2 if extra > 0.0 else used
        if used.sum() < 3:
            raise NotIdentified("fewer than 3 stars agree on an attitude", matched=int(used.sum()))
        jacobian = camera.jacobian_px_per_rad(rays_cam)[used]
        w, r = tapered(weight, chi2)[used], residual[used]
        normal = np.einsum("nia,nij,njb->ab", jacobian, w, jacobian)
        turn = np.linalg.solve(normal, np.einsum("nia,nij,nj->a", jacobian, w, r))
        R = R_from_rotvec(turn) @ R
        new_extra = extra_variance_px2(residual, covariance_px2)
        settled = np.linalg.norm(turn) < 1e-9 and abs(new_extra - extra) <= 1e-3 * new_extra
        extra = new_extra
        if settled:
            break
    by_stars = _covariance(jacobian, weight[used], w, r)
    by_lens = _covariance_by_lens(camera, rays_cam[used], jacobian, w)
    return AttitudeFit(
        attitude=Attitude(R_cam_icrs=R, covariance_rad2=by_stars + by_lens),
        residual_px=residual,
        used=used,
        rms_px=float(np.sqrt(np.mean(residual[used] ** 2))),
        extra_sigma_px=float(np.sqrt(extra)),
    )


def _covariance(jacobian: Array, weight: Array, tapered: Array, residual: Array) -> Array:
    """Covariance of the attitude: the stated one, or the one that the scatter of the residuals shows if that is larger.

    The second is the sandwich H^-1 (sum s s^T) H^-1 of the stars' own pulls s; it sees heavy tails and centroid errors
    that are larger than stated, but is itself noisy with few stars.
    """
    stated = np.linalg.inv(np.einsum("nia,nij,njb->ab", jacobian, weight, jacobian))
    n = len(residual)
    if n < FEWEST_FOR_SCATTER:
        return stated
    bread = np.linalg.inv(np.einsum("nia,nij,njb->ab", jacobian, tapered, jacobian))
    pulls = np.einsum("nia,nij,nj->na", jacobian, tapered, residual)
    seen = bread @ np.einsum("na,nb->ab", pulls, pulls) @ bread * (n / (n - 3))
    return stated * max(1.0, float(np.trace(seen) / np.trace(stated)))


def _covariance_by_lens(camera: Camera, rays_cam: Array, jacobian: Array, weight: Array) -> Array:
    """Covariance (3, 3) of the turn with which the attitude answers an error of the lens; 0 where that is not known.

    For a lens that was fitted to these very stars this makes the marginal of the joint fit, if the camera's covariance
    is its marginal too (the inverse of a matrix in blocks).
    """
    if camera.covariance is None:
        return np.zeros((3, 3))
    lens = lens_jacobian(camera, rays_cam, camera.covariance_order)
    turned = np.linalg.solve(
        np.einsum("nia,nij,njb->ab", jacobian, weight, jacobian), np.einsum("nia,nij,njm->am", jacobian, weight, lens)
    )
    return np.asarray(turned @ camera.covariance @ turned.T)


def tapered(weight: Array, chi2: Array) -> Array:
    """Weights (n, 2, 2) with Huber's taper beyond 2.5 sigma: what is not quite an outlier does not pull."""
    return weight * np.minimum(1.0, 2.5 / np.sqrt(np.maximum(chi2, 1e-12)))[:, None, None]


def extra_variance_px2(residual_px: Array, covariance_px2: Array, parameters: int = 3) -> float:
    """Variance per axis [px^2] to add to every centroid so that the median normalised residual is as expected.

    `parameters`: of the fit that left the residuals.
    """
    axes_px2, axes = np.linalg.eigh(covariance_px2)
    squared = np.square(np.einsum("nij,ni->nj", axes, residual_px)).T
    axes_px2 = np.ascontiguousarray(axes_px2.T)
    middle_two = (len(residual_px) - 1) // 2, len(residual_px) // 2

    def median_chi2(extra: float) -> float:
        along = squared / (axes_px2 + extra)
        ordered = np.partition(along[0] + along[1], middle_two)  # np.median itself takes three times as long
        return 0.5 * float(ordered[middle_two[0]] + ordered[middle_two[1]])

    # The fit has already taken its parameters' share out of the residuals.
    expected = CHI2_2DOF_MEDIAN * max(1.0 - 0.5 * parameters / len(residual_px), 0.1)
    low, high = 1e-6, 1.0
    if median_chi2(low) <= expected:
        return low
    while median_chi2(high) > expected and high < 1e4:
        high *= 4.0
    for _ in range(40):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if median_chi2(middle) > expected else (low, middle)
        if high < 1.001 * low:
            break
    return float(high)
