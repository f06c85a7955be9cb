"""The likelihood of one image in the parameters of a track, and how it changes with the map's skyline."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from startrack.applications.tracking.shared import TrackErrors
from startrack.core.types import Array, Evidence
from startrack.localization.error_basis import ErrorBasis
from startrack.localization.integrity import clear_logs
from startrack.localization.sector_moments import solve_linear
from startrack.localization.skyline_model import MIDDLES_RAD, SECTORS, SkylineModel
from startrack.terrain import Terrain

STEP_SIGMAS, LEAST_STEP_RAD = 0.5, 1e-7  # of the skyline's spread, to each side: where the change with it is taken
UNKNOWN_M = 1e6  # standard deviation of a position about which nothing is known


@dataclass(eq=False)
class FrameModel:
    """Log-likelihoods of parameters (n, 2 + k): a position [m], and the shared errors in their standard deviations."""

    model: SkylineModel
    errors: TrackErrors

    @classmethod
    def near(cls, evidence: Evidence, terrain: Terrain, errors: TrackErrors, reference_m: Array, half_m: float) -> Self:
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

    @cached_property
    def map_sigma_rad(self) -> Array:
        """(SECTORS,) standard deviation of the skyline by heights of posts, as the likelihood counts it."""
        return self.errors.listed.map_sigma_rad(self.model.terrain, self.model.reference_m, MIDDLES_RAD)

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
        step = np.maximum(STEP_SIGMAS * np.hypot(spread, self.map_sigma_rad), LEAST_STEP_RAD)
        all_clear = np.ones(SECTORS)
        higher, lower = (clear_logs(self.model.profiles, shifts + sign * step, all_clear) for sign in (1.0, -1.0))
        return np.asarray(self.clear * (higher - lower) / (2 * step))

    def information(self) -> tuple[Array, Array]:
        """Of a linear model of the sectors: (2 + k, 2 + k), and its product (2 + k,) with the best parameters.

        Positions are relative to the reference. Sets how much each sector counts for the errors of the image.
        """
        model, image = self.model, self.model.image_errors
        design = np.hstack([model.position_slopes.T, self.rise_rad])
        origin = np.r_[model.reference_m, np.zeros(design.shape[1] - 2)]
        height = model.moments.mean_rad - self.shifts(origin[None])[0]
        own: Array = np.zeros((SECTORS, 0))
        mean: Array = np.zeros(0)
        known: Array = np.zeros((0, 0))
        if image is not None:
            own, mean, known = model.image_rise, image.mean, np.asarray(np.linalg.inv(image.covariance))
        d = design.shape[1]
        prior = np.diag(np.r_[np.full(2, UNKNOWN_M**-2), np.ones(d - 2), np.zeros(len(known))])
        prior[d:, d:] = known
        moments = model.moments._replace(mean_rad=height)
        _, _, model.clear = solve_linear(moments, np.hstack([design, own]), np.append(np.zeros(d), mean), prior)
        weight = model.clear / model.moments.variance_rad2
        explained = np.linalg.solve((own.T * weight) @ own + known, own.T * weight)  # by the image's own errors
        weighted = np.asarray(design.T * weight - ((design.T * weight) @ own) @ explained)
        return weighted @ design, weighted @ (height - own @ mean)
