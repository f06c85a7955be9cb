"""Frame as an observation of its position and of the errors that it shares with other frames.

The likelihood of one image in the parameters of a track gives points of the posterior by images of one position. The
posterior mean m of position and shared errors by one frame, with its prior, depends on the true ones p and on the
errors h of the map's posts and waves as m = K p + G h + noise. K is what the evidence adds to the prior. G is the
covariance of the parameters with the slopes of the log-likelihood, which is the derivative of a posterior mean; for the
waves these slopes are those of a linear model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from startrack.applications.tracking.track_errors import TrackErrors
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Evidence, Ints
from startrack.estimation.observations import UNKNOWN_M, UNSEEN_NOISE, FrameEstimate
from startrack.localization import (
    ENOUGH,
    ErrorBasis,
    Gaussian,
    LinearErrors,
    SkylineModel,
    WeightedPoints,
    clear_logs,
    moments,
    sample,
    solve_linear,
)
from startrack.terrain import NO_POST, Terrain

FRAME_REACH_SIGMAS, FRAME_MARGIN_M = 6.0, 5.0  # of a Gaussian, to the side of the neighbourhood
LEAST_FRAME_HALF_M = 40.0  # of the neighbourhood
MAX_NEIGHBOURHOODS = 3  # after so many the posterior is taken as it is
MIN_NOISE_SHARE = 0.3  # of the evidence's covariance: the least noise that a frame has of its own
NEGLIGIBLE_POST = 1e-4  # part of the variance of a position, by all posts that are left out together
FIRST_WAVE = 2**40  # number of the first wave, behind those of all posts
WAVE_NODES = 4096  # along each side of their grid
NODE_SPACING = 2.0  # of a wave's nodes, in the crests' distance over the wave's number
ROUNDING = 1e-9  # of the covariance, added to the noise so that it can be inverted
STEP_SIGMAS, LEAST_STEP_RAD = 0.5, 1e-7  # of the skyline's spread, to each side: where the change with it is taken
LEAST_SHARE = float(np.sqrt(2.0 / ENOUGH))  # of the information along a parameter: a variance by points errs by that
UNSEEN_RAD = 1e-7  # mean square of the skyline's rise by shared errors of one standard deviation, that no image shows
LEAST_CORRECTED = 0.1  # of a variance: the correction of moments makes it no smaller


@dataclass(eq=False)
class FrameModel:
    """Log-likelihoods of parameters (n, 2 + k): a position [m], and the shared errors in their standard deviations."""

    model: SkylineModel
    errors: TrackErrors

    @classmethod
    def of_evidence(
        cls, evidence: Evidence, terrain: Terrain, errors: TrackErrors, reference_m: Array, half_m: float
    ) -> Self:
        """Model of `evidence` with its errors of the image, for positions within `half_m` of a reference (2,) [m]."""
        image = errors.of_image(evidence.image_errors)
        basis = ErrorBasis.whole(errors.listed)
        return cls(SkylineModel.of(terrain, evidence, reference_m, half_m, errors.listed, image, basis), errors)

    @cached_property
    def rise_rad(self) -> Array:
        """Rise (SECTORS, k) [rad] of the skyline by one standard deviation of each shared error."""
        rise = self.model.seen.image_rise
        edge = rise[:, 0] if rise.shape[1] else np.zeros(SECTORS)
        return self.errors.rise_rad(self.model.slopes_rad, edge)

    def shifts(self, parameters: Array) -> Array:
        """Shift (n, SECTORS) [rad] of the map's skyline from the reference's, without errors of the image's own."""
        return self.model.shifts(self.errors.to_model(parameters, self.model.seen.rows))

    def lifts(self, parameters: Array) -> Array | None:
        """Lift (n, SECTORS) [rad] of the light above the skyline by the edge, which frames share; None: 0."""
        raised = self.model.seen.image_errors.slopes_rad
        if not self.errors.uses_sky or not raised.shape[1]:
            return None
        return np.outer(self.errors.sigma[-1] * parameters[:, -1], raised[:, 0])

    def log_likelihood(self, parameters: Array) -> Array:
        """Log-likelihood (n,) of `parameters` (n, 2 + k), with the prior of the likeliest linear errors there."""
        shifts, lifts, prior = self.model.with_linear_errors(self.shifts(parameters), self.lifts(parameters))
        return self.model.log_likelihood_of(shifts, lifts) + prior

    def is_allowed(self, parameters: Array) -> Array:
        """Whether a camera can stand at each of `parameters` (n, 2 + k), in the neighbourhood of the reference."""
        near = np.abs(parameters[:, :2] - self.model.around.reference_m).max(axis=1) < self.model.around.half_m
        return near & np.asarray(self.model.terrain.allowed(parameters[:, :2]))

    def settle(self, parameters: Array) -> None:
        """Take the states of the chain, which decide where the circle is cut, as they are at `parameters` (2 + k,)."""
        states = self.model.states(self.errors.to_model(parameters[None], self.model.seen.rows)[0])
        self.model, self.clear = self.model.with_closing(states), states[:, 0]

    def slopes(self, parameters: Array, share: Array) -> Array:
        """Change (n, SECTORS) [1/rad] of the log-likelihood with the skyline, at points with a `share` (n,) of weight.

        The edge of a single star is a step: the change is taken over a part of the skyline's spread. Sectors count by
        their probability to show the map's skyline. The likeliest linear errors follow the skyline: those of the
        image, which light alone shows, are the likeliest as they are.
        """
        seen, linear, waves = self.model.seen, self.model.linear, slice(self.model.linear.images, None)
        unraised, by_edge = self.shifts(parameters), self.lifts(parameters)
        shifts, lifts, _ = self.model.with_linear_errors(unraised, by_edge)
        errors, _ = linear.likeliest(seen.moments.mean_rad - unraised, by_edge)
        spread = np.sqrt(share @ np.square(shifts - share @ shifts))
        step = np.maximum(STEP_SIGMAS * np.hypot(spread, self.model.around.map_sigma_rad), LEAST_STEP_RAD)
        all_clear = np.ones(SECTORS)
        higher, lower = (
            clear_logs(seen.profiles, shifts + by * step, all_clear, seen.gains(shifts + by * step, lifts))
            for by in (1.0, -1.0)
        )
        slopes = self.clear * (higher - lower) / (2 * step)
        slopes_of_waves = slopes @ linear.wave_rise_rad - errors[:, waves] @ linear.inverse[waves, waves]
        return np.asarray(slopes - slopes_of_waves @ linear.gain[waves])

    @cached_property
    def design(self) -> Array:
        """Rise (SECTORS, 2 + k) [rad] of the skyline by a metre east and north, and by a sigma of each shared error."""
        return np.hstack([self.model.around.slopes.T, self.rise_rad])

    def information(self) -> tuple[Array, Array]:
        """Information (2 + k, 2 + k) of a linear model of sectors, and its product (2 + k,) with the best parameters.

        Positions are relative to the reference. Sets how much each sector counts for the linear errors.
        """
        seen, linear, design, d = self.model.seen, self.model.linear, self.design, self.design.shape[1]
        at_reference = np.r_[self.model.around.reference_m, np.zeros(d - 2)]
        height = seen.moments.mean_rad - self.shifts(at_reference[None])[0]
        prior = np.diag(np.r_[np.full(2, UNKNOWN_M**-2), np.ones(d - 2), np.zeros(len(linear))])
        prior[d:, d:] = linear.inverse
        left = seen.moments._replace(mean_rad=height)
        _, _, clear = solve_linear(left, np.hstack([design, linear.rise_rad]), np.zeros(len(prior)), prior)
        self.model = replace(self.model, sector_weight=clear)
        growth = self.gradient_by_height()
        return growth @ design, growth @ height

    def gradient_by_height(self) -> Array:
        """Growth (2 + k, SECTORS) of the gradient with the heights that sectors see, as `information` weighed them."""
        linear = self.model.linear
        weighted = self.design.T * linear.weight
        return np.asarray(weighted - (self.design.T @ linear.weighted) @ linear.gain)


