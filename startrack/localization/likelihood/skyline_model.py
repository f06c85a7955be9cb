"""The likelihood of a position and of errors that all azimuths share, near a reference position, obstacles included.

The skyline in sector s stands d_s higher than the map's at the reference: by the position, exactly; by each shared
error, to first order. Errors of the image (lens and attitude, which raise the light of the sky but not the stars) and
waves of the map's error are integrated in closed form: at each position and shared errors their normal distribution
about the best values is that of a linear model of the sectors, and the likelihood is taken at those values.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from startrack.core.types import SECTORS, Array, Evidence, ImageErrors, Ints
from startrack.localization.likelihood.linear_errors import LinearErrors
from startrack.localization.likelihood.neighbourhood import NO_IMAGE_ERRORS, Neighbourhood, SectorRows
from startrack.localization.likelihood.obstacle_chain import (
    RISEN,
    Levels,
    chain_log_likelihoods,
    closing_of,
    state_probabilities,
)
from startrack.localization.likelihood.shared_errors import OWN_EDGE, ErrorBasis, SharedErrors
from startrack.localization.likelihood.skyline_profiles import solve_linear
from startrack.terrain import Terrain

LEAST_REACH_RAD = np.radians(0.1)  # of shifts, for which levels are prepared
MARGIN = 1.5  # of the shifts that are met

Closing = tuple[int, Ints]  # sector where the circle is cut, and the states over which it is closed


class LinearSolution(NamedTuple):
    """Parameters by a linear model of the sectors."""

    parameters: Array  # (2 + a,)
    covariance: Array  # (2 + a, 2 + a)
    sector_weight: Array  # (SECTORS,) how much each sector counts


class PreparedLevels:
    """The emissions of the chain's levels, prepared anew where larger shifts are met.

    Copies of a model share them: they hold as long as the profiles and the light's own edge are the same.
    """

    _known: Levels | None = None

    def at_least(self, seen: SectorRows, shifts: Array) -> Levels:
        """Emissions of the levels for the rows `seen`, at shifts (n, SECTORS) and smaller ones."""
        most = np.maximum(shifts.max(axis=0), -shifts.min(axis=0))
        if self._known is None or (most > self._known.reach).any():
            reach = np.maximum(MARGIN * most, LEAST_REACH_RAD)
            self._known = seen.prepare_levels(reach)
        return self._known


@dataclass(frozen=True, eq=False)
class SkylineModel:
    """Log-likelihoods of positions [m] and shared errors about a reference position.

    Parameters (n, 2 + a) are a position, and coordinates of the errors in directions that the rows show.
    """

    seen: SectorRows
    errors: SharedErrors
    error_slopes_rad: Array  # (k, SECTORS) rise of the skyline by one unit of each shared error
    gross: str = ""  # fact that has a gross error, or OWN_EDGE; "": neither
    stated_basis: ErrorBasis | None = None  # None: of the directions that the rows show
    sector_weight: Array = field(default_factory=lambda: np.ones(SECTORS))  # (SECTORS,) for the linear errors
    closing: Closing | None = None  # None: as at the reference
    levels: PreparedLevels = field(default_factory=PreparedLevels)

    @classmethod
    def of(
        cls,
        terrain: Terrain,
        rows: Evidence,
        reference_m: Array,
        half_m: float,
        errors: SharedErrors,
        image_errors: ImageErrors | None = None,
        basis: ErrorBasis | None = None,
    ) -> SkylineModel:
        """Model of `rows` on a `terrain`, for positions within `half_m` [m] of `reference_m` (2,).

        The `errors` are shared, the `image_errors` those of the rows of extended light. `basis`: directions of the
        shared errors; None: those that the rows show.
        """
        around = Neighbourhood(terrain, reference_m, half_m)
        seen = SectorRows(around, rows, image_errors or NO_IMAGE_ERRORS)
        return cls(seen, errors, around.error_slopes_rad(errors), stated_basis=basis)

    @property
    def around(self) -> Neighbourhood:
        """The neighbourhood of the reference."""
        return self.seen.around

    @property
    def terrain(self) -> Terrain:
        """The whole terrain."""
        return self.seen.around.terrain

    @cached_property
    def basis(self) -> ErrorBasis:
        """Directions of the shared errors."""
        if self.stated_basis is not None:
            return self.stated_basis
        return ErrorBasis.of(
            self.errors, self.gross, self.error_slopes_rad, self.around.slopes, self.seen.moments, self.terrain.reach_m
        )

    @cached_property
    def slopes_rad(self) -> Array:
        """Rise (a, SECTORS) [rad] of the skyline by one unit of each direction that the rows show."""
        return np.asarray(self.basis.shown.T @ self.error_slopes_rad)

    def with_gross(self, gross: str) -> SkylineModel:
        """Copy of this model where a fact has a gross error, whatever is stated of it."""
        if gross in self.errors.facts:
            return replace(self, gross=gross)
        errors = SharedErrors.of(self.terrain, self.seen.rows.clock, gross)
        return replace(self, gross=gross, errors=errors, error_slopes_rad=self.around.error_slopes_rad(errors))

    def with_rows(self, rows: Evidence) -> SkylineModel:
        """Model of the same neighbourhood with other `rows` and their clock, whose light ends at the skyline."""
        seen, gross = replace(self.seen, rows=rows, edge=None), "" if self.gross == OWN_EDGE else self.gross
        errors = replace(self.errors, clock=rows.clock)
        return SkylineModel(seen, errors, self.error_slopes_rad, gross, self.stated_basis)

    def with_closing(self, states: Array) -> SkylineModel:
        """Copy with the circle cut where the chain is surest of its state by `states` (SECTORS, STATES)."""
        return replace(self, closing=closing_of(states))

    def shifts(self, parameters: Array) -> Array:
        """Rise (n, SECTORS) [rad] of the map's skyline from the reference to `parameters` (n, 2 + a)."""
        moved = self.around.horizons_rad(parameters[:, :2]) - self.around.horizon_rad
        return np.asarray(moved + parameters[:, 2:] @ self.slopes_rad + self._expected_rise)

    @cached_property
    def _expected_rise(self) -> Array:
        """Rise (SECTORS,) [rad] by the expected values of the shared errors, and by errors of posts."""
        return np.asarray(self.basis.mean @ self.error_slopes_rad + self.around.expected_rise_rad)

    def rise_rad(self, parameters: Array) -> Array | None:
        """Rise (SECTORS,) [rad] of the skyline above the map's by errors of the ground at parameters (2 + a,), or None.

        None where there are no errors. On real ground without that of the clock: the sky is turned to the time that it
        shows.
        """
        if not len(self.errors) and not self.errors.waves:
            return None
        values = self.basis.mean + self.basis.shown @ parameters[2:]
        if self.errors.clock is not None and not self.terrain.axisymmetric:
            values[-1] = 0.0
        left_rad = self.seen.moments.mean_rad - self.shifts(parameters[None])[0]
        by_waves = self.linear.waves_rad(left_rad)
        return np.asarray(values @ self.error_slopes_rad + by_waves + self.around.expected_rise_rad)

    def log_likelihood(self, parameters: Array) -> Array:
        """Log-likelihoods (n,) of parameters (n, 2 + a): position [m], and coordinates of the errors in `basis`.

        Errors of the image and waves are integrated.
        """
        shifts, lifts, log_integral = self.with_linear_errors(self.shifts(parameters))
        return self.log_likelihood_of(shifts, lifts) + log_integral

    def log_likelihood_of(self, shifts: Array, lifts: Array | None = None) -> Array:
        """Log-likelihoods (n,) of shifts (n, SECTORS) [rad] of the map's skyline.

        `lifts` (n, SECTORS) [rad] are those of the light above the skyline, beyond what is expected; None: 0. The
        states of obstacles are wider than they are: these have the light as it is expected.
        """
        seen, found = self.seen, np.empty(len(shifts))
        cut, closing = self._closing
        levels = self.levels.at_least(seen, shifts)
        gains = seen.gains(shifts, lifts)
        chain_log_likelihoods(seen.profiles, levels, seen.moves, shifts, cut, closing, found, gains)
        return found

    @cached_property
    def _closing(self) -> Closing:
        """Sector where the circle is cut, and the states over which it is closed: as at the reference, if not given."""
        if self.closing is not None:
            return self.closing
        return closing_of(self.states_at(np.zeros(SECTORS)))

    def shift_of(self, parameters: Array) -> tuple[Array, Array | None]:
        """Rise (SECTORS,) [rad] of the map's skyline from the reference to parameters (2 + a,), with linear errors.

        And the lift (SECTORS,) [rad] of the light by those of the image; None: 0.
        """
        shifts, lifts, _ = self.with_linear_errors(self.shifts(parameters[None]))
        return np.asarray(shifts[0]), None if lifts is None else np.asarray(lifts[0])

    def states(self, parameters: Array) -> Array:
        """Probabilities (SECTORS, STATES) of the chain's states at parameters (2 + a,)."""
        return self.states_at(*self.shift_of(parameters))

    def lit(self, states: Array) -> Array:
        """Probabilities (SECTORS,) that the light has an edge of its own, by those of the `states`."""
        return states[:, RISEN + 1 :].sum(axis=1) if self.seen.edge is not None else np.zeros(SECTORS)

    def states_at(self, shift: Array, lift_rad: Array | None = None) -> Array:
        """Probabilities (SECTORS, STATES) of the chain's states at a `shift` (SECTORS,) of the map's skyline.

        `lift_rad` (SECTORS,) is that of the light beyond what is expected; None: 0.
        """
        return state_probabilities(self.seen.emissions(shift, lift_rad), self.seen.moves)

    @cached_property
    def linear(self) -> LinearErrors:
        """The errors that are integrated in closed form."""
        return LinearErrors.of(self.seen, self.errors, self.gross, self.sector_weight)

    def with_linear_errors(self, shifts: Array, lifts: Array | None = None) -> tuple[Array, Array | None, Array]:
        """The `shifts` and lifts of the light (n, SECTORS) [rad] with the likeliest linear errors; a logarithm (n,).

        The logarithm is that of the integral of the likelihood over these errors, in the likelihood there. `lifts`,
        here and of those found: None where there are none.
        """
        linear = self.linear
        if not len(linear):
            return np.ascontiguousarray(shifts), lifts, np.zeros(len(shifts))
        rise_rad, lifts, integral = linear.fit(self.seen.moments.mean_rad - shifts, lifts)
        return np.ascontiguousarray(shifts + rise_rad), lifts, integral

    def solve_linear(self) -> LinearSolution:
        """The parameters by the linear model of the sectors."""
        linear, k = self.linear, 2 + len(self.basis)
        design = np.vstack([self.around.slopes, self.slopes_rad, linear.rise_rad.T]).T
        prior = np.zeros((design.shape[1], design.shape[1]))
        prior[:k, :k] = np.diag(np.r_[np.full(2, self.terrain.reach_m**-2.0), np.ones(k - 2)])
        prior[k:, k:] = np.linalg.inv(linear.wide_covariance)
        moments = self.seen.moments
        left = moments._replace(mean_rad=moments.mean_rad - self._expected_rise)
        parameters, covariance, weight = solve_linear(left, design, np.r_[np.zeros(k), linear.mean], prior)
        at = np.r_[parameters[:2] + self.around.reference_m, parameters[2:k]]
        return LinearSolution(at, covariance[:k, :k], weight)

    def with_likely_errors(self, points_m: Array, weight: Array) -> Array:
        """Parameters (n, 2 + a) of `points_m` (n, 2) with the shared errors that suit each, by the linear model.

        `weight` (SECTORS,) is that of the sectors.
        """
        k, moments = len(self.basis), self.seen.moments
        if not k:
            return points_m
        weighted = self.slopes_rad * (weight / moments.variance_rad2)
        normal = weighted @ self.slopes_rad.T + np.eye(k)
        left = moments.mean_rad - self.shifts(np.hstack([points_m, np.zeros((len(points_m), k))]))
        return np.hstack([points_m, left @ np.linalg.solve(normal, weighted).T])
