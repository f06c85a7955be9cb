"""Ground that differs from its map by errors as the terrain file states them."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, Ints
from startrack.terrain import NO_POST, ForwardingTerrain, Terrain

MOST_SIGMAS = 4.0  # of an error of the shape, beyond which none is drawn: a crater may have no depth there


def draw_ground(terrain: Terrain, *, rng: np.random.Generator) -> Terrain:
    """The ground below a camera, drawn by `rng` where the `terrain` has errors; else the terrain.

    Errors of the shape are drawn from their stated or default sigmas, without the gross parts.
    """
    errors, shared_sigma_rad, ground = terrain.errors.shape, terrain.errors.common_sigma_rad, terrain
    if any(error.name == "bias_rad" and error.sigma > 0.0 for error in errors):
        shared_sigma_rad = 0.0  # it is drawn with the shape
    shape = np.array([error.sigma for error in errors])
    errs = np.flatnonzero(shape)
    if len(errs):
        drawn = rng.standard_normal(len(errs))
        while (far := np.abs(drawn) > MOST_SIGMAS).any():
            drawn[far] = rng.standard_normal(np.count_nonzero(far))
        shape[errs] *= drawn
        ground = terrain.with_shape(shape)
    if shared_sigma_rad > 0.0 or terrain.errors.height_sigma_m > 0.0:
        return ErringGround(ground, rng, shared_sigma_rad)
    return ground


class ErringGround(ForwardingTerrain):
    """The terrain `whole` with the horizon of one camera wrong by drawn errors.

    Each post errs by itself, and lifts the horizon by the mean of its effect over the errors of all posts. An error
    that all azimuths share, of `shared_sigma_rad`, is drawn too.
    """

    def __init__(self, whole: Terrain, rng: np.random.Generator, shared_sigma_rad: float) -> None:
        super().__init__(whole)
        self._shared_rad = float(rng.normal(0.0, shared_sigma_rad)) if shared_sigma_rad > 0.0 else 0.0
        self._rng = rng
        self._post, self._error_m = np.zeros(0, dtype=np.int64), np.zeros(0)  # drawn so far; posts ascending

    without_table = Terrain.without_table  # itself: a copy would draw other errors

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:  # type: ignore[override]
        """Horizon elevation (..., n) [rad] seen from one point (1, 2) at azimuths (n,)."""
        found = np.asarray(self.whole.horizon_rad(points_m, azimuths_rad)) + self._shared_rad
        crests = self.whole.errors.expected_crests(np.reshape(points_m, 2), azimuths_rad)
        if crests is None:
            return found
        return np.asarray(found + crests.rise_rad + np.sum(crests.rad_per_m * self._errors_m(crests.post), axis=1))

    def _errors_m(self, posts: Ints) -> Array:
        """Errors of the heights of posts (n, k) [m]: each is drawn when its post is first seen."""
        new = np.setdiff1d(posts, self._post)
        drawn = self._rng.normal(0.0, self.whole.errors.height_sigma_m, len(new))
        drawn[new == NO_POST] = 0.0
        post = np.concatenate([self._post, new])
        order = np.argsort(post)
        self._post, self._error_m = post[order], np.concatenate([self._error_m, drawn])[order]
        return self._error_m[np.searchsorted(self._post, posts)]
