"""Integrity of a fix: what it would be without each group of directions, and how far off it can be if one is wrong.

The posterior without a group is that of the other sectors, computed on a grid about the fix where the terrain allows a
camera, with the shared errors that suit each position. It need not be normal: the edge of a single bright star is a
step. Source: solution separation, as in Blanch et al. 2015, IEEE Trans. AES 51(1), 713.
"""

from __future__ import annotations

import numpy as np

from startrack.core.types import SECTORS, Array, Bools, Integrity
from startrack.localization.likelihood.obstacle_chain import clear_emissions
from startrack.localization.likelihood.skyline_model import SkylineModel
from startrack.localization.likelihood.skyline_profiles import Profiles

GROUPS = 8  # of azimuth, 45 degrees wide
DIVISIONS = 3  # into such groups, each turned by 15 degrees: an obstacle of up to 30 degrees is wholly in one group
RISK = 1e-3  # of an error beyond the protection level: half without an obstacle, half with one
WRONG_GROUP = 0.05  # probability that one of the groups shows something that is on no map
WIDER_CIRCLE = 1.05  # radius that holds all but half of RISK, in that of the 99.9 % circle; of a normal distribution
# Reach in sigmas and points across of the grids: wider ones where a group is missed much. At 2 sigma from point to
# point sums over a normal distribution are right to 1 %, and what is left without a group is wider.
GRIDS = ((6.0, 13), (15.0, 17), (40.0, 25))
RIM_PART, RIM_MASS = 0.9, 1e-3  # of the grid's reach; a posterior with more mass beyond is not on the grid
TINY_PART = 1e-9  # of the covariance, added so that one on a single point of a grid can be inverted


def assess_integrity(
    model: SkylineModel,
    parameters: Array,
    covariance_m2: Array,
    clear: Array,
    lit: Array,
    whole_m2: Array,
    radius999_m: float,
) -> Integrity:
    """Integrity of a fix: its separations without each group of directions, and its protection level.

    Args:
        model: the likelihood near it.
        parameters: (2 + k,) of the fix.
        covariance_m2: (2, 2) about that of the position where the shared errors suit it.
        clear: (SECTORS,) probabilities that a sector shows the map's skyline.
        lit: (SECTORS,) probabilities that its light has an edge of its own.
        whole_m2: (2, 2) covariance of the position with all errors.
        radius999_m: of the fix.
    """
    groups = _divide()
    mean, without = np.full((len(groups), 2), np.nan), np.full((len(groups), 2, 2), np.inf)
    for number, (reach, across) in enumerate(GRIDS):
        offsets, is_rim = _grid(model, parameters[:2], covariance_m2, reach, across)
        by_sector, prior = _sector_logs(model, parameters, offsets, clear, lit)
        whole = by_sector.sum(axis=1)[:, None] + prior[:, None]
        if number == 0:
            (best,), (covariance,) = _moments(offsets, whole)
            covariance = covariance + TINY_PART * covariance_m2
        rest = whole - by_sector @ groups.T
        new = np.isnan(mean[:, 0]) & (_masses(rest)[is_rim].sum(axis=0) < RIM_MASS)
        mean[new], without[new] = (found[new] for found in _moments(offsets, rest))
        if np.isfinite(mean).all():
            break
    return _conclude(best, covariance, mean, without, whole_m2, radius999_m)


def _divide() -> Array:
    """Membership (DIVISIONS * GROUPS, SECTORS), 1 or 0, of each sector of azimuth in each group."""
    first = np.arange(DIVISIONS)[:, None] * SECTORS // (DIVISIONS * GROUPS)
    group = (np.arange(SECTORS) - first) % SECTORS * GROUPS // SECTORS
    return np.asarray(group[:, None] == np.arange(GROUPS)[:, None], dtype=np.float64).reshape(-1, SECTORS)


