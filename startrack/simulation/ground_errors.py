"""Ground that differs from its map by errors as the terrain file states them."""

from __future__ import annotations

import numpy as np

from startrack.terrain import Terrain
from startrack.terrain.horizon_posts import NO_POST
from startrack.terrain.protocol import ForwardingTerrain
from startrack.types import Array, Ints

SHAPE_SIGMAS = 4.0  # of a terrain's shape, beyond which none is drawn


def draw_ground(terrain: Terrain, *, rng: np.random.Generator) -> Terrain:
    """The ground below a camera, drawn by `rng` where the file of the `terrain` states errors; else the terrain."""
    if any(terrain.shape_sigma):
        terrain = terrain.reshaped(_draw_shape(terrain, rng))
    if terrain.common_sigma_rad > 0.0 or terrain.height_sigma_m > 0.0:
        return ErringGround(terrain, rng)
    return terrain


class ErringGround(ForwardingTerrain):
    """The terrain `whole` with the horizon of one camera wrong by drawn errors.

    Each post about a crest errs by itself and lifts the horizon to first order (the choice of the crest is that of the
    map); the error that all azimuths share is drawn too, with that of the camera's own ground.
    """

    def __init__(self, whole: Terrain, rng: np.random.Generator) -> None:
        super().__init__(whole)
        self._shared_rad = float(rng.normal(0.0, whole.common_sigma_rad))
        self._rng = rng
        self._post, self._error_m = np.zeros(0, dtype=np.int64), np.zeros(0)  # drawn so far; posts ascending

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:  # type: ignore[override]
        """Horizon elevation (..., n) [rad] seen from one point (1, 2) at azimuths (n,)."""
        if self.whole.height_sigma_m == 0.0:
            return np.asarray(self.whole.horizon_rad(points_m, azimuths_rad)) + self._shared_rad
        posts = self.whole.horizon_posts(np.reshape(points_m, 2), azimuths_rad)
        by_post = np.sum(posts.rad_per_m * self._errors_m(posts.post), axis=1)
        return np.asarray(posts.horizon_rad + self._shared_rad + by_post)

    def _errors_m(self, posts: Ints) -> Array:
        """Errors of the heights of posts (n, 4) [m]: each is drawn when its post is first seen."""
        new = np.setdiff1d(posts, self._post)
        drawn = self._rng.normal(0.0, self.whole.height_sigma_m, len(new))
        drawn[new == NO_POST] = 0.0
        post = np.concatenate([self._post, new])
        order = np.argsort(post)
        self._post, self._error_m = post[order], np.concatenate([self._error_m, drawn])[order]
        return self._error_m[np.searchsorted(self._post, posts)]


def _draw_shape(terrain: Terrain, rng: np.random.Generator) -> Array:
    """A shape (2,) for `reshaped`, from the terrain's prior: drawn in a box, and kept as often as it is likely."""
    while True:
        shape = SHAPE_SIGMAS * np.array(terrain.shape_sigma) * rng.uniform(-1.0, 1.0, 2)
        if rng.random() < np.exp(terrain.log_prior(shape)):
            return np.asarray(shape)