def sample_together(models: Sequence[FrameModel], position_m: Array, covariance_m2: Array) -> WeightedPoints:
    """Points of the posterior by exposures of one position, with one reference, from near a position (2,)."""
    # The position as it is given, and the errors that a linear model gives for it.
    information, weighted = (np.sum(parts, axis=0) for parts in zip(*(m.information() for m in models), strict=True))
    information += np.diag(np.r_[np.full(2, UNKNOWN_M**-2), np.ones(len(information) - 2)])
    covariance = np.linalg.inv(information)
    best = covariance @ weighted
    drift = np.linalg.solve(covariance[:2, :2], covariance[:2, 2:]).T  # of the errors with the position
    alone = covariance[2:, 2:] - drift @ covariance[:2, 2:]
    wide = covariance[:2, :2] + covariance_m2
    mean = np.r_[position_m, best[2:] + drift @ (position_m - models[0].model.around.reference_m - best[:2])]
    for model in models:
        model.settle(mean)

    def log_density(points: Array) -> Array:
        value, inside = np.full(len(points), -np.inf), models[0].is_allowed(points)
        if inside.any():
            within = points[inside]
            value[inside] = np.sum([model.log_likelihood(within) for model in models], axis=0)
            value[inside] -= 0.5 * np.square(within[:, 2:]).sum(axis=1)
        return value

    first = mean, np.block([[wide, wide @ drift.T], [drift @ wide, alone + drift @ wide @ drift.T]])
    return sample(log_density, [first])


