"""Attitude of a calibrated camera from matched stars, with a covariance that includes the lens's uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera, lens_jacobian
from startrack.core.types import Array, Attitude, Bools, NotIdentified
from startrack.estimation.adjust import (
    HUBER_WITH_CUT,
    MIN_ATTITUDE_STARS,
    STAR_OUTLIER_CHI2,
    Scheme,
    State,
    Terms,
    adjust,
    observations_of_image,
)

MIN_FOR_SCATTER = 30  # stars from which the scatter of the residuals is a better covariance than the stated one
UNKNOWN_TIME_SIGMA_RAD = np.radians(60 / 3600)  # aberration and proper motion left out
SCHEME = Scheme(loss=HUBER_WITH_CUT, steps=12, estimates_extra=True)


@dataclass(frozen=True)
class Misfit:
    """Errors by a smooth displacement that a lens model does not hold, as j columns of roots: root @ root.T."""

    displacement_px: Array  # (2 k, j) of the coefficients of `misfit.smooth_shifts`
    lens: Array  # (m, j) of the parameters of the camera's covariance
    turn_rad: Array  # (3, j) of the attitude


@dataclass(frozen=True, kw_only=True)
class AttitudeFit:
    """Result of `solve_attitude`."""

    attitude: Attitude
    centroid_covariance_rad2: Array  # (3, 3) part of the attitude's covariance that is not the lens's
    covariance_with_lens: Array  # (3, m) of the rotation [rad] and the m parameters of the camera's covariance
    residual_px: Array  # (n, 2) measured minus predicted
    used: Bools  # (n,) not rejected as outliers
    rms_px: float  # of the used stars, per axis
    extra_sigma_px: float  # error per axis beyond the stated centroid errors (lens, blends, catalogue)
    weight: Array  # (m, 2, 2) inverse covariances of the used stars, times the factor of the robust loss
    misfit: Misfit | None = None  # in the covariances, of a lens fitted to these stars

    def attitude_of(self, *, has_time: bool) -> Attitude:
        """The attitude; unless it `has_time`, with the error of stars at J2000.0 and without aberration."""
        if has_time:
            return self.attitude
        covariance = self.attitude.covariance_rad2 + UNKNOWN_TIME_SIGMA_RAD**2 * np.eye(3)
        return replace(self.attitude, covariance_rad2=covariance)


def solve_attitude(
    camera: Camera, xy_px: Array, covariance_px2: Array, rays_icrs: Array, R_cam_icrs: Array
) -> AttitudeFit:
    """Attitude that fits measured pixels (n, 2) with covariances (n, 2, 2) of stars (n, 3), outliers rejected.

    `R_cam_icrs` (3, 3): a start within some pixels. The scatter of the residuals sets an error common to all stars,
    which is added to every centroid. An error of the lens (the camera's covariance) shifts the stars together, so that
    the scatter does not contain it: it is added to the attitude's covariance. Raises NotIdentified with fewer than 3
    stars.
    """
    if len(xy_px) < MIN_ATTITUDE_STARS:
        raise NotIdentified("fewer than 3 stars agree on an attitude", matched=len(xy_px))
    points = observations_of_image(xy_px, covariance_px2, rays_icrs)
    found = adjust(State(camera=camera, R_cam_icrs=np.array(R_cam_icrs)[None]), points, (), SCHEME)
    used = found.chi2 < STAR_OUTLIER_CHI2
    pose, weight, residual = found.terms.pose[used], found.weight[used], found.residual_px[used]
    by_stars = _covariance_by_stars(pose, found.inverse[used], weight, residual)
    with_lens = np.zeros((3, len(camera.covariance_order)))
    by_lens = np.zeros((3, 3))
    if camera.covariance is not None:
        # For a lens fitted to these very stars the sum of both covariances is the marginal of the joint fit, provided
        # that the camera's covariance is its marginal too (the inverse of a matrix in blocks).
        lens = lens_jacobian(camera, found.state.rays_cam(points)[used], camera.covariance_order)
        terms = Terms(lens, pose, np.zeros(len(pose), dtype=np.int64), 1)
        (response,) = terms.normal_equations(weight, residual).pose_by_lens
        with_lens = response @ camera.covariance
        by_lens = with_lens @ response.T
    return AttitudeFit(
        attitude=Attitude(R_cam_icrs=found.state.R_cam_icrs[0], covariance_rad2=by_stars + by_lens),
        centroid_covariance_rad2=by_stars,
        covariance_with_lens=with_lens,
        residual_px=found.residual_px,
        used=used,
        rms_px=float(np.sqrt(np.mean(residual**2))),
        extra_sigma_px=float(np.sqrt(found.extra_px2)),
        weight=weight,
    )


def _covariance_by_stars(pose: Array, inverse: Array, weight: Array, residual_px: Array) -> Array:
    """Covariance (3, 3) from the stated errors, or from the scatter of the residuals where that is larger.

    The second is the sandwich H^-1 (sum s s^T) H^-1 of the stars' scores s: it is valid for heavy tails and for
    centroid errors larger than stated, but is noisy with few stars.
    """
    stated = np.linalg.inv(np.einsum("nia,nij,njb->ab", pose, inverse, pose, optimize=True))
    n = len(residual_px)
    if n < MIN_FOR_SCATTER:
        return np.asarray(stated)
    bread = np.linalg.inv(np.einsum("nia,nij,njb->ab", pose, weight, pose, optimize=True))
    scores = np.einsum("nia,nij,nj->na", pose, weight, residual_px, optimize=True)
    by_scatter = bread @ (scores.T @ scores) @ bread * (n / (n - 3))
    return np.asarray(stated * max(1.0, float(np.trace(by_scatter) / np.trace(stated))))
