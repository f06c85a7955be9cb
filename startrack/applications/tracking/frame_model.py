"""The likelihood of one image in the parameters of a track, and points of the posterior by images of one position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from startrack.applications.tracking.track_errors import TrackErrors
from startrack.core.types import SECTORS, Array, Evidence
from startrack.estimation.observations import UNKNOWN_M
from startrack.localization import (
    NO_IMAGE_ERRORS,
    ErrorBasis,
    Gaussian,
    SkylineModel,
    WeightedPoints,
    clear_logs,
    moments,
    sample,
    solve_linear,
)
from startrack.terrain import Terrain

STEP_SIGMAS, LEAST_STEP_RAD = 0.5, 1e-7  # of the skyline's spread, to each side: where the change with it is taken
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
        """Of `evidence` with its errors of the image, for positions within `half_m` of a reference (2,)."""
        image = errors.of_image(evidence.image_errors)
        model = SkylineModel(terrain, evidence, reference_m, half_m, errors.listed, image_errors=image)
        model.basis = ErrorBasis.whole(errors.listed)
        return cls(model, errors)

    @cached_property
    def rise_rad(self) -> Array:
        """(SECTORS, k) rise of the skyline by one standard deviation of each shared error."""
        image = self.model.image_errors
        edge = np.zeros(SECTORS) if image is None else self.model.image_rise[:, 0]
        return self.errors.rise_rad(self.model.slopes_rad, edge)

    def shifts(self, parameters: Array) -> Array:
        """(n, SECTORS) of the map's skyline, without errors of the image's own."""
        found = self.model.shifts(self.errors.to_model(parameters, self.model.rows))
        if self.errors.uses_sky:
            found = found + np.outer(parameters[:, -1], self.rise_rad[:, -1])
        return found

    def log_likelihood(self, parameters: Array) -> Array:
        """(n,)."""
        shifts, prior = self.model.with_image_errors(self.shifts(parameters))
        return self.model.log_likelihood_of(shifts) + prior

    def is_allowed(self, parameters: Array) -> Array:
        """(n,) whether a camera can stand there, in the neighbourhood."""
        in_units = self.errors.to_model(parameters, self.model.rows)
        positions = self.model.errors.turned(in_units[:, :2], in_units[:, 2:])
        near = np.abs(parameters[:, :2] - self.model.reference_m).max(axis=1) < self.model.half_m
        return near & np.asarray(self.model.terrain.allowed(positions))

    def settle(self, parameters: Array) -> None:
        """Take the states of the chain, which decide where the circle is cut, at parameters (2 + k,)."""
        self.clear = self.model.states(self.errors.to_model(parameters[None], self.model.rows)[0])[:, 0]

    def slopes(self, parameters: Array, share: Array) -> Array:
        """(n, SECTORS) change of the log-likelihood with the skyline [1/rad] at points with `share` (n,) of the weight.

        The edge of a single star is a step: the change is taken over a part of the skyline's spread. Sectors count by
        their probability to show the map's skyline.
        """
        shifts, _ = self.model.with_image_errors(self.shifts(parameters))
        spread = np.sqrt(share @ np.square(shifts - share @ shifts))
        step = np.maximum(STEP_SIGMAS * np.hypot(spread, self.model.map_sigma_rad), LEAST_STEP_RAD)
        all_clear = np.ones(SECTORS)
        higher, lower = (clear_logs(self.model.profiles, shifts + sign * step, all_clear) for sign in (1.0, -1.0))
        return np.asarray(self.clear * (higher - lower) / (2 * step))

    def information(self) -> tuple[Array, Array]:
        """Of a linear model of the sectors: (2 + k, 2 + k), and its product (2 + k,) with the best parameters.

        Positions are relative to the reference. Sets how much each sector counts for the errors of the image.
        """
        model, image = self.model, self.model.image_errors or NO_IMAGE_ERRORS
        design, own, known = np.hstack([model.position_slopes.T, self.rise_rad]), model.image_rise, image.covariance
        known = np.asarray(np.linalg.inv(known))
        d = design.shape[1]
        height = model.moments.mean_rad - self.shifts(np.r_[model.reference_m, np.zeros(d - 2)][None])[0]
        prior = np.diag(np.r_[np.full(2, UNKNOWN_M**-2), np.ones(d - 2), np.zeros(len(known))])
        prior[d:, d:] = known
        moments_left = model.moments._replace(mean_rad=height)
        every, mean = np.hstack([design, own]), np.append(np.zeros(d), image.mean)
        _, _, model.clear = solve_linear(moments_left, every, mean, prior)
        weight = model.clear / model.moments.variance_rad2
        explained = np.linalg.solve((own.T * weight) @ own + known, own.T * weight)  # by the image's own errors
        weighted = np.asarray(design.T * weight - ((design.T * weight) @ own) @ explained)
        return weighted @ design, weighted @ (height - own @ image.mean)


def sample_together(models: Sequence[FrameModel], position_m: Array, covariance_m2: Array) -> WeightedPoints:
    """Points of the posterior by exposures of one position, with one reference, from near a position (2,)."""
    first = _first_gaussian(models, position_m, covariance_m2)
    for model in models:
        model.settle(first[0])

    def log_density(points: Array) -> Array:
        value, inside = np.full(len(points), -np.inf), models[0].is_allowed(points)
        if inside.any():
            within = points[inside]
            value[inside] = np.sum([model.log_likelihood(within) for model in models], axis=0)
            value[inside] -= 0.5 * np.square(within[:, 2:]).sum(axis=1)
        return value

    return sample(log_density, [first])


def _first_gaussian(models: Sequence[FrameModel], position_m: Array, covariance_m2: Array) -> Gaussian:
    """Mean and covariance of parameters: a position as it is given, and the errors that a linear model gives for it."""
    parts = [model.information() for model in models]
    information = np.sum([part[0] for part in parts], axis=0)
    information += np.diag(np.r_[np.full(2, UNKNOWN_M**-2), np.ones(len(information) - 2)])
    covariance = np.linalg.inv(information)
    best = covariance @ np.sum([part[1] for part in parts], axis=0)
    drift = np.linalg.solve(covariance[:2, :2], covariance[:2, 2:]).T  # of the errors with the position
    alone = covariance[2:, 2:] - drift @ covariance[:2, 2:]
    wide = covariance[:2, :2] + covariance_m2
    away = position_m - models[0].model.reference_m
    mean = np.r_[position_m, best[2:] + drift @ (away - best[:2])]
    return mean, np.block([[wide, wide @ drift.T], [drift @ wide, alone + drift @ wide @ drift.T]])


def balanced_moments(found: WeightedPoints) -> Gaussian:
    """Mean (d,) and covariance (d, d) of the points, corrected by what the same points give of a known Gaussian.

    What the evidence says nothing about keeps the covariance of its prior, which weighted points have to some percent.
    """
    mean, covariance = moments(found.points, found.share)
    root = np.linalg.cholesky(covariance)
    size2 = np.square(np.linalg.solve(root, (found.points - mean).T)).sum(axis=0)
    known = WeightedPoints(found.points, -0.5 * size2 - found.log_drawn, found.log_drawn)
    shown_mean, shown = moments(found.points, known.share)
    corrected = 2.0 * covariance - shown
    if np.linalg.eigvalsh(np.linalg.solve(root, np.linalg.solve(root, corrected).T))[0] < LEAST_CORRECTED:
        return mean, covariance
    return 2.0 * mean - shown_mean, corrected
