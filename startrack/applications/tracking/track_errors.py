"""The errors that frames of a track share: of the terrain, of the clock, and of the skyline in the sky's light."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from startrack.chain import EDGE_SIGMA_PX
from startrack.core.types import Array, BadInput, Clock, Evidence, Exposure, ImageErrors
from startrack.estimation.observations import FrameEstimate
from startrack.exposure import NO_TIME
from startrack.localization import SharedErrors, clock_at
from startrack.terrain import Terrain

LINEAR_SIZE_1 = 0.005  # sigma of a crater's size: of positions 15 m off it leaves 0.1 m
SIZE_ROUNDS = 10  # of the expansion about a crater's size
BIAS, CLOCK, DEPTH, WIDTH, EDGE = "bias_rad", "clock_s", "depth_1", "diameter_1", "edge_px"


class ErrorFound(NamedTuple):
    """Shared error as estimated, in the unit of its name."""

    error: float  # beyond its mean before
    sigma: float
    mean: float


@dataclass(frozen=True, eq=False)
class TrackErrors:
    """The errors (k,) that all frames of a track have in common, with their standard deviations.

    Those of the terrain and the clock come first, as `SharedErrors` lists them. Parameters of a track are a position
    (2,) [m] and the errors in units of their standard deviations. Depth and width of a round crater are positive:
    their logarithms are normal. The parameters are those of the logarithms once `place` was applied, before it those
    of the errors.
    """

    listed: SharedErrors  # of the terrain and the clock
    uses_sky: bool = False  # whether the light of the sky is part of the evidence
    gross: frozenset[str] = frozenset()  # facts that no file states, whose gross error an image shows

    @classmethod
    def of(cls, terrain: Terrain, clock: Clock | None, uses_sky: bool = False) -> Self:
        """Errors of a `terrain`, of a `clock`, and with `uses_sky` of the skyline that the sky's light shows."""
        return cls(SharedErrors.of(terrain, clock), uses_sky)

    @classmethod
    def of_exposure(cls, terrain: Terrain, exposure: Exposure, uses_sky: bool = False) -> Self:
        """Errors of a `terrain`, of the clock of an `exposure`, and with `uses_sky` of the skyline in the sky's light.

        Raises BadInput (no_time, bad_terrain) where the exposure has no time, or the terrain no site.
        """
        if exposure.time_utc is None:
            raise BadInput("no_time", "; ".join([NO_TIME, *exposure.warnings]))
        if terrain.site is None:
            raise BadInput("bad_terrain", f"terrain {terrain.name} has no site")
        stated = exposure.time_sigma_s, exposure.time_sigma_is_stated
        return cls.of(terrain, clock_at(terrain.site, exposure.time_utc, *stated), uses_sky)

    def on(self, terrain: Terrain) -> Self:
        """Copy for a `terrain` of another steepness, from which its errors are counted."""
        return replace(self, listed=SharedErrors.of(terrain, self.listed.clock))

    def with_gross(self, facts: Iterable[str]) -> Self:
        """Copy with gross errors of more `facts`; those that the terrain states are left out."""
        return replace(self, gross=self.gross | (frozenset(facts) & frozenset(self.listed.facts)))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names (k,) of the errors; each ends with its unit."""
        return (*(one.name for one in self.listed.listed), *([EDGE] if self.uses_sky else []))

    @cached_property
    def sigma(self) -> Array:
        """Standard deviations (k,) in the units of the names."""
        found = self.listed.sigma()
        for fact in self.gross:
            found = np.where([one.fact == fact for one in self.listed.listed], self.listed.sigma(fact), found)
        return np.append(found, [EDGE_SIGMA_PX] if self.uses_sky else [])

    @property
    def mean(self) -> Array:
        """Means (k,) of the prior in the units of the names: what is stated, from where errors are counted from."""
        return np.append(self.listed.mean, [0.0] if self.uses_sky else [])

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def _log_sigma(self) -> Array:
        """Standard deviation (k,) of the logarithm of depth and width; 0 for other errors."""
        is_size = np.isin(self.names, (DEPTH, WIDTH)) & self.listed.axisymmetric
        return np.divide(self.sigma, 1.0 + self.mean, out=np.zeros(len(self)), where=is_size)

    def values(self, shared: Array) -> Array:
        """Errors (k,) in the units of the names, at parameters `shared` (k,)."""
        s = np.where(self._log_sigma > 0.0, self._log_sigma, 1.0)
        linear = np.where(self._log_sigma > 0.0, np.expm1(s * shared) / s, shared)
        return np.asarray(self.mean + self.sigma * linear)

    def slopes(self, shared: Array) -> Array:
        """Derivatives (k,) of the `values` by the parameters, at `shared` (k,)."""
        return np.asarray(self.sigma * np.exp(self._log_sigma * shared))

    def errors_found(self, shared: Array, covariance: Array) -> list[ErrorFound]:
        """Errors (k,) relative to their means, with sigmas, at parameters `shared` (k,) of this `covariance` (k, k)."""
        sigma = self.slopes(shared) * np.sqrt(np.diag(covariance))
        found = np.stack([self.values(shared) - self.mean, sigma, self.mean], axis=-1)
        return [ErrorFound(*one) for one in found.tolist()]

    def to_model(self, parameters: Array, evidence: Evidence) -> Array:
        """Parameters (n, 2 + m) of a `SkylineModel` of `evidence`, from `parameters` (n, 2 + k) of the track."""
        m = len(self.listed)
        found = parameters[:, : 2 + m] * np.r_[1.0, 1.0, self.sigma[:m]] + np.r_[0.0, 0.0, self.listed.mean]
        if self.listed.clock is not None and evidence.clock is not None:
            found[:, -1] -= evidence.clock.offset_s  # the directions include it
        return found

    def rise_rad(self, slopes_rad: Array, edge_rad: Array) -> Array:
        """Rise (n, k) [rad] of the skyline by one standard deviation of each error.

        `slopes_rad` (m, n) are the rises by a unit of each listed error, `edge_rad` (n,) those by one px of the edge.
        """
        units = np.vstack([slopes_rad, edge_rad]) if self.uses_sky else slopes_rad
        return np.asarray((units * self.sigma[:, None]).T)

    def of_image(self, errors: ImageErrors | None) -> ImageErrors | None:
        """Errors of one image without that of the edge, which all images share."""
        if errors is None or not self.uses_sky:
            return errors
        own = errors.covariance.copy()
        own[0, 0] -= EDGE_SIGMA_PX**2
        return replace(errors, covariance=own)

    @property
    def bends(self) -> bool:
        """Whether positions are not linear in the size of a round crater, as little as it is known."""
        return self.size_sigma_1 > LINEAR_SIZE_1

    @cached_property
    def size_sigma_1(self) -> float:
        """Relative standard deviation of depth or width of a round crater, the larger one; 0 where they are known."""
        return max(
            (s for s, name in zip(self.sigma.tolist(), self.names, strict=True) if name in (DEPTH, WIDTH)), default=0.0
        )

    def place(
        self, estimate: FrameEstimate, position_m: Array | None = None, shared: Array | None = None
    ) -> FrameEstimate:
        """The `estimate` of a frame with its position after the turn and the scaling of a round crater.

        See `SharedErrors`: the `estimate` holds the position before. The change with the errors is taken at the
        true `position_m` (2,), None: that of the estimate, and at errors `shared` (k,), None: as stated.
        """
        m, small = len(self.listed), 1e-3
        if not (m and self.listed.axisymmetric):
            return estimate
        shared = np.zeros(len(self)) if shared is None else shared
        at, slope = (self.values(shared) - self.mean) / self.sigma, self.slopes(shared) / self.sigma
        values, one = at[:m] * self.sigma[:m], small * np.diag(self.sigma[:m])
        by_position = self.listed.true_positions(np.eye(2), np.tile(values, (2, 1))).T
        before = estimate.mean[:2] if position_m is None else np.linalg.solve(by_position, position_m)
        moved = [self.listed.true_positions(np.tile(before, (m, 1)), values + sign * one) for sign in (1.0, -1.0)]
        to = np.eye(len(estimate.mean))
        to[:2, :2], to[:2, 2 : 2 + m] = by_position, (moved[0] - moved[1]).T / (2 * small)
        linear = estimate.transform(to, np.r_[-to[:2, 2:] @ at, np.zeros(len(at))])
        by_shared = linear.response[:, 2:]  # at + slope (shared' - shared) by parameters shared'
        response = np.hstack([linear.response[:, :2], by_shared * slope])
        return replace(linear, mean=linear.mean - by_shared @ (at - slope * shared), response=response)