def _grid(model: SkylineModel, middle_m: Array, covariance_m2: Array, reach: float, across: int) -> tuple[Array, Bools]:
    """Offsets (n, 2) [m] in an ellipse where a camera can stand, or all if none can; whether they are at its rim."""
    line = reach * np.linspace(-1.0, 1.0, across)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    radius = np.linalg.norm(points, axis=1)
    inside = radius <= reach * (1 + 1e-9)
    offsets, is_rim = points[inside] @ np.linalg.cholesky(covariance_m2).T, radius[inside] > RIM_PART * reach
    kept = np.asarray(model.terrain.allowed(middle_m + offsets))
    return (offsets[kept], is_rim[kept]) if kept.any() else (offsets, is_rim)


def _sector_logs(
    model: SkylineModel, parameters: Array, offsets: Array, clear: Array, lit: Array
) -> tuple[Array, Array]:
    """Log-likelihoods (n, SECTORS) of the sectors at offsets (n, 2), and logarithms (n,) of the errors' densities.

    The stars alone count where the light rather has an edge of its own (`lit`) than ends at the skyline (`clear`).
    """
    moved = model.with_likely_errors(parameters[:2] + offsets, clear)
    shifts, lifts, log_integral = model.with_linear_errors(model.shifts(moved))
    logs = clear_logs(model.seen.profiles, shifts, clear, model.seen.gains(shifts, lifts))
    if model.seen.edge is not None:
        logs = np.where(lit > clear, clear_logs(model.seen.stars.profiles, shifts, np.minimum(clear + lit, 1.0)), logs)
    return logs, log_integral + model.basis.log_prior(moved[:, 2:])


def clear_logs(profiles: Profiles, shifts: Array, clear: Array, gains: Array | None = None) -> Array:
    """Log-likelihoods (n, SECTORS) where sectors show the map's skyline with probabilities `clear` (SECTORS,).

    `shifts` (n, SECTORS) [rad] are of the skyline, which has the `profiles`; `gains` (n, SECTORS) are those of the
    light by errors of the image, None: 0.
    """
    return np.asarray(np.log(clear * clear_emissions(profiles, shifts, gains) + 1.0 - clear))


def _moments(offsets_m: Array, logs: Array) -> tuple[Array, Array]:
    """Means (m, 2) and covariances (m, 2, 2) of m distributions on the offsets (n, 2), of log-densities (n, m)."""
    mass = _masses(logs)
    mean = mass.T @ offsets_m
    away = offsets_m - mean[:, None]
    return mean, np.asarray(np.einsum("nm,mni,mnj->mij", mass, away, away))


def _masses(logs: Array) -> Array:
    """Shares (n, m) of the points of a grid in distributions of log-densities (n, m)."""
    mass = np.exp(logs - logs.max(axis=0))
    return np.asarray(mass / mass.sum(axis=0))


def _conclude(
    best: Array, covariance: Array, mean: Array, without: Array, whole_m2: Array, radius999_m: float
) -> Integrity:
    """Integrity from the posterior by all rows, and from those without each group: means (m, 2), nan if it is open.

    `without` (m, 2, 2) are their covariances, `covariance` that by all rows.
    """
    held = np.isfinite(mean[:, 0])
    shared, level = _positive_part(whole_m2 - covariance), np.full(len(mean), np.inf)
    spread = np.sqrt(-2.0 * np.log(0.5 * RISK / WRONG_GROUP) * np.linalg.eigvalsh(without[held] + shared)[:, 1])
    level[held] = np.linalg.norm(mean[held] - best, axis=1) + spread
    known = np.zeros_like(without)
    known[held] = np.linalg.inv(without[held] + TINY_PART * covariance)
    part = np.maximum(2.0 - np.einsum("gij,ij->g", known[:GROUPS], covariance), 0.0)
    first = np.arange(GROUPS) / GROUPS + np.arange(DIVISIONS)[:, None] / (DIVISIONS * GROUPS)
    return Integrity(
        2 * np.pi * first.ravel(), mean - best, part / max(part.sum(), np.finfo(float).tiny),
        max(float(level.max()), WIDER_CIRCLE * radius999_m),
    )  # fmt: skip


def _positive_part(matrix: Array) -> Array:
    """A symmetric matrix (n, n) with 0 in place of negative eigenvalues."""
    sizes, axes = np.linalg.eigh(matrix)
    return np.asarray((axes * np.maximum(sizes, 0.0)) @ axes.T)
