"""Least-squares adjustment of attitudes and lens parameters to measured pixels, robust if requested.

One loop serves the attitude of a calibrated camera, the lens of an unknown one and a calibration of many images.
Callers choose the free lens parameters, the loss, a prior, and whether the variance beyond the stated centroid errors
(lens, blends, catalogue) is estimated on the way so that the chi-square fits. The images have only the lens in common,
so that each image's attitude is eliminated alone (the Schur complement): the cost grows linearly with their number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from startrack.camera import Camera, lens_jacobian, with_update
from startrack.core.limits import check_time
from startrack.core.statistics import root_between
from startrack.core.types import Array, Ints, NotIdentified, Rows, array
from startrack.frames import R_from_rotvec

RIDGE_1 = 1e-14  # relative to the diagonal; the system stays solvable with unconstrained parameters
TINY = np.finfo(np.float64).tiny
CHI2_2DOF_MEDIAN = 1.3863
STAR_OUTLIER_CHI2 = 16.0  # 4 sigma in each axis: rejects one good star in 3000
HUBER_SIGMAS = 2.5  # residual beyond which the influence of an observation is constant
MIN_ATTITUDE_STARS = 3
SMALLEST_EXTRA_PX2, LARGEST_EXTRA_PX2 = 1e-6, 1e8
ROOT_TOLERANCE = 1e-6  # of the logarithm of the variance that is added
FIRST_DAMPING = 1e-6
SMALLEST_DAMPING, MAX_DAMPING = FIRST_DAMPING**2, 1.0 / FIRST_DAMPING
SMALLEST_RISE_RAD = 0.2  # angle up to which the radius of a valid lens must increase


@dataclass(frozen=True, kw_only=True)
class Observations(Rows):
    """Measured pixels with known directions, sorted by image."""

    image: Ints = array("n", dtype=np.int64)  # 0 ... images - 1, ascending
    xy_px: Array = array("n", 2)  # measured
    covariance_px2: Array = array("n", 2, 2)  # of the measurement
    rays_icrs: Array = array("n", 3)  # apparent directions, refraction included; of boards: positions [squares]

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(np.diff(self.image) < 0) or np.any(self.image[:1] < 0):
            raise ValueError("Observations.image must ascend from 0")

    @property
    def images(self) -> int:
        """Number of images."""
        return int(self.image[-1]) + 1 if len(self.image) else 0


def observations(
    xy_px: list[Array], rays_icrs: list[Array], covariance_px2: list[Array] | float | None = None
) -> Observations:
    """Observations from pixels `xy_px` (n_i, 2) and directions `rays_icrs` (n_i, 3), one array per image.

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


