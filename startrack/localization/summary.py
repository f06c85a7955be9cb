"""Points of a posterior: where they may be, and how they hang together."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, Bools, Ints, NotLocated
from startrack.terrain import Terrain


def require_inside(points_m: Array, weight: Array, terrain: Terrain) -> Bools:
    """Whether points (n, 2) [m] of these weights (n,) are within the search radius of the `terrain`.

    Raises NotLocated outside_search_area where most of the weight is beyond it.
    """
    outside = np.einsum("ni,ni->n", points_m, points_m) > terrain.search_radius_m**2
    if outside.any() and weight[outside].sum() > 0.5 * weight.sum():
        raise NotLocated(
            f"the stars place the camera outside the search area of {terrain.search_radius_m:.0f} m: "
            "is this the terrain of the image, and are its heights in metres? Else widen [search] radius_m in its file",
            reason="outside_search_area",
        )
    return np.asarray(~outside)


def camera_at(point_m: Array, terrain: Terrain) -> Array:
    """East, north and up (3,) [m] of the camera that stands at `point_m` (2,) of the `terrain`."""
    up_m = float(terrain.ground_m(point_m[None, :])[0]) + terrain.camera_height_m
    return np.array([point_m[0], point_m[1], up_m])


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
