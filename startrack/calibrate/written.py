"""A fitted camera as its file holds it: the covariance in the file's parameter names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.camera import Camera
from startrack.types import Array

LOCKED_1 = 1e-7  # relative: fx and fy of square pixels, apart just enough that the matrix has an inverse


def written(camera: Camera, free: tuple[str, ...], covariance: Array) -> Camera:
    """The camera with the covariance (m, m) of its free parameters, fx and fy each by itself."""
    if free[0] == "fx":
        return replace(camera, covariance_order=free, covariance=0.5 * (covariance + covariance.T))
    names = ("fx", "fy", *free[1:])
    spread = np.zeros((len(names), len(free)))
    spread[0, 0], spread[1, 0] = 1.0, camera.focal_px[1] / camera.focal_px[0]
    spread[np.arange(2, len(names)), np.arange(1, len(free))] = 1.0
    wide = spread @ covariance @ spread.T
    # Exactly locked, the matrix could not be inverted by those who want to weigh errors with it.
    wide[[0, 1], [0, 1]] += 0.5 * (LOCKED_1 * camera.focal_px[0]) ** 2
    return replace(camera, covariance_order=names, covariance=0.5 * (wide + wide.T))
