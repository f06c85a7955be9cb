"""Integrity of a fix: what it would be without each group of directions, and how far off it can be if one is wrong.

Near the fix the log-likelihood of each group of directions is close to a quadratic. Their sum gives the fix, and the
sum without one group gives the fix without it. Source: solution separation, as in Blanch et al. 2015, IEEE Trans. AES
51(1), 713.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localization.likelihood import PositionLikelihood
from startrack.terrain import Terrain
from startrack.types import Array, Evidence, Fix, NotLocated

GROUPS = 8  # of azimuth, 45 degrees wide: an obstacle on no map is narrower
RISK = 1e-3  # of an error beyond the protection level
WRONG_GROUP = 0.05  # probability that one of the groups shows something that is on no map
RINGS, POINTS_ON_RING = 5, 16  # points about the fix to which the quadratics are fitted
REACHES_SIGMAS = (2.5, 7.5)  # of the outer ring; the wider one where a group alone holds the fix in one direction
MOST_CHI2 = 25.0  # of a separation of two coordinates; see docs/trust.md
UNIMPORTANT_SIGMAS = 0.5  # of the fix: a separation of that size is no contradiction, whatever its own error
MARGIN_M = 2.0  # of the neighbourhood beyond the points
CARRIED_PART = 0.5  # of the information, by the groups that are named


@dataclass(frozen=True, eq=False)
class Integrity:
    """Solutions without one group of directions each."""

    first_azimuth_rad: Array  # (g,) where the groups begin
    part: Array  # (g,) of the information about the position, in each
    separation_m: Array  # (g, 2) of the fix without the group from the fix
    chi2: Array  # (g,) of the separation
    protection_level_m: float  # infinite where one group alone holds the fix

    def carriers(self) -> list[int]:
        """The fewest groups that hold half of the information, the strongest first."""
        order = np.argsort(-self.part, kind="stable")
        count = int(np.searchsorted(np.cumsum(self.part[order]), CARRIED_PART * self.part.sum())) + 1
        return [int(group) for group in order[:count]]


def assess_integrity(
    evidence: Evidence, position_m: Array, covariance_m2: Array, fix: Fix, terrain: Terrain
) -> Integrity:
    """The integrity of a fix.

    Args:
        evidence: the rows near the skyline that determine the position.
        position_m: (2,) close to their best one.
        covariance_m2: (2, 2) of the position by the rows, without errors that they share.
        fix: the posterior with these errors.
        terrain: with the evidence's enu.

    Raises NotLocated (inconsistent_evidence) where one group of directions contradicts the others.
    """
    likelihood = PositionLikelihood.from_evidence(evidence, terrain)
    count = likelihood.sectors.count
    group = np.arange(count) * GROUPS // count
    for reach_sigmas in REACHES_SIGMAS:
        offsets_m = _offsets(covariance_m2, reach_sigmas)
        local = likelihood.near(position_m, float(np.abs(offsets_m).max()) + MARGIN_M)
        by_sector = likelihood.sectors.by_sector(local.sums_by_sector(position_m + offsets_m))
        by_group = np.stack([by_sector[:, group == g].sum(axis=1) for g in range(GROUPS)], axis=1)
        found = _separate(*_quadratics(offsets_m, by_group), fix)
        if np.isfinite(found.protection_level_m):
            break
    _require_agreement(found)
    return found


def _require_agreement(found: Integrity) -> None:
    worst = int(np.argmax(found.chi2))
    if found.chi2[worst] > MOST_CHI2:
        first = round(np.degrees(found.first_azimuth_rad[worst]))
        raise NotLocated(
            f"without the azimuths {first} to {first + round(360 / GROUPS)} degrees the position would be "
            f"{np.linalg.norm(found.separation_m[worst]):.1f} m away, which their errors do not explain: is something "
            "there on no map, or the camera file wrong?",
            reason="inconsistent_evidence",
        )


def _offsets(covariance_m2: Array, reach_sigmas: float) -> Array:
    """Points (n, 2) [m] on rings by a covariance (2, 2)."""
    angle = 2 * np.pi * np.arange(POINTS_ON_RING) / POINTS_ON_RING
    radius = reach_sigmas * (np.arange(RINGS) + 1) / RINGS
    rings = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(rings.reshape(-1, 2) @ np.linalg.cholesky(covariance_m2).T)


def _quadratics(offsets_m: Array, values: Array) -> tuple[Array, Array]:
    """Slopes (g, 2) at the middle and information (g, 2, 2) of the values (n, g) [nats] at offsets (n, 2) [m]."""
    x, y = offsets_m.T
    design = np.stack([np.ones_like(x), x, y, -0.5 * x * x, -x * y, -0.5 * y * y], axis=1)
    scale = np.sqrt(np.mean(np.square(design), axis=0))
    ring = np.repeat((np.arange(RINGS) + 1) / RINGS, POINTS_ON_RING)
    weight = np.exp(-np.square(1.25 * ring))[:, None]  # the middle counts most
    found = (np.linalg.lstsq(weight * design / scale, weight * values, rcond=None)[0] / scale[:, None]).T
    return found[:, 1:3], np.stack([found[:, [3, 4]], found[:, [4, 5]]], axis=1)


def _separate(slopes: Array, information: Array, fix: Fix) -> Integrity:
    """The fixes without each group, from the groups' quadratics."""
    whole = information.sum(axis=0)
    covariance = np.linalg.inv(whole) if np.linalg.eigvalsh(whole)[0] > 0.0 else fix.covariance_m2
    best = covariance @ slopes.sum(axis=0)
    shared = fix.covariance_m2 - covariance  # of errors that all directions share
    shared = shared if np.linalg.eigvalsh(shared)[0] > 0.0 else np.zeros((2, 2))
    separation, chi2, level = np.zeros((len(slopes), 2)), np.zeros(len(slopes)), fix.radius999_m
    for g in range(len(slopes)):
        rest = whole - information[g]
        if np.linalg.eigvalsh(rest)[0] <= 0.0:  # the group alone holds the fix in one direction
            separation[g], level = np.nan, np.inf
            continue
        without = np.linalg.inv(rest)
        separation[g] = without @ (slopes.sum(axis=0) - slopes[g]) - best
        extra = without - covariance + UNIMPORTANT_SIGMAS**2 * covariance
        chi2[g] = separation[g] @ np.linalg.solve(extra, separation[g])
        largest = float(np.linalg.eigvalsh(without + shared)[1])
        spread = np.sqrt(-2.0 * np.log(RISK / WRONG_GROUP) * largest)
        level = max(level, float(np.linalg.norm(separation[g])) + float(spread))
    part = np.array([np.trace(one @ covariance) for one in information]) / 2
    first = 2 * np.pi * np.arange(len(slopes)) / len(slopes)
    return Integrity(first, part, separation, chi2, level)