def observations_of_image(xy_px: Array, covariance_px2: Array, rays_icrs: Array) -> Observations:
    """Observations of a single image: pixels (n, 2), their covariances (n, 2, 2), directions (n, 3)."""
    image = np.zeros(len(xy_px), dtype=np.int64)
    return Observations(image=image, xy_px=xy_px, covariance_px2=covariance_px2, rays_icrs=rays_icrs)


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of the normal matrix of m lens parameters and q pose parameters per image, and the right sides."""

    lens: Array  # (m, m)
    lens_pose: Array  # (images, m, q)
    pose: Array  # (images, q, q)
    lens_right: Array  # (m,)
    pose_right: Array  # (images, q)

    def subtract(self, part: NormalEquations) -> NormalEquations:
        """Copy of these equations without a part of their observations."""
        return NormalEquations(
            self.lens - part.lens, self.lens_pose - part.lens_pose, self.pose - part.pose,
            self.lens_right - part.lens_right, self.pose_right - part.pose_right,
        )  # fmt: skip

    def with_prior(self, precision: Array, offset: Array) -> NormalEquations:
        """Copy with a prior of the lens parameters: precisions (m,) and expected minus current values (m,)."""
        return replace(self, lens=self.lens + np.diag(precision), lens_right=self.lens_right + precision * offset)

    def with_damping(self, damping: float) -> NormalEquations:
        """Copy with the diagonals multiplied by 1 + damping. Source: Marquardt 1963, J. SIAM 11, 431."""
        return replace(
            self,
            lens=self.lens + damping * np.diag(np.diag(self.lens)),
            pose=self.pose + damping * np.einsum("nii,ij->nij", self.pose, np.eye(self.pose.shape[1])),
        )

    @cached_property
    def pose_inverse(self) -> Array:
        """Inverses (images, q, q) of the pose blocks."""
        size = np.trace(self.pose, axis1=1, axis2=2)[:, None, None]
        return np.linalg.inv(self.pose + (RIDGE_1 * size + TINY) * np.eye(self.pose.shape[1]))

    @cached_property
    def pose_by_lens(self) -> Array:
        """Response (images, q, m) of the poses to a change of the lens parameters."""
        return -self.pose_inverse @ np.swapaxes(self.lens_pose, 1, 2)

    @cached_property
    def lens_covariance(self) -> Array:
        """Marginal covariance (m, m) of the lens parameters."""
        schur = self.lens + np.sum(self.lens_pose @ self.pose_by_lens, axis=0)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.lens), TINY))
        scaled = schur * scale * scale[:, None]
        inverse = np.linalg.inv(0.5 * (scaled + scaled.T) + RIDGE_1 * np.eye(len(scaled)))
        return inverse * scale * scale[:, None]

    @property
    def pose_covariance(self) -> Array:
        """Marginal covariances (images, q, q) of the poses."""
        by = self.pose_by_lens
        return self.pose_inverse + by @ self.lens_covariance @ np.swapaxes(by, 1, 2)

    def solve(self) -> tuple[Array, Array]:
        """Steps of the lens parameters (m,) and of the poses (images, q)."""
        if len(self.pose) == 1:
            return self._solve_dense()
        right = self.lens_right + np.einsum("nam,na->m", self.pose_by_lens, self.pose_right)
        lens = self.lens_covariance @ right
        return lens, np.einsum("nab,nb->na", self.pose_inverse, self.pose_right) + self.pose_by_lens @ lens

    def _solve_dense(self) -> tuple[Array, Array]:
        """Steps (m,) and (1, q) for a single image, by one small system with the parameters' units divided out."""
        m = len(self.lens)
        size = m + self.pose.shape[1]
        full = np.empty((size, size))
        full[:m, :m], full[:m, m:], full[m:, :m], full[m:, m:] = (
            self.lens, self.lens_pose[0], self.lens_pose[0].T, self.pose[0]
        )  # fmt: skip
        diagonal = full.ravel()[:: size + 1]  # a view
        unit = 1.0 / np.sqrt(np.maximum(diagonal, TINY))
        full *= unit
        full *= unit[:, None]
        diagonal += RIDGE_1
        step = unit * np.linalg.solve(full, unit * np.concatenate([self.lens_right, self.pose_right[0]]))
        return step[:m], step[None, m:]


@dataclass(frozen=True)
class Terms:
    """Derivatives of the observations' pixels by the lens parameters (n, 2, m) and by their image's pose (n, 2, q).

    q is 3 for attitudes (stars), and 6 for poses of boards, which have a position too.
    """

    lens: Array
    pose: Array
    image: Ints  # (n,) ascending
    images: int

    def take(self, which: Ints) -> Terms:
        """Terms of the observations with these ascending indices."""
        return Terms(self.lens.T[..., which].T, self.pose.T[..., which].T, self.image[which], self.images)

    def shift_px(self, lens: Array, poses: Array) -> Array:
        """Linear shift (n, 2) of the predicted pixels by steps of the lens parameters (m,) and poses (images, q)."""
        return self.lens @ lens + np.einsum("nij,nj->ni", self.pose, poses[self.image])

    def normal_equations(self, weight: Array, residual_px: Array) -> NormalEquations:
        """Normal equations by weights (n, 2, 2) and residuals (n, 2), measured minus predicted, of the observations."""
        m = self.lens.shape[2]
        q = m + self.pose.shape[2]
        ends = np.searchsorted(self.image, np.arange(self.images + 1))
        total = np.zeros((self.images, q + 1, q + 1))
        for i, (a, b) in enumerate(pairwise(ends.tolist())):  # one matrix product each is much faster than einsum
            full = np.concatenate([self.lens.T[..., a:b], self.pose.T[..., a:b], residual_px.T[None, :, a:b]])
            (xx, xy), (yx, yy) = weight[a:b].transpose(1, 2, 0)
            x, y = full[:, 0], full[:, 1]
            weighted = np.stack([xx * x + xy * y, yx * x + yy * y], axis=1)
            total[i] = full.reshape(q + 1, -1) @ weighted.reshape(q + 1, -1).T
        return NormalEquations(
            lens=total[:, :m, :m].sum(axis=0),
            lens_pose=total[:, :m, m:q],
            pose=total[:, m:q, m:q],
            lens_right=total[:, :m, q].sum(axis=0),
            pose_right=total[:, m:q, q],
        )


