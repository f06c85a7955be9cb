"""The skyline of a map about a reference position, and how rows stand above it, sector by sector."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from startrack.core.statistics import interpolate_circle
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Bools, Evidence, ImageErrors, sector_of
from startrack.localization.likelihood.obstacle_chain import (
    LIT_MOVES,
    MOVES,
    RISEN,
    Levels,
    Moves,
    clear_emissions,
    emissions,
    gains_of_light,
    prepare_levels,
)
from startrack.localization.likelihood.shared_errors import SharedErrors
from startrack.localization.likelihood.skyline_profiles import Profiles, SectorMoments, measure_moments, profiles_of
from startrack.terrain import NO_POST, ExpectedCrests, Terrain, require_horizons

SAMPLES = 6 * SECTORS  # of the skyline around the reference, between which rows are compared with it
TRACED_RAD = np.radians(0.7)  # rows this near the skyline are compared with its own elevation at their azimuth
NODES_ACROSS = 5  # traced horizons along each side of the neighbourhood
ROUGH_RAD = np.radians(0.002)  # of ground that nobody states as exact: 0.35 m of a rim 10 km away

NO_IMAGE_ERRORS = ImageErrors(np.zeros((SECTORS, 0)), np.zeros(0), np.zeros((0, 0)), np.full(SECTORS, np.inf))


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """A terrain about a reference position (2,)."""

    terrain: Terrain
    reference_m: Array
    half_m: float  # horizons are prepared for positions so far from the reference; 0: each is traced

    @cached_property
    def ground(self) -> Terrain:
        """Terrain that is prepared for the neighbourhood."""
        if self.half_m == 0.0:
            return self.terrain
        return self.terrain.near(self.reference_m, self.half_m, MIDDLES_RAD, NODES_ACROSS)

    @cached_property
    def horizon_rad(self) -> Array:
        """Horizon (SECTORS,) [rad] of the map at the reference."""
        return self.horizons_rad(self.reference_m[None])[0]

    def horizons_rad(self, points_m: Array) -> Array:
        """Horizons (n, SECTORS) [rad] of the map at points (n, 2)."""
        return np.asarray(self.ground.horizon_rad(np.ascontiguousarray(points_m)[:, None], MIDDLES_RAD))

    @cached_property
    def slopes(self) -> Array:
        """Rise (2, SECTORS) [rad/m] of the skyline by a metre east and north."""
        step = max(0.02 * self.half_m, 1.0)
        horizon = self.horizons_rad(self.reference_m + step * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]]))
        return np.stack([horizon[0] - horizon[1], horizon[2] - horizon[3]]) / (2 * step)

    def error_slopes_rad(self, errors: SharedErrors) -> Array:
        """Rise (k, SECTORS) [rad] of the skyline by one unit of each of the shared `errors`."""
        return errors.slopes_rad(self.terrain, self.reference_m, MIDDLES_RAD, self.horizon_rad, self._shape_slopes_rad)

    def wave_slopes_rad(self, errors: SharedErrors) -> Array:
        """Rise (w, SECTORS) [rad] of the skyline by one unit of each of the waves among the shared `errors`."""
        return np.array([self._shape_slopes_rad[one.name] for one in errors.waves]).reshape(-1, SECTORS)

    @cached_property
    def _shape_slopes_rad(self) -> dict[str, Array]:
        """Rise (SECTORS,) [rad] of the skyline by one unit of each error of the terrain's shape, by name."""
        slopes = np.reshape(self.terrain.errors.slopes_rad(self.reference_m, MIDDLES_RAD), (-1, SECTORS))
        return {one.name: slope for one, slope in zip(self.terrain.errors.shape, slopes, strict=True)}

    @cached_property
    def skyline_rad(self) -> Array:
        """Skyline (SAMPLES,) [rad] of the map at the reference, from north eastward."""
        around = np.linspace(0.0, 2 * np.pi, SAMPLES, endpoint=False)
        horizon = np.asarray(self.terrain.horizon_rad(self.reference_m[None], around)).ravel()
        require_horizons(self.terrain, self.reference_m[None], horizon)
        return horizon

    @cached_property
    def crests(self) -> ExpectedCrests | None:
        """Skyline at the reference with all errors of posts; None of a ground without them."""
        return self.terrain.errors.expected_crests(self.reference_m, MIDDLES_RAD)

    @cached_property
    def expected_rise_rad(self) -> Array:
        """Mean rise (SECTORS,) [rad] of the map's skyline by errors of posts: the highest place is seen."""
        return np.zeros(SECTORS) if self.crests is None else self.crests.rise_rad

    @cached_property
    def map_sigma_rad(self) -> Array:
        """Sigma (SECTORS,) [rad] of the map's skyline, as if independent between the sectors.

        Posts that make the skyline at several azimuths err there together: see `independent_sigma`. What follows no
        post is common to neighbours as the square of their correlation by posts; where the skyline follows none at all
        it is that azimuth's alone. Ground of which facts are not stated is rough by ROUGH_RAD besides.
        """
        rough = 0.0 if all(one.is_stated for one in self.terrain.errors.shape) else ROUGH_RAD
        if self.crests is None:
            by_posts = np.asarray(self.terrain.errors.sigma_rad(self.reference_m[None], MIDDLES_RAD)).ravel()
            return np.hypot(by_posts, rough)
        of_posts, own = self._covariance_by_posts(self.crests), self.crests.own_sigma_rad
        likeness = correlation_of(of_posts)
        np.fill_diagonal(likeness, 1.0)
        return np.hypot(independent_sigma(of_posts + np.outer(own, own) * np.square(likeness)), rough)

    @cached_property
    def post_sigma_rad(self) -> Array | None:
        """Part (SECTORS,) [rad] of `map_sigma_rad` that follows the posts; None of a ground without their errors."""
        return None if self.crests is None else independent_sigma(self._covariance_by_posts(self.crests))

    def _covariance_by_posts(self, crests: ExpectedCrests) -> Array:
        """Covariance (SECTORS, SECTORS) [rad^2] of the skyline's elevations, as far as they follow the posts."""
        used = crests.post != NO_POST
        numbers, of = np.unique(crests.post[used], return_inverse=True)
        response = np.zeros((SECTORS, len(numbers)))
        np.add.at(response, (np.nonzero(used)[0], of), crests.rad_per_m[used])
        return np.asarray(self.terrain.errors.height_sigma_m**2 * response @ response.T)


