"""Evidence as the thesis's methods need it: a list of seen and of missing stars, on the plane of the rim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, BadInput, Bools, Evidence, Fix, Mode, NotLocated
from startrack.localization.summary import camera_at, require_inside
from startrack.terrain import Terrain, require_terrain

DECISIVE_NATS = 5.0  # wrong for 1 star in 150; on a rendered 4 Mpx frame 3 nats double the pseudo-gradient's error
FAR_M = 1e12


@dataclass(frozen=True)
class RimPlane:
    """Stars where their rays pierce the plane of a circular rim, seen from the camera."""

    points_m: Array  # (n, 2): rho u
    seen: Bools  # (n,): the likelier of the two, as a detection list would say
    radius_m: float
    wall_m: float  # height of the rim above the camera


def stars_on_rim_plane(evidence: Evidence, terrain: Terrain) -> RimPlane:
    """The stars that a detection list would hold or lack: with decisive evidence, and above the lowest skyline.

    Faint stars whose light was not measured either way are on no list. A star lower than the rim seen from the opposite
    wall is hidden from everywhere on the floor. Raises BadInput bad_terrain where the terrain is no cylinder, or none.
    """
    terrain = require_terrain(terrain)
    certainty = np.abs(evidence.llr)
    evidence = evidence.take(certainty >= min(DECISIVE_NATS, 0.5 * float(certainty.max(initial=0.0))))
    if terrain.rim is None:
        raise BadInput("bad_terrain", f"{terrain.name}: this method needs a [cylinder]")
    radius, height = terrain.rim
    points = points_of_rays(height, evidence.azimuth_rad, evidence.elevation_rad)
    rho = np.hypot(points[:, 0], points[:, 1])
    above = rho < 2 * radius
    wall = float(np.median(rho[above] * np.tan(evidence.elevation_rad[above]))) if above.any() else 0.0
    return RimPlane(points[above], evidence.llr[above] > 0, radius, wall)


def points_of_rays(wall_m: float, azimuths_rad: Array, elevations_rad: Array) -> Array:
    """Points (n, 2) [m] where rays (n,) pierce a plane `wall_m` above the camera: rho u, rho = wall / tan e, u level.

    A ray is visible from p exactly where |p + rho u| is below the radius of the rim in that plane; rays at or below
    the horizontal pierce it infinitely far away.
    """
    tan = np.tan(elevations_rad)
    rho = np.divide(wall_m, tan, out=np.full_like(tan, FAR_M), where=tan > 0)
    return np.minimum(rho, FAR_M)[:, None] * np.stack([np.sin(azimuths_rad), np.cos(azimuths_rad)], axis=-1)


def point_fix(position_m: Array, terrain: Terrain) -> Fix:
    """The fix at a position (2,) [m] of a method without a posterior: covariance and circles are infinite, not stated.

    The method's published error is no substitute: it holds for the publication's skies, not for this evidence. Raises
    NotLocated outside_search_area where the position is beyond the search radius or no camera can stand there.
    """
    require_inside(position_m[None], np.ones(1), terrain)
    if not terrain.allowed(position_m[None])[0]:
        raise NotLocated(
            f"the stars place the camera at E {position_m[0]:.0f} m N {position_m[1]:.0f} m, where none can stand",
            reason="outside_search_area",
        )
    return Fix(
        position_enu_m=camera_at(position_m, terrain),
        covariance_m2=np.full((2, 2), np.inf),
        radius95_m=np.inf,
        radius999_m=np.inf,
        modes=(Mode(east_m=float(position_m[0]), north_m=float(position_m[1]), weight=1.0),),
        ambiguous=False,
        search="approximate",
    )