class CameraState(Protocol):
    """A dataclass of the unknowns of `adjust` with a camera: State, or a state of boards or of a narrow field."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def camera(self) -> Camera: ...
    @property
    def rotations(self) -> Array: ...  # (images, 3, 3)
    @property
    def is_valid(self) -> bool: ...
    def rays_cam(self, points: Observations) -> Array: ...
    def residual_px(self, points: Observations, rays_cam: Array) -> Array: ...
    def terms(self, points: Observations, rays_cam: Array, free: tuple[str, ...]) -> Terms: ...
    def step(self, free: tuple[str, ...], lens: Array, poses: Array) -> Any: ...


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
        """Derivatives of the predicted pixels by the free lens parameters and by the attitudes [rad]."""
        lens = lens_jacobian(self.camera, rays_cam, free) if free else np.zeros((len(rays_cam), 2, 0))
        return Terms(lens, self.camera.jacobian_px_per_rad(rays_cam), points.image, len(self.R_cam_icrs))

    def step(self, free: tuple[str, ...], lens: Array, poses: Array) -> State:
        """The state after a step of the free lens parameters (m,) and of the attitudes (images, 3) [rad]."""
        camera = with_update(self.camera, dict(zip(free, lens.tolist(), strict=True))) if free else self.camera
        return replace(self, camera=camera, R_cam_icrs=R_from_rotvec(poses) @ self.R_cam_icrs)

    @property
    def rotations(self) -> Array:
        """Attitudes R_cam_icrs (images, 3, 3) of the images."""
        return self.R_cam_icrs

    @property
    def is_valid(self) -> bool:
        """Whether the radius of the lens grows with the angle near the axis: a step must not fold the image."""
        return min(self.camera.focal_px) > 0 and self.camera.lens.max_invertible_rad > SMALLEST_RISE_RAD


class Loss(NamedTuple):
    """A loss: functions of an observation's chi-square for the cost, and for the factor on the weight."""

    cost: Callable[[Array], Array]
    weight_factor: Callable[[Array], Array]


def cauchy_loss(scale_chi2: float) -> Loss:
    """Cauchy's loss: the weight is halved at the chi-square `scale_chi2`, and tends to 0 for wrong matches."""
    return Loss(lambda chi2: scale_chi2 * np.log1p(chi2 / scale_chi2), lambda chi2: 1.0 / (1.0 + chi2 / scale_chi2))


SQUARES = Loss(lambda chi2: chi2, np.ones_like)
HUBER_WITH_CUT = Loss(
    lambda chi2: np.minimum(chi2, STAR_OUTLIER_CHI2),
    lambda chi2: np.where(chi2 < STAR_OUTLIER_CHI2, HUBER_SIGMAS / np.sqrt(np.maximum(chi2, HUBER_SIGMAS**2)), 0.0),
)


@dataclass(frozen=True)
class Prior:
    """Knowledge of the free lens parameters before the adjustment, each (m,)."""

    sigma: Array
    offset: Array  # expected value minus the value at the start

    @property
    def precision(self) -> Array:
        """Inverse variances (m,) of the parameters."""
        return np.asarray(self.sigma**-2.0)


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """Settings of the iteration of an adjustment."""

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
    damped = scheme.damped and not scheme.estimates_extra
    state, settled, extra, moved = start, False, extra_px2, np.zeros(len(free))
    rays = state.rays_cam(points)
    residual = state.residual_px(points, rays)
    inverse = inverse_covariance(points.covariance_px2, extra)
    damping = _Damping(points, free, scheme.loss, inverse, prior) if damped else None
    for k in range(scheme.steps):
        check_time()
        if scheme.estimates_extra:
            extra = extra_variance_px2(residual, points.covariance_px2, len(free) + 3 * points.images)
            inverse = inverse_covariance(points.covariance_px2, extra)
        factor = scheme.loss.weight_factor(chi_square(residual, inverse))
        if (agreeing := int(np.count_nonzero(factor))) < MIN_ATTITUDE_STARS:
            raise NotIdentified("fewer than 3 stars agree on an attitude", matched=agreeing)
        weight = inverse * factor[:, None, None]
        terms = state.terms(points, rays, free)
        equations = terms.normal_equations(weight, residual)
        if prior is not None:
            equations = equations.with_prior(prior.precision, prior.offset - moved)
        if settled:
            break
        before = residual
        if damping is not None:
            trial = damping.step(equations, state, residual, moved)
            if trial is None:
                break
            state, rays, residual, lens = trial
        else:
            lens, poses = equations.solve()
            state = state.step(free, lens, poses)
            if k == scheme.steps - 1 and not scheme.estimates_extra:
                break  # the residual of a few plain steps is not used
            rays = state.rays_cam(points)
            residual = state.residual_px(points, rays)
        moved = moved + lens
        settled = len(residual) == 0 or float(np.sqrt(np.mean(np.square(residual - before)))) < scheme.settled_px
        if settled and not damped:
            break  # the equations of the last step are good enough
    return Solution(
        state=state, terms=terms, equations=equations, residual_px=residual, chi2=chi_square(residual, inverse),
        inverse=inverse, weight=weight, extra_px2=extra,
    )  # fmt: skip


