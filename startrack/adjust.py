"""Least-squares adjustment of attitudes and lens parameters to measured pixels, robust where asked for.

One loop serves the attitude of a calibrated camera, the lens of an unknown one and a calibration of many images.
Callers choose the free lens parameters, the loss, a prior, and whether the variance beyond the stated centroid errors
(lens, blends, catalogue) is estimated on the way so that the chi-square fits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from startrack.camera import Camera
from startrack.camera.parameters import with_update
from startrack.camera.uncertainty import lens_jacobian
from startrack.frames import R_from_rotvec
from startrack.normal_equations import NormalEquations, Terms
from startrack.types import Array, Attitude, Bools, Ints, NotIdentified, Value, array

CHI2_2DOF_MEDIAN = 1.3863
OUTLIER_CHI2 = 16.0  # 4 sigma in each axis: one good star in 3000 is lost
HUBER_SIGMAS = 2.5  # from here the pull of an observation no longer grows
FEWEST_STARS = 3
FEWEST_FOR_SCATTER = 30  # stars from which the scatter of the residuals is a better covariance than the stated one
SMALLEST_EXTRA_PX2, LARGEST_EXTRA_PX2 = 1e-6, 1e8
FIRST_DAMPING, MOST_DAMPING = 1e-6, 1e6
SMALLEST_RISE_RAD = 0.2  # a lens whose radius stops growing sooner is no lens


@dataclass(frozen=True, kw_only=True)
class Observations(Value):
    """Measured pixels with known directions, sorted by image."""

    image: Ints = array("n", dtype=np.int64)  # 0 ... images - 1, ascending
    xy_px: Array = array("n", 2)  # measured
    covariance_px2: Array = array("n", 2, 2)  # of the measurement
    rays_icrs: Array = array("n", 3)  # apparent directions, refraction included; of boards: positions [squares]

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(np.diff(self.image) < 0) or np.any(self.image[:1] < 0):
            raise ValueError("Observations.image must ascend from 0")

    def __len__(self) -> int:
        return len(self.image)

    @property
    def images(self) -> int:
        """Number of images."""
        return int(self.image[-1]) + 1 if len(self.image) else 0

    def take(self, which: Any) -> Observations:
        """The observations selected by a mask or by ascending indices; the images keep their numbers."""
        return replace(
            self, image=self.image[which], xy_px=self.xy_px[which], covariance_px2=self.covariance_px2[which],
            rays_icrs=self.rays_icrs[which],
        )  # fmt: skip


def observations(
    xy_px: list[Array], rays_icrs: list[Array], covariance_px2: list[Array] | float | None = None
) -> Observations:
    """Observations from pixels (n_i, 2) and directions (n_i, 3), one array per image.

    `covariance_px2`: per image (n_i, 2, 2), or one variance per axis [px^2] for all. None: the centroid errors are not
    known; a fit then takes them from the scatter.
    """
    counts = [len(xy) for xy in xy_px]
    covariance = (
        np.concatenate(covariance_px2)
        if isinstance(covariance_px2, list)
        else np.broadcast_to((covariance_px2 or 0.0) * np.eye(2), (sum(counts), 2, 2))
    )
    return Observations(
        image=np.repeat(np.arange(len(counts)), counts),
        xy_px=np.concatenate(xy_px),
        covariance_px2=covariance,
        rays_icrs=np.concatenate(rays_icrs),
    )


class Adjustable(Protocol):
    """What `adjust` changes: State, or another dataclass with its methods (boards, a view of a narrow field)."""

    @property
    def rotations(self) -> Array: ...  # (images, 3, 3)
    @property
    def is_valid(self) -> bool: ...
    def rays_cam(self, points: Observations) -> Array: ...
    def residual_px(self, points: Observations, rays_cam: Array) -> Array: ...
    def terms(self, points: Observations, rays_cam: Array, free: tuple[str, ...]) -> Terms: ...
    def step(self, free: tuple[str, ...], lens: Array, poses: Array) -> Any: ...


class CameraState(Adjustable, Protocol):
    """An adjustable dataclass with a camera."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def camera(self) -> Camera: ...


