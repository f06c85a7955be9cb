"""Branch and bound over the ground: every place that could matter, refined; everything else excluded with proof."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localize.likelihood import Sectors, contribution
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Ints

SETTLED = 1e-4  # a ray whose contribution varies by less over a box is settled there
PAIRS_AT_ONCE = 2_000_000
CHILDREN = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])


@dataclass
class Boxes:
    """Equal squares still in the running, and the rays that vary over each."""

    centres_m: Array  # (n, 2)
    half_m: float
    sums: Array  # (n, sectors) contributions of the settled rays
    box: Ints  # (pairs,) box of each unsettled (box, ray) pair
    ray: Ints  # (pairs,)
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
        """The four quarters of each box, bounds not yet renewed."""
        n = len(self)
        quarter = self.half_m / 2
        centres = (self.centres_m[:, None, :] + quarter * CHILDREN).reshape(-1, 2)
        pairs_of = (4 * self.box[:, None] + np.arange(4)).ravel()
        sums = np.repeat(self.sums, 4, axis=0)
        unset = np.zeros(4 * n)
        return Boxes(centres, quarter, sums, pairs_of, np.repeat(self.ray, 4), unset, unset)


def start_boxes(sectors: Sectors, terrain: Terrain, reach_m: float, across: int) -> Boxes:
    """A grid of boxes over the square of half side `reach_m`, bounds not yet known."""
    half = reach_m / across
    middle = -reach_m + half * (2 * np.arange(across) + 1)
    x, y = np.meshgrid(middle, middle)
    centres = np.stack([x.ravel(), y.ravel()], axis=1)
    centres = centres[_touches_ground(terrain, centres, half)]
    n, rays = len(centres), len(sectors.evidence)
    unset = np.zeros(n)
    return Boxes(
        centres, half, np.zeros((n, sectors.count)), np.repeat(np.arange(n), rays), np.tile(np.arange(rays), n),
        unset, unset,
    )  # fmt: skip


def bounded(boxes: Boxes, sectors: Sectors, terrain: Terrain) -> Boxes:
    """The boxes with the rays that no longer vary settled, and with bounds of the log-likelihood."""
    evidence = sectors.evidence
    n, count = len(boxes), sectors.count
    low, high = np.empty(len(boxes.ray)), np.empty(len(boxes.ray))
    for start in range(0, len(boxes.ray), PAIRS_AT_ONCE):
        some = slice(start, start + PAIRS_AT_ONCE)
        box, ray = boxes.box[some], boxes.ray[some]
        azimuth, elevation, llr = evidence.azimuth_rad[ray], evidence.elevation_rad[ray], evidence.llr[ray]
        centres = boxes.centres_m[box]
        floor, ceiling = terrain.horizon_bounds_rad(centres, np.full(len(box), boxes.half_m), azimuth)
        sigma = np.hypot(evidence.edge_sigma_rad[ray], terrain.horizon_sigma_rad(centres, azimuth))
        ends = contribution(llr, elevation, floor, sigma), contribution(llr, elevation, ceiling, sigma)
        low[some], high[some] = np.minimum(*ends), np.maximum(*ends)
    key = boxes.box * count + sectors.sector[boxes.ray]
    settled = high - low < SETTLED
    sums = boxes.sums + _sum_by(key[settled], 0.5 * (low + high)[settled], n, count)
    open_key = key[~settled]
    lower = sectors.score(sums + _sum_by(open_key, low[~settled], n, count))
    upper = sectors.score(sums + _sum_by(open_key, high[~settled], n, count))
    return Boxes(boxes.centres_m, boxes.half_m, sums, boxes.box[~settled], boxes.ray[~settled], lower, upper)


def centre_scores(boxes: Boxes, sectors: Sectors, terrain: Terrain) -> Array:
    """Log-likelihood (n,) at the boxes' centres."""
    evidence = sectors.evidence
    azimuth = evidence.azimuth_rad[boxes.ray]
    centres = boxes.centres_m[boxes.box]
    horizon = terrain.horizon_rad(centres, azimuth)
    sigma = np.hypot(evidence.edge_sigma_rad[boxes.ray], terrain.horizon_sigma_rad(centres, azimuth))
    value = contribution(evidence.llr[boxes.ray], evidence.elevation_rad[boxes.ray], horizon, sigma)
    key = boxes.box * sectors.count + sectors.sector[boxes.ray]
    return sectors.score(boxes.sums + _sum_by(key, value, len(boxes), sectors.count))


def on_ground(boxes: Boxes, terrain: Terrain) -> Bools:
    """Boxes that hold at least one place where the camera can be, judged at corners, edges' middles and centre."""
    return _touches_ground(terrain, boxes.centres_m, boxes.half_m)


def _touches_ground(terrain: Terrain, centres_m: Array, half_m: float) -> Bools:
    steps = np.linspace(-half_m, half_m, 5)
    x, y = np.meshgrid(steps, steps)
    points = centres_m[:, None, :] + np.stack([x.ravel(), y.ravel()], axis=1)
    return np.asarray(terrain.allowed(points)).any(axis=1)


def _sum_by(key: Ints, value: Array, n: int, count: int) -> Array:
    return np.bincount(key, weights=value, minlength=n * count).reshape(n, count)
