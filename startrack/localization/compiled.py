"""The compiled search for a cylinder with hard edges: evidence to boxes, as the general search would give them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from startrack.localization.grid_search import taken
from startrack.localization.rim_plane import on_rim_plane
from startrack.localization.sector_likelihood import Sectors
from startrack.terrain import Cylinder, Terrain
from startrack.types import Array, Evidence

if TYPE_CHECKING:
    from startrack.localization.posterior import ExactPosterior

SCOUT_RAYS, SCOUT_ACROSS, SCOUT_KEPT = 200, 15, 3
FINEST_GUESS_M = 50.0
FIRST_STEP_M, LAST_STEP_M = 64.0, 4.0
CLIMB_RANGE_M = 600.0


def applies(evidence: Evidence, terrain: Terrain) -> bool:
    """Whether every ray's visible ground is a disk with a sharp edge."""
    return isinstance(terrain, Cylinder) and not evidence.edge_sigma_rad.any()


def climbed(
    start_m: Array, evidence: Evidence, cylinder: Cylinder, first_step_m: float, last_step_m: float
) -> tuple[Array, float]:
    """The best place (1, 2) near the start (1, 2) by a plain sum of the llr, and that sum. Needs numba."""
    from startrack.localization.disks_guess import climb

    evidence = taken(evidence, evidence.elevation_rad > 0)
    sector, ceiling = np.zeros(len(evidence), dtype=np.int64), np.zeros(1)
    place, best = climb(
        start_m[0], first_step_m, -on_rim_plane(evidence, cylinder), evidence.llr, sector, ceiling, -np.inf,
        cylinder.radius_m, 0.5 * last_step_m, CLIMB_RANGE_M,
    )  # fmt: skip
    return place[None, :], best


def explored(method: ExactPosterior, evidence: Evidence, cylinder: Cylinder) -> tuple[Array, float, Array, float]:
    """Centres (n, 2), half side, log-likelihoods (n,) and log of the mass dropped. Needs numba."""
    from startrack.localization import cylinder_kernel as disks
    from startrack.localization import disks_guess

    evidence = taken(evidence, evidence.elevation_rad > 0)  # below the horizontal nothing is ever visible over the rim
    centres, llr = -on_rim_plane(evidence, cylinder), evidence.llr
    if method.sector_epsilon > 0:
        sectors = Sectors.of(evidence, method.sector_width_rad, method.sector_epsilon)
        sector, ceiling, log_floor = sectors.sector, sectors.ceiling, float(np.log(method.sector_epsilon))
    else:  # without a floor the sectors do not matter
        sector, ceiling, log_floor = np.zeros(len(llr), dtype=np.int64), np.zeros(1), -np.inf
    radius, reach = cylinder.radius_m, cylinder.reach_m
    few = disks_guess.most_telling(centres, llr, radius, SCOUT_RAYS)
    guess = disks_guess.scout(centres[few], llr[few], radius, reach, SCOUT_ACROSS, SCOUT_KEPT, FINEST_GUESS_M)
    _, best = disks_guess.climb(
        guess, FIRST_STEP_M, centres, llr, sector, ceiling, log_floor, radius, LAST_STEP_M, CLIMB_RANGE_M
    )
    return disks.explore(
        centres, llr, sector, ceiling, log_floor, radius, reach, best, method.prune_nats, method.negligible_nats,
        method.finest_m, method.boxes_per_sigma, method.most_boxes,
    )  # fmt: skip
