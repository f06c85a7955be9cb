"""A quick guess at the best place, so that the proof can begin by excluding most of the area."""

from __future__ import annotations

import numpy as np

from startrack.localization.sector_likelihood import Sectors, contribution
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Evidence, Ints

LOUDEST_RAYS = 800
FIRST_ACROSS = 25
KEPT = 4
AROUND = 5
FINEST_M = 0.3


def likely_places(evidence: Evidence, sectors: Sectors, terrain: Terrain) -> tuple[Array, Array]:
    """A few places (n, 2) [m] that fit well, and their log-likelihoods (n,) by all rays: lower bounds of the maximum.

    A grid over the area judged by the loudest rays, then ever finer grids around the best few. The guess decides
    nothing: a poor one only makes the search slower.
    """
    loudest = np.argsort(-np.abs(evidence.llr), kind="stable")[:LOUDEST_RAYS]
    few = taken(evidence, loudest)
    few_sectors = Sectors.of(few, 2 * np.pi / sectors.count, sectors.epsilon)
    step = 2 * terrain.reach_m / FIRST_ACROSS
    places = _grid(np.zeros((1, 2)), step, FIRST_ACROSS)
    while True:
        places = places[np.asarray(terrain.allowed(places))]
        if not len(places):
            return places, np.zeros(0)
        score = scores(places, few, few_sectors, terrain)
        best = places[np.argsort(-score, kind="stable")[:KEPT]]
        if step < FINEST_M:
            return best, scores(best, evidence, sectors, terrain)
        step /= 2
        places = np.unique(_grid(best, step, AROUND), axis=0)


def scores(places_m: Array, evidence: Evidence, sectors: Sectors, terrain: Terrain) -> Array:
    """Log-likelihoods (n,) of places (n, 2), ray by ray."""
    n, rays = len(places_m), len(evidence)
    points = np.repeat(places_m, rays, axis=0)
    azimuth = np.tile(evidence.azimuth_rad, n)
    sigma = np.hypot(np.tile(evidence.edge_sigma_rad, n), terrain.horizon_sigma_rad(points, azimuth))
    value = contribution(
        np.tile(evidence.llr, n), np.tile(evidence.elevation_rad, n), terrain.horizon_rad(points, azimuth), sigma
    )
    key = np.repeat(np.arange(n), rays) * sectors.count + np.tile(sectors.sector, n)
    sums: Array = np.bincount(key, weights=value, minlength=n * sectors.count).astype(np.float64)
    return sectors.score(sums.reshape(n, sectors.count))


def taken(evidence: Evidence, which: Bools | Ints) -> Evidence:
    """The rays selected by a mask or index."""
    if which.dtype == np.bool_ and which.all():
        return evidence
    return Evidence(
        azimuth_rad=evidence.azimuth_rad[which],
        elevation_rad=evidence.elevation_rad[which],
        llr=evidence.llr[which],
        edge_sigma_rad=evidence.edge_sigma_rad[which],
    )


def _grid(middles_m: Array, step_m: float, across: int) -> Array:
    line = step_m * (np.arange(across) - (across - 1) / 2)
    x, y = np.meshgrid(line, line)
    return (middles_m[:, None, :] + np.stack([x.ravel(), y.ravel()], axis=1)).reshape(-1, 2)
