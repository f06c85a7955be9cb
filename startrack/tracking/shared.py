"""The errors that all frames of a track share: of the horizon, of the clock, of a crater's shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from startrack.localization import clock_at, clock_matters
from startrack.pipeline import NO_TIME
from startrack.terrain import Terrain
from startrack.types import Array, BadInput, Clock, Evidence, Exposure

BIAS, CLOCK, STEEPNESS = "horizon_bias_rad", "clock_s", "steepness_1"
SHAPES = STEEPNESS, "size_1"


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Names and standard deviations (k,) of the shared errors, in the units that their names end with."""

    names: tuple[str, ...]
    sigma: Array  # (k,)
    turn_rad_s: Array  # (3,) of the sky, in enu

    @classmethod
    def of(cls, terrain: Terrain, clock: Clock | None) -> Self:
        """Those of a terrain, and of a clock that matters on it."""
        stated = {BIAS: terrain.common_sigma_rad, **dict(zip(SHAPES, terrain.shape_sigma, strict=True))}
        turn = np.zeros(3)
        if clock is not None and clock_matters(clock, terrain):
            stated[CLOCK], turn = clock.sigma_s, clock.turn_rad_s
        known = {name: sigma for name, sigma in stated.items() if sigma > 0.0}
        return cls(tuple(known), np.array(list(known.values())), turn)

    @classmethod
    def of_exposure(cls, terrain: Terrain, exposure: Exposure) -> Self:
        """Those of a `terrain`, and of the clock of an `exposure`.

        Raises BadInput (no_time, bad_terrain) where the exposure has no time, or the terrain no site.
        """
        if exposure.time_utc is None:
            raise BadInput("no_time", "; ".join([NO_TIME, *exposure.warnings]))
        if terrain.site is None:
            raise BadInput("bad_terrain", f"terrain {terrain.name} has no site")
        return cls.of(terrain, clock_at(terrain.site, exposure.time_utc, exposure.time_sigma_s))

    def of_terrain(self, terrain: Terrain) -> Self:
        """The same clock above another `terrain`."""
        own = type(self).of(terrain, None)
        if CLOCK not in self.names:
            return own
        at = self.names.index(CLOCK)
        return type(self)((*own.names, CLOCK), np.append(own.sigma, self.sigma[at]), self.turn_rad_s)

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
            else:
                reach += 0.35 * sigma  # d tan H / tan H = dH / (sin H cos H), at rims up to 20 degrees
        return reach
