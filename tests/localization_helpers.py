"""Log-likelihoods of positions written out in numpy: of the search row by row, and of the chain of obstacles."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.special import ndtr

from startrack.core.errors import Reason
from startrack.core.types import SECTORS, Array, Evidence, Fix, NotLocated
from startrack.localization import ExactPosterior
from startrack.localization.likelihood.obstacle_chain import (
    LEVELS_RAD,
    MOVES,
    NOTCH_LEVELS_RAD,
    RISEN,
    STATES,
    STOP,
    WRONG_SECTOR,
    Moves,
    transitions,
)
from startrack.localization.likelihood.skyline_profiles import HIGH_RAD, LOW_RAD, ROW_NATS, Profiles, sector_of
from startrack.localization.search_profiles import HIDE, SEARCH_EPSILON
from startrack.terrain import Cylinder, ForwardingTerrain, Terrain, load_terrain

TERRAIN = load_terrain("shackleton-thesis")
assert isinstance(TERRAIN, Cylinder)
THESIS_STARS = 2142  # Kua 2008, eq. 3.8 at magnitude 6
PART = 300  # positions at a time: their matrices fit the processor's cache


def sky(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    return 2 * np.pi * rng.random(n), np.arcsin(rng.random(n))


def random_position(rng: np.random.Generator, terrain: Cylinder = TERRAIN) -> Array:
    r, b = 0.98 * terrain.radius_m * np.sqrt(rng.random()), 2 * np.pi * rng.random()
    return r * np.array([np.sin(b), np.cos(b)])


def perfect_list(rng: np.random.Generator, at_m: Array, n: int = THESIS_STARS) -> Evidence:
    azimuth, elevation = sky(rng, n)
    seen = elevation > TERRAIN.horizon_rad(at_m[None], azimuth)
    return Evidence(
        azimuth_rad=azimuth, elevation_rad=elevation, llr=np.where(seen, 12.0, -12.0), edge_sigma_rad=np.zeros(n)
    )


def slow_contributions(evidence: Evidence, margin_rad: Array, sigma_rad: Array) -> Array:
    """Contributions (..., n) of rows at these margins above the horizon."""
    soft = sigma_rad > 0
    visible = np.where(soft, ndtr(margin_rad / np.where(soft, sigma_rad, 1.0)), margin_rad > 0)
    llr, extended = evidence.llr, evidence.extended_nats
    point = np.log(visible * np.exp(np.where(extended > 0, 0.0, llr)) + 1.0 - visible)
    return np.where(extended > 0, llr * visible + extended * visible * (1.0 - visible) / 2, point)


def slow_sums(points_m: Array, evidence: Evidence, terrain: Terrain) -> Array:
    """Sums (n, SECTORS) of the contributions of rows at positions (n, 2), each with its own horizon."""
    evidence = replace(evidence, llr=np.where(evidence.extended_nats > 0, evidence.llr, capped_llr(evidence)))
    horizon = terrain.horizon_rad(points_m[:, None], evidence.azimuth_rad)
    sigma = np.hypot(evidence.edge_sigma_rad, terrain.errors.sigma_rad(points_m[:, None], evidence.azimuth_rad))
    value = slow_contributions(evidence, evidence.elevation_rad - horizon, sigma)
    key = np.arange(len(points_m))[:, None] * SECTORS + sector_of(evidence.azimuth_rad)
    sums = np.bincount(key.ravel(), weights=value.ravel(), minlength=len(points_m) * SECTORS)
    return sums.reshape(len(points_m), SECTORS)


def capped_llr(evidence: Evidence) -> Array:
    """The llr (n,) of stars, as far as one counts."""
    return np.clip(evidence.llr, -ROW_NATS, ROW_NATS)


def best_levels(evidence: Evidence) -> Array:
    """(SECTORS,) the greatest sum of the llr of stars above one elevation."""
    found, sector, llr = np.zeros(SECTORS), sector_of(evidence.azimuth_rad), capped_llr(evidence)
    for s in np.unique(sector):
        own = np.flatnonzero(sector == s)
        found[s] = max(np.cumsum(llr[own[np.argsort(-evidence.elevation_rad[own])]]).max(), 0.0)
    return found


def search_scores(below: Array, best: Array) -> Array:
    """Log-likelihoods (n,) of the search of sums (n, SECTORS), less the best ones (SECTORS,)."""
    emission = np.stack(
        np.broadcast_arrays((1 - SEARCH_EPSILON) * np.exp(np.minimum(below, 0.0)) + SEARCH_EPSILON, np.exp(-best)),
        axis=-1,
    )
    T, product, log = np.array([[1 - HIDE, HIDE], [STOP, 1 - STOP]]), np.eye(2), np.zeros(len(below))
    for s in range(SECTORS):
        product = product @ T * emission[:, s, None]
        size = product.sum(axis=(1, 2))
        product, log = product / size[:, None, None], log + np.log(size)
    return np.asarray(log + np.log(np.trace(product, axis1=1, axis2=2)))


def locate_or_refuse(evidence: Evidence, terrain: Terrain) -> tuple[Fix | None, Reason | None]:
    """The fix of the posterior, or the reason of its refusal."""
    try:
        return ExactPosterior()(evidence, terrain), None
    except NotLocated as refusal:
        return None, refusal.reason


def _mean_likelihoods(margin_rad: Array, llr: Array, ranges_rad: list[tuple[Array | float, float]]) -> list[Array]:
    """Means (p,) over heights of the skyline from low (p,) to high of exp F, F the sum of llr (n,) of rows above it."""
    order = np.argsort(margin_rad, axis=1)
    at = np.take_along_axis(margin_rad, order, axis=1)
    above = np.cumsum(llr[order][:, ::-1], axis=1)[:, ::-1]
    zero, far = np.zeros((len(at), 1)), np.full((len(at), 1), np.inf)
    likelihood, edge, means = np.exp(np.hstack([above, zero])), np.hstack([-far, at, far]), []
    for low_rad, high_rad in ranges_rad:
        low = np.reshape(np.broadcast_to(low_rad, len(at)), (-1, 1))
        overlap = np.minimum(edge[:, 1:], high_rad) - np.maximum(edge[:, :-1], low)
        means.append((likelihood * np.maximum(overlap, 0.0)).sum(axis=1) / (high_rad - low[:, 0]))
    return means


def slow_chain(emissions: Array, moves: Moves = MOVES) -> Array:
    """Logarithms (p,) of the traces of the products of transitions and emissions (p, SECTORS, STATES)."""
    parts = np.array_split(emissions, max(len(emissions) // PART, 1))
    return np.concatenate([_chain_of_part(part, transitions(moves)) for part in parts])


def _chain_of_part(emissions: Array, T: Array) -> Array:
    product, log = np.tile(np.eye(STATES), (len(emissions), 1, 1)), np.zeros(len(emissions))
    for e in np.moveaxis(emissions, 1, 0):
        # One product of two matrices, instead of one small product a position.
        product = (product.reshape(-1, STATES) @ T).reshape(product.shape) * e[:, None]
        scale = product.max(axis=(1, 2))
        product, log = product / scale[:, None, None], log + np.log(scale)
    return np.asarray(log + np.log(np.trace(product, axis1=1, axis2=2)))


def slow_chain_scores(points_m: Array, evidence: Evidence, terrain: Terrain, reference_m: Array) -> Array:
    """Log-likelihoods (p,) of positions (p, 2) with obstacles: each star with its own horizon, hard edges.

    Heights of the skyline are in a window about that of the reference (2,).
    """
    azimuth = evidence.azimuth_rad
    about = evidence.elevation_rad - terrain.horizon_rad(reference_m[None], azimuth)
    e = np.ones((len(points_m), SECTORS, STATES))
    for s in range(SECTORS):
        own = np.flatnonzero((sector_of(azimuth) == s) & (about > LOW_RAD) & (about < HIGH_RAD))
        llr = np.clip(evidence.llr[own], -ROW_NATS, ROW_NATS)
        margin = evidence.elevation_rad[own] - terrain.horizon_rad(points_m[:, None], azimuth[own])
        (anywhere,) = _mean_likelihoods(about[own][None], llr, [(LOW_RAD, HIGH_RAD)])
        e[:, s, 0] = np.exp((llr * (margin > 0)).sum(axis=1))
        e[:, s, 1:RISEN] = np.stack(_mean_likelihoods(margin, llr, list(pairwise(LEVELS_RAD))), axis=1)
        sunk = [(-high, -low) for low, high in pairwise(NOTCH_LEVELS_RAD)]
        e[:, s, RISEN + 1 :] = np.stack(_mean_likelihoods(margin, llr, sunk), axis=1)
        e[:, s] = (1 - WRONG_SECTOR) * e[:, s] + WRONG_SECTOR * anywhere
    return slow_chain(e)


class Delegating:
    """A terrain that forwards every call, of a class unknown to the package."""

    def __init__(self, whole: Terrain) -> None:
        self._whole = whole

    def __getattr__(self, name: str) -> object:
        return getattr(self._whole, name)


class ThreeMethods(Terrain):
    """A terrain of a user's own: the three required methods, in open form."""

    def __init__(self, whole: Terrain) -> None:
        self.whole = whole
        self.search_radius_m = whole.search_radius_m
        self.camera_height_m = whole.camera_height_m
        self.horizon_cost = whole.horizon_cost

    @property
    def reach_m(self) -> float:
        return self.whole.reach_m

    def allowed(self, points_m: Array) -> Array:
        return self.whole.allowed(points_m)

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        return self.whole.horizon_rad(points_m, azimuths_rad)

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        return self.whole.horizon_bounds_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)

    def ground_m(self, points_m: Array) -> Array:
        return self.whole.ground_m(points_m)


