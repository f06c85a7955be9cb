"""A crater whose depth and width are not quite known: both estimated with the position, and marginalised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from startrack.localization.consistency import best_near
from startrack.localization.grid_search import likely_places, taken
from startrack.localization.sector_likelihood import Sectors
from startrack.terrain import Cylinder
from startrack.types import Array, Evidence

Explored = tuple[Array, float, Array, float]  # centres, half side, log-likelihoods, log of the mass dropped

ACROSS = 5  # nodes along each axis
ZOOMS = 8
KEPT_NATS = 8.0
ENOUGH_SHRINKING = 0.7
PRIOR_SIGMAS = 3.0
FIRST_STEP_M = 64.0
TELLING_LLR = 0.3
WINDOW_RAD = np.radians(5.0)


@dataclass(frozen=True)
class CraterFit:
    """Depth and diameter as the stars see them."""

    depth_m: float
    diameter_m: float
    covariance_m2: Array  # (2, 2) of depth and diameter


def marginalised(
    explore: Callable[[Evidence, Cylinder], Explored], evidence: Evidence, cylinder: Cylinder
) -> tuple[Explored, CraterFit]:
    """The position's posterior over depths and diameters drawn from their priors, and the fit of these two.

    A crater is named by two numbers: how much steeper it is than the file says (depth over diameter), and how much
    larger. Grids of craters, each with its best place, zoom in on those that matter; over the last grid the exact
    posteriors are mixed, each crater with its own share of the probability.
    """
    nodes = _craters_that_matter(evidence, cylinder)
    parts = [explore(evidence, _shaped(cylinder, node)) for node in nodes]
    log_prior = np.array([_log_prior(cylinder, node) for node in nodes])
    logs = [p[2] + prior + np.log(4 * p[1] ** 2) for p, prior in zip(parts, log_prior, strict=True)]
    log_mass = np.array([_log_sum(log) for log in logs])
    share = np.exp(log_mass - log_mass.max())
    share /= share.sum()
    shapes = np.array([[c.depth_m, c.diameter_m] for c in (_shaped(cylinder, node) for node in nodes)])
    mean = share @ shapes
    fit = CraterFit(
        depth_m=float(mean[0]),
        diameter_m=float(mean[1]),
        covariance_m2=np.einsum("n,ni,nj->ij", share, shapes - mean, shapes - mean),
    )
    half = max(p[1] for p in parts)
    dropped = _log_sum(np.array([p[3] + prior for p, prior in zip(parts, log_prior, strict=True)]))
    density = np.concatenate(logs) - np.log(4 * half**2)
    return (np.concatenate([p[0] for p in parts]), half, density, dropped), fit


def _shaped(cylinder: Cylinder, node: Array) -> Cylinder:
    """The crater that is node[0] steeper and node[1] larger (relative)."""
    steeper, larger = float(node[0]), float(node[1])
    return replace(
        cylinder,
        depth_m=cylinder.depth_m * (1 + steeper) * (1 + larger),
        diameter_m=cylinder.diameter_m * (1 + larger),
    )


def _log_prior(cylinder: Cylinder, node: Array) -> float:
    crater = _shaped(cylinder, node)
    z = 0.0
    if cylinder.depth_sigma_m > 0:
        z += ((crater.depth_m - cylinder.depth_m) / cylinder.depth_sigma_m) ** 2
    if cylinder.diameter_sigma_m > 0:
        z += ((crater.diameter_m - cylinder.diameter_m) / cylinder.diameter_sigma_m) ** 2
    return -0.5 * z


def _craters_that_matter(evidence: Evidence, cylinder: Cylinder) -> Array:
    """Nodes (n, 2) of an even grid that covers the joint posterior of shape and position."""
    larger = PRIOR_SIGMAS * cylinder.diameter_sigma_m / cylinder.diameter_m
    steeper = float(np.hypot(PRIOR_SIGMAS * cylinder.depth_sigma_m / cylinder.depth_m, larger))
    middle, half = np.zeros(2), np.array([steeper, larger])
    place = likely_places(evidence, Sectors.of(evidence, np.radians(1.5), 1e-4), cylinder)[0][:1]
    near = _near(evidence, cylinder, place)
    for _ in range(ZOOMS):
        nodes = _grid(middle, half)
        fits = [best_near(place, near, _shaped(cylinder, node), FIRST_STEP_M) for node in nodes]
        scores = np.array([fit[1] + _log_prior(cylinder, node) for fit, node in zip(fits, nodes, strict=True)])
        place = fits[int(np.argmax(scores))][0]
        kept = nodes[scores > scores.max() - KEPT_NATS]
        step = 2 * half / (ACROSS - 1)
        low = np.maximum(kept.min(axis=0) - step, middle - half)
        high = np.minimum(kept.max(axis=0) + step, middle + half)
        shrunk = (high - low) / np.maximum(2 * half, 1e-12)
        middle, half = (low + high) / 2, (high - low) / 2
        if shrunk.min() > ENOUGH_SHRINKING:
            break
    return _grid(middle, half)


def _grid(middle: Array, half: Array) -> Array:
    line = np.linspace(-1.0, 1.0, ACROSS)
    steeper, larger = np.meshgrid(line if half[0] > 0 else [0.0], line if half[1] > 0 else [0.0])
    return middle + np.stack([steeper.ravel(), larger.ravel()], axis=1) * half


def _near(evidence: Evidence, cylinder: Cylinder, place_m: Array) -> Evidence:
    below = evidence.elevation_rad - cylinder.horizon_rad(place_m, evidence.azimuth_rad)
    return taken(evidence, (np.abs(below) < WINDOW_RAD) & (np.abs(evidence.llr) > TELLING_LLR))


def _log_sum(values: Array) -> float:
    top = float(np.max(values, initial=-np.inf))
    return top + float(np.log(np.sum(np.exp(values - top)))) if np.isfinite(top) else -np.inf
