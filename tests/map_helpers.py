"""Projections, labels and a small map for tests."""

from __future__ import annotations

import numpy as np

from startrack.frames import Site
from startrack.terrain import STEREOGRAPHIC, HeightMap, Projection, Raster

SITE = Site("moon", -1.5, 0.3, 0.0)
POSTS, POST_M, SIGMA_M = 61, 60.0, 4.0  # of `basin`

PDS3 = """PDS_VERSION_ID = PDS3
RECORD_TYPE = FIXED_LENGTH
RECORD_BYTES = 122
FILE_RECORDS = 61
^IMAGE = "HILL.IMG"
TARGET_NAME = {body}
OBJECT = IMAGE
  LINES = 61
  LINE_SAMPLES = 61
  SAMPLE_TYPE = LSB_INTEGER
  SAMPLE_BITS = 16
  UNIT = METER
  SCALING_FACTOR = 0.5
  OFFSET = 1737400.
END_OBJECT = IMAGE
OBJECT = IMAGE_MAP_PROJECTION
  MAP_PROJECTION_TYPE = "POLAR STEREOGRAPHIC"
  MAP_RESOLUTION = 303.23 <pix/deg>
  A_AXIS_RADIUS = {radius} <km>
  B_AXIS_RADIUS = {radius} <km>
  C_AXIS_RADIUS = {radius} <km>
  POSITIVE_LONGITUDE_DIRECTION = "EAST"
  CENTER_LATITUDE = -90. <deg>
  CENTER_LONGITUDE = 0. <deg>
  LINE_PROJECTION_OFFSET = 30. <pix>
  SAMPLE_PROJECTION_OFFSET = 30. <pix>
  MAP_SCALE = 100. <m/pix>
END_OBJECT = IMAGE_MAP_PROJECTION
END
"""  # a detached label of 61 x 61 posts, for format(body=, radius=)


def polar_stereographic(
    south: bool = True, longitude_rad: float = 0.0, true_scale_latitude_rad: float | None = None
) -> Projection:
    """About a pole. rho = 2 R tan((90 - |latitude|) / 2) where the scale is true at the pole (the LOLA polar maps)."""
    pole = -np.pi / 2 if south else np.pi / 2
    at = pole if true_scale_latitude_rad is None else true_scale_latitude_rad
    return Projection(
        kind=STEREOGRAPHIC, latitude_rad=pole, longitude_rad=longitude_rad, scale=float((1 + np.sin(abs(at))) / 2)
    )


def basin(height_sigma_m: float = SIGMA_M) -> HeightMap:
    """Two ridges around a floor: the inner one just below the outer one in the west, far below it in the east."""
    line = (np.arange(POSTS) - POSTS // 2) * POST_M
    east, north = np.meshgrid(line, -line)
    away = np.hypot(east, north)
    inner, outer = (np.exp(-0.5 * ((away - at) / 120.0) ** 2) for at in (700.0, 1400.0))
    heights = (
        (204.0 - 50.0 * (east > 0)) * inner + 420.0 * outer + 4.0 * np.sin(away / 90.0 + 3 * np.arctan2(east, north))
    )
    projection = Projection(kind=STEREOGRAPHIC, latitude_rad=SITE.latitude_rad, longitude_rad=SITE.longitude_rad)
    raster = Raster(
        heights_m=heights.astype(np.float32), source="basin", dx_m=POST_M, dy_m=-POST_M, projection=projection,
        x0_m=float(line[0]), y0_m=-float(line[0]),
    )  # fmt: skip
    return HeightMap(name="basin", site=SITE, maps=(raster,), search_radius_m=300.0, height_sigma_m=height_sigma_m)
