"""A skyline that was measured directly, as rows of evidence: heights with sigmas, and an attitude that they share.

Where heading and tilt err, boxes of positions are ranked with each heading by how well the horizon in them suits the
points, the likeliest tilt taken out. From the best ones linear solutions lead to the likely positions and attitudes.
About each of these the points are rows of evidence, and what the attitude still lacks is one of the errors that all
azimuths share.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from startrack.core.limits import check_time
from startrack.core.types import (
    MIDDLES_RAD,
    SECTORS,
    Array,
    Bools,
    Clock,
    Evidence,
    Fix,
    ImageErrors,
    Ints,
    NotLocated,
    PositionPrior,
    Rows,
    array,
    sector_of,
)
from startrack.frames import R_from_rotvec, turn_azel
from startrack.localization.likelihood.neighbourhood import Neighbourhood
from startrack.localization.likelihood.skyline_profiles import FREEDOM, REWEIGHTINGS, SectorMoments, solve_linear
from startrack.localization.posterior import (
    Part,
    SearchedNear,
    name_prior,
    require_prior_inside,
    settle_steepness,
    weigh_parts,
)
from startrack.localization.search import FINEST_M, NATS, Place, boxes_about, split_boxes
from startrack.terrain import Terrain, require_terrain

COLUMN_SIGMAS = 2.0  # width of the edge of a column of rows, and their distance: normal up to 3 sigma, linear beyond
COLUMN = np.arange(-6, 7)  # rows of a sector: a skyline farther off than 12 of their distances counts the same
SLOPE_STEP_RAD = np.radians(0.1)  # of azimuth, to either side: the skyline's slope at a point
POSITION_STEP_M = 2.0  # at which the skyline's change with the position is taken
SEARCHED = 4  # points of a sector, that a search takes
LEAST_HEIGHT_SIGMA_RAD = 1e-6  # of a sector: 0.2 arcsec
TURN, TILT = 0, slice(1, 3)  # parts of an attitude
NEEDED_RAD = np.radians(30.0)  # of the skyline
HEADING_STEP_RAD = 2 * np.pi / SECTORS  # between two headings that are ranked
BEAM = 600  # boxes with a heading that are kept at each level: in three searches the true one was among the first 80
FIRST_PART = 1 / 32  # half side of the first boxes that are ranked, in that of the search area
AT_ONCE = 4000  # boxes with a heading, so that memory stays flat
HEADING_SIGMAS = 3.0  # of the heading's error, to the last one that is tried
WRONG = 0.1  # probability that a sector shows anything, in ranks and fits
LINEAR_STEPS, FOLLOWED_PLACES = 12, 12  # linear solutions, and the boxes from which they begin
LONGEST_M, SHORTER, TRIED = 60.0, 0.4, 4  # of a step; its part that is tried next where it gains nothing
SETTLED_NATS = 0.05  # gain of a step that ends them
SETTLED_ROUNDS, FIXED_M = 3, 1e-3  # of the attitude that suits the position found, and how far that may move
SAME_SIGMAS = 7.0  # between two solutions of one peak
MOST_PEAKS = 6


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


class Ranked(NamedTuple):
    """Boxes of positions (n, 2) [m], each with a heading in sectors (n,), and their log-likelihoods (n,)."""

    centres_m: Array
    heading: Ints
    score: Array

    def best(self, count: int) -> Ranked:
        """The `count` best boxes, the best first."""
        order = np.argsort(-self.score, kind="stable")[:count]
        return Ranked(self.centres_m[order], self.heading[order], self.score[order])


def locate_points(points: SkylinePoints, terrain: Terrain) -> tuple[Fix, SeenSkyline]:
    """Posterior of the camera's position in the enu of the `terrain` by the `points`, and these beside the map there.

    The errors of the attitude are integrated.
    Raises NotLocated: insufficient_geometry, outside_search_area, inconsistent_evidence.
    """
    middle = SeenSkyline.at(points, require_terrain(terrain), np.zeros(2), np.zeros(3))
    used = float(middle.used.mean() * 2 * np.pi)
    if used < NEEDED_RAD:
        raise NotLocated(
            f"{np.degrees(used):.0f} degrees of the skyline are measured where the terrain has it, and "
            f"{np.degrees(NEEDED_RAD):.0f} are needed"
        )
    ground = settle_steepness(middle.rows(), terrain)
    try:
        peaks = find_peaks(points.thinned(), ground)
        at = np.array([one.seen.position_m for one in peaks])
        parts, turned = [], []
        for number, one in enumerate(peaks):
            seen = SeenSkyline.at(points, ground, one.seen.position_m, one.seen.attitude_rad)
            linked = [k for k in range(len(at)) if k != number and one.covers(at[k])]
            turned.append(seen)
            parts.append(Part(seen.rows(), boxes_about([one.place], ground), at[linked]))
        fix = weigh_parts(parts, ground, of_one_sky=False)
    except NotLocated as refusal:
        raise name_prior(refusal, points.near) from refusal
    if not terrain.axisymmetric:  # in a round crater a heading spreads the position over an arc
        fix = replace(fix, compared_at_m=fix.position_enu_m[:2])
    there = replace(turned[0], position_m=fix.compared_at_m)
    for _ in range(SETTLED_ROUNDS):
        there = replace(there, attitude_rad=there.solve(FIXED_M)[1])
    return fix, there


class Peak(NamedTuple):
    """A likely position with its attitude."""

    seen: SeenSkyline
    fit: float  # log-density there
    covariance: Array  # (5, 5) of position [m] and what the attitude lacks [rad]

    def covers(self, position_m: Array) -> bool:
        """Whether a box about a position (2,) is in reach of the linear solution."""
        off = position_m - self.seen.position_m
        spread = self.covariance[:2, :2] + FINEST_M**2 * np.eye(2)
        return bool(off @ np.linalg.solve(spread, off) < SAME_SIGMAS**2)

    def reaches(self, position_m: Array, heading_rad: float) -> bool:
        """Whether a box about a position (2,) with about this heading is in reach of the linear solution."""
        turned = abs(heading_rad - self.seen.attitude_rad[TURN])
        return turned < 2 * HEADING_STEP_RAD and self.covers(position_m)

    @property
    def place(self) -> Place:
        """Place at the position, in the search's form."""
        return Place(self.seen.position_m, self.covariance[:2, :2], self.fit, np.zeros(SECTORS), 0.0)


