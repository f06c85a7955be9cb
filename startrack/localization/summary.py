"""Sums over a posterior on boxes: moments and connected modes; and where its points may be."""

from __future__ import annotations

import numpy as np

from startrack.terrain import Terrain
from startrack.types import Array, Bools, Ints, NotLocated

AMBIGUOUS_MASS = 0.01
NEGLIGIBLE_BOX = 1e-12


def require_inside(points_m: Array, weight: Array, terrain: Terrain) -> Bools:
    """Which of the points (n, 2) [m] of these weights (n,) are within the search radius of the `terrain`.

    Raises NotLocated outside_search_area where most of the weight is beyond it.
    """
    outside = np.einsum("ni,ni->n", points_m, points_m) > terrain.search_radius_m**2
    if outside.any() and weight[outside].sum() > 0.5 * weight.sum():
        raise NotLocated(
            f"the stars place the camera outside the search area of {terrain.search_radius_m:.0f} m: "
            "widen [search] radius_m in the terrain file if that can be true",
            reason="outside_search_area",
        )
    return np.asarray(~outside)


def camera_at(point_m: Array, terrain: Terrain) -> Array:
    """East, north and up (3,) [m] of the camera that stands at a point (2,) [m] of the `terrain`."""
    up_m = float(terrain.ground_m(point_m[None, :])[0]) + terrain.camera_height_m
    return np.array([point_m[0], point_m[1], up_m])


def smallest_axis(centres_m: Array, width_m: float, log_weight: Array) -> float:
    """Standard deviation [m] of the posterior along its shorter axis; where it has modes, of the narrowest that counts.

    Of all modes together it would be as large as they are far apart.
    """
    weight = np.exp(log_weight - np.max(log_weight))
    weight /= weight.sum()
    centres_m, weight = centres_m[weight > NEGLIGIBLE_BOX], weight[weight > NEGLIGIBLE_BOX]
    label = _modes(centres_m, weight, width_m, _moments(centres_m, weight, width_m)[1])
    counts = np.flatnonzero(np.bincount(label, weights=weight) > AMBIGUOUS_MASS)
    spreads = [_mean_and_spread(centres_m[label == i], weight[label == i])[1] for i in counts]
    return float(np.sqrt(max(min(np.linalg.eigvalsh(spread)[0] for spread in spreads), 0.0)))


def _moments(centres_m: Array, weight: Array, width_m: float) -> tuple[Array, Array]:
    """Mean and covariance; a box's own extent (width^2 / 12) is part of the covariance."""
    mean, spread = _mean_and_spread(centres_m, weight)
    return mean, spread + width_m**2 / 12 * np.eye(2)


def _mean_and_spread(centres_m: Array, weight: Array) -> tuple[Array, Array]:
    """Mean and covariance of the boxes' centres."""
    weight = weight / weight.sum()
    mean = weight @ centres_m
    centred = centres_m - mean
    return mean, (centred * weight[:, None]).T @ centred


def _modes(centres_m: Array, weight: Array, width_m: float, covariance: Array) -> Ints:
    """Mode number (n,) of each box: boxes linked by gaps no wider than the posterior's local spread."""
    label = np.zeros(len(weight), dtype=np.int64)
    if _in_one_piece(centres_m, covariance, width_m):
        return label
    for sigmas in (1.0, 1.0, 3.0):  # far modes widen the first spread; the heaviest one's own decides in the end
        heaviest = label == np.argmax(np.bincount(label, weights=weight))
        _, covariance = _moments(centres_m[heaviest], weight[heaviest], width_m)
        gap = max(1.5 * width_m, sigmas * float(np.sqrt(np.linalg.eigvalsh(covariance)[1])))
        label = link_points(centres_m, gap)
    return label


def _in_one_piece(centres_m: Array, covariance: Array, width_m: float) -> bool:
    """Whether the boxes leave no gap along the posterior's longer axis, where two places would lie apart."""
    along = np.sort(centres_m @ np.linalg.eigh(covariance)[1][:, 1])
    return bool(np.diff(along).max(initial=0.0) < 1.5 * width_m)


def link_points(points_m: Array, gap_m: float) -> Ints:
    """Labels (n,) of the connected groups of points closer than the gap.

    Points are first put into cells of the gap's size, so the cost does not grow with the number of pairs.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    cell = np.floor(points_m / (0.5 * gap_m)).astype(np.int64)
    cell -= cell.min(axis=0)
    if cell.max() <= 2:
        return np.zeros(len(cell), dtype=np.int64)
    across = int(cell[:, 1].max()) + 1
    numbers, of = np.unique(cell[:, 0] * across + cell[:, 1], return_inverse=True)
    cells = np.stack([numbers // across, numbers % across], axis=1)
    pairs = cKDTree(cells).query_pairs(2.9, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    return np.asarray(connected_components(graph, directed=False)[1])[of].astype(np.int64)