@dataclass(frozen=True, kw_only=True)
class State:
    """A camera and the attitudes R_cam_icrs (images, 3, 3) of its images: what an adjustment changes."""

    camera: Camera
    R_cam_icrs: Array

    def rays_cam(self, points: Observations) -> Array:
        """Directions (n, 3) of the observations in their cameras' axes."""
        if len(self.R_cam_icrs) == 1:
            return np.asarray(points.rays_icrs @ self.R_cam_icrs[0].T)
        return np.einsum("nij,nj->ni", self.R_cam_icrs[points.image], points.rays_icrs)

    def residual_px(self, points: Observations, rays_cam: Array) -> Array:
        """Measured minus predicted pixels (n, 2), also outside the frame and the calibrated angle."""
        return points.xy_px - self.camera.project_unlimited(rays_cam)

    def terms(self, points: Observations, rays_cam: Array, free: tuple[str, ...]) -> Terms:
        """Derivatives of the predicted pixels by the free lens parameters and the attitudes."""
        lens = lens_jacobian(self.camera, rays_cam, free) if free else np.zeros((len(rays_cam), 2, 0))
        return Terms(lens, self.camera.jacobian_px_per_rad(rays_cam), points.image, len(self.R_cam_icrs))

    def step(self, free: tuple[str, ...], lens: Array, poses: Array) -> State:
        """The state after a step of the free lens parameters (m,) and of the attitudes (images, 3) [rad]."""
        camera = with_update(self.camera, dict(zip(free, lens.tolist(), strict=True))) if free else self.camera
        return replace(self, camera=camera, R_cam_icrs=R_from_rotvec(poses) @ self.R_cam_icrs)

    @property
    def rotations(self) -> Array:
        """R_cam_icrs (images, 3, 3)."""
        return self.R_cam_icrs

    @property
    def is_valid(self) -> bool:
        """Whether the radius of the lens grows with the angle near the axis: a step must not fold the image."""
        return min(self.camera.focal_px) > 0 and self.camera.lens.max_invertible_rad > SMALLEST_RISE_RAD


class Loss(NamedTuple):
    """A loss as a function of an observation's chi-square, and the factor by which it changes the weight."""

    cost: Callable[[Array], Array]
    weight_factor: Callable[[Array], Array]


def cauchy_loss(scale_chi2: float) -> Loss:
    """Cauchy's loss: the weight is halved at the chi-square `scale_chi2`, and wrong matches lose their pull."""
    return Loss(lambda chi2: scale_chi2 * np.log1p(chi2 / scale_chi2), lambda chi2: 1.0 / (1.0 + chi2 / scale_chi2))


def _huber_factor(chi2: Array) -> Array:
    factor = np.minimum(1.0, HUBER_SIGMAS / np.sqrt(np.maximum(chi2, 1e-12)))
    return np.where(chi2 < OUTLIER_CHI2, factor, 0.0)


SQUARES = Loss(lambda chi2: chi2, np.ones_like)
HUBER_WITH_CUT = Loss(lambda chi2: np.minimum(chi2, OUTLIER_CHI2), _huber_factor)


