"""One frame as an observation of its position and of the errors that it shares with other frames.

The posterior mean m of position and shared errors by one frame, with its prior, depends on the true ones p and on the
errors h of the map's posts as m = K p + G h + noise. K is what the evidence adds to the prior. G is the covariance of
the parameters with the slopes of the log-likelihood: the derivative of a posterior mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from startrack.terrain import Terrain
from startrack.terrain.horizon_posts import NO_POST, HorizonPosts
from startrack.tracking.importance_sampling import Samples, sample_posterior
from startrack.tracking.shared import BIAS, ImageErrors, SharedErrors
from startrack.tracking.skyline_likelihood import SkylineLikelihood
from startrack.types import Array, Evidence, Ints

REACH_SIGMAS, MARGIN_M = 6.0, 5.0  # of a Gaussian, to the side of the neighbourhood
MAX_NEIGHBOURHOODS = 4  # after so many the posterior is taken as it is
FIRST_SHARED_SIGMA = 0.3  # of the prior, of the first Gaussian
OUTSIDE = -1e6  # logarithm of a density that is zero
MIN_NOISE_SHARE = 0.3  # of the evidence's covariance: the least noise that a frame has of its own
NEGLIGIBLE_POST = 1e-4  # part of the variance of a position, by all posts that are left out together
ROUNDING = 1e-9  # of the covariance, added to the noise so that it can be inverted


@dataclass(frozen=True, eq=False)
class FrameEstimate:
    """The observation of one frame. Parameters: east and north [m], and k shared errors in their prior's sigma."""

    mean: Array  # (2 + k,) of the posterior with the priors of the shared errors
    covariance: Array  # (2 + k, 2 + k) of that, with the errors of posts
    response: Array  # (2 + k, 2 + k) of the mean to the true parameters: K
    noise: Array  # (2 + k, 2 + k) of the mean, of this frame alone
    post: Ints  # (c,) numbers of the posts with a measurable effect
    by_post: Array  # (2 + k, c) of the mean to the error [m] of each: G
    weight: float = 1.0  # probability of this mode of the frame's posterior

    @property
    def parameters(self) -> int:
        """2 + k."""
        return len(self.mean)


def estimate_frame(
    evidence: Evidence,
    terrain: Terrain,
    shared: SharedErrors,
    first_mean: Array,
    first_covariance: Array,
    image_errors: ImageErrors | None = None,
) -> FrameEstimate:
    """The observation by rows of `evidence` above the map's horizon.

    Args:
        evidence: rows of one exposure, or of several of a camera at rest.
        terrain: with the evidence's enu.
        shared: errors that frames share.
        first_mean: (2 + k,) parameters near the posterior's mode that is meant, see `first_guess`.
        first_covariance: (2 + k, 2 + k) about that of the mode.
        image_errors: of the rows of the sky's light; None: none.
    """
    mean, covariance = first_mean, first_covariance
    for _ in range(MAX_NEIGHBOURHOODS):
        half = REACH_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1])) + MARGIN_M
        sigmas = float(np.abs(mean[2:]).max(initial=0.0)) + REACH_SIGMAS * float(
            np.sqrt(np.diag(covariance)[2:].max(initial=0.0))
        )
        near = partial(SkylineLikelihood.near, evidence, terrain, shared, image_errors)
        likelihood = near(mean[:2], half, min(sigmas, REACH_SIGMAS))
        samples = sample_posterior(_log_posterior(likelihood, half), mean, covariance)
        moved = float(np.abs(samples.mean[:2] - mean[:2]).max())
        inside = moved + 3.0 * np.sqrt(np.linalg.eigvalsh(samples.covariance[:2, :2])[1]) < half
        mean, covariance = samples.mean, samples.covariance
        if inside:
            break
    return _observation(likelihood, samples, image_errors)


def first_guess(
    shared: SharedErrors, position_m: Array, covariance_m2: Array, horizon_error_rad: float = 0.0
) -> tuple[Array, Array]:
    """Mean (2 + k,) and covariance (2 + k, 2 + k) of the first Gaussian, from a fix by one image."""
    k = len(shared.names)
    mean, covariance = np.zeros(2 + k), np.diag(np.full(2 + k, FIRST_SHARED_SIGMA**2))
    mean[:2], covariance[:2, :2] = position_m, covariance_m2
    if BIAS in shared.names:
        at = shared.names.index(BIAS)
        mean[2 + at] = horizon_error_rad / shared.sigma[at]
    return mean, covariance