@dataclass
class _Damping:
    """Marquardt's damping: a step is taken only if it lowers the cost."""

    points: Observations
    free: tuple[str, ...]
    loss: Loss
    inverse: Array  # (n, 2, 2)
    prior: Prior | None
    damping: float = FIRST_DAMPING

    def step(
        self, equations: NormalEquations, state: Any, residual_px: Array, moved: Array
    ) -> tuple[Any, Array, Array, Array] | None:
        """New state, its rays and residuals, and the step of the lens parameters; None where no step lowers the cost.

        `moved`: sum of the earlier steps of the lens parameters (m,).
        """
        cost = self.cost(residual_px, moved)
        while self.damping < MAX_DAMPING:
            lens, poses = equations.with_damping(self.damping).solve()
            trial = state.step(self.free, lens, poses)
            rays = trial.rays_cam(self.points)
            residual = trial.residual_px(self.points, rays)
            if self.cost(residual, moved + lens) <= cost * (1 + 1e-12) and trial.is_valid:
                self.damping = max(self.damping / 30.0, SMALLEST_DAMPING)
                return trial, rays, residual, lens
            self.damping = max(self.damping * 10.0, FIRST_DAMPING)
        return None

    def cost(self, residual_px: Array, moved: Array) -> float:
        """Loss of the residuals (n, 2) and of the prior."""
        by_data = float(np.sum(self.loss.cost(chi_square(residual_px, self.inverse))))
        if self.prior is None:
            return by_data
        return by_data + float(np.sum(self.prior.precision * np.square(self.prior.offset - moved)))


def inverse_covariance(covariance_px2: Array, extra_px2: float) -> Array:
    """Inverses (n, 2, 2) of the covariances (n, 2, 2) with a variance per axis added."""
    xx, yy, xy = covariance_px2[:, 0, 0] + extra_px2, covariance_px2[:, 1, 1] + extra_px2, covariance_px2[:, 0, 1]
    by_determinant = 1.0 / (xx * yy - xy * xy)
    mixed = -xy * by_determinant
    return np.array([[yy * by_determinant, mixed], [mixed, xx * by_determinant]]).transpose(2, 0, 1)


def chi_square(residual_px: Array, inverse: Array) -> Array:
    """Normalised squared residuals (n,) of residuals (n, 2) with inverse covariances (n, 2, 2)."""
    x, y = residual_px.T
    return np.asarray(inverse[:, 0, 0] * x * x + 2.0 * inverse[:, 0, 1] * x * y + inverse[:, 1, 1] * y * y)


def extra_variance_px2(
    residual_px: Array, covariance_px2: Array, parameters: int = 3, *, by_sum: bool = False
) -> float:
    """Variance per axis [px^2] to add to every centroid so that the chi-square is as expected; at least 1e-6.

    The median of the residuals' chi-squares (n,) is compared with that of two degrees of freedom; `by_sum`: their sum
    with the degrees of freedom, for residuals without outliers. `parameters`: number of fitted parameters, which
    are subtracted from the degrees of freedom of the residuals (n, 2).
    """
    n = len(residual_px)
    # Along the axes of each covariance.
    (x, y), xx, yy, xy = residual_px.T, covariance_px2[:, 0, 0], covariance_px2[:, 1, 1], covariance_px2[:, 0, 1]
    half, turn = np.hypot(0.5 * (xx - yy), xy), 0.5 * np.arctan2(2.0 * xy, xx - yy)
    c, s = np.cos(turn), np.sin(turn)
    squared = np.square(np.stack([c * x + s * y, c * y - s * x]))
    axes_px2 = 0.5 * (xx + yy) + np.stack([half, -half])
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
    return float(np.exp(root_between(excess, low, high, ROOT_TOLERANCE))) if excess(high) < 0.0 else float(np.exp(high))
