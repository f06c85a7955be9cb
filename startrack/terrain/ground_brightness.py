"""How bright the ground is that a picture is rendered of: the same everywhere, or in patches of azimuth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from startrack.core.declaration import Either, Number, Table
from startrack.core.types import Array, BadInput

BORDER_RAD = np.radians(0.2)  # over which one patch goes over to the next
_LIGHT = Number(low=0.0, high=1000.0)
_PATCHES = {
    "low": Number(low=0.0, high=1000.0, required=True),
    "high": Number(low=0.0, high=1000.0, required=True),
    "size_deg": Number(low=1.0, high=360.0, required=True, description="of a patch in azimuth, about"),
    "seed": Number(low=0, high=2**32 - 1, integer=True, default=0),
}
GROUND_TABLE = Table(
    description="For pictures that are rendered.",
    keys={
        "brightness": Either(
            kinds=(_LIGHT, Table(keys=_PATCHES, closed=True)),
            description="light of the ground over that of the sky above it: a number, or patches of random brightness",
        )
    },
)


@dataclass(frozen=True, kw_only=True)
class GroundBrightness:
    """Light of the ground over that of the sky above it: patches in azimuth, each with a random number.

    The patches are equally wide, `size_rad` about, and begin at a random azimuth; the numbers are uniform between `low`
    and `high`. The same `seed` gives the same patches.
    """

    low: float
    high: float
    size_rad: float = 2 * np.pi
    seed: int = 0

    @classmethod
    def of(cls, stated: float | Mapping[str, Any]) -> Self:
        """The brightness that is `stated` as a value of the key `ground.brightness`.

        Raises BadInput bad_terrain for a `low` above `high`.
        """
        if not isinstance(stated, Mapping):
            return cls(low=stated, high=stated)
        low, high = stated["low"], stated["high"]
        if low > high:
            raise BadInput("bad_terrain", f"ground.brightness: low {low:g} is above high {high:g}")
        return cls(low=low, high=high, size_rad=float(np.radians(stated["size_deg"])), seed=stated["seed"])

    def __call__(self, azimuth_rad: Array) -> Array:
        """Brightness (...) at azimuths `azimuth_rad` (...) in enu."""
        at, patches_1 = self._knots
        return np.interp(azimuth_rad, at, patches_1, period=2 * np.pi)

    @property
    def value(self) -> float | dict[str, float]:
        """The value of the key that states it."""
        if self.low == self.high:
            return self.low
        return {"low": self.low, "high": self.high, "size_deg": float(np.degrees(self.size_rad)), "seed": self.seed}

    @cached_property
    def _knots(self) -> tuple[Array, Array]:
        """Azimuths (n,) of the ends of all patches, and the brightness there, linear between them."""
        rng, count = np.random.default_rng(self.seed), max(round(2 * np.pi / self.size_rad), 1)
        begins = rng.uniform(0, 2 * np.pi) + np.arange(count) * 2 * np.pi / count
        ends = np.stack([begins + BORDER_RAD / 2, begins + 2 * np.pi / count - BORDER_RAD / 2], axis=1)
        return ends.ravel(), np.repeat(rng.uniform(self.low, self.high, count), 2)
