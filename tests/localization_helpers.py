"""The log-likelihood of positions written out in numpy, row by row: the reference of the kernels."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from startrack.localization.sector_likelihood import Sectors
from startrack.terrain import ForwardingTerrain, Terrain
from startrack.types import Array, Evidence


def slow_contributions(evidence: Evidence, margin_rad: Array, sigma_rad: Array) -> Array:
    """Contributions (..., n) of rows at these margins above the horizon."""
    soft = sigma_rad > 0
    visible = np.where(soft, ndtr(margin_rad / np.where(soft, sigma_rad, 1.0)), margin_rad > 0)
    llr, extended = evidence.llr, evidence.extended_nats
    point = np.log(visible * np.exp(np.where(extended > 0, 0.0, llr)) + 1.0 - visible)
    return np.where(extended > 0, llr * visible + extended * visible * (1.0 - visible) / 2, point)


def slow_scores(points_m: Array, evidence: Evidence, terrain: Terrain, sectors: Sectors) -> Array:
    """Log-likelihoods (n,) of positions (n, 2)."""
    azimuth = evidence.azimuth_rad
    horizon = terrain.horizon_rad(points_m[:, None], azimuth)
    sigma = np.hypot(evidence.edge_sigma_rad, terrain.horizon_sigma_rad(points_m[:, None], azimuth))
    value = slow_contributions(evidence, evidence.elevation_rad - horizon, sigma)
    key = np.arange(len(points_m))[:, None] * sectors.count + sectors.sector
    sums = np.bincount(key.ravel(), weights=value.ravel(), minlength=len(points_m) * sectors.count)
    sums = sums.reshape(len(points_m), sectors.count)
    return sectors.score(sums)


class Delegating:
    """A terrain that forwards every call, of a class unknown to the package."""

    def __init__(self, whole: Terrain) -> None:
        self._whole = whole

    def __getattr__(self, name: str) -> object:
        return getattr(self._whole, name)


class ThreeMethods(Terrain):
    """A terrain of a user's own: the three required methods, in open form."""

    def __init__(self, whole: Terrain) -> None:
        self.whole = whole
        self.search_radius_m = whole.search_radius_m
        self.camera_height_m = whole.camera_height_m
        self.horizon_cost = whole.horizon_cost

    @property
    def reach_m(self) -> float:
        return self.whole.reach_m

    def allowed(self, points_m: Array) -> Array:
        return self.whole.allowed(points_m)

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        return self.whole.horizon_rad(points_m, azimuths_rad)

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        return self.whole.horizon_bounds_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)

    def ground_m(self, points_m: Array) -> Array:
        return self.whole.ground_m(points_m)


WRAPPERS = (Delegating, ForwardingTerrain, ThreeMethods)
