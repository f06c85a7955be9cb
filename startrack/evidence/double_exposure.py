"""Two skylines in one frame: did the camera move between two parts of the exposure?

Where it moved and kept its attitude among the stars, both parts show one sky above two skylines. A star above both
shines with all its light, one above a single skyline with the part of the exposure in which that was there, and one
below both not at all. A single skyline dims stars only within a narrow band, the same all around, where it is soft
(trees, haze, blur). (The light of the sky has two steps then; it does not decide here, as dust, glare and the ground's
own light make steps, too.)

"Two positions and the parts of the exposure there" is compared with "one position", and with "each star between the
skylines is visible or hidden, without a rule": an obstacle, a wrong map or a wrong time hides stars, but dims none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Bools, NotLocated
from startrack.evidence.photometry import CLIPPED_SIGMAS
from startrack.evidence.skyline import SKYLINE_POINTS, Skyline
from startrack.evidence.star_photometer import StarPhotometry
from startrack.terrain import Terrain

PRIOR = 1e-3  # that a frame is a double exposure
DECISIVE = 1 / PRIOR  # ratio of the weights, with the prior, from which a frame is refused
EXPOSURE_PARTS = np.linspace(0.2, 0.8, 7)  # at the first position; an error of the scale feigns nine tenths
LIGHT = np.concatenate([[0.0], EXPOSURE_PARTS, [1.0]])  # of a star: hidden, dimmed and visible
SOFT_RAD = np.radians([0.03, 0.1, 0.3])  # widths of a soft skyline: a third of a pixel of a fisheye to two, trees
LEAST_SNR = 3.0  # of a star whose light shows a part
SCREENED_RAD = np.radians([0.25, 0.5, 1.0, 2.0, 4.0])  # from the skyline: bands in which dimmed stars are counted first
SCREENED_SHARES = np.array([0.03, 0.1, 0.3, 0.8])  # of dimmed stars in a band
SCREENED_NATS = 3.0  # gain of dimmed stars in a band: one clean frame of twenty, moves of one pixel 5 to 70
PAIRED_RAD = np.radians(6.0)  # from the skyline: stars with which two positions are sought
FAR_ABOVE_RAD = SCREENED_RAD[-1]  # above the skyline: stars there show how far the light of visible stars scatters
SCATTER_SNR, SCATTER_STARS = 2 * LEAST_SNR, 30
RADII = 0.0025 * 1.5 ** np.arange(12)  # of the moves tried, in radii of the search area: 25 m to 2.2 km of 10 km
TRACED_REACH, TRACED_NODES = 0.25, 9  # of a map's horizons that are interpolated; points at which they are traced
MOVE_DIRECTIONS = 24
CLIMB_STEPS = np.array([64.0, 32.0, 16.0, 8.0, 4.0]) * 1e-4  # of a climb, in radii of the search area
CLIMB_ROUNDS, CLIMBS = 6, 3  # of each step of a climb; the number of climbs
MOVE_AZIMUTHS_RAD = np.linspace(0.0, 2 * np.pi, MOVE_DIRECTIONS, endpoint=False)
OUTLIERS = 0.02  # least share of stars with any light: variable, blended, beside a defect
SCATTER_ROUNDS = 4
CIRCLE = np.stack([np.sin(MOVE_AZIMUTHS_RAD), np.cos(MOVE_AZIMUTHS_RAD)], axis=1)  # (MOVE_DIRECTIONS, 2)


@dataclass(frozen=True)
class DoubleExposure:
    """The two positions that explain a frame best, and by how much they do so better than one."""

    positions_m: Array  # (2, 2) east and north
    part: float  # of the exposure at the first position
    over_one_nats: float  # gain over the best single position
    over_free_nats: float  # gain over stars that are visible or hidden without a rule
    stars: int  # between both skylines

    @property
    def log_odds(self) -> float:
        """Log odds of a double exposure: the smaller gain, less the prior and the explanations that were tried."""
        tried = len(RADII) * MOVE_DIRECTIONS * len(EXPOSURE_PARTS)
        return min(self.over_one_nats, self.over_free_nats) + float(np.log(PRIOR / tried))

    def __str__(self) -> str:
        moved_m, percent = float(np.linalg.norm(self.positions_m[1] - self.positions_m[0])), 100 * self.part
        return (
            f"two skylines: {self.stars} stars are between those of two positions {moved_m:.0f} m apart and shine with "
            f"about {percent:.0f} or {100 - percent:.0f} % of their light: did the camera move during the exposure, or "
            "are these two pictures in one frame?"
        )


@dataclass(frozen=True)
class _Rows:
    """Stars (n) and the log-likelihoods of their fluxes, hidden, visible and with a part of their light."""

    azimuth_rad: Array
    elevation_rad: Array
    hidden: Array  # (n,)
    visible: Array  # (n,)
    dimmed: Array  # (n, len(EXPOSURE_PARTS))

    @property
    def free(self) -> Array:
        """Log-likelihoods (n,) of stars that are visible or hidden without a rule."""
        return np.logaddexp(self.hidden, self.visible) - np.log(2.0)

    def find_above(self, terrain: Terrain, points_m: Array) -> Array:
        """Flags (m, n): 1 where a star is above the skyline of a point (m, 2), else 0."""
        return np.where(self.find_height(terrain, points_m) > 0.0, 1.0, 0.0)

    def find_height(self, terrain: Terrain, points_m: Array) -> Array:
        """Heights (m, n) [rad] of the stars above the skylines of points (m, 2)."""
        return np.asarray(self.elevation_rad - terrain.horizon_rad(points_m[:, None], self.azimuth_rad))

    def single_fits(self, above: Array) -> Array:
        """Log-likelihoods (m,) of single skylines, `above` (m, n)."""
        return self.hidden.sum() + above @ (self.visible - self.hidden)

    def soft_fits(self, above_rad: Array) -> Array:
        """Log-likelihoods (m,) of single skylines that are soft, the best of several widths; `above_rad` (m, n)."""
        from scipy.special import ndtr

        logs = np.concatenate([self.hidden[:, None], self.dimmed, self.visible[:, None]], axis=1)
        star = np.arange(len(logs))
        fits = []
        for width_rad in SOFT_RAD:
            part = ndtr(above_rad / width_rad)
            nearest = np.abs(part[..., None] - LIGHT).argmin(axis=-1)
            fits.append(logs[star, nearest].sum(axis=-1))
        return np.max(fits, axis=0)

    def pair_fits(self, first: Array, second: Array) -> Array:
        """Log-likelihoods (m, len(EXPOSURE_PARTS)) of pairs of skylines, `first` and `second` (m, n)."""
        hidden, other = self.hidden[:, None], self.dimmed[:, ::-1]
        both = self.visible[:, None] - self.dimmed - other + hidden
        return hidden.sum() + first @ (self.dimmed - hidden) + second @ (other - hidden) + (first * second) @ both


def check_single_skyline(light: StarPhotometry, terrain: Terrain, position_m: Array) -> None:
    """Raise NotLocated (inconsistent_evidence) where two skylines explain the stars far better than one does.

    `light` is the photometry of the stars above a `terrain`, `position_m` (2,) [m] the position that was found.
    """
    found = find_double_exposure(light, terrain, position_m)
    if found is not None and found.log_odds > np.log(DECISIVE):
        raise NotLocated(str(found), reason="inconsistent_evidence")


def find_double_exposure(light: StarPhotometry, terrain: Terrain, position_m: Array) -> DoubleExposure | None:
    """The best two positions near `position_m` (2,) [m]; None where no band beside the skyline has dimmed stars.

    `light` has the stars above the `terrain`. Stars left out as blocked count too: some of them are dimmed ones.
    """
    known = light.usable | (np.array([cause == "blocked" for cause in light.causes])[light.cause_code])
    which = np.flatnonzero(known & (light.expected_e > LEAST_SNR * light.sigma_e) & (light.sigma_e > 0))
    azimuth, elevation = light.azimuth_rad[which], light.elevation_rad[which]
    above_rad = elevation - Skyline.trace(position_m, terrain, SKYLINE_POINTS // 2)(azimuth)
    fluxes = light.expected_e[which], light.flux_e[which], light.sigma_e[which]
    high = (above_rad > FAR_ABOVE_RAD) & (fluxes[0] > SCATTER_SNR * fluxes[2])
    if np.count_nonzero(high) < SCATTER_STARS:
        return None
    scatter = measure_scatter(*(values[high] for values in fluxes))

    def rows(chosen: Bools) -> _Rows:
        expected_e, flux_e, sigma_e = (values[chosen] for values in fluxes)
        logs = log_likelihoods(LIGHT, expected_e, flux_e, sigma_e, *scatter)
        return _Rows(azimuth[chosen], elevation[chosen], logs[:, 0], logs[:, -1], logs[:, 1:-1])

    near = np.abs(above_rad) < SCREENED_RAD[-1]
    screened, distance_rad = rows(near), np.abs(above_rad[near])
    # The best gain of a share of dimmed stars over none, of all bands about the skyline.
    ratio = np.exp(screened.dimmed - screened.free[:, None]) - 1.0
    each = np.log1p(SCREENED_SHARES[:, None, None] * ratio)
    if max(float(each[:, distance_rad < reach].sum(axis=1).max()) for reach in SCREENED_RAD) < SCREENED_NATS:
        return None
    near = np.abs(above_rad) < PAIRED_RAD
    reach_m = TRACED_REACH * terrain.search_radius_m
    ground = terrain.near(position_m, reach_m, azimuth[near], TRACED_NODES)
    return _best_pair(rows(near), ground, position_m)


def _best_pair(rows: _Rows, terrain: Terrain, position_m: Array) -> DoubleExposure:
    """The best of all pairs near a position (2,): it and another, or one on either side of it."""
    moves = (RADII[:, None, None] * terrain.search_radius_m * CIRCLE).reshape(-1, 2)
    pairs = np.concatenate([
        np.stack([np.broadcast_to(position_m, moves.shape), position_m + moves], axis=1),
        np.stack([position_m - 0.5 * moves, position_m + 0.5 * moves], axis=1),
    ])  # fmt: skip

    def two(pairs_m: Array) -> Array:
        first, second = (rows.find_above(terrain, pairs_m[:, k]) for k in (0, 1))
        fits = rows.pair_fits(first, second).max(axis=1)
        return np.where(terrain.allowed(pairs_m).all(axis=1), fits, -np.inf)

    def one(points_m: Array) -> Array:
        height_rad = rows.find_height(terrain, points_m[:, 0])
        return np.maximum(rows.single_fits(np.where(height_rad > 0.0, 1.0, 0.0)), rows.soft_fits(height_rad))

    steps_m = CLIMB_STEPS * terrain.search_radius_m
    starts = pairs[np.argsort(-two(pairs), kind="stable")[:CLIMBS]]
    best, pair = max((_climb(two, start, steps_m) for start in starts), key=lambda found: found[0])
    single = max(_climb(one, start[None], steps_m)[0] for start in (position_m, *pair, pair.mean(axis=0)))
    first, second = (rows.find_above(terrain, pair[k][None]) for k in (0, 1))
    part = int(np.argmax(rows.pair_fits(first, second)))
    between = (first != second)[0]
    dimmed = np.where(first[0] > 0, rows.dimmed[:, part], rows.dimmed[:, -1 - part])
    free_nats = float((dimmed - rows.free)[between].sum())
    return DoubleExposure(pair, float(EXPOSURE_PARTS[part]), best - single, free_nats, int(np.count_nonzero(between)))


def _climb(fits: Callable[[Array], Array], start_m: Array, steps_m: Array) -> tuple[float, Array]:
    """The best fit [nats] near one or two positions (k, 2) [m, enu], and where, in ever smaller steps (s,)."""
    at, best = start_m, float(fits(start_m[None])[0])
    ways = np.einsum("kl,wc->kwlc", np.eye(len(start_m)), CIRCLE[:: MOVE_DIRECTIONS // 8]).reshape(-1, *start_m.shape)
    ways = np.concatenate([ways, np.broadcast_to(CIRCLE[:: MOVE_DIRECTIONS // 8, None], (8, *start_m.shape))])
    for step_m in steps_m:
        for _ in range(CLIMB_ROUNDS):
            tried = at + step_m * ways
            fit = fits(tried)
            if fit.max() <= best:
                break
            best, at = float(fit.max()), tried[int(np.argmax(fit))]
    return best, at


def measure_scatter(expected_e: Array, flux_e: Array, sigma_e: Array) -> tuple[Array, float]:
    """Scatter of visible stars' measured light `flux_e` (n,) about `expected_e`, beyond the noise `sigma_e`.

    The variance per expected electron and per its square (2,), from the residuals' squares with deviant ones clipped;
    and the share of outliers.
    """
    terms, per_e = np.stack([expected_e, np.square(expected_e)], axis=1), np.asarray([0.0, 0.0])
    beyond = np.square(flux_e - expected_e)
    kept = beyond < np.square(np.maximum(CLIPPED_SIGMAS * sigma_e, 0.5 * expected_e))
    for _ in range(SCATTER_ROUNDS):
        variance = np.square(sigma_e) + terms @ per_e
        weighted = terms[kept] / variance[kept, None]
        rest = (beyond - np.square(sigma_e))[kept] / variance[kept]
        per_e = np.asarray(np.linalg.lstsq(weighted, rest, rcond=None)[0])
        if per_e.min() < 0:  # one of them alone
            one = int(np.argmax(per_e))
            alone = float(weighted[:, one] @ rest / np.square(weighted[:, one]).sum())
            per_e = np.where(np.arange(2) == one, max(alone, 0.0), 0.0)
        kept = beyond < CLIPPED_SIGMAS**2 * (np.square(sigma_e) + terms @ per_e)
    return per_e, max(OUTLIERS, 1.0 - float(np.mean(kept)))


def log_likelihoods(
    light: Array, expected_e: Array, flux_e: Array, sigma_e: Array, per_e: Array, outliers: float
) -> Array:
    """Log-likelihoods (n, k) of fluxes `flux_e` (n,) where stars shine with parts `light` (k,) of what is expected.

    `sigma_e` (n,): noise without the star; `per_e` (2,) and `outliers`: from `measure_scatter`.
    """
    mean = expected_e[:, None] * light
    variance = np.square(sigma_e)[:, None] + per_e[0] * mean + per_e[1] * np.square(mean)
    normal = -0.5 * np.square(flux_e[:, None] - mean) / variance - 0.5 * np.log(2 * np.pi * variance)
    anything = np.log(outliers) - np.log(2.0 * expected_e + 10.0 * sigma_e)
    return np.logaddexp(np.log1p(-outliers) + normal, anything[:, None])
