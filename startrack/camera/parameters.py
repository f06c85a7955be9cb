"""A camera by its parameters: changed by a fit, and with their covariance as the file holds it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.camera.camera import Camera
from startrack.camera.decentring import Decentring
from startrack.camera.kannala_brandt import KannalaBrandt
from startrack.types import Array

LOCKED_1 = 1e-7  # relative: fx and fy of square pixels, apart just enough that the matrix has an inverse


def with_update(camera: Camera, by: dict[str, float]) -> Camera:
    """The camera with its parameters changed: f (both focal lengths), fx, fy, cx, cy, k1 ... k4, p1, p2."""
    fx, fy = camera.focal_px
    stretched = 1.0 + by.get("f", 0.0) / fx
    focal = (float(fx * stretched + by.get("fx", 0.0)), float(fy * stretched + by.get("fy", 0.0)))
    centre = (float(camera.centre_px[0] + by.get("cx", 0.0)), float(camera.centre_px[1] + by.get("cy", 0.0)))
    lens = camera.lens
    if camera.lens.model == "kannala_brandt":
        steps = [by.get(f"k{n}", 0.0) for n in range(1, 5)]
        order = max(len(lens.k), *(n for n in range(5) if n == 0 or f"k{n}" in by))
        known = (*lens.k, 0.0, 0.0, 0.0, 0.0)
        lens = KannalaBrandt(tuple(float(known[n] + steps[n]) for n in range(order)))
    bent = camera.decentring
    bent = Decentring(float(bent.p1 + by.get("p1", 0.0)), float(bent.p2 + by.get("p2", 0.0)))
    return replace(camera, focal_px=focal, centre_px=centre, lens=lens, decentring=bent)


def with_covariance(camera: Camera, free: tuple[str, ...], covariance: Array) -> Camera:
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