def balanced_moments(found: WeightedPoints) -> Gaussian:
    """Mean (d,) and covariance (d, d) of the points, corrected by what the same points give of a known Gaussian.

    What the evidence says nothing about keeps the covariance of its prior, which weighted points have to some percent.
    """
    mean, covariance = moments(found.points, found.share)
    off, known_1 = found.points - mean, np.linalg.inv(covariance)
    size2 = np.einsum("ni,ij,nj->n", off, known_1, off)
    known = WeightedPoints(found.points, -0.5 * size2 - found.log_drawn, found.log_drawn)
    shown_mean, shown = moments(found.points, known.share)
    corrected = 2.0 * covariance - shown
    if np.linalg.eigvals(known_1 @ corrected).real.min() < LEAST_CORRECTED:
        return mean, covariance
    return 2.0 * mean - shown_mean, corrected


def estimate_frame(
    evidence: Evidence, terrain: Terrain, errors: TrackErrors, position_m: Array, covariance_m2: Array
) -> FrameEstimate:
    """The observation by rows of `evidence` of one exposure, with their errors of the image.

    `terrain` has the evidence's enu; the `errors` are those that frames share. `position_m` (2,) is near the
    posterior's mode that is meant, `covariance_m2` (2, 2) about that of the mode.
    """
    reference, spread = position_m, covariance_m2
    for _ in range(MAX_NEIGHBOURHOODS):
        half = max(FRAME_REACH_SIGMAS * largest_sigma(spread) + FRAME_MARGIN_M, LEAST_FRAME_HALF_M)
        models = [FrameModel.of_evidence(evidence, terrain, errors, reference, half)]
        found = sample_together(models, reference, spread)
        mean, covariance = moments(found.points, found.share)
        if np.abs(mean[:2] - reference).max() + 3.0 * largest_sigma(covariance[:2, :2]) < half:
            break
        reference, spread = mean[:2], covariance[:2, :2]
    return observe_together(models, found)


