"""Branch and bound over the ground: every place that could matter, refined; everything else excluded with proof."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.localize.likelihood import Sectors, contribution
from startrack.localize.rays import Rays
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Ints

SETTLED = 1e-4  # a ray whose contribution varies by less over a box is settled there
PAIRS_AT_ONCE = 1_000_000
CHILDREN = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])


@dataclass(frozen=True)
class Boxes:
    """Equal squares still in the running, and the bundles of rays that vary over each."""

    centres_m: Array  # (n, 2)
    half_m: float
    sums: Array  # (n, sectors) contributions of the settled bundles
    box: Ints  # (pairs,) box of each unsettled (box, bundle) pair
    ray: Ints  # (pairs,) bundle, on the level in use
    lower: Array  # (n,) bounds of the log-likelihood over the box
    upper: Array  # (n,)

    def __len__(self) -> int:
        return len(self.centres_m)

    def take(self, keep: Bools) -> Boxes:
        """The kept boxes."""
        number = np.cumsum(keep) - 1
        pairs = keep[self.box]
        return Boxes(
            self.centres_m[keep], self.half_m, self.sums[keep], number[self.box[pairs]], self.ray[pairs],
            self.lower[keep], self.upper[keep],
        )  # fmt: skip

    def split(self) -> Boxes:
        """The four quarters of each box, with the bounds of the whole."""
        quarter = self.half_m / 2
        return Boxes(
            (self.centres_m[:, None, :] + quarter * CHILDREN).reshape(-1, 2),
            quarter,
            np.repeat(self.sums, 4, axis=0),
            (4 * self.box[:, None] + np.arange(4)).ravel(),
            np.repeat(self.ray, 4),
            np.repeat(self.lower, 4),
            np.repeat(self.upper, 4),
        )

    def taken_apart(self, rays: Rays, which: Bools) -> Boxes:
        """The same boxes with the bundles of the pairs `which` replaced by their children."""
        parts = self.ray[which]
        first, count = rays.first_child[parts], rays.last_child[parts] - rays.first_child[parts]
        step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return replace(
            self,
            box=np.concatenate([self.box[~which], np.repeat(self.box[which], count)]),
            ray=np.concatenate([self.ray[~which], np.repeat(first, count) + step]),
        )

    def all_taken_apart(self, rays: Rays) -> Boxes:
        """The same boxes asked ray by ray."""
        boxes = self
        while not (leaf := rays.leaf[boxes.ray]).all():
            boxes = boxes.taken_apart(rays, ~leaf)
        return boxes


def whole_area(sectors: Sectors, rays: Rays, reach_m: float) -> Boxes:
    """One box over the whole square of half side `reach_m`, nothing settled."""
    n = rays.roots
    return Boxes(
        np.zeros((1, 2)), reach_m, np.zeros((1, sectors.count)), np.zeros(n, dtype=np.int64), np.arange(n),
        np.full(1, -np.inf), np.full(1, np.inf),
    )  # fmt: skip


def bounded(boxes: Boxes, sectors: Sectors, rays: Rays, terrain: Terrain) -> Boxes:
    """The boxes with bounds of the log-likelihood; what no longer varies is settled, coarse bundles are taken apart."""
    n, count = len(boxes), sectors.count
    low, high = np.empty(len(boxes.ray)), np.empty(len(boxes.ray))
    coarse = np.empty(len(boxes.ray), dtype=bool)
    for start in range(0, len(boxes.ray), PAIRS_AT_ONCE):
        some = slice(start, start + PAIRS_AT_ONCE)
        centres = boxes.centres_m[boxes.box[some]]
        half = np.full(len(centres), boxes.half_m)
        low[some], high[some], coarse[some] = rays.bounds(terrain, centres, half, boxes.ray[some])
    key = boxes.box * count + rays.sector[boxes.ray]
    settled = high - low < SETTLED
    sums = boxes.sums + _sum_by(key[settled], 0.5 * (low + high)[settled], n, count)
    open_ = ~settled
    lower = sectors.score(sums + _sum_by(key[open_], low[open_], n, count))
    upper = sectors.score(sums + _sum_by(key[open_], high[open_], n, count))
    left = Boxes(boxes.centres_m, boxes.half_m, sums, boxes.box[open_], boxes.ray[open_], lower, upper)
    return left.taken_apart(rays, coarse[open_])


def centre_scores(boxes: Boxes, sectors: Sectors, rays: Rays, terrain: Terrain) -> Array:
    """Log-likelihood (n,) at the centres of boxes that are asked ray by ray."""
    azimuth = rays.azimuth_rad[boxes.ray]
    centres = boxes.centres_m[boxes.box]
    horizon = terrain.horizon_rad(centres, azimuth)
    sigma = np.hypot(rays.sigma_rad[boxes.ray], terrain.horizon_sigma_rad(centres, azimuth))
    value = contribution(rays.llr[boxes.ray], rays.lowest_rad[boxes.ray], horizon, sigma)
    key = boxes.box * sectors.count + rays.sector[boxes.ray]
    return sectors.score(boxes.sums + _sum_by(key, value, len(boxes), sectors.count))


def on_ground(boxes: Boxes, terrain: Terrain) -> Bools:
    """Boxes (n,) that hold a place where the camera can be, judged on a 5 x 5 grid of points over each."""
    steps = np.linspace(-boxes.half_m, boxes.half_m, 5)
    x, y = np.meshgrid(steps, steps)
    points = boxes.centres_m[:, None, :] + np.stack([x.ravel(), y.ravel()], axis=1)
    return np.asarray(terrain.allowed(points)).any(axis=1)


def _sum_by(key: Ints, value: Array, n: int, count: int) -> Array:
    return np.bincount(key, weights=value, minlength=n * count).reshape(n, count)