WRAPPERS = (Delegating, ForwardingTerrain, ThreeMethods)


def _cell_part(profiles: Profiles, sector: int, height_rad: float) -> tuple[int, float]:
    """The cell of a sector that holds a height, and the part of the way through it, from 0 to 1 within the window."""
    begin, last = profiles.first[sector], profiles.first[sector + 1] - 1
    k = begin + int(np.clip(np.searchsorted(profiles.x[begin:last], height_rad, side="right") - 1, 0, None))
    return k, (height_rad - profiles.x[k]) / (profiles.x[k + 1] - profiles.x[k])


def log_at(profiles: Profiles, sector: int, height_rad: float) -> float:
    """F - R of a sector at a height, from the cells."""
    if height_rad >= HIGH_RAD:
        return -float(profiles.free[sector])
    k, u = _cell_part(profiles, sector, height_rad)
    u = float(np.clip(u, 0.0, 1.0))
    level = (1.0 - u) * profiles.left[k] + u * profiles.right[k]
    return float(level + u * (1.0 - u) * profiles.bend[k] - profiles.free[sector])


def integral_to(profiles: Profiles, sector: int, height_rad: float) -> float:
    """Integral of exp(F - R) of a sector up to a height, from the cells."""
    if height_rad >= HIGH_RAD:
        end = profiles.integral[profiles.first[sector + 1] - 1]
        return float(end + (height_rad - HIGH_RAD) * np.exp(-profiles.free[sector]))
    k, u = _cell_part(profiles, sector, height_rad)
    return float((1.0 - u) * profiles.integral[k] + u * profiles.integral[k + 1])