def find_peaks(points: SkylinePoints, terrain: Terrain) -> list[Peak]:
    """The likely positions with their attitudes, the likeliest first. Raises NotLocated (outside_search_area)."""
    ranked, found, followed = rank_boxes(points, terrain), list[Peak](), 0
    for centre_m, heading in zip(ranked.centres_m, ranked.heading * HEADING_STEP_RAD, strict=True):
        if followed == FOLLOWED_PLACES:
            break
        if any(one.reaches(centre_m, heading) for one in found):
            continue
        followed += 1
        peak = follow(SeenSkyline.at(points, terrain, centre_m, np.array([heading, 0.0, 0.0])))
        same = [one for one in found if one.reaches(peak.seen.position_m, peak.seen.attitude_rad[TURN])]
        if all(peak.fit > one.fit for one in same):
            found = [one for one in found if one not in same] + [peak]
    found.sort(key=lambda one: -one.fit)
    return [one for one in found if one.fit > found[0].fit - NATS][:MOST_PEAKS]


def rank_boxes(points: SkylinePoints, terrain: Terrain) -> Ranked:
    """The best small boxes with their headings. Raises NotLocated (outside_search_area)."""
    if points.near is not None:
        terrain = SearchedNear(terrain, points.near)
        require_prior_inside(terrain)
    east_m, north_m, half = terrain.searched
    first, sigma = FIRST_PART * half, float(np.median(Neighbourhood(terrain, np.zeros(2), 0.0).map_sigma_rad))
    reach = 0.0 if terrain.axisymmetric else HEADING_SIGMAS * points.heading_sigma_rad
    most = min(int(np.ceil(reach / HEADING_STEP_RAD - 0.5)), SECTORS // 2)
    headings, centres = np.arange(-most, most + 1)[:SECTORS], np.array([[east_m, north_m]])
    while half > max(first, FINEST_M) and len(centres):
        centres, half = split_boxes(centres, half, terrain), half / 2
    found = Ranked(np.repeat(centres, len(headings), axis=0), np.tile(headings, len(centres)), np.zeros(0))
    while len(found.heading):
        parts = range(0, len(found.heading), AT_ONCE)
        some = (Ranked(found.centres_m[i : i + AT_ONCE], found.heading[i : i + AT_ONCE], np.zeros(0)) for i in parts)
        score = np.concatenate([score_boxes(points, terrain, one, half, sigma) for one in some])
        found = found._replace(score=score).best(BEAM)
        if half <= FINEST_M:
            return found
        found, half = split_ranked(found, half, terrain, most), half / 2
    raise NotLocated("no position in the search area is allowed", reason="outside_search_area")


def split_ranked(found: Ranked, half_m: float, terrain: Terrain, most: int) -> Ranked:
    """The quarters of boxes that may hold a camera, each with the headings beside its own, up to `most` sectors."""
    boxes, of = np.unique(found.centres_m, axis=0, return_inverse=True)
    parts = [split_boxes(one[None], half_m, terrain) for one in boxes]
    heading = found.heading[:, None] + [-1, 0, 1]
    wanted = np.unique(np.stack([np.repeat(of.ravel(), 3), heading.ravel()], axis=1), axis=0)
    wanted = wanted[np.abs(wanted[:, 1]) <= most]
    centres = np.concatenate([np.zeros((0, 2)), *(parts[i] for i in wanted[:, 0])])
    return Ranked(centres, np.repeat(wanted[:, 1], [len(parts[i]) for i in wanted[:, 0]]), np.zeros(0))


def score_boxes(points: SkylinePoints, terrain: Terrain, found: Ranked, half_m: float, sigma_rad: float) -> Array:
    """Log-likelihoods (n,) of boxes with their headings: each sector's height is anywhere in the box's range.

    `half_m` is half a box's side, `sigma_rad` the error of the map.
    """
    check_time()
    used = np.flatnonzero(np.isfinite(points.variance_rad2))
    seen = (used + found.heading[:, None]) % SECTORS
    traced, (boxes, of) = np.unique(seen), np.unique(found.centres_m, axis=0, return_inverse=True)
    middle, half_range, slope = np.zeros((3, len(boxes), SECTORS))
    middle[:, traced], half_range[:, traced] = terrain.horizon_spread_rad(
        boxes[:, None, :], half_m, MIDDLES_RAD[traced]
    )
    slope[:, traced] = np.gradient(middle[:, traced], axis=1) if len(traced) > 1 else 0.0
    at = of.ravel()[:, None], seen
    own = points.variance_rad2[used] + sigma_rad**2 + np.square(slope[at]) / 12
    width = np.square(half_range[at]) / 3
    left, variance = points.mean(points.elevation_rad)[used] - middle[at], own + width
    azimuth = MIDDLES_RAD[used]
    tilts = np.stack([-np.cos(azimuth), np.sin(azimuth)])  # by how much a tilt that lacks raises the points
    precision, weight = max(points.tilt_sigma_rad, LEAST_HEIGHT_SIGMA_RAD) ** -2.0, 1.0 / variance
    for _ in range(REWEIGHTINGS):
        normal = np.einsum("is,ns,js->nij", tilts, weight, tilts) + precision * np.eye(2)
        tilt = np.linalg.solve(normal, np.einsum("is,ns->ni", tilts, weight * left)[:, :, None])[:, :, 0]
        off = np.square(left - tilt @ tilts) / variance
        weight = (FREEDOM + 1.0) / (FREEDOM + off) / variance
    clear = (1.0 - WRONG) * np.exp(-0.5 * off) / np.sqrt(1.0 + width / own) + WRONG
    turned = found.heading * HEADING_STEP_RAD / max(points.heading_sigma_rad, HEADING_STEP_RAD)
    return np.asarray(
        np.log(clear).sum(axis=1) - 0.5 * precision * np.square(tilt).sum(axis=1) - 0.5 * np.square(turned)
        + (0.0 if points.near is None else points.near.log_density(found.centres_m))
    )  # fmt: skip


def follow(begin: SeenSkyline) -> Peak:
    """Peak to which linear solutions lead; a step that gains nothing is shortened."""
    seen, best = begin, log_fit(begin)
    for _ in range(LINEAR_STEPS):
        check_time()
        position_m, attitude_rad, covariance = seen.solve()
        move_m, turn = position_m - seen.position_m, attitude_rad - seen.attitude_rad
        first = min(1.0, LONGEST_M / max(float(np.linalg.norm(move_m)), LONGEST_M))
        tried = [
            replace(seen, position_m=seen.position_m + part * move_m, attitude_rad=seen.attitude_rad + part * turn)
            for part in first * SHORTER ** np.arange(TRIED)
        ]
        better = next(((one, fit) for one in tried if (fit := log_fit(one)) > best), None)
        if better is None:
            break
        gained, (seen, best) = better[1] - best, better
        if gained < SETTLED_NATS:
            break
    return Peak(seen, best, covariance)


def log_fit(seen: SeenSkyline) -> float:
    """Logarithm of the density at a position and an attitude, each sector normal or wrong; -inf of forbidden ground."""
    if not bool(seen.terrain.allowed(seen.position_m[None])[0]):
        return -np.inf
    left = np.square(seen.above_rad) / seen.variance_rad2
    log = float(np.log((1.0 - WRONG) * np.exp(-0.5 * left) + WRONG)[seen.used].sum())
    sigma = np.maximum(seen.stated.attitude_sigma_rad, LEAST_HEIGHT_SIGMA_RAD)
    log -= 0.5 * float(np.square(seen.lacking_rad / sigma).sum())
    near = seen.stated.near
    return log if near is None else log + float(near.log_density(seen.position_m[None])[0])
