"""From matched stars to a lens: robust first, one clip, then plainly; the order by cross-validation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.calibrate.held_out import folds, held_out_residual_px
from startrack.calibrate.observations import Observations
from startrack.calibrate.reach import reach_rad
from startrack.calibrate.solve import Solution, State, mean_scatter_px2, scatter_px2, solve
from startrack.camera import Camera, KannalaBrandt, Pinhole
from startrack.types import Array, Bools, NotIdentified

FEWEST = 12
CLIP_CHI2 = 20.0  # two axes: one good star in 20,000 is lost
FIRST_SIGMA_PX = 1.0
ROBUST_ROUNDS = 4
SMALLEST_PX2 = 1e-6
PINHOLE_LIMIT_RAD = np.radians(65.0)  # the tangent is no lens beyond
BASE = ("f", "cx", "cy")
ASPECT_BASE = ("fx", "fy", "cx", "cy")
MOST_ORDERS = 4
NEARLY_AS_GOOD_CHI2 = 4.0  # a longer polynomial this little worse is taken: its covariance owns up to the rim
RISES_BEYOND = 1.1  # of the outermost star: a polynomial that turns back sooner is a bad one
ASPECT_CHI2 = 12.0  # by which the held-out chi^2 must fall before fx and fy part
SCATTER_SIGMA = 3.0  # chi^2 beyond which the stated centroid errors are not believed
LOCKED_1 = 1e-6  # relative: fx and fy of square pixels, apart just enough that the matrix has an inverse


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One lens model that was tried."""

    name: str  # such as "kannala_brandt k1..k3"
    parameters: int
    held_out_chi2: float
    held_out_rms_px: float  # of the distance


@dataclass(frozen=True, kw_only=True)
class LensFit:
    """A fitted camera with its attitudes, and how well it fits."""

    camera: Camera  # with covariance; calibrated to where stars reach
    R_cam_icrs: Array  # (images, 3, 3)
    turn_covariance_rad2: Array  # (images, 3, 3)
    residual_px: Array  # (n, 2) measured minus predicted, of all observations
    used: Bools  # (n,) not clipped
    held_out_px: Array  # (n, 2) residual where the fit did not see the observation; of the clipped ones the plain one
    extra_sigma_px: float  # error per axis beyond the stated centroid errors
    chi2_per_dof: float  # with the stated centroid errors alone
    candidates: tuple[Candidate, ...]

    @property
    def held_out_rms_px(self) -> float:
        """RMS distance of the stars from where a fit without them puts them."""
        return float(np.sqrt(np.mean(np.sum(np.square(self.held_out_px[self.used]), axis=1))))

    @property
    def rms_px(self) -> float:
        """RMS distance of the used stars."""
        return float(np.sqrt(np.mean(np.sum(np.square(self.residual_px[self.used]), axis=1))))


def fit_lens(
    start: Camera, R_cam_icrs: Array, points: Observations, *, aspect: bool | None = None, order: int | None = None
) -> LensFit:
    """The lens and the attitudes that fit the observations best, from a start that is roughly right.

    `aspect`: whether fx and fy are fitted apart, `order`: how many k; None: held-out data decide. Raises NotIdentified
    where fewer than 12 observations agree with each other.
    """
    if len(points) < FEWEST:
        raise NotIdentified(f"{len(points)} matched stars cannot fix a lens: at least {FEWEST} are needed")
    state = State(camera=start, R_cam_icrs=np.asarray(R_cam_icrs, dtype=np.float64))
    robust, extra = _robust(state, points, order)
    used = _agreeing(robust, points, extra)
    good = points.take(used)
    if len(good) < FEWEST:
        raise NotIdentified(f"only {len(good)} of {len(points)} matched stars agree on a lens", matched=len(good))
    best, candidates = _chosen(robust.state, good, max(extra, SMALLEST_PX2), aspect, order)
    return _finished(best, points, used, candidates)


def _robust(state: State, points: Observations, order: int | None) -> tuple[Solution, float]:
    """Solution with Cauchy's loss, and the variance per axis that the centroids have beyond the stated one."""
    free: tuple[str, ...] = BASE
    extra = FIRST_SIGMA_PX**2
    most = MOST_ORDERS if order is None else order
    for k in range(ROBUST_ROUNDS):
        if state.camera.lens.model == "kannala_brandt":
            free = BASE + tuple(f"k{n}" for n in range(1, min(most, 1 + k) + 1))
        solution = solve(state, points, free, max(extra, SMALLEST_PX2), robust=True)
        state = solution.state
        extra = scatter_px2(solution.residual_px, points.covariance_px2, _count(solution))
    return solution, extra


def _agreeing(solution: Solution, points: Observations, extra: float) -> Bools:
    inverse = np.linalg.inv(points.covariance_px2 + max(extra, SMALLEST_PX2) * np.eye(2))
    return np.einsum("ni,nij,nj->n", solution.residual_px, inverse, solution.residual_px) < CLIP_CHI2


def _count(solution: Solution) -> int:
    return solution.terms.lens.shape[2] + 3 * solution.terms.images