def correlation_of(covariance: Array) -> Array:
    """Correlations (n, n) of errors with a `covariance` (n, n); 0 of those without variance."""
    sigma = np.sqrt(np.diag(covariance))
    scale = np.divide(1.0, sigma, out=np.zeros(len(sigma)), where=sigma > 0.0)
    return np.asarray(covariance * np.outer(scale, scale))


def independent_sigma(covariance: Array) -> Array:
    """Standard deviations (n,) of independent errors that tell as much as errors with a `covariance` (n, n).

    Each variance counts as often as errors are alike: by the sum of its correlations. That is right for what changes
    little between errors that are alike, as a position does. A sum of covariances would give the crest of a far
    mountain the errors of near ground that may hide it.
    """
    alike = np.maximum(correlation_of(covariance).sum(axis=1), 1.0)
    return np.asarray(np.sqrt(np.diag(covariance) * alike))


class OwnEdge(NamedTuple):
    """Likelihoods where the sky's light has an edge of its own, and the stars alone show the skyline."""

    plain: SectorRows  # the same rows about the same reference, where the light ends at the skyline
    light: Array  # (SECTORS,) likelihood of the light, in which the two profiles' offsets are made up for
    lit: Array  # (SECTORS,) rough probability of it, by which the linear model leaves the light out
    offset: Array = np.zeros(SECTORS)  # (SECTORS,) nats, by which all likelihoods of a sector are less: none overflows


