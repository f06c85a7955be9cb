"""Triangles alike in shape and roughly in size: what a lens of unknown scale leaves of a pattern of stars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from startrack.identify.triangles import Triangles
from startrack.types import Array, Ints


@dataclass(frozen=True)
class SimilarTriangles:
    """Catalogue triangles in a k-d tree of (two ratios of sides, logarithm of the size), scaled to unit tolerance."""

    triangles: Triangles
    tree: Any  # scipy.spatial.cKDTree
    shape_tolerance: float
    size_tolerance: float  # of the logarithm

    def candidates(self, image: Triangles) -> tuple[Ints, Ints]:
        """Pairs (image triangle, catalogue triangle) that agree, mirror images included."""
        none = np.zeros(0, dtype=np.int64)
        if not len(image) or not len(self.triangles):
            return none, none
        hits = self.tree.query_ball_point(
            _features(image.sides_rad, self.shape_tolerance, self.size_tolerance), 1.0, p=np.inf, return_sorted=False
        )
        counts = np.fromiter((len(h) for h in hits), dtype=np.int64, count=len(hits))
        if not counts.sum():
            return none, none
        return np.repeat(np.arange(len(hits)), counts), np.concatenate([np.asarray(h, np.int64) for h in hits if h])


def similar_triangles(found: Triangles, shape_tolerance: float, size_tolerance: float) -> SimilarTriangles:
    """The index of the triangles; tolerances are relative."""
    from scipy.spatial import cKDTree

    tree = cKDTree(_features(found.sides_rad, shape_tolerance, size_tolerance), balanced_tree=False)
    return SimilarTriangles(found, tree, shape_tolerance, size_tolerance)


def _features(sides_rad: Array, shape_tolerance: float, size_tolerance: float) -> Array:
    longest = sides_rad[:, 2]
    return np.stack(
        [
            sides_rad[:, 0] / longest / shape_tolerance,
            sides_rad[:, 1] / longest / shape_tolerance,
            np.log(longest) / size_tolerance,
        ],
        axis=1,
    )
