"""A skyline that was measured directly, as rows of evidence: heights with sigmas, and an attitude that they share.

Errors of heights are correlated along the azimuth, as exp(-distance / correlation): a hand draws smoothly. The sectors
of the model are independent, so each counts with the variance that its covariances with all sectors sum up to. That is
right for errors that go far around the compass, as those of a position, a tilt, or a heading; what alternates from
sector to sector is known better than stated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from startrack.core.types import (
    MIDDLES_RAD,
    SECTORS,
    Array,
    Bools,
    Clock,
    Evidence,
    ImageErrors,
    Ints,
    PositionPrior,
    Rows,
    array,
    sector_of,
)
from startrack.frames import R_from_rotvec, turn_azel
from startrack.localization.neighbourhood import Neighbourhood
from startrack.localization.skyline_profiles import SectorMoments, solve_linear
from startrack.terrain import Terrain

COLUMN_SIGMAS = 2.0  # width of the edge of a column of rows, and their distance: normal up to 3 sigma, linear beyond
COLUMN = np.arange(-6, 7)  # rows of a sector: a skyline farther off than 12 of their distances counts the same
SLOPE_STEP_RAD = np.radians(0.1)  # of azimuth, to either side: the skyline's slope at a point
POSITION_STEP_M = 2.0  # at which the skyline's change with the position is taken
SEARCHED = 4  # points of a sector, that a search takes
LEAST_HEIGHT_SIGMA_RAD = 1e-6  # of a sector: 0.2 arcsec
TURN, TILT = 0, slice(1, 3)  # parts of an attitude


@dataclass(frozen=True, kw_only=True)
class SkylinePoints(Rows):
    """Apparent heights of a skyline at azimuths in enu, by an attitude that errs.

    The true directions are those stated, turned by a tilt about a level axis and then by a heading about the vertical.
    """

    azimuth_rad: Array = array("n")
    elevation_rad: Array = array("n")
    sigma_rad: Array = array("n")
    correlation_rad: float  # of the errors of heights, an angle of azimuth; 0: they are independent
    heading_sigma_rad: float = 0.0
    tilt_sigma_rad: float = 0.0  # about each of two level axes
    near: PositionPrior | None = None

    @property
    def attitude_sigma_rad(self) -> Array:
        """Standard deviations (3,) [rad] of heading and of the tilts about east and north."""
        return np.array([self.heading_sigma_rad, self.tilt_sigma_rad, self.tilt_sigma_rad])

    def turned(self, attitude_rad: Array) -> SkylinePoints:
        """Copy turned by a heading (azimuths grow) and tilts about east and north, `attitude_rad` (3,)."""
        heading, east, north = attitude_rad
        R = R_from_rotvec([0.0, 0.0, -heading]) @ R_from_rotvec([east, north, 0.0])
        azimuth, elevation = turn_azel(self.azimuth_rad, self.elevation_rad, R)
        return replace(self, azimuth_rad=azimuth, elevation_rad=elevation)

    def thinned(self) -> SkylinePoints:
        """Copy with every so manieth point, so that a sector holds some SEARCHED at most: enough for a search."""
        order = np.argsort(self.azimuth_rad, kind="stable")
        most = int(np.bincount(self.sector, minlength=SECTORS).max(initial=0))
        return self.take(np.sort(order[:: max(most // SEARCHED, 1)]))

    @cached_property
    def sector(self) -> Ints:
        """Sector of azimuth (n,) of each point."""
        return sector_of(self.azimuth_rad)

    def mean(self, values: Array) -> Array:
        """Means (SECTORS,) of `values` (n,), weighted as the sigmas; 0 where no point is."""
        weight = self.sigma_rad**-2.0
        sums, total = (np.bincount(self.sector, one, SECTORS) for one in (weight * values, weight))
        return np.asarray(sums / np.where(total > 0.0, total, 1.0))

    @cached_property
    def variance_rad2(self) -> Array:
        """Variances (SECTORS,) of the means, with covariances with all other sectors; infinite where no point is."""
        weight = self.sigma_rad**-2.0
        share = weight / np.bincount(self.sector, weight, SECTORS)[self.sector] * self.sigma_rad
        found = np.full(SECTORS, np.inf)
        for s in np.unique(self.sector):
            own = np.flatnonzero(self.sector == s)
            apart = np.abs(self.azimuth_rad[own, None] - self.azimuth_rad)
            apart = np.minimum(apart, 2 * np.pi - apart)
            like = apart == 0.0 if self.correlation_rad == 0.0 else np.exp(-apart / self.correlation_rad)
            found[s] = max(float(share[own] @ like @ share), LEAST_HEIGHT_SIGMA_RAD**2)
        return found


@dataclass(frozen=True, eq=False)
class SeenSkyline:
    """Points of a skyline, turned by an attitude (3,), beside the map's skyline seen from a position (2,)."""

    stated: SkylinePoints
    terrain: Terrain
    position_m: Array
    attitude_rad: Array
    map_sigma_rad: Array  # (SECTORS,) error of the map thereabouts

    @classmethod
    def at(cls, stated: SkylinePoints, terrain: Terrain, position_m: Array, attitude_rad: Array) -> SeenSkyline:
        """Seen skyline with the errors of the map as seen from the position."""
        return cls(stated, terrain, position_m, attitude_rad, Neighbourhood(terrain, position_m, 0.0).map_sigma_rad)

    @cached_property
    def points(self) -> SkylinePoints:
        """Points that the terrain decides about, turned."""
        turned = self.stated.turned(self.attitude_rad)
        return turned.take(np.asarray(self.terrain.is_informative(turned.azimuth_rad, turned.elevation_rad)))

    def _map_rad(self, east_m: float = 0.0, north_m: float = 0.0, later_rad: float = 0.0) -> Array:
        """Horizon (n,) [rad] beside the points, from so far off the position and at azimuths greater by so much."""
        azimuth = np.mod(self.points.azimuth_rad + later_rad, 2 * np.pi)
        return np.asarray(self.terrain.horizon_rad(self.position_m[None] + [east_m, north_m], azimuth)).ravel()

    @cached_property
    def above_rad(self) -> Array:
        """Mean height (SECTORS,) [rad] of the points above the map; 0 where no point is."""
        return self.points.mean(self.points.elevation_rad - self._map_rad())

    @cached_property
    def elevation_rad(self) -> Array:
        """Elevation (SECTORS,) [rad] of the skyline in the middle of the sectors; the map's where no point is."""
        return np.asarray(np.ravel(self.terrain.horizon_rad(self.position_m[None], MIDDLES_RAD)) + self.above_rad)

    @cached_property
    def used(self) -> Bools:
        """Whether sectors (SECTORS,) have points."""
        return np.bincount(self.points.sector, minlength=SECTORS) > 0

    @cached_property
    def variance_rad2(self) -> Array:
        """Variances (SECTORS,) of `above_rad`, the errors of the map included; infinite where no point is."""
        return np.asarray(self.points.variance_rad2 + np.square(self.map_sigma_rad))

    @cached_property
    def position_slopes(self) -> Array:
        """Rise (2, SECTORS) [rad/m] of the map by a metre east and north, in the mean over the points."""
        step = POSITION_STEP_M
        east, north = self._map_rad(step) - self._map_rad(-step), self._map_rad(0, step) - self._map_rad(0, -step)
        return np.stack([self.points.mean(one) for one in (east, north)]) / (2 * step)

    @cached_property
    def attitude_slopes(self) -> Array:
        """Rise (3, SECTORS) [rad/rad] of the points above the map with what the attitude lacks."""
        points, step = self.points, SLOPE_STEP_RAD
        slope = (self._map_rad(later_rad=step) - self._map_rad(later_rad=-step)) / (2 * step)
        c, s, tan = np.cos(points.azimuth_rad), np.sin(points.azimuth_rad), np.tan(points.elevation_rad)
        raised = slope, slope * tan * s - c, slope * tan * c + s
        return np.stack([points.mean(one) for one in raised])

    @cached_property
    def lacking_rad(self) -> Array:
        """Expected values (3,) [rad] of what the attitude lacks, tilts about the true east and north."""
        heading = self.attitude_rad[TURN]
        c, s = np.cos(heading), np.sin(heading)
        return -np.r_[heading, np.array([[c, s], [-s, c]]) @ self.attitude_rad[TILT]]

    def solve(self, reach_m: float | None = None) -> tuple[Array, Array, Array]:
        """Position (2,) [m] and attitude (3,) [rad] of a linear solution, and their covariance (5, 5).

        `reach_m` is the sigma of the position about this one before (None: of the search area).
        """
        precision = np.maximum(self.stated.attitude_sigma_rad, LEAST_HEIGHT_SIGMA_RAD) ** -2.0
        prior = np.diag(np.r_[np.full(2, (reach_m or self.terrain.reach_m) ** -2.0), precision])
        moments = SectorMoments(self.above_rad, self.variance_rad2)
        design = np.vstack([self.position_slopes, self.attitude_slopes]).T
        step, covariance, _ = solve_linear(moments, design, np.r_[0.0, 0.0, self.lacking_rad], prior)
        lack, heading = step[2:], self.attitude_rad[TURN]
        c, s = np.cos(heading), np.sin(heading)
        tilt = np.array([[c, -s], [s, c]]) @ lack[TILT]
        return self.position_m + step[:2], self.attitude_rad + np.r_[lack[TURN], tilt], covariance

    @property
    def image_errors(self) -> ImageErrors:
        """Errors of the attitude, as far as it errs; in a round crater without the heading, see `clock`."""
        errs = self.stated.attitude_sigma_rad > 0.0
        errs[TURN] &= not self.terrain.axisymmetric
        return ImageErrors(
            slopes_rad=self.attitude_slopes[errs].T, mean=self.lacking_rad[errs],
            covariance=np.diag(np.square(self.stated.attitude_sigma_rad[errs])),
            variance_rad2=np.where(self.used, 0.0, np.inf), reference=np.zeros(np.count_nonzero(errs)),
        )  # fmt: skip

    @property
    def clock(self) -> Clock | None:
        """Heading of ground that is the same after a turn, as a clock of one radian a second; None elsewhere."""
        sigma = self.stated.heading_sigma_rad
        if not self.terrain.axisymmetric or sigma == 0.0:
            return None
        return Clock(turn_rad_s=np.array([0.0, 0.0, -1.0]), sigma_s=sigma)

    def rows(self) -> Evidence:
        """Rows of extended light, as a column of pixels would show each sector's height at its middle.

        Pixels of an edge of width w, which stand d apart and have the noise that makes its height right to sigma, have
        (light / noise)^2 = 2 sqrt(pi) w d / sigma^2; without noise each shows the part of the light above the edge.
        """
        from scipy.special import ndtr

        at = np.repeat(np.flatnonzero(self.used), len(COLUMN))
        off = np.tile(COLUMN_SIGMAS * COLUMN, int(self.used.sum()))  # in sigmas
        sigma, nats = np.sqrt(self.points.variance_rad2[at]), 2.0 * np.sqrt(np.pi) * COLUMN_SIGMAS**2
        return Evidence(
            azimuth_rad=MIDDLES_RAD[at], elevation_rad=self.elevation_rad[at] + off * sigma,
            llr=nats * (ndtr(off / COLUMN_SIGMAS) - 0.5), edge_sigma_rad=COLUMN_SIGMAS * sigma,
            extended_nats=nats, image_errors=self.image_errors, clock=self.clock,
            near=self.stated.near,
        )  # fmt: skip
