"""Log-likelihoods of positions near one: the rows that stay open nearby, against horizons prepared once."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import floor
from typing import Any, cast

import numpy as np

from startrack.frames import R_from_rotvec, turn_azel
from startrack.kernels import njit
from startrack.localization.prefix_sums import PrefixSums
from startrack.localization.score_kernel import log_mixtures, score_disks
from startrack.localization.sector_likelihood import Sectors, contributions, row_contribution
from startrack.localization.sky_profiles import SkyProfiles
from startrack.terrain import Terrain
from startrack.terrain.horizon_kernel import surfaces
from startrack.types import Array, Evidence, Ints

COMPASS = np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)], dtype=np.float64)


@dataclass(frozen=True)
class LocalLikelihood:
    """Log-likelihood of positions within `half_m` of one, all rows counted.

    Rows too far from the skyline to change there are summed beforehand. Elevations may be replaced within the leeway
    of `near`, which serves the horizon's bias.
    """

    terrain: Terrain
    ground: Terrain  # the same, prepared for the neighbourhood
    centre_m: Array  # (2,)
    half_m: float
    evidence: Evidence  # the open rows
    sigma_rad: Array  # (n,) of the edge, with the terrain's
    sector: Ints
    settled: Array  # (sectors,) sums of the visible settled rows, less the ceilings
    ceiling: Array  # (sectors,)
    log_floor: float
    stars: Ints | slice  # which of the open rows are points of light
    profiles: SkyProfiles | None  # of the rows of extended light

    @classmethod
    def near(
        cls, sectors: Sectors, sums: PrefixSums, terrain: Terrain, centre_m: Array, half_m: float,
        leeway_rad: float = 0.0, across: int = 3,
    ) -> LocalLikelihood:  # fmt: skip
        """About a position (2,) [m], for elevations that change by no more than the leeway."""
        first, last = sums.open_rays(terrain, centre_m[None], half_m, leeway_rad)
        rows = sums.pairs(first, last)[1]
        e = sums.evidence.take(rows)
        map_sigma = terrain.horizon_sigma_rad(centre_m[None], e.azimuth_rad)
        is_extended = e.extended_nats * e.edge_sigma_rad > 0.0
        extended = np.flatnonzero(is_extended)
        return cls(
            terrain=terrain,
            ground=terrain.near(centre_m, half_m, e.azimuth_rad, across),
            centre_m=centre_m,
            half_m=half_m,
            evidence=e,
            sigma_rad=np.hypot(e.edge_sigma_rad, map_sigma),
            sector=sums.sector[rows],
            settled=sums.sums(first, last)[0][0] - sectors.ceiling,
            ceiling=sectors.ceiling,
            log_floor=sectors.log_floor,
            stars=np.flatnonzero(~is_extended) if len(extended) else slice(None),
            profiles=SkyProfiles.from_rows(e, extended, map_sigma) if len(extended) else None,
        )

    def scores(self, points_m: Array, elevation_rad: Array | None = None) -> Array:
        """Log-likelihoods (n,) of positions (n, 2), the rows at other elevations where these are given."""
        return self._scorer(elevation_rad)(points_m)

    def climb(
        self, start_m: Array, first_step_m: float, last_step_m: float, elevation_rad: Array | None = None
    ) -> tuple[Array, float]:
        """Best position (2,) near the start and its log-likelihood: steps to the best of 8 neighbours, ever shorter.

        Positions where no camera can stand are not excluded.
        """
        score = self._scorer(elevation_rad)
        position, step, best = np.asarray(start_m, dtype=np.float64), first_step_m, -np.inf
        while step >= last_step_m:
            around = position + step * COMPASS
            found = score(around)
            top = int(np.argmax(found))
            if found[top] > best:
                position, best = around[top], float(found[top])
            else:
                step /= 2
        return position, best

    def _scorer(self, elevation_rad: Array | None) -> Callable[[Array], Array]:
        """Positions (n, 2) to log-likelihoods (n,), by interpolated horizons, by disks, or by the terrain itself."""
        which = self.stars
        e = self.evidence if isinstance(which, slice) else self.evidence.take(which)
        elevation = e.elevation_rad if elevation_rad is None else elevation_rad[which]
        sigma, sector = self.sigma_rad[which], self.sector[which]
        nodes = self.ground.interpolation(e.azimuth_rad)
        disks = None if nodes is not None or sigma.any() else self.terrain.visible_disks(e.azimuth_rad, elevation)

        def score(points_m: Array) -> Array:
            points, found = np.ascontiguousarray(points_m, dtype=np.float64), np.empty(len(points_m))
            rest = sector, self._settled_at(points, elevation_rad), self.log_floor
            if nodes is not None:
                rise, fill = np.tan(elevation), cast(Any, _score_nodes)
                fill(nodes, rise, e.llr, e.extended_nats, sigma, *rest, points, found)
            elif disks is not None:
                score_disks(*disks, e.llr, *rest, points, found)
            else:
                horizon, settled = self.ground.horizon_rad(points[:, None], e.azimuth_rad), rest[1]
                for k in range(len(points)):
                    value = contributions(e.llr, e.extended_nats, elevation, horizon[k], sigma)
                    sums = np.bincount(sector, weights=value, minlength=settled.shape[1])
                    found[k] = log_mixtures(settled[k % len(settled)] + sums, self.log_floor)
            return found

        return score

    def _settled_at(self, points_m: Array, elevation_rad: Array | None) -> Array:
        """Sums (n or 1, sectors) of the settled rows and of the extended light, less the ceilings, at points (n, 2)."""
        if self.profiles is None:
            return self.settled[None]
        row = self.profiles.row
        horizon = self.ground.horizon_rad(points_m[:, None], self.evidence.azimuth_rad[row])
        if elevation_rad is not None:
            horizon = horizon + (self.evidence.elevation_rad - elevation_rad)[row]
        sums = np.repeat(self.settled[None], len(points_m), axis=0)
        self.profiles.add_sums(horizon, self.sector[row], sums)
        return sums


def turn_rays(evidence: Evidence, rotvec_rad: Array) -> Evidence:
    """The rows with their directions turned by a rotation vector (3,) in enu."""
    azimuth, elevation = turn_azel(*rays_of(evidence), R_from_rotvec(rotvec_rad))
    return replace(evidence, azimuth_rad=azimuth, elevation_rad=elevation)


def rays_of(evidence: Evidence) -> tuple[Array, Array]:
    """Azimuths and elevations (n,), (n,) [rad]."""
    return evidence.azimuth_rad, evidence.elevation_rad


@njit(cache=True, nogil=True)
def _score_nodes(nodes, rise, llr, extended, sigma, sector, settled, log_floor, points, found):
    """Fill found (n,) with the log-likelihoods of points (n, 2); rise (rows,): tan of the rows' elevations.

    settled (n or 1, sectors): sums of the other rows, at each point or everywhere.
    """
    across = nodes.nodes.shape[1]
    scale = (across - 1) / (2 * nodes.half_m)
    sums, up = np.empty(settled.shape[1]), np.empty(1)
    for p in range(len(found)):
        for s in range(len(sums)):
            sums[s] = settled[p % len(settled), s]
        x, y = (
            (points[p, 0] - nodes.east_m + nodes.half_m) * scale,
            (points[p, 1] - nodes.north_m + nodes.half_m) * scale,
        )
        surfaces(nodes.ground, points[p : p + 1], up)
        higher = up[0] - nodes.middle_up_m
        i, j = min(max(floor(x), 0), across - 2), min(max(floor(y), 0), across - 2)
        u, v = x - i, y - j
        a, b, c, d = (1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v
        for k in range(len(llr)):
            n = nodes.nodes[k]
            tan = a * n[i, j] + b * n[i, j + 1] + c * n[i + 1, j] + d * n[i + 1, j + 1] - higher * nodes.per_height[k]
            above = (rise[k] - tan) / (1.0 + rise[k] * tan)  # tan of the difference
            if sigma[k] > 0.0:
                sums[sector[k]] += row_contribution(llr[k], extended[k], above / sigma[k], 0)
            elif above > 0.0:
                sums[sector[k]] += llr[k]
        found[p] = log_mixtures(sums, log_floor)
