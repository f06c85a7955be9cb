"""Log-likelihoods about one place: the rays that its neighbourhood leaves open, against horizons worked out once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from startrack.localization.prefix_sums import Profile
from startrack.localization.sector_likelihood import Sectors, contribution
from startrack.terrain import Terrain
from startrack.terrain.horizon_interpolator import HorizonInterpolator
from startrack.types import Array, Ints

COMPASS = np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)], dtype=np.float64)


@dataclass(frozen=True)
class Vicinity:
    """What the evidence says of places within `half_m` of one, and how it changes where all elevations change.

    The log-likelihoods are those of all rays: what lies too far from the skyline to change is summed up beforehand.
    """

    ground: Terrain
    azimuth_rad: Array  # (n,) of the open rays
    elevation_rad: Array
    llr: Array
    sigma_rad: Array  # of the edge
    sector: Ints
    visible: Array  # (sectors,) sums of the rays that are visible all the same
    ceiling: Array  # (sectors,)
    epsilon: float

    @classmethod
    def of(
        cls, sectors: Sectors, profile: Profile, terrain: Terrain, place_m: Array, half_m: float,
        leeway_rad: float = 0.0, across: int = 3,
    ) -> Vicinity:  # fmt: skip
        """About a place (2,) [m], for elevations that change by no more than the leeway."""
        first, last = profile.open_rays(terrain, place_m[None], half_m, leeway_rad)
        rays = profile.pairs(first, last)[1]
        e = profile.evidence
        sigma = np.hypot(e.edge_sigma_rad[rays], terrain.horizon_sigma_rad(place_m[None], e.azimuth_rad[rays]))
        return cls(
            ground=terrain.near(place_m, half_m, e.azimuth_rad[rays], across),
            azimuth_rad=e.azimuth_rad[rays],
            elevation_rad=e.elevation_rad[rays],
            llr=e.llr[rays],
            sigma_rad=sigma,
            sector=profile.sector[rays],
            visible=profile.sums(first, last)[0][0],
            ceiling=sectors.ceiling,
            epsilon=sectors.epsilon,
        )

    def scores(self, places_m: Array, elevation_rad: Array | None = None) -> Array:
        """Log-likelihoods (n,) of places (n, 2), the rays standing at other elevations where these are given."""
        elevation = self.elevation_rad if elevation_rad is None else elevation_rad
        if isinstance(self.ground, HorizonInterpolator):
            from startrack.localization import local_search_kernel as vicinity_compiled

            found = np.empty(len(places_m))
            fill: Any = vicinity_compiled.scores
            fill(*self._fixed, np.ascontiguousarray(places_m), np.tan(elevation), found)
            return found
        horizon = self.ground.horizon_rad(places_m[:, None], self.azimuth_rad)
        value = contribution(self.llr, elevation, horizon, self.sigma_rad)
        n, count = len(places_m), len(self.ceiling)
        key = np.arange(n)[:, None] * count + self.sector
        sums = np.bincount(key.ravel(), weights=value.ravel(), minlength=n * count).reshape(n, count)
        return self._sectors.score(self.visible + sums)

    def climbed(
        self, place_m: Array, first_step_m: float, last_step_m: float, elevation_rad: Array | None = None
    ) -> tuple[Array, float]:
        """Best place (2,) near the start and its log-likelihood: steps to the best of 8 neighbours, ever shorter.

        Whether a camera can stand there is not asked.
        """
        elevation = self.elevation_rad if elevation_rad is None else elevation_rad
        if isinstance(self.ground, HorizonInterpolator):
            from startrack.localization import local_search_kernel as vicinity_compiled

            start = np.ascontiguousarray(place_m, dtype=np.float64)
            rise = np.tan(elevation)
            climb: Any = vicinity_compiled.climb
            east, north, best = climb(*self._fixed, start, first_step_m, last_step_m, rise)
            return np.array([east, north]), best
        place, step, best = np.asarray(place_m, dtype=np.float64), first_step_m, -np.inf
        while step >= last_step_m:
            around = place + step * COMPASS
            score = self.scores(around, elevation)
            top = int(np.argmax(score))
            if score[top] > best:
                place, best = around[top], float(score[top])
            else:
                step /= 2
        return place, best

    def turned(self, turn_rad: float) -> Vicinity:
        """The same rays at azimuths so much larger; horizons are asked at four corners only."""
        azimuth = np.mod(self.azimuth_rad + turn_rad, 2 * np.pi)
        near = self.ground
        if isinstance(near, HorizonInterpolator):
            near = near.whole.near(near.centre_m, near.half_m, azimuth, 2)
        return replace(self, azimuth_rad=azimuth, ground=near)

    @cached_property
    def _sectors(self) -> Sectors:
        from startrack.types import Evidence

        none = np.zeros(0)
        rays = Evidence(azimuth_rad=none, elevation_rad=none, llr=none, edge_sigma_rad=none)
        return Sectors(rays, np.zeros(0, dtype=np.int64), self.ceiling, self.epsilon)

    @cached_property
    def _fixed(self) -> tuple[Any, ...]:
        near = self.ground
        assert isinstance(near, HorizonInterpolator)
        column = near.column(self.azimuth_rad)[0]
        where = near.middle_up_m, float(near.centre_m[0]), float(near.centre_m[1]), float(near.half_m)
        return (
            near.whole.ground, np.ascontiguousarray(near.nodes[column]), near.per_height[column], *where, self.llr,
            np.ascontiguousarray(self.sigma_rad), self.sector, self.visible, self.ceiling, self.epsilon,
        )  # fmt: skip