def _log_posterior(likelihood: SkylineLikelihood, half_m: float) -> Callable[[Array], Array]:
    terrain, centre = likelihood.local.terrain, likelihood.centre_m

    def log_density(points: Array) -> Array:
        inside = np.abs(points[:, :2] - centre).max(axis=1) < half_m
        inside &= np.asarray(terrain.allowed(points[:, :2]))
        found = np.full(len(points), OUTSIDE)
        if inside.any():
            found[inside] = likelihood.log_likelihood(points[inside])
            found[inside] -= 0.5 * np.square(points[inside, 2:]).sum(axis=1)
        return found

    return log_density


def _observation(likelihood: SkylineLikelihood, samples: Samples, image_errors: ImageErrors | None) -> FrameEstimate:
    used = samples.weight > 0.0
    samples = Samples(samples.points[used], samples.weight[used])
    mean, covariance = samples.mean, samples.covariance
    prior = np.diag(np.concatenate([np.zeros(2), np.ones(len(mean) - 2)]))
    by_horizon = samples.covariance_with(likelihood.slopes(samples.points))
    by_evidence = covariance - covariance @ prior @ covariance  # of the mean at given true parameters
    counted = (by_horizon * np.square(likelihood.map_sigma_rad)) @ by_horizon.T
    noise = clipped_noise(by_evidence - counted, by_evidence) + ROUNDING * covariance
    if image_errors is not None:
        by_image = by_horizon @ (image_errors.at(likelihood.azimuth_rad) * likelihood.is_sky[:, None])
        noise += by_image @ image_errors.covariance @ by_image.T
    post, by_post = _posts(likelihood, by_horizon, covariance)
    shared_by_posts = likelihood.local.terrain.height_sigma_m**2 * by_post @ by_post.T
    found = FrameEstimate(
        mean, covariance - by_evidence + noise + shared_by_posts, np.eye(len(mean)) - covariance @ prior, noise, post,
        by_post,
    )  # fmt: skip
    return _without(found, 2 + np.flatnonzero(~likelihood.rise_rad.any(axis=0)))


def _without(estimate: FrameEstimate, unseen: Ints) -> FrameEstimate:
    """The estimate without sampling noise in the parameters (u,) that the evidence does not depend on."""
    if not len(unseen):
        return estimate
    seen = ~np.isin(np.arange(estimate.parameters), unseen)
    both, own = np.outer(seen, seen), np.diag(np.where(seen, 0.0, 1.0))
    return replace(
        estimate, mean=estimate.mean * seen, covariance=estimate.covariance * both + own,
        response=estimate.response * both, noise=estimate.noise * both + own, by_post=estimate.by_post * seen[:, None],
    )  # fmt: skip


def clipped_noise(noise: Array, whole: Array) -> Array:
    """`noise` (d, d) with at least the least share of `whole` (d, d) in every direction."""
    sizes, axes = np.linalg.eigh(0.5 * (whole + whole.T))
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    scale = np.where(sizes > 0.0, 1.0 / np.sqrt(np.maximum(sizes, 1e-300)), 0.0)
    share, turned = np.linalg.eigh((axes * scale).T @ noise @ (axes * scale))
    return np.asarray(root @ (turned * np.clip(share, MIN_NOISE_SHARE, 1.0)) @ turned.T @ root.T)


def _posts(likelihood: SkylineLikelihood, by_horizon: Array, covariance: Array) -> tuple[Ints, Array]:
    """Posts (c,) of the crests and of the camera's ground, and the response (d, c) of the mean to their heights."""
    terrain = likelihood.local.terrain
    if not terrain.height_sigma_m:
        return np.zeros(0, dtype=np.int64), np.zeros((len(by_horizon), 0))
    azimuth = likelihood.azimuth_rad
    parts = [terrain.horizon_posts(likelihood.centre_m, azimuth), terrain.ground_posts(likelihood.centre_m, azimuth)]
    # Ground higher than the map acts on the evidence as a map lower than the ground.
    post, by_post = _sum_by_post(parts, -by_horizon)
    scale = terrain.height_sigma_m / np.sqrt(np.diag(covariance))
    effect = np.square(by_post * scale[:, None]).max(axis=0, initial=0.0)
    order = np.argsort(effect)
    kept = np.sort(order[np.cumsum(effect[order]) > NEGLIGIBLE_POST])
    return post[kept], by_post[:, kept]


def _sum_by_post(parts: list[HorizonPosts], by_horizon: Array) -> tuple[Ints, Array]:
    post = np.concatenate([part.post.ravel() for part in parts])
    response = np.concatenate(
        [(by_horizon[:, :, None] * part.rad_per_m).reshape(len(by_horizon), -1) for part in parts], 1
    )
    known = post != NO_POST
    numbers, of = np.unique(post[known], return_inverse=True)
    return numbers, np.stack([np.bincount(of, weights=row[known], minlength=len(numbers)) for row in response])
