"""The likelihood of a position and of errors that all azimuths share, near a reference position, obstacles included.

The skyline in sector s stands d_s higher than the map's at the reference: by the position, exactly; by each shared
error, to first order. Errors of the image (lens and attitude, which raise the light of the sky but not the stars) are
integrated in closed form: at each position and shared errors their normal distribution about the best values is that
of a linear model of the sectors, and the likelihood is taken at those values.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Evidence, ImageErrors, Ints
from startrack.localization.obstacle_chain import (
    MOVES,
    Levels,
    chain_log_likelihoods,
    closing_of,
    prepare_levels,
    state_probabilities,
)
from startrack.localization.sector_moments import SectorMoments, measure_moments
from startrack.localization.shared_errors import ErrorBasis, SharedErrors
from startrack.localization.skyline_profiles import HIGH_RAD, ROW_NATS, Profiles, profiles_of
from startrack.terrain import Terrain

SAMPLES = 6 * SECTORS  # of the skyline around the reference, between which rows are compared with it
TRACED_RAD = np.radians(0.7)  # rows this near the skyline are compared with its own elevation at their azimuth
LEAST_REACH_RAD = np.radians(0.1)  # of shifts, for which levels are prepared
MARGIN = 1.5  # of the shifts that are met
OF_GROUND = ("ground", "horizon_rad", "error_slopes_rad", "position_slopes", "skyline_rad", "map_sigma_rad")
NODES_ACROSS = 5  # traced horizons along each side of the neighbourhood

NO_IMAGE_ERRORS = ImageErrors(np.zeros((SECTORS, 0)), np.zeros(0), np.zeros((0, 0)), np.full(SECTORS, np.inf))


@dataclass(eq=False)
class SkylineModel:
    """Log-likelihoods of positions [m] and shared errors about a reference position (2,).

    Parameters (n, 2 + a) are a position, and coordinates of the errors in directions that the rows show.
    """

    terrain: Terrain
    rows: Evidence
    reference_m: Array
    half_m: float  # horizons are prepared for positions so far from the reference
    errors: SharedErrors
    gross: str = ""  # fact that has a gross error
    image_errors: ImageErrors | None = None
    is_rough: bool = False  # rows are compared with samples of the skyline alone
    _prepared: Levels | None = field(default=None, init=False)  # by the first points

    @cached_property
    def ground(self) -> Terrain:
        """The terrain, prepared for the neighbourhood."""
        return self.terrain.near(self.reference_m, self.half_m, MIDDLES_RAD, NODES_ACROSS).interpolated()

    @cached_property
    def horizon_rad(self) -> Array:
        """(SECTORS,) of the map at the reference."""
        return np.asarray(self.ground.horizon_rad(self.reference_m[None], MIDDLES_RAD)).ravel()

    @cached_property
    def error_slopes_rad(self) -> Array:
        """(k, SECTORS) rise of the skyline by one unit of each shared error."""
        return self.errors.slopes_rad(self.terrain, self.reference_m, MIDDLES_RAD, self.horizon_rad)

    @cached_property
    def basis(self) -> ErrorBasis:
        """Directions of the shared errors."""
        slopes, moved, reach_m = self.error_slopes_rad, self.position_slopes, self.terrain.reach_m
        return ErrorBasis.of(self.errors, self.gross, slopes, moved, self.moments, reach_m)

    @cached_property
    def slopes_rad(self) -> Array:
        """(a, SECTORS) rise of the skyline by one unit of each direction that the rows show."""
        return np.asarray(self.basis.shown.T @ self.error_slopes_rad)

    def with_gross(self, gross: str) -> SkylineModel:
        """The same neighbourhood where a fact has a gross error, whatever is stated of it."""
        errors = self.errors if gross in self.errors.facts else SharedErrors.of(self.terrain, self.rows.clock, gross)
        shared = ("above_rad", "profiles", "moments", "image_rise", "clear", "_closing", *OF_GROUND)
        same = shared if errors is self.errors else [name for name in shared if name != "error_slopes_rad"]
        other = self._sharing(replace(self, gross=gross, errors=errors), same)
        other._prepared = self._prepared
        return other

    def with_rows(self, rows: Evidence, is_rough: bool) -> SkylineModel:
        """The same neighbourhood with other `rows` and their clock; `is_rough` is the field of the class."""
        errors = replace(self.errors, clock=rows.clock)
        return self._sharing(replace(self, rows=rows, errors=errors, is_rough=is_rough), OF_GROUND)

    def _sharing(self, other: SkylineModel, names: Iterable[str]) -> SkylineModel:
        """The `other` model with what this one has computed."""
        for name in names:
            other.__dict__[name] = getattr(self, name)
        return other

    @cached_property
    def position_slopes(self) -> Array:
        """(2, SECTORS) rise of the skyline by a metre east and north."""
        step = max(0.02 * self.half_m, 1.0)
        moved = self.reference_m + step * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
        horizon = np.asarray(self.ground.horizon_rad(moved[:, None], MIDDLES_RAD))
        return np.stack([horizon[0] - horizon[1], horizon[2] - horizon[3]]) / (2 * step)

    @cached_property
    def above_rad(self) -> Array:
        """(n,) how far the rows stand above the skyline at the reference."""
        rows, around = self.rows, np.linspace(0.0, 2 * np.pi, SAMPLES + 1)
        above = rows.elevation_rad - np.interp(
            rows.azimuth_rad, around, np.append(self.skyline_rad, self.skyline_rad[0])
        )
        if not self.terrain.axisymmetric and not self.is_rough:  # crests are narrower than the samples
            near = np.flatnonzero(np.abs(above) < TRACED_RAD)
            traced = self.terrain.horizon_rad(self.reference_m[None], rows.azimuth_rad[near])
            above[near] = rows.elevation_rad[near] - np.asarray(traced).ravel()
        return above

    @cached_property
    def profiles(self) -> Profiles:
        """How well each height of the skyline explains the rows of each sector."""
        return profiles_of(self.rows, self.above_rad, self.map_sigma_rad)

    @cached_property
    def map_sigma_rad(self) -> Array:
        """(SECTORS,) error of the map's skyline, as if independent between the sectors."""
        return self.errors.map_sigma_rad(self.terrain, self.reference_m, MIDDLES_RAD)

    @cached_property
    def skyline_rad(self) -> Array:
        """(SAMPLES,) of the map at the reference, from north eastward."""
        around = np.linspace(0.0, 2 * np.pi, SAMPLES, endpoint=False)
        return np.asarray(self.terrain.horizon_rad(self.reference_m[None], around)).ravel()

    @cached_property
    def log_offset(self) -> float:
        """What makes log-likelihoods of different references and times comparable: they see other windows of rows."""
        rows = self.rows
        high = (self.above_rad >= HIGH_RAD) & (rows.extended_nats == 0.0)
        return float(self.profiles.free.sum() + np.clip(rows.llr[high], -ROW_NATS, ROW_NATS).sum())

    @property
    def later_s(self) -> float:
        """How much later than stated the time is that the rows are turned to."""
        return 0.0 if self.errors.clock is None else self.errors.clock.offset_s

    @cached_property
    def moments(self) -> SectorMoments:
        """Heights of the skyline that the rows show, sector by sector."""
        return measure_moments(self.profiles)

    def shifts(self, parameters: Array) -> Array:
        """(n, SECTORS) by how much the map's skyline at `parameters` (n, 2 + a) stands higher than at the reference."""
        points = np.ascontiguousarray(parameters[:, :2])
        horizon = np.asarray(self.ground.horizon_rad(points[:, None], MIDDLES_RAD))
        return np.asarray(horizon - self.horizon_rad + parameters[:, 2:] @ self.slopes_rad + self._expected_rise)

    @cached_property
    def _expected_rise(self) -> Array:
        """(SECTORS,) by the expected values of the shared errors."""
        return np.asarray(self.basis.mean @ self.error_slopes_rad)

    def raised_rad(self, parameters: Array) -> Array | None:
        """Rise (SECTORS,) of the skyline above the map's by the shared errors of parameters (2 + a,); None of none."""
        return np.asarray(parameters[2:] @ self.slopes_rad + self._expected_rise) if len(self.errors) else None

    def log_likelihood(self, parameters: Array) -> Array:
        """(n,) of parameters (n, 2 + a): position [m], and coordinates of the shared errors; see `basis`."""
        shifts, prior = self.with_image_errors(self.shifts(parameters))
        return self.log_likelihood_of(shifts) + prior

    def log_likelihood_of(self, shifts: Array) -> Array:
        """(n,) of shifts (n, SECTORS) of the map's skyline."""
        found = np.empty(len(shifts))
        cut, closing = self._closing
        chain_log_likelihoods(self.profiles, self._levels(shifts), MOVES, shifts, cut, closing, found)
        return found

    def shift_of(self, parameters: Array) -> Array:
        """(SECTORS,) by how much the skyline of the map at parameters (2 + a,) stands higher than at the reference."""
        return np.asarray(self.with_image_errors(self.shifts(parameters[None]))[0][0])

    def states(self, parameters: Array) -> Array:
        """Probabilities (SECTORS, STATES) of the chain's states at parameters (2 + a,); the circle is cut by them."""
        found = state_probabilities(self.profiles, self.shift_of(parameters))
        self._closing = closing_of(found)
        return found

    @cached_property
    def _closing(self) -> tuple[int, Ints]:
        return closing_of(state_probabilities(self.profiles, np.zeros(SECTORS)))

    def _levels(self, shifts: Array) -> Levels:
        """The emissions of the levels, prepared for at least these shifts (n, SECTORS)."""
        most = np.maximum(shifts.max(axis=0), -shifts.min(axis=0))
        known = self._prepared
        if known is None or (most > known.reach).any():
            reach = np.maximum(MARGIN * most, LEAST_REACH_RAD)
            known = self._prepared = Levels(reach, prepare_levels(self.profiles, reach))
        return known

    def with_image_errors(self, shifts: Array) -> tuple[Array, Array | float]:
        """The `shifts` (n, SECTORS) with the likeliest errors of the image, and the logarithm (n,) of their density."""
        if self.image_errors is None:
            return np.ascontiguousarray(shifts), 0.0
        errors = (self.moments.mean_rad - shifts - self._image_mean) @ self._image_gain.T
        prior = -0.5 * np.einsum("ni,ij,nj->n", errors, np.linalg.inv(self.image_errors.covariance), errors)
        return np.ascontiguousarray(shifts + self._image_mean + errors @ self.image_rise.T), prior

    @cached_property
    def image_rise(self) -> Array:
        """(SECTORS, j) rise of the skyline that stars and sky's light show together, by one unit of each error.

        The share of the sky's light must not vary with its noise: errors that look like a displacement would not.
        """
        if self.image_errors is None:
            return NO_IMAGE_ERRORS.raised_rad
        stars = np.flatnonzero(self.rows.extended_nats == 0.0)
        by_stars = measure_moments(profiles_of(self.rows.take(stars), self.above_rad[stars], np.zeros(SECTORS)))
        share = by_stars.variance_rad2 / (by_stars.variance_rad2 + self.image_errors.variance_rad2)
        return np.asarray(share[:, None] * self.image_errors.raised_rad)

    @property
    def _image_mean(self) -> Array:
        """(SECTORS,) rise by the expected errors of the image."""
        return np.asarray(self.image_rise @ (self.image_errors or NO_IMAGE_ERRORS).mean)

    @cached_property
    def _image_gain(self) -> Array:
        """(j, SECTORS) from heights that are left to the likeliest errors of the image."""
        weighted = (self.image_rise * self.clear[:, None] / self.moments.variance_rad2[:, None]).T
        image = self.image_errors or NO_IMAGE_ERRORS
        normal = weighted @ self.image_rise + np.linalg.inv(image.covariance)
        return np.asarray(np.linalg.solve(normal, weighted))

    def with_likely_errors(self, points_m: Array, weight: Array) -> Array:
        """Parameters (n, 2 + a) of `points_m` (n, 2) with the shared errors that suit each, by the linear model.

        `weight` (SECTORS,) is that of the sectors.
        """
        k = len(self.basis)
        if not k:
            return points_m
        weighted = self.slopes_rad * (weight / self.moments.variance_rad2)
        normal = weighted @ self.slopes_rad.T + np.eye(k)
        left = self.moments.mean_rad - self.shifts(np.hstack([points_m, np.zeros((len(points_m), k))]))
        return np.hstack([points_m, left @ np.linalg.solve(normal, weighted).T])

    @cached_property
    def clear(self) -> Array:
        """(SECTORS,) probability that the map's skyline shows, at the linear solution; see `solve_model`."""
        return np.ones(SECTORS)
