"""Integrity of a fix: what it would be without each group of directions, and how far off it can be if one is wrong.

The posterior without a group is that of the other rows, computed on a grid about the fix where the terrain allows a
camera. It need not be normal: the edge of a single bright star is a step. Source: solution separation, as in Blanch et
al. 2015, IEEE Trans. AES 51(1), 713.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.local_search import LocalLikelihood
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Evidence, Fix, NotLocated

GROUPS = 8  # of azimuth, 45 degrees wide
DIVISIONS = 3  # into such groups, each turned by 15 degrees: an obstacle of up to 30 degrees is wholly in one group
RISK = 1e-3  # of an error beyond the protection level: half without an obstacle, half with one
WRONG_GROUP = 0.05  # probability that one of the groups shows something that is on no map
WIDER_CIRCLE = 1.05  # radius that holds all but half of RISK, in that of the 99.9 % circle; of a normal distribution
Grid = tuple[float, int]
Allowed = Callable[[Array], Bools]  # of offsets (n, 2) [m]: where a camera can stand
COARSE: Grid = (6.0, 13)  # reach in sigmas, and points across, of a grid
# Where the coarse grid does not do: closer points, and wider grids for wide posteriors.
FINE: tuple[Grid, ...] = ((6.0, 21), (15.0, 21), (40.0, 41))
SUSPICIOUS_CHI2 = 9.0  # on the coarse grid, from which on the fine ones decide
# At 2 sigma from point to point sums over a normal distribution are right to 1 %, at 0.6 sigma to 1e-10.
NODES = 5  # traced horizons along each side of the grid; interpolated between them, levels change by 1 %, at most 8 %
MATCHED = (0.8, 1.25)  # variances of the posterior, in those that the grid is made for
CENTRED = 0.5  # sigmas, from the middle of the grid to that of the posterior
MATCH_ROUNDS, WIDER_PART = 8, 0.02  # a grid too coarse or too small is replaced; part of its variance that stays
RIM_PART, RIM_MASS = 0.9, 1e-3  # of the grid's reach; a posterior with more mass beyond is not on the grid
CHUNK = 100  # points at which all rows are summed at once
MOST_CHI2 = 30.0  # of a separation (two coordinates); of 540 true positions of simulated stars the largest was 27
NEGLIGIBLE_SIGMAS = 0.7  # of the fix, added to the error of a separation: smaller ones are in its circle anyway
LEAST_PART = 1e-9  # of the covariance, added so that one on a single point of a grid can be inverted
MARGIN_1, MARGIN_M = 1.02, 2.0  # of the neighbourhood beyond the grid; a grid with closer points has a wider rim
WIDER = 1.5  # factor by which a neighbourhood that serves may exceed a grid with its margin
CARRIED_PART = 0.5  # of the information, by the groups that are named


@dataclass(frozen=True, eq=False)
class Integrity:
    """Solutions without one group of directions each."""

    first_azimuth_rad: Array  # (m,) where the groups begin, of all divisions
    separation_m: Array  # (m, 2) of the fix without the group from the fix; nan where the group alone holds it
    chi2: Array  # (m,) of the separation; 0 where there is none
    part: Array  # (GROUPS,) of the information about the position, in each group of the first division
    protection_level_m: float  # infinite where one group alone holds the fix

    def carriers(self) -> list[int]:
        """The fewest groups that hold half of the information, the strongest first."""
        order = np.argsort(-self.part, kind="stable")
        count = int(np.searchsorted(np.cumsum(self.part[order]), CARRIED_PART * self.part.sum())) + 1
        return [int(group) for group in order[:count] if self.part[group] > 0.0]


def assess_integrity(
    evidence: Evidence, position_m: Array, covariance_m2: Array, fix: Fix, terrain: Terrain
) -> Integrity:
    """The integrity of a fix.

    Args:
        evidence: the rows near the skyline that determine the position.
        position_m: (2,) close to their best one.
        covariance_m2: (2, 2) about that of the position by the rows, without errors that they share.
        fix: the posterior with these errors.
        terrain: with the evidence's enu.

    Raises NotLocated (inconsistent_evidence) where one group of directions contradicts the others.
    """
    grid = _GridScores(PositionLikelihood.from_evidence(evidence, terrain))
    groups = _divide(grid.likelihood.sectors.count)
    centre_m, covariance_m2, by_sector = _match_grid(grid, position_m, covariance_m2)
    allowed = _allowed_about(terrain, centre_m)
    found = _assess(lambda _: by_sector, covariance_m2, groups, fix, (COARSE,), allowed)
    suspicious = bool(found.chi2.max() > SUSPICIOUS_CHI2)
    if suspicious or not np.isfinite(found.protection_level_m):
        scores = partial(grid, centre_m, exact=suspicious)
        found = _assess(scores, covariance_m2, groups, fix, allowed=allowed)
    _require_agreement(found)
    return found


def _require_agreement(found: Integrity) -> None:
    worst = int(np.argmax(found.chi2))
    if found.chi2[worst] > MOST_CHI2:
        first = round(np.degrees(found.first_azimuth_rad[worst]))
        raise NotLocated(
            f"without the azimuths {first} to {(first + round(360 / GROUPS)) % 360} degrees the position would be "
            f"{np.linalg.norm(found.separation_m[worst]):.1f} m away, which their errors do not explain: is something "
            "there on no map, or the camera file wrong?",
            reason="inconsistent_evidence",
        )


def _divide(sectors: int) -> Array:
    """Which sectors of azimuth are in each group (DIVISIONS * GROUPS, sectors): 1 or 0."""
    number = np.arange(sectors)
    first = np.arange(DIVISIONS)[:, None] * sectors // (DIVISIONS * GROUPS)
    group = (number - first) % sectors * GROUPS // sectors
    return np.asarray(group[:, None] == np.arange(GROUPS)[:, None], dtype=np.float64).reshape(-1, sectors)


def _match_grid(scores: _GridScores, position_m: Array, covariance_m2: Array) -> tuple[Array, Array, Array]:
    """Position (2,) and covariance (2, 2) whose coarse grid fits the posterior by all rows, and the scores there."""
    for number in range(MATCH_ROUNDS):
        offsets_m, _ = _grid(covariance_m2, *COARSE, _allowed_about(scores.likelihood.terrain, position_m))
        by_sector = scores(position_m, offsets_m)
        (mean,), (spread,) = _moments(offsets_m, by_sector.sum(axis=1)[:, None])
        unit = np.linalg.inv(np.linalg.cholesky(covariance_m2))
        variances = np.linalg.eigvalsh(unit @ spread @ unit.T)
        off = float(np.linalg.norm(unit @ mean))
        if number == MATCH_ROUNDS - 1 or (MATCHED[0] < variances[0] and variances[1] < MATCHED[1] and off < CENTRED):
            break
        position_m, covariance_m2 = position_m + mean, spread + WIDER_PART * covariance_m2
    return position_m, covariance_m2, by_sector


def _allowed_about(terrain: Terrain, centre_m: Array) -> Allowed:
    return lambda offsets_m: terrain.allowed(centre_m + offsets_m)


def _anywhere(offsets_m: Array) -> Bools:
    return np.ones(len(offsets_m), dtype=bool)


def _grid(covariance_m2: Array, reach_sigmas: float, across: int, allowed: Allowed) -> tuple[Array, Bools]:
    """Offsets (n, 2) [m] in an ellipse that are allowed, or all if none is; which of them are at its rim (n,)."""
    line = reach_sigmas * np.linspace(-1.0, 1.0, across)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    radius = np.linalg.norm(points, axis=1)
    inside = radius <= reach_sigmas * (1 + 1e-9)
    offsets_m, is_rim = points[inside] @ np.linalg.cholesky(covariance_m2).T, radius[inside] > RIM_PART * reach_sigmas
    kept = allowed(offsets_m)
    return (offsets_m[kept], is_rim[kept]) if kept.any() else (offsets_m, is_rim)


@dataclass(eq=False)
class _GridScores:
    """Contributions of the sectors to the log-likelihood on grids, with the last neighbourhood that was prepared."""

    likelihood: PositionLikelihood
    _local: LocalLikelihood | None = None

    def __call__(self, centre_m: Array, offsets_m: Array, exact: bool = False) -> Array:
        """Contributions (n, sectors) at offsets (n, 2) from a position (2,); horizons are interpolated or `exact`."""
        reach_m = float(np.abs(offsets_m).max())
        local = self._local
        if local is None or not self._serves(local, centre_m, reach_m):
            half_m = MARGIN_1 * reach_m + MARGIN_M
            local = self._local = self.likelihood.near(centre_m, half_m, across=NODES)
        local = local if exact else local.interpolated()
        points = centre_m + offsets_m
        parts = [local.sums_by_sector(points[k : k + CHUNK]) for k in range(0, len(points), CHUNK)]
        return self.likelihood.sectors.by_sector(np.concatenate(parts))

    @staticmethod
    def _serves(local: LocalLikelihood, centre_m: Array, reach_m: float) -> bool:
        """Whether a neighbourhood holds a grid, and has nodes about as close as its own would have."""
        needed_m = float(np.abs(centre_m - local.centre_m).max()) + reach_m
        return needed_m <= local.half_m <= WIDER * (reach_m + MARGIN_M)


def _moments(offsets_m: Array, log: Array) -> tuple[Array, Array]:
    """Means (m, 2) and covariances (m, 2, 2) of m distributions on the offsets (n, 2), of log-densities (n, m)."""
    mass = _masses(log)
    mean = mass.T @ offsets_m
    away = offsets_m - mean[:, None]
    return mean, np.asarray(np.einsum("nm,mni,mnj->mij", mass, away, away))


def _masses(log: Array) -> Array:
    """Shares (n, m) of the points of a grid in distributions of log-densities (n, m)."""
    mass = np.exp(log - log.max(axis=0))
    return np.asarray(mass / mass.sum(axis=0))


def _assess(
    scores: Callable[[Array], Array],
    covariance_m2: Array,
    groups: Array,
    fix: Fix,
    grids: tuple[Grid, ...] = FINE,
    allowed: Allowed = _anywhere,
) -> Integrity:
    """Integrity from the contributions of the sectors at offsets, `scores`: (n, 2) to (n, sectors).

    `covariance_m2` is about that of the posterior by all sectors, `groups` (m, sectors) has 1 for those of a group.
    Only `allowed` offsets count.
    """
    mean, without = np.full((len(groups), 2), np.nan), np.full((len(groups), 2, 2), np.inf)
    for number, (reach_sigmas, across) in enumerate(grids):
        offsets_m, is_rim = _grid(covariance_m2, reach_sigmas, across, allowed)
        by_sector = scores(offsets_m)
        whole = by_sector.sum(axis=1)[:, None]
        if number == 0:
            (best,), (covariance,) = _moments(offsets_m, whole)
        rest = whole - by_sector @ groups.T
        new = np.isnan(mean[:, 0]) & (_masses(rest)[is_rim].sum(axis=0) < RIM_MASS)
        mean[new], without[new] = (found[new] for found in _moments(offsets_m, rest))
        if np.isfinite(mean).all():
            break
    return _conclude(best, covariance, mean, without, fix)


def _conclude(best: Array, covariance: Array, mean: Array, without: Array, fix: Fix) -> Integrity:
    """Integrity from the posterior by all rows, and from those without each group: means (m, 2), nan if it is open."""
    held = np.isfinite(mean[:, 0])
    shared = _positive_part(fix.covariance_m2 - covariance)
    separation, chi2, level = mean - best, np.zeros(len(mean)), np.full(len(mean), np.inf)
    scatter = _positive_part(without[held] - covariance) + shared + NEGLIGIBLE_SIGMAS**2 * fix.covariance_m2
    chi2[held] = np.einsum("mi,mij,mj->m", separation[held], np.linalg.inv(scatter), separation[held])
    spread = np.sqrt(-2.0 * np.log(0.5 * RISK / WRONG_GROUP) * np.linalg.eigvalsh(without[held] + shared)[:, 1])
    level[held] = np.linalg.norm(separation[held], axis=1) + spread
    known = np.zeros_like(without)
    known[held] = np.linalg.inv(without[held] + LEAST_PART * covariance)
    part = np.maximum(2.0 - np.einsum("gij,ij->g", known[:GROUPS], covariance), 0.0)
    first = np.arange(GROUPS) / GROUPS + np.arange(DIVISIONS)[:, None] / (DIVISIONS * GROUPS)
    return Integrity(
        2 * np.pi * first.ravel(), separation, chi2, part / max(part.sum(), np.finfo(float).tiny),
        max(float(level.max()), WIDER_CIRCLE * fix.radius999_m),
    )  # fmt: skip


def _positive_part(matrices: Array) -> Array:
    """Symmetric matrices (..., n, n) with 0 in place of negative eigenvalues."""
    sizes, axes = np.linalg.eigh(matrices)
    return np.asarray((axes * np.maximum(sizes, 0.0)[..., None, :]) @ np.swapaxes(axes, -1, -2))