def largest_sigma(covariance: Array) -> float:
    """Standard deviation along the longest axis of a `covariance` (d, d)."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def observe_together(models: Sequence[FrameModel], found: WeightedPoints) -> FrameEstimate:
    """The observation by sampled points of exposures of one position."""
    used = np.isfinite(found.log_weight)
    mean, covariance = balanced_moments(found)
    points, share = found.points[used], found.share[used]
    shown, response = shown_part(covariance)
    by_evidence = response @ covariance  # of the mean at given true parameters
    plain, spread = moments(points, share)
    by_horizon, counted = np.zeros((len(mean), len(MIDDLES_RAD))), np.zeros_like(covariance)
    wave, rises = waves_at(models[0].model.around.reference_m, models[0].model.terrain, models[0].model.linear)
    by_wave = np.zeros((len(mean), len(wave)))
    for model in models:
        model.settle(mean)
        slopes = model.slopes(points, share)
        common = ((points - plain) * share[:, None]).T @ (slopes - share @ slopes)
        own = shown @ covariance @ np.linalg.solve(spread, common)
        by_posts = model.model.around.post_sigma_rad  # other errors of the ground are this frame's own noise
        counted += 0.0 if by_posts is None else (own * np.square(by_posts)) @ own.T
        by_horizon += own
        of_waves = shown @ covariance @ model.gradient_by_height() @ rises  # sampled ones would be noise of the points
        counted += of_waves @ of_waves.T
        by_wave += of_waves
    noise = clipped_noise(by_evidence - counted, by_evidence) + ROUNDING * covariance
    noise += UNSEEN_NOISE * (covariance - shown @ covariance @ shown.T)
    post, by_post = _posts(models[0], by_horizon, covariance)
    post, by_post = np.append(post, wave), np.hstack([by_post, by_wave])
    shared_by_posts = by_post @ by_post.T
    estimate = FrameEstimate(
        shown @ mean, covariance - by_evidence + noise + shared_by_posts, response, noise, post, by_post,
    )  # fmt: skip
    # Without sampling noise along shared errors that the evidence does not depend on.
    rises = np.vstack([model.rise_rad for model in models])
    square_rad2, axes = np.linalg.eigh(rises.T @ rises / SECTORS)
    unseen = np.zeros_like(covariance)
    unseen[2:, 2:] = axes @ np.diag(square_rad2 < UNSEEN_RAD**2) @ axes.T
    return estimate.transform(np.eye(len(mean)) - unseen, unseen=unseen)


def shown_part(covariance: Array) -> tuple[Array, Array]:
    """Projection (d, d) on what the evidence shows, and response (d, d) of the mean to the true parameters.

    They are those of a posterior with this `covariance` (d, d). Directions in which it differs from the prior by no
    more than sampled points err are not shown: the evidence would seem to be certain there.
    """
    root = np.linalg.cholesky(covariance)
    not_prior = np.eye(len(root)) - root[2:].T @ root[2:]
    share, axes = np.linalg.eigh(not_prior)  # of the information
    share, back = np.where(share > LEAST_SHARE, share, 0.0), axes.T @ np.linalg.inv(root)
    return root @ (axes * (share > 0.0)) @ back, root @ (axes * share) @ back


def clipped_noise(noise: Array, whole: Array) -> Array:
    """Covariance `noise` (d, d), in every direction from the least share of `whole` (d, d) to all of it."""
    sizes, axes = np.linalg.eigh(0.5 * (whole + whole.T))
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    scale = np.where(sizes > 0.0, 1.0 / np.sqrt(np.maximum(sizes, 1e-300)), 0.0)
    share, turned = np.linalg.eigh((axes * scale).T @ noise @ (axes * scale))
    return np.asarray(root @ (turned * np.clip(share, MIN_NOISE_SHARE, 1.0)) @ turned.T @ root.T)


def _posts(model: FrameModel, by_horizon: Array, covariance: Array) -> tuple[Ints, Array]:
    """Posts (c,) of the crests and of the camera's ground, and the response (d, c) of the mean to the error of each."""
    terrain, around = model.model.terrain, model.model.around
    if around.crests is None:
        return np.zeros(0, dtype=np.int64), np.zeros((len(by_horizon), 0))
    crests = around.crests.post, around.crests.rad_per_m
    parts = [crests, terrain.errors.ground_posts(around.reference_m, MIDDLES_RAD)]
    every = np.concatenate([posts.ravel() for posts, _ in parts])
    # Ground higher than the map acts on the evidence as a map lower than the ground.
    response = np.concatenate(
        [(-by_horizon[:, :, None] * rad_per_m).reshape(len(by_horizon), -1) for _, rad_per_m in parts], axis=1
    )
    known = every != NO_POST
    post, of = np.unique(every[known], return_inverse=True)
    by_post: Array = np.stack([np.bincount(of, weights=row[known], minlength=len(post)) for row in response])
    by_post *= terrain.errors.height_sigma_m
    effect = np.square(by_post / np.sqrt(np.diag(covariance))[:, None]).max(axis=0, initial=0.0)
    order = np.argsort(effect)
    kept = np.sort(order[np.cumsum(effect[order]) > NEGLIGIBLE_POST])
    return post[kept], by_post[:, kept]


def waves_at(position_m: Array, terrain: Terrain, linear: LinearErrors) -> tuple[Ints, Array]:
    """Numbers (c,) of waves of the map's error, from FIRST_WAVE on, and the rise (SECTORS, c) [rad] by a sigma of each.

    A wave changes with the place, since the crests stand in other directions there: its error is that of the four
    nodes about the position (2,) of a square grid, independent of each other, in parts whose squares add up to 1.
    """
    spacing_m = NODE_SPACING * terrain.errors.crest_distance_m / (1 + np.arange(linear.waves) // 2)
    at = position_m / spacing_m[:, None]
    low, corner = np.floor(at), np.array([[0, 0], [1, 0], [0, 1], [1, 1]])[:, None]
    part = np.sqrt(np.prod(1.0 - np.abs(at - low - corner), axis=-1))
    node = np.moveaxis((low + corner).astype(np.int64) + WAVE_NODES // 2, -1, 0)
    number = FIRST_WAVE + (node[0] * WAVE_NODES + node[1]) * linear.waves + np.arange(linear.waves)
    return number.ravel(), np.concatenate([linear.sigma_of_waves_rad * one for one in part], axis=1)