def _chosen(
    state: State, points: Observations, extra: float, aspect: bool | None, order: int | None
) -> tuple[Solution, tuple[Candidate, ...]]:
    """The model that predicts held-out stars best, and all that were tried."""
    off_axis = np.arctan2(np.hypot(*state.rays_cam(points)[:, :2].T), state.rays_cam(points)[:, 2])
    fold = folds(points, off_axis)
    tried: list[tuple[Candidate, Solution, float]] = []

    def attempt(start: State, free: tuple[str, ...], name: str) -> None:
        solution = solve(start, points, free, extra)
        held = held_out_residual_px(solution, fold)
        inverse = np.linalg.inv(points.covariance_px2 + extra * np.eye(2))
        chi2 = np.einsum("ni,nij,nj->n", held, inverse, held)
        rms = float(np.sqrt(np.mean(np.sum(held**2, axis=1))))
        candidate = Candidate(name=name, parameters=len(free), held_out_chi2=float(chi2.sum()), held_out_rms_px=rms)
        tried.append((candidate, solution, candidate.held_out_chi2))

    base = ASPECT_BASE if aspect else BASE
    if order is None and off_axis.max() < PINHOLE_LIMIT_RAD:
        pinhole = replace(state.camera, lens=Pinhole())
        attempt(State(camera=pinhole, R_cam_icrs=state.R_cam_icrs), base, "pinhole")
    for k in range(MOST_ORDERS + 1) if order is None else (order,):
        known = (*state.camera.lens.k, *(MOST_ORDERS * (0.0,)))[:k]
        begin = State(camera=replace(state.camera, lens=KannalaBrandt(known)), R_cam_icrs=state.R_cam_icrs)
        attempt(begin, base + tuple(f"k{n}" for n in range(1, k + 1)), f"kannala_brandt, {k} k")
    chosen = _longest_of_the_best(tried, float(off_axis.max()))
    if aspect is None:
        free = ASPECT_BASE + tuple(f"k{n + 1}" for n in range(len(tried[chosen][1].state.camera.lens.k)))
        attempt(tried[chosen][1].state, free, f"{tried[chosen][0].name}, fx and fy apart")
        if tried[-1][2] < tried[chosen][2] - ASPECT_CHI2:
            chosen = len(tried) - 1
    return tried[chosen][1], tuple(candidate for candidate, _, _ in tried)


def _longest_of_the_best(tried: list[tuple[Candidate, Solution, float]], outermost_rad: float) -> int:
    sound = [
        i
        for i, (_, solution, _) in enumerate(tried)
        if solution.state.camera.lens.max_invertible_rad > min(RISES_BEYOND * outermost_rad, np.pi - 0.01)
    ]
    among = sound or list(range(len(tried)))
    least = min(tried[i][2] for i in among)
    return max(i for i in among if tried[i][2] <= least + NEARLY_AS_GOOD_CHI2)


def _free(solution: Solution) -> tuple[str, ...]:
    return BASE if solution.terms.lens.shape[2] - len(solution.state.camera.lens.k) == 3 else ASPECT_BASE


def _finished(best: Solution, points: Observations, used: Bools, candidates: tuple[Candidate, ...]) -> LensFit:
    """The last plain fit, with sigmas that the scatter supports, and its covariance."""
    good = points.take(used)
    free = _free(best) + tuple(f"k{n + 1}" for n in range(len(best.state.camera.lens.k)))
    dof = 2 * len(good) - _count(best)
    stated = good.covariance_px2 + SMALLEST_PX2 * np.eye(2)
    chi2 = float(np.einsum("ni,nij,nj->", best.residual_px, np.linalg.inv(stated), best.residual_px))
    believed = chi2 < dof + SCATTER_SIGMA * np.sqrt(2.0 * dof)
    extra = 0.0 if believed else mean_scatter_px2(best.residual_px, good.covariance_px2, _count(best))
    last = solve(best.state, good, free, max(extra, SMALLEST_PX2))
    rays = last.state.rays_cam(points)
    off_axis = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    residual = last.state.residual_px(points, rays)
    held = np.array(residual)
    held[used] = held_out_residual_px(last, folds(good, off_axis[used]))
    order, covariance = _file_covariance(last.state.camera, free, last.normal.lens_covariance)
    reached = min(reach_rad(off_axis[used]), last.state.camera.lens.max_invertible_rad)
    camera = replace(
        last.state.camera,
        calibrated_angle_rad=reached,
        max_angle_rad=max(min(last.state.camera.max_angle_rad, last.state.camera.lens.max_invertible_rad), reached),
        covariance_order=order,
        covariance=covariance,
    )
    return LensFit(
        camera=camera,
        R_cam_icrs=last.state.R_cam_icrs,
        turn_covariance_rad2=last.normal.turn_covariance,
        residual_px=residual,
        used=used,
        held_out_px=held,
        extra_sigma_px=float(np.sqrt(extra)),
        chi2_per_dof=chi2 / dof,
        candidates=candidates,
    )


def _file_covariance(camera: Camera, free: tuple[str, ...], covariance: Array) -> tuple[tuple[str, ...], Array]:
    """Covariance in the file's names, where fx and fy always stand apart (square pixels: all but locked together)."""
    if free[0] == "fx":
        return free, covariance
    names = ("fx", "fy", *free[1:])
    spread = np.zeros((len(names), len(free)))
    spread[0, 0], spread[1, 0] = 1.0, camera.focal_px[1] / camera.focal_px[0]
    spread[np.arange(2, len(names)), np.arange(1, len(free))] = 1.0
    wide = spread @ covariance @ spread.T
    # Exactly locked, the matrix could not be inverted by those who want to weigh errors with it.
    wide[[0, 1], [0, 1]] += 0.5 * (LOCKED_1 * camera.focal_px[0]) ** 2
    return names, 0.5 * (wide + wide.T)
