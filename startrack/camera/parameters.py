"""A camera by its parameters: changed by a fit, and with their covariance.

Names: f (both focal lengths, their ratio kept), fx, fy, cx, cy, those of the lens (k1 to k4), p1 and p2 (decentring).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from startrack.camera.camera import Camera
from startrack.camera.decentring import Decentring
from startrack.core.types import Array

SQUARE_PIXEL_SIGMA_1 = 1e-7  # relative sigma of fx / fy where they are fitted as one: just enough for an inverse


def with_update(camera: Camera, step: Mapping[str, float]) -> Camera:
    """The camera with `step` added to its parameters, by name; the lens keeps those that are not named."""
    fx, fy = camera.focal_px
    scale = 1.0 + step.get("f", 0.0) / fx
    p1, p2 = camera.decentring.p1 + step.get("p1", 0.0), camera.decentring.p2 + step.get("p2", 0.0)
    return replace(
        camera,
        focal_px=(float(fx * scale + step.get("fx", 0.0)), float(fy * scale + step.get("fy", 0.0))),
        centre_px=(
            float(camera.centre_px[0] + step.get("cx", 0.0)),
            float(camera.centre_px[1] + step.get("cy", 0.0)),
        ),
        lens=camera.lens.with_update(step),
        decentring=Decentring(float(p1), float(p2)),
    )


def with_covariance(camera: Camera, free: tuple[str, ...], covariance: Array) -> Camera:
    """The camera with the covariance (m, m) of its free parameters; f becomes fx and fy."""
    if free[0] == "fx":
        return replace(camera, covariance_order=free, covariance=0.5 * (covariance + covariance.T))
    names = ("fx", "fy", *free[1:])
    by_free = np.zeros((len(names), len(free)))  # d names / d free
    by_free[0, 0], by_free[1, 0] = 1.0, camera.focal_px[1] / camera.focal_px[0]
    by_free[np.arange(2, len(names)), np.arange(1, len(free))] = 1.0
    wide = by_free @ covariance @ by_free.T
    # With fx / fy exactly known the matrix would be singular, and no use as a weight.
    wide[[0, 1], [0, 1]] += 0.5 * (SQUARE_PIXEL_SIGMA_1 * camera.focal_px[0]) ** 2
    return replace(camera, covariance_order=names, covariance=0.5 * (wide + wide.T))
