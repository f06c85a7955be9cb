"""What is not a star but fools a matched filter: single bright pixels, and edges or lines that cross the stamp."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from startrack.detection.frame import Pixels
from startrack.types import Array, Ints

DIRECTIONS = 8


def edge_chi2(data: Pixels, weights: Pixels) -> Array:
    """chi^2 (n,) of stamps (n, s, s) as straight stripes of any brightness, in the best of eight directions.

    Larger by the number of stripes than the least squares' own, so that many stripes are no better than few.

    A skyline, the edge of the image circle, a bad column, a satellite's trail: what varies in one direction only.
    """
    n, side = len(data), data.shape[1]
    stripes, starts = _stripes(side)
    counts = np.diff(starts, append=stripes.shape[1]).astype(np.float32)  # of stripes: noise alone explains as much
    w = weights.reshape(n, -1).astype(np.float32)
    flat = data.reshape(n, -1).astype(np.float32)
    moment = w * flat
    total, light = w @ stripes, moment @ stripes
    explained = np.add.reduceat(light * light / np.maximum(total, 1e-30), starts, axis=1) - counts
    return np.asarray(np.sum(moment * flat, axis=1) - explained.max(axis=1), dtype=np.float64)


@lru_cache(maxsize=16)
def _stripes(side: int) -> tuple[NDArray[np.float32], Ints]:
    """Which pixel lies in which stripe of one pixel's width (s^2, m): 0 or 1; and each direction's first stripe."""
    offset = np.arange(side) - side // 2
    x, y = np.tile(offset, side), np.repeat(offset, side)
    masks = []
    for turn in np.arange(DIRECTIONS) * np.pi / DIRECTIONS:
        _, number = np.unique(np.rint(x * np.cos(turn) + y * np.sin(turn)), return_inverse=True)
        masks.append(np.eye(number.max() + 1, dtype=np.float32)[number])
    return np.concatenate(masks, axis=1), np.cumsum([0] + [mask.shape[1] for mask in masks[:-1]])
