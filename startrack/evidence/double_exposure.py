"""Two skylines in one frame: did the camera move between two parts of the exposure?

Where it moved and kept its attitude among the stars, both parts show one sky above two skylines. A star above both
shines with all its light, one above a single skyline with the part of the exposure in which that was there, and one
below both not at all. A single skyline makes no star shine with a part of its light. (The light of the sky has two
steps then; it does not decide here, as dust, glare and the ground's own light make steps, too.)

"Two positions and the parts of the exposure there" is compared with "one position", and with "each star between the
skylines is visible or hidden, without a rule": an obstacle, a wrong map or a wrong time hides stars, but dims none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Bools, NotLocated
from startrack.evidence.dimmed_light import log_likelihoods, measure_scatter
from startrack.evidence.star_evidence import StarPhotometry
from startrack.terrain import Terrain

PRIOR = 1e-3  # that a frame is a double exposure
DECISIVE = 1e3  # ratio of the weights, with the prior, from which a frame is refused
PARTS = np.linspace(0.2, 0.8, 7)  # of the exposure, at the first position; an error of the scale feigns nine tenths
LIGHT = np.concatenate([[0.0], PARTS, [1.0]])  # of a star: hidden, dimmed and visible
LEAST_SNR = 3.0  # of a star whose light shows a part
SCREENED_RAD = np.radians([0.25, 0.5, 1.0, 2.0, 4.0])  # from the skyline: bands in which dimmed stars are counted first
SCREENED_SHARES = np.array([0.03, 0.1, 0.3, 0.8])  # of dimmed stars in a band
SCREENED_NATS = 3.0  # gain of dimmed stars in a band: one clean frame of twenty, moves of one pixel 5 to 70
WIDEST_RAD = np.radians(6.0)  # from the skyline: stars with which two positions are sought
AZIMUTHS_RAD = np.linspace(0.0, 2 * np.pi, 720, endpoint=False)  # of the skyline by which stars are chosen
HIGH_RAD = np.radians(4.0)  # above the skyline: stars there show how far the light of visible stars scatters
HIGH_SNR, LEAST_HIGH = 6.0, 30
RADII = 0.0025 * 1.5 ** np.arange(12)  # of the moves tried, in radii of the search area: 25 m to 2.2 km of 10 km
REACH, NODES_ACROSS = 0.25, 9  # of horizons of a map that are interpolated, and the points at which they are traced
DIRECTIONS = 24
STEPS = np.array([64.0, 32.0, 16.0, 8.0, 4.0]) * 1e-4  # of a climb, in radii of the search area
ROUNDS, STARTS = 6, 3  # climbs: rounds of each step, and their number
TURNS = np.linspace(0.0, 2 * np.pi, DIRECTIONS, endpoint=False)
CIRCLE = np.stack([np.sin(TURNS), np.cos(TURNS)], axis=1)  # (DIRECTIONS, 2)


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
        tried = len(RADII) * DIRECTIONS * len(PARTS)
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
    dimmed: Array  # (n, len(PARTS))

    @property
    def free(self) -> Array:
        """Log-likelihoods (n,) of stars that are visible or hidden without a rule."""
        return np.logaddexp(self.hidden, self.visible) - np.log(2.0)

    def above(self, terrain: Terrain, points_m: Array) -> Array:
        """1 where a star is above the skyline of a point (m, 2), else 0: (m, n)."""
        return np.where(self.elevation_rad > terrain.horizon_rad(points_m[:, None], self.azimuth_rad), 1.0, 0.0)

    def of_one(self, above: Array) -> Array:
        """Log-likelihoods (m,) of single skylines, `above` (m, n)."""
        return self.hidden.sum() + above @ (self.visible - self.hidden)

    def of_two(self, first: Array, second: Array) -> Array:
        """Log-likelihoods (m, len(PARTS)) of pairs of skylines, `first` and `second` (m, n)."""
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
    skyline_rad = terrain.horizon_rad(position_m[None], AZIMUTHS_RAD)
    above_rad = elevation - np.interp(azimuth, AZIMUTHS_RAD, skyline_rad, period=2 * np.pi)
    fluxes = light.expected_e[which], light.flux_e[which], light.sigma_e[which]
    high = (above_rad > HIGH_RAD) & (fluxes[0] > HIGH_SNR * fluxes[2])
    if np.count_nonzero(high) < LEAST_HIGH:
        return None
    scatter = measure_scatter(*(values[high] for values in fluxes))

    def rows(chosen: Bools) -> _Rows:
        expected_e, flux_e, sigma_e = (values[chosen] for values in fluxes)
        logs = log_likelihoods(LIGHT, expected_e, flux_e, sigma_e, *scatter)
        return _Rows(azimuth[chosen], elevation[chosen], logs[:, 0], logs[:, -1], logs[:, 1:-1])

    near = np.abs(above_rad) < SCREENED_RAD[-1]
    if _screened_gain(rows(near), np.abs(above_rad[near])) < SCREENED_NATS:
        return None
    near = np.abs(above_rad) < WIDEST_RAD
    reach_m = REACH * terrain.search_radius_m
    ground = terrain.near(position_m, reach_m, azimuth[near], NODES_ACROSS).interpolated()
    return _best_pair(rows(near), ground, position_m)


def _screened_gain(rows: _Rows, distance_rad: Array) -> float:
    """The best gain [nats] of a share of dimmed stars over none, of all bands about the skyline; distances (n,)."""
    ratio = np.exp(rows.dimmed - rows.free[:, None]) - 1.0
    each = np.log1p(SCREENED_SHARES[:, None, None] * ratio)
    return max(float(each[:, distance_rad < reach].sum(axis=1).max()) for reach in SCREENED_RAD)


def _best_pair(rows: _Rows, terrain: Terrain, position_m: Array) -> DoubleExposure:
    """The best of all pairs near a position (2,): it and another, or one on either side of it."""
    moves = (RADII[:, None, None] * terrain.search_radius_m * CIRCLE).reshape(-1, 2)
    pairs = np.concatenate([
        np.stack([np.broadcast_to(position_m, moves.shape), position_m + moves], axis=1),
        np.stack([position_m - 0.5 * moves, position_m + 0.5 * moves], axis=1),
    ])  # fmt: skip

    def two(pairs_m: Array) -> Array:
        first, second = (rows.above(terrain, pairs_m[:, k]) for k in (0, 1))
        fits = rows.of_two(first, second).max(axis=1)
        return np.where(terrain.allowed(pairs_m).all(axis=1), fits, -np.inf)

    def one(points_m: Array) -> Array:
        return rows.of_one(rows.above(terrain, points_m[:, 0]))

    steps_m = STEPS * terrain.search_radius_m
    starts = pairs[np.argsort(-two(pairs), kind="stable")[:STARTS]]
    best, pair = max((_climb(two, start, steps_m) for start in starts), key=lambda found: found[0])
    single = max(_climb(one, start[None], steps_m)[0] for start in (position_m, *pair, pair.mean(axis=0)))
    first, second = (rows.above(terrain, pair[k][None]) for k in (0, 1))
    part = int(np.argmax(rows.of_two(first, second)))
    between = (first != second)[0]
    dimmed = np.where(first[0] > 0, rows.dimmed[:, part], rows.dimmed[:, -1 - part])
    free_nats = float((dimmed - rows.free)[between].sum())
    return DoubleExposure(pair, float(PARTS[part]), best - single, free_nats, int(np.count_nonzero(between)))


def _climb(fits: Callable[[Array], Array], start_m: Array, steps_m: Array) -> tuple[float, Array]:
    """The best fit near one or two positions (k, 2), and where; `fits` takes (m, k, 2)."""
    at, best = start_m, float(fits(start_m[None])[0])
    ways = np.einsum("kl,wc->kwlc", np.eye(len(start_m)), CIRCLE[:: DIRECTIONS // 8]).reshape(-1, *start_m.shape)
    ways = np.concatenate([ways, np.broadcast_to(CIRCLE[:: DIRECTIONS // 8, None], (8, *start_m.shape))])
    for step_m in steps_m:
        for _ in range(ROUNDS):
            tried = at + step_m * ways
            fit = fits(tried)
            if fit.max() <= best:
                break
            best, at = float(fit.max()), tried[int(np.argmax(fit))]
    return best, at
