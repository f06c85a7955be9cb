"""Branch and bound over the ground: every place that could matter, refined; everything else excluded with proof."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.localization.prefix_sums import Profile
from startrack.localization.sector_likelihood import Sectors, contribution
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Evidence, Ints

SETTLED = 1e-4  # a ray whose contribution varies by less over a box is settled there
SMALL_BOX_M = 20.0
CHILDREN = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])


@dataclass(frozen=True)
class Boxes:
    """Equal squares still in the running, with bounds of the log-likelihood over each."""

    centres_m: Array  # (n, 2)
    half_m: float
    lower: Array  # (n,)
    upper: Array  # (n,)

    def __len__(self) -> int:
        return len(self.centres_m)

    def take(self, keep: Bools) -> Boxes:
        """The kept boxes."""
        return Boxes(self.centres_m[keep], self.half_m, self.lower[keep], self.upper[keep])

    def quarters(self, terrain: Terrain) -> tuple[Array, Ints]:
        """Centres (m, 2) of the quarters that hold ground, and the box (m,) that each is of."""
        half = self.half_m / 2
        centres = (self.centres_m[:, None, :] + half * CHILDREN).reshape(-1, 2)
        on_ground = holds_ground(terrain, centres, half)
        return centres[on_ground], np.repeat(np.arange(len(self)), 4)[on_ground]


@dataclass(frozen=True)
class RayBoxes(Boxes):
    """Boxes asked ray by ray."""

    sums: Array  # (n, sectors) contributions of the settled rays
    box: Ints  # (pairs,) box of each open (box, ray) pair
    ray: Ints  # (pairs,)
    least: Array  # (pairs,) bounds of their contributions
    most: Array  # (pairs,)

    def take(self, keep: Bools) -> RayBoxes:
        """The kept boxes."""
        number = np.cumsum(keep) - 1
        pairs = keep[self.box]
        return RayBoxes(
            self.centres_m[keep], self.half_m, self.lower[keep], self.upper[keep], self.sums[keep],
            number[self.box[pairs]], self.ray[pairs], self.least[pairs], self.most[pairs],
        )  # fmt: skip

    def handed_down(self, terrain: Terrain) -> RayBoxes:
        """The quarters that hold ground, with what is known of the boxes that they are quarters of."""
        centres, of = self.quarters(terrain)
        # Pairs of a box go to each of its quarters: pairs are sorted by box, so those of one box are a run.
        count = np.bincount(self.box, minlength=len(self))
        order = np.argsort(self.box, kind="stable")
        starts = np.cumsum(count) - count
        box = np.repeat(np.arange(len(of)), count[of])
        step = np.arange(count[of].sum()) - np.repeat(np.cumsum(count[of]) - count[of], count[of])
        pair = order[np.repeat(starts[of], count[of]) + step]
        return RayBoxes(
            centres, self.half_m / 2, self.lower[of], self.upper[of], self.sums[of], box, self.ray[pair],
            self.least[pair], self.most[pair],
        )  # fmt: skip


def by_sector(
    centres_m: Array, half_m: float, sectors: Sectors, profile: Profile, terrain: Terrain
) -> tuple[Boxes, Ints, Ints]:
    """Boxes bounded with one look-up per sector, and the open rays (n, sectors) of each: first, one past the last."""
    first, last = profile.open_rays(terrain, centres_m, half_m)
    return scored(centres_m, half_m, first, last, sectors, profile), first, last


def scored(centres_m: Array, half_m: float, first: Ints, last: Ints, sectors: Sectors, profile: Profile) -> Boxes:
    """Boxes (n, 2) with the bounds that their open rays leave."""
    visible, least, most = profile.sums(first, last)
    return Boxes(centres_m, half_m, sectors.score(visible + least), sectors.score(visible + most))


def ray_by_ray(boxes: Boxes, first: Ints, last: Ints, sectors: Sectors, profile: Profile, terrain: Terrain) -> RayBoxes:
    """The same boxes with each open ray on its own, bounded anew."""
    return tightened(asked(boxes, first, last, profile), None, sectors, profile, terrain)


def split(boxes: RayBoxes, sectors: Sectors, profile: Profile, terrain: Terrain) -> RayBoxes:
    """The quarters that hold ground, bounded."""
    return tightened(boxes.handed_down(terrain), None, sectors, profile, terrain)


def asked(boxes: Boxes, first: Ints, last: Ints, profile: Profile) -> RayBoxes:
    """The same boxes with their open rays, the bounds as they are."""
    box, ray = profile.pairs(first, last)
    sums, _, _ = profile.sums(first, last)
    llr = profile.evidence.llr[ray]
    return RayBoxes(
        boxes.centres_m, boxes.half_m, boxes.lower, boxes.upper, sums, box, ray, np.minimum(llr, 0), np.maximum(llr, 0)
    )


def tightened(
    boxes: RayBoxes, which: Bools | None, sectors: Sectors, profile: Profile, terrain: Terrain, turn_rad: float = 0.0
) -> RayBoxes:
    """The boxes with the horizon's bounds asked for some pairs (pairs,) or all, and what no longer varies settled.

    They are asked for all azimuths within the turn, which may be wider and yet quicker to tell than for one.
    """
    n, count, rays = len(boxes), sectors.count, profile.evidence
    some = np.arange(len(boxes.ray)) if which is None else np.flatnonzero(which)
    box, ray = boxes.box[some], boxes.ray[some]
    azimuth, elevation, llr = rays.azimuth_rad[ray], rays.elevation_rad[ray], rays.llr[ray]
    floor, ceiling = terrain.horizon_bounds_rad(boxes.centres_m[box], np.array(boxes.half_m), azimuth, turn_rad)
    sigma = np.hypot(rays.edge_sigma_rad[ray], terrain.horizon_sigma_rad(boxes.centres_m[box], azimuth))
    ends = contribution(llr, elevation, floor, sigma), contribution(llr, elevation, ceiling, sigma)
    least, most = boxes.least.copy(), boxes.most.copy()
    least[some], most[some] = np.minimum(*ends), np.maximum(*ends)
    key = boxes.box * count + profile.sector[boxes.ray]
    open_ = most - least >= SETTLED
    sums = boxes.sums + _sum_by(key[~open_], 0.5 * (least + most)[~open_], n, count)
    box, ray, least, most, key = boxes.box[open_], boxes.ray[open_], least[open_], most[open_], key[open_]
    lower = sectors.score(sums + _sum_by(key, least, n, count))
    upper = sectors.score(sums + _sum_by(key, most, n, count))
    return RayBoxes(boxes.centres_m, boxes.half_m, lower, upper, sums, box, ray, least, most)


def centre_scores(boxes: RayBoxes, sectors: Sectors, profile: Profile, terrain: Terrain) -> Array:
    """Log-likelihood (n,) at the boxes' centres."""
    rays: Evidence = profile.evidence
    azimuth, centres = rays.azimuth_rad[boxes.ray], boxes.centres_m[boxes.box]
    sigma = np.hypot(rays.edge_sigma_rad[boxes.ray], terrain.horizon_sigma_rad(centres, azimuth))
    value = contribution(
        rays.llr[boxes.ray], rays.elevation_rad[boxes.ray], terrain.horizon_rad(centres, azimuth), sigma
    )
    key = boxes.box * sectors.count + profile.sector[boxes.ray]
    return sectors.score(boxes.sums + _sum_by(key, value, len(boxes), sectors.count))


def holds_ground(terrain: Terrain, centres_m: Array, half_m: float) -> Bools:
    """Boxes (n,) that may hold a place where the camera can be: all within reach; of small ones, by a grid of points.

    The grid is closer than slopes change, so that no more than single metres of a small box's ground are missed.
    """
    beyond = np.maximum(np.abs(centres_m) - half_m, 0.0)
    within = np.asarray(np.hypot(beyond[:, 0], beyond[:, 1]) <= terrain.reach_m)
    if half_m > SMALL_BOX_M:
        return within
    steps = np.linspace(-half_m, half_m, 5)
    x, y = np.meshgrid(steps, steps)
    points = centres_m[:, None, :] + np.stack([x.ravel(), y.ravel()], axis=1)
    return within & np.asarray(np.any(terrain.allowed(points), axis=1))


def _sum_by(key: Ints, value: Array, n: int, count: int) -> Array:
    return np.bincount(key, weights=value, minlength=n * count).astype(np.float64).reshape(n, count)
