"""Projections of maps for tests."""

from __future__ import annotations

import numpy as np

from startrack.terrain.raster import STEREOGRAPHIC, Projection


def polar_stereographic(
    south: bool = True, longitude_rad: float = 0.0, true_scale_latitude_rad: float | None = None
) -> Projection:
    """About a pole. rho = 2 R tan((90 - |latitude|) / 2) where the scale is true at the pole (the LOLA polar maps)."""
    pole = -np.pi / 2 if south else np.pi / 2
    at = pole if true_scale_latitude_rad is None else true_scale_latitude_rad
    return Projection(
        kind=STEREOGRAPHIC, latitude_rad=pole, longitude_rad=longitude_rad, scale=float((1 + np.sin(abs(at))) / 2)
    )