@dataclass(frozen=True, eq=False)
class SectorRows:
    """The rows of an image about the skyline of a neighbourhood.

    Errors of the image lift the light of the sky above the skyline, and not the stars. Heights of the light are those
    without the lift that is expected.
    """

    around: Neighbourhood
    rows: Evidence
    image_errors: ImageErrors = NO_IMAGE_ERRORS
    edge: OwnEdge | None = None  # None: the light ends at the skyline

    @cached_property
    def above_rad(self) -> Array:
        """Heights (n,) [rad] of the rows above the skyline at the reference."""
        rows, terrain = self.rows, self.around.terrain
        above = rows.elevation_rad - interpolate_circle(self.around.skyline_rad, rows.azimuth_rad)
        if not terrain.axisymmetric:  # crests are narrower than the samples
            near = np.flatnonzero(np.abs(above) < TRACED_RAD)
            traced = terrain.horizon_rad(self.around.reference_m[None], rows.azimuth_rad[near])
            above[near] = rows.elevation_rad[near] - np.asarray(traced).ravel()
        lift_rad = self.image_errors.slopes_rad @ self.image_errors.reference
        return np.where(self.is_light, above - lift_rad[sector_of(rows.azimuth_rad)], above)

    @cached_property
    def is_light(self) -> Bools:
        """Whether each row (n,) is of the light of the sky, not of a star."""
        return np.asarray(self.rows.extended_nats > 0.0)

    @cached_property
    def profiles(self) -> Profiles:
        """Log-likelihoods of the rows of each sector by the height of the skyline."""
        if self.edge is not None:
            return self.edge.plain.profiles.scaled(self.edge.offset)
        return profiles_of(self.rows, self.above_rad, self.around.map_sigma_rad)

    @cached_property
    def light(self) -> SectorRows:
        """The rows of the light of the sky alone."""
        return self._take(self.is_light) if self.edge is None else self.edge.plain.light

    @cached_property
    def stars(self) -> SectorRows:
        """The rows of the stars alone."""
        return self._take(~self.is_light) if self.edge is None else self.edge.plain.stars

    def _take(self, chosen: Bools) -> SectorRows:
        """The `chosen` rows alone."""
        return self if chosen.all() else replace(self, rows=self.rows.take(np.flatnonzero(chosen)))

    def gains(self, shifts: Array, lifts: Array | None) -> Array | None:
        """What log-likelihoods of the map's skyline at `shifts` gain (n, SECTORS) by `lifts` of the light; None: 0."""
        return None if lifts is None else gains_of_light(self.light.profiles, shifts, lifts)

    @cached_property
    def moments(self) -> SectorMoments:
        """Heights of the skyline that the rows show, by the stars alone where the light has an edge of its own."""
        together = measure_moments(self.profiles)
        if self.edge is None:
            return together
        return together.mix(self.stars.moments, self.edge.lit)

    @cached_property
    def log_offset(self) -> float:
        """Term that makes log-likelihoods of other references and times comparable: they see other windows of rows."""
        return float(self.profiles.offset.sum())

    @property
    def moves(self) -> Moves:
        """Probabilities of the chain's states from sector to sector."""
        return MOVES if self.edge is None else LIT_MOVES

    def emissions(self, shift: Array, lift_rad: Array | None = None) -> Array:
        """Likelihoods (SECTORS, STATES) of the chain's states at shifts (SECTORS,) [rad] of the map's skyline.

        `lift_rad` (SECTORS,) is that of the light beyond what is expected; None: 0.
        """
        gains = self.gains(shift[None], None if lift_rad is None else lift_rad[None])
        found = emissions(self.profiles, shift, np.zeros(SECTORS) if gains is None else gains[0])
        if self.edge is not None:
            at_skyline = clear_emissions(self.stars.profiles, shift[None])[0] * self.edge.light
            found[:, RISEN + 1 :] = at_skyline[:, None]
        return found

    def prepare_levels(self, reach: Array) -> Levels:
        """The emissions of all states but the first at shifts up to `reach` (SECTORS,)."""
        seen, light = (self, np.zeros(0)) if self.edge is None else (self.stars, self.edge.light)
        return Levels(reach, prepare_levels(self.profiles, reach), seen.profiles, light)

    @cached_property
    def image_rise(self) -> Array:
        """Rise (SECTORS, j) [rad] of the skyline by stars and sky's light together, by one unit of each image error."""
        if not len(self.image_errors.mean):
            return NO_IMAGE_ERRORS.slopes_rad
        used = self._share_of_light if self.edge is None else self.edge.plain._share_of_light * (1.0 - self.edge.lit)
        return np.asarray(used[:, None] * self.image_errors.slopes_rad)

    @cached_property
    def _share_of_light(self) -> Array:
        """Share (SECTORS,) of the sky's light in what stars and light show together.

        It must not vary with the noise of the light: errors that look like a displacement would not.
        """
        stars = self.stars
        by_stars = measure_moments(profiles_of(stars.rows, stars.above_rad, np.zeros(SECTORS)))
        return np.asarray(by_stars.variance_rad2 / (by_stars.variance_rad2 + self.image_errors.variance_rad2))
