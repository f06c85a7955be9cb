"""The errors that frames of a track share (horizon, clock, a crater's shape, skyline), and those of each image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from startrack.localization import clock_at, clock_matters
from startrack.pipeline import NO_TIME
from startrack.sky_errors import EDGE_SIGMA_PX
from startrack.terrain import Terrain
from startrack.types import Array, BadInput, Clock, Evidence, Exposure

BIAS, CLOCK, STEEPNESS, EDGE = "horizon_bias_rad", "clock_s", "steepness_1", "edge_px"
SHAPES = STEEPNESS, "size_1"
COARSEST_PX_PER_RAD = 100.0  # of a lens: for a bound


@dataclass(frozen=True, eq=False)
class ImageErrors:
    """Errors of attitude and lens [px]: they raise the skyline of the sky's light, not that of the stars."""

    raised_rad: Array  # (sectors, j) of equal width from north on, by one px of each, the first all around; 0: unused
    covariance: Array  # (j, j)

    def without_edge(self, shared: SharedErrors) -> ImageErrors:
        """These without the error of the whole skyline, where it is among the errors `shared` by all images."""
        if EDGE not in shared.names:
            return self
        own = self.covariance.copy()
        own[0, 0] -= EDGE_SIGMA_PX**2
        return replace(self, covariance=own)

    def at(self, azimuth_rad: Array) -> Array:
        """Rises (n, j) [rad] at azimuths (n,), by one unit of each."""
        sector = (azimuth_rad / (2 * np.pi) * len(self.raised_rad)).astype(np.int64) % len(self.raised_rad)
        return np.asarray(self.raised_rad[sector])


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Names and standard deviations (k,) of the shared errors, in the units that their names end with."""

    names: tuple[str, ...]
    sigma: Array  # (k,)
    turn_rad_s: Array  # (3,) of the sky, in enu

    @classmethod
    def of(cls, terrain: Terrain, clock: Clock | None, uses_sky: bool = False) -> Self:
        """Those of a terrain, of a clock that matters on it, and of the skyline that the sky's light shows.

        `uses_sky`: whether the light of the sky is part of the evidence.
        """
        stated = {BIAS: terrain.common_sigma_rad, **dict(zip(SHAPES, terrain.shape_sigma, strict=True))}
        turn = np.zeros(3)
        if clock is not None and clock_matters(clock, terrain):
            stated[CLOCK], turn = clock.sigma_s, clock.turn_rad_s
        if uses_sky:
            stated[EDGE] = EDGE_SIGMA_PX
        known = {name: sigma for name, sigma in stated.items() if sigma > 0.0}
        return cls(tuple(known), np.array(list(known.values())), turn)

    @classmethod
    def of_exposure(cls, terrain: Terrain, exposure: Exposure, uses_sky: bool = False) -> Self:
        """Those of a `terrain`, of the clock of an `exposure`, and with `uses_sky` of the skyline in the sky's light.

        Raises BadInput (no_time, bad_terrain) where the exposure has no time, or the terrain no site.
        """
        if exposure.time_utc is None:
            raise BadInput("no_time", "; ".join([NO_TIME, *exposure.warnings]))
        if terrain.site is None:
            raise BadInput("bad_terrain", f"terrain {terrain.name} has no site")
        return cls.of(terrain, clock_at(terrain.site, exposure.time_utc, exposure.time_sigma_s), uses_sky)

    def of_terrain(self, terrain: Terrain) -> Self:
        """The same clock and skyline above another `terrain`."""
        own, kept = type(self).of(terrain, None), [name for name in self.names if name in (CLOCK, EDGE)]
        sigma = [self.sigma[self.names.index(name)] for name in kept]
        return type(self)((*own.names, *kept), np.append(own.sigma, sigma), self.turn_rad_s)

    def shape_axis(self, name: str) -> int:
        """Which of the two numbers of `Terrain.reshaped` the error `name` is."""
        return SHAPES.index(name)

    def taken(self, evidence: Evidence) -> Array:
        """(k,) what the directions of the evidence already include, in standard deviations."""
        clock = evidence.clock
        offset_s = 0.0 if clock is None else clock.offset_s
        return np.array([offset_s if name == CLOCK else 0.0 for name in self.names]) / self.sigma

    def reach_rad(self, evidence: Evidence) -> float:
        """About the change of the heights in `evidence` above the horizon with one standard deviation of all errors."""
        reach = 0.0
        for name, sigma in zip(self.names, self.sigma, strict=True):
            if name == BIAS:
                reach += sigma
            elif name == CLOCK:
                reach += sigma * float(np.hypot(*self.turn_rad_s[:2]))
            elif name == EDGE:
                reach += sigma / COARSEST_PX_PER_RAD
            else:
                reach += 0.35 * sigma  # d tan H / tan H = dH / (sin H cos H), at rims up to 20 degrees
        return reach