@dataclass(frozen=True)
class Prior:
    """Knowledge of the free lens parameters before the adjustment, each (m,)."""

    sigma: Array
    offset: Array  # expected value minus the value at the start

    @property
    def precision(self) -> Array:
        """(m,)"""
        return np.asarray(self.sigma**-2.0)


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """How an adjustment iterates."""

    loss: Loss = SQUARES
    steps: int = 40
    settled_px: float = 1e-6  # RMS shift of the predictions below which it ends
    damped: bool = True  # Levenberg-Marquardt; False: Gauss-Newton, for good starts
    estimates_extra: bool = False  # variance beyond the stated one from the residuals at each step; not damped


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Result of `adjust`."""

    state: Any  # of the type of the start
    terms: Terms
    equations: NormalEquations  # at the solution
    residual_px: Array  # (n, 2)
    chi2: Array  # (n,) with the extra variance added
    inverse: Array  # (n, 2, 2) inverse covariances, the extra variance added
    weight: Array  # (n, 2, 2) these, times the factor of the loss
    extra_px2: float

    @property
    def parameters(self) -> int:
        """Number of fitted parameters."""
        return self.terms.lens.shape[2] + self.terms.pose.shape[2] * self.terms.images


def adjust(
    start: Any, points: Observations, free: tuple[str, ...], scheme: Scheme, *, extra_px2: float = 0.0,
    prior: Prior | None = None,
) -> Solution:  # fmt: skip
    """Adjust a state (State or a class with its methods) to the observations, from a start that is roughly right.

    `extra_px2`: variance per axis beyond the stated one, unless the scheme estimates it. Raises
    NotIdentified where a loss with a cut leaves fewer than 3 observations.
    """
    state, damping, settled, extra = start, FIRST_DAMPING, False, extra_px2
    damped = scheme.damped and not scheme.estimates_extra
    moved = np.zeros(len(free))
    rays = state.rays_cam(points)
    residual = state.residual_px(points, rays)
    inverse = inverse_covariance(points.covariance_px2, extra)

    def cost_of(residual_px: Array, moved_by: Array) -> float:
        by_prior = 0.0 if prior is None else float(np.sum(prior.precision * np.square(prior.offset - moved_by)))
        return float(np.sum(scheme.loss.cost(chi_square(residual_px, inverse)))) + by_prior

    cost = cost_of(residual, moved) if damped else np.inf
    for _ in range(scheme.steps):
        if scheme.estimates_extra:
            extra = extra_variance_px2(residual, points.covariance_px2, len(free) + 3 * points.images)
            inverse = inverse_covariance(points.covariance_px2, extra)
        chi2 = chi_square(residual, inverse)
        factor = scheme.loss.weight_factor(chi2)
        if (agreeing := int(np.count_nonzero(factor))) < FEWEST_STARS:
            raise NotIdentified("fewer than 3 stars agree on an attitude", matched=agreeing)
        weight = inverse * factor[:, None, None]
        terms = state.terms(points, rays, free)
        equations = terms.normal_equations(weight, residual)
        if prior is not None:
            equations = equations.with_prior(prior.precision, prior.offset - moved)
        if settled:
            break
        while True:
            lens, poses = (equations.damped(damping) if damped else equations).solve()
            trial = state.step(free, lens, poses)
            trial_rays = trial.rays_cam(points)
            trial_residual = trial.residual_px(points, trial_rays)
            if not damped:
                break
            trial_cost = cost_of(trial_residual, moved + lens)
            if trial_cost <= cost * (1 + 1e-12) and trial.is_valid:
                cost = trial_cost
                break
            damping = max(damping * 10.0, 1e-6)
            if damping >= MOST_DAMPING:
                return Solution(state=state, terms=terms, equations=equations, residual_px=residual, chi2=chi2,
                                inverse=inverse, weight=weight, extra_px2=extra)  # fmt: skip
        damping = max(damping / 30.0, 1e-12)
        shift = float(np.sqrt(np.mean(np.square(trial_residual - residual)))) if len(residual) else 0.0
        state, rays, residual, moved = trial, trial_rays, trial_residual, moved + lens
        settled = shift < scheme.settled_px
        if settled and not damped:
            break  # the equations of the last step are good enough
    return Solution(state=state, terms=terms, equations=equations, residual_px=residual,
                    chi2=chi_square(residual, inverse), inverse=inverse, weight=weight, extra_px2=extra)  # fmt: skip


def inverse_covariance(covariance_px2: Array, extra_px2: float) -> Array:
    """Inverses (n, 2, 2) of the covariances (n, 2, 2) with a variance per axis added."""
    xx, yy, xy = covariance_px2[:, 0, 0] + extra_px2, covariance_px2[:, 1, 1] + extra_px2, covariance_px2[:, 0, 1]
    by_determinant = 1.0 / (xx * yy - xy * xy)
    inverse = np.empty((len(xx), 2, 2))
    inverse[:, 0, 0], inverse[:, 1, 1] = yy * by_determinant, xx * by_determinant
    inverse[:, 0, 1] = inverse[:, 1, 0] = -xy * by_determinant
    return inverse


def chi_square(residual_px: Array, inverse: Array) -> Array:
    """Normalised squared residuals (n,) of residuals (n, 2) with inverse covariances (n, 2, 2)."""
    x, y = residual_px.T
    return np.asarray(inverse[:, 0, 0] * x * x + 2.0 * inverse[:, 0, 1] * x * y + inverse[:, 1, 1] * y * y)


def extra_variance_px2(
    residual_px: Array, covariance_px2: Array, parameters: int = 3, *, by_sum: bool = False
) -> float:
    """Variance per axis [px^2] to add to every centroid so that the chi-square is as expected; at least 1e-6.

    The median of the residuals' chi-squares (n,) is compared with that of two degrees of freedom; `by_sum`: their sum
    with the degrees of freedom, for residuals without outliers. `parameters`: number of fitted parameters, whose
    share the residuals (n, 2) lack.
    """
    from scipy.optimize import brentq

    n = len(residual_px)
    axes_px2, axes = np.linalg.eigh(covariance_px2)
    squared = np.square(np.einsum("nij,ni->nj", axes, residual_px)).T
    axes_px2 = np.ascontiguousarray(axes_px2.T)
    middle_two = (n - 1) // 2, n // 2
    expected = max(2.0 * n - parameters, 1.0) if by_sum else CHI2_2DOF_MEDIAN * max(1.0 - 0.5 * parameters / n, 0.1)

    def excess(log_extra: float) -> float:
        along = squared / (axes_px2 + np.exp(log_extra))
        chi2 = along[0] + along[1]
        if by_sum:
            return float(chi2.sum()) - expected
        ordered = np.partition(chi2, middle_two)  # a third of the time of numpy.median
        return 0.5 * float(ordered[middle_two[0]] + ordered[middle_two[1]]) - expected

    low, high = float(np.log(SMALLEST_EXTRA_PX2)), 0.0
    if excess(low) <= 0.0:
        return SMALLEST_EXTRA_PX2
    while excess(high) > 0.0 and high < np.log(LARGEST_EXTRA_PX2):
        low, high = high, high + np.log(4.0)
    return float(np.exp(brentq(excess, low, high, xtol=1e-6))) if excess(high) < 0.0 else float(np.exp(high))


@dataclass(frozen=True, kw_only=True)
class AttitudeFit:
    """Result of `solve_attitude`."""

    attitude: Attitude
    residual_px: Array  # (n, 2) measured minus predicted
    used: Bools  # (n,) not rejected as outliers
    rms_px: float  # of the used stars, per axis
    extra_sigma_px: float  # error per axis beyond the stated centroid errors (lens, blends, catalogue)


def solve_attitude(
    camera: Camera, xy_px: Array, covariance_px2: Array, rays_icrs: Array, R_cam_icrs: Array
) -> AttitudeFit:
    """Attitude that fits measured pixels (n, 2) with covariances (n, 2, 2) of stars (n, 3), outliers rejected.

    `R_cam_icrs` (3, 3): a start within some pixels. The scatter of the residuals sets an error common to all stars,
    which is added to every centroid. The uncertainty of the lens (the camera's covariance) turns all stars alike, so
    that no scatter shows it: it is added to the attitude's covariance. Raises NotIdentified with fewer than 3 stars.
    """
    if len(xy_px) < FEWEST_STARS:
        raise NotIdentified("fewer than 3 stars agree on an attitude", matched=len(xy_px))
    points = Observations(
        image=np.zeros(len(xy_px), dtype=np.int64), xy_px=xy_px, covariance_px2=covariance_px2, rays_icrs=rays_icrs
    )
    start = State(camera=camera, R_cam_icrs=np.array(R_cam_icrs)[None])
    found = adjust(start, points, (), Scheme(loss=HUBER_WITH_CUT, steps=12, estimates_extra=True))
    used = found.chi2 < OUTLIER_CHI2
    jacobian, weight, residual = found.terms.pose[used], found.weight[used], found.residual_px[used]
    by_stars = _attitude_covariance(jacobian, found.inverse[used], weight, residual)
    rays_cam = found.state.rays_cam(points)[used]
    by_lens = _attitude_covariance_by_lens(camera, rays_cam, jacobian, weight)
    return AttitudeFit(
        attitude=Attitude(R_cam_icrs=found.state.R_cam_icrs[0], covariance_rad2=by_stars + by_lens),
        residual_px=found.residual_px,
        used=used,
        rms_px=float(np.sqrt(np.mean(residual**2))),
        extra_sigma_px=float(np.sqrt(found.extra_px2)),
    )


def _attitude_covariance(jacobian: Array, inverse: Array, weight: Array, residual_px: Array) -> Array:
    """Covariance (3, 3) from the stated errors, or from the scatter of the residuals where that is larger.

    The second is the sandwich H^-1 (sum s s^T) H^-1 of the stars' scores s: it holds for heavy tails and for centroid
    errors larger than stated, but is noisy with few stars.
    """
    stated = np.linalg.inv(np.einsum("nia,nij,njb->ab", jacobian, inverse, jacobian, optimize=True))
    n = len(residual_px)
    if n < FEWEST_FOR_SCATTER:
        return np.asarray(stated)
    bread = np.linalg.inv(np.einsum("nia,nij,njb->ab", jacobian, weight, jacobian, optimize=True))
    scores = np.einsum("nia,nij,nj->na", jacobian, weight, residual_px, optimize=True)
    by_scatter = bread @ (scores.T @ scores) @ bread * (n / (n - 3))
    return np.asarray(stated * max(1.0, float(np.trace(by_scatter) / np.trace(stated))))


def _attitude_covariance_by_lens(camera: Camera, rays_cam: Array, jacobian: Array, weight: Array) -> Array:
    """Covariance (3, 3) of the attitude's response to an error of the lens; 0 where the camera has no covariance.

    For a lens fitted to these very stars the sum of both covariances is the marginal of the joint fit, provided that
    the camera's covariance is its marginal too (the inverse of a matrix in blocks).
    """
    if camera.covariance is None:
        return np.zeros((3, 3))
    weighted = np.einsum("nia,nij->naj", jacobian, weight)
    by_turn = np.einsum("naj,njb->ab", weighted, jacobian)
    by_lens = np.einsum("naj,njm->am", weighted, lens_jacobian(camera, rays_cam, camera.covariance_order))
    response = np.linalg.solve(by_turn, by_lens)
    return np.asarray(response @ camera.covariance @ response.T)
