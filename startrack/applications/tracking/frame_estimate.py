"""One frame as an observation of its position and of the errors that it shares with other frames.

The posterior mean m of position and shared errors by one frame, with its prior, depends on the true ones p and on the
errors h of the map's posts as m = K p + G h + noise. K is what the evidence adds to the prior. G is the covariance of
the parameters with the slopes of the log-likelihood: the derivative of a posterior mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from startrack.applications.tracking.frame_model import FrameModel, balanced_moments, sample_together
from startrack.applications.tracking.track_errors import TrackErrors
from startrack.core.types import MIDDLES_RAD, Array, Evidence, Ints
from startrack.estimation.observations import FrameEstimate
from startrack.localization import WeightedPoints, moments
from startrack.terrain import NO_POST, Terrain

FRAME_REACH_SIGMAS, FRAME_MARGIN_M = 6.0, 5.0  # of a Gaussian, to the side of the neighbourhood
LEAST_FRAME_HALF_M = 40.0  # of the neighbourhood
MAX_NEIGHBOURHOODS = 3  # after so many the posterior is taken as it is
MIN_NOISE_SHARE = 0.3  # of the evidence's covariance: the least noise that a frame has of its own
NEGLIGIBLE_POST = 1e-4  # part of the variance of a position, by all posts that are left out together
ROUNDING = 1e-9  # of the covariance, added to the noise so that it can be inverted


def estimate_frame(
    evidence: Evidence, terrain: Terrain, errors: TrackErrors, position_m: Array, covariance_m2: Array
) -> FrameEstimate:
    """The observation by rows of `evidence` and their errors of the image.

    Args:
        evidence: rows of one exposure.
        terrain: with the evidence's enu.
        errors: those that frames share.
        position_m: (2,) near the posterior's mode that is meant.
        covariance_m2: (2, 2) about that of the mode.
    """
    reference, spread = position_m, covariance_m2
    for _ in range(MAX_NEIGHBOURHOODS):
        half = max(FRAME_REACH_SIGMAS * _largest_sigma(spread) + FRAME_MARGIN_M, LEAST_FRAME_HALF_M)
        models = [FrameModel.of_evidence(evidence, terrain, errors, reference, half)]
        found = sample_together(models, reference, spread)
        mean, covariance = moments(found.points, found.share)
        if np.abs(mean[:2] - reference).max() + 3.0 * _largest_sigma(covariance[:2, :2]) < half:
            break
        reference, spread = mean[:2], covariance[:2, :2]
    return observe_together(models, found)


def _largest_sigma(covariance: Array) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def observe_together(models: Sequence[FrameModel], found: WeightedPoints) -> FrameEstimate:
    """The observation by sampled points of exposures of one position."""
    used = np.isfinite(found.log_weight)
    mean, covariance = balanced_moments(found)
    points, share = found.points[used], found.share[used]
    prior = np.diag(np.concatenate([np.zeros(2), np.ones(len(mean) - 2)]))
    by_evidence = covariance - covariance @ prior @ covariance  # of the mean at given true parameters
    plain, spread = moments(points, share)
    by_horizon, counted = np.zeros((len(mean), len(MIDDLES_RAD))), np.zeros_like(covariance)
    for model in models:
        model.settle(mean)
        slopes = model.slopes(points, share)
        common = ((points - plain) * share[:, None]).T @ (slopes - share @ slopes)
        own = covariance @ np.linalg.solve(spread, common)
        counted += (own * np.square(model.model.map_sigma_rad)) @ own.T
        by_horizon += own
    noise = clipped_noise(by_evidence - counted, by_evidence) + ROUNDING * covariance
    post, by_post = _posts(models[0], by_horizon, covariance)
    shared_by_posts = models[0].model.terrain.height_sigma_m ** 2 * by_post @ by_post.T
    estimate = FrameEstimate(
        mean, covariance - by_evidence + noise + shared_by_posts, np.eye(len(mean)) - covariance @ prior, noise, post,
        by_post,
    )  # fmt: skip
    # Without sampling noise in the parameters that the evidence does not depend on.
    seen = np.append([True, True], np.any([model.rise_rad.any(axis=0) for model in models], axis=0))
    estimate = _transform(estimate, np.diag(seen * 1.0), np.diag(seen * 1.0), np.diag(~seen * 1.0))
    # With the position after the turn of the clock's error.
    to = np.eye(len(mean))
    to[:2, 2:] = models[0].errors.turn_m(estimate.mean[:2])
    return _transform(estimate, to, np.asarray(np.linalg.inv(to)), np.zeros_like(to)) if to[:2, 2:].any() else estimate


def _transform(estimate: FrameEstimate, to: Array, back: Array, own: Array) -> FrameEstimate:
    """The estimate of the parameters after the linear map `to` with the inverse `back`, with `own` noise (p, p)."""
    return replace(
        estimate, mean=to @ estimate.mean, covariance=to @ estimate.covariance @ to.T + own,
        response=to @ estimate.response @ back, noise=to @ estimate.noise @ to.T + own, by_post=to @ estimate.by_post,
    )  # fmt: skip


def clipped_noise(noise: Array, whole: Array) -> Array:
    """`noise` (d, d) with at least the least share of `whole` (d, d) in every direction."""
    sizes, axes = np.linalg.eigh(0.5 * (whole + whole.T))
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    scale = np.where(sizes > 0.0, 1.0 / np.sqrt(np.maximum(sizes, 1e-300)), 0.0)
    share, turned = np.linalg.eigh((axes * scale).T @ noise @ (axes * scale))
    return np.asarray(root @ (turned * np.clip(share, MIN_NOISE_SHARE, 1.0)) @ turned.T @ root.T)


def _posts(model: FrameModel, by_horizon: Array, covariance: Array) -> tuple[Ints, Array]:
    """Posts (c,) of the crests and of the camera's ground, and the response (d, c) of the mean to their heights."""
    terrain, at = model.model.terrain, model.model.reference_m
    if not terrain.height_sigma_m:
        return np.zeros(0, dtype=np.int64), np.zeros((len(by_horizon), 0))
    parts = [terrain.horizon_posts(at, MIDDLES_RAD), terrain.ground_posts(at, MIDDLES_RAD)]
    every = np.concatenate([part.post.ravel() for part in parts])
    # Ground higher than the map acts on the evidence as a map lower than the ground.
    response = np.concatenate(
        [(-by_horizon[:, :, None] * part.rad_per_m).reshape(len(by_horizon), -1) for part in parts], axis=1
    )
    known = every != NO_POST
    post, of = np.unique(every[known], return_inverse=True)
    by_post: Array = np.stack([np.bincount(of, weights=row[known], minlength=len(post)) for row in response])
    scale = terrain.height_sigma_m / np.sqrt(np.diag(covariance))
    effect = np.square(by_post * scale[:, None]).max(axis=0, initial=0.0)
    order = np.argsort(effect)
    kept = np.sort(order[np.cumsum(effect[order]) > NEGLIGIBLE_POST])
    return post[kept], by_post[:, kept]
