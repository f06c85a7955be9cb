"""What the thesis's methods need of the evidence: a list of seen and of missing stars, on the plane of the rim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.terrain import Terrain
from startrack.types import Array, BadInput, Bools, Evidence, Fix, Mode

DECISIVE_NATS = 5.0  # wrong for 1 star in 150; on a rendered 4 Mpx frame 3 nats double the pseudo-gradient's error


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
    wall is hidden from everywhere on the floor. Raises BadInput bad_terrain where the terrain is no cylinder.
    """
    certainty = np.abs(evidence.llr)
    evidence = evidence.take(certainty >= min(DECISIVE_NATS, 0.5 * float(certainty.max(initial=0.0))))
    disks = terrain.visible_disks(evidence.azimuth_rad, evidence.elevation_rad)
    if disks is None:
        raise BadInput("bad_terrain", f"{terrain.name}: this method needs a [cylinder]")
    points, radius = -disks[0], disks[1]
    rho = np.hypot(points[:, 0], points[:, 1])
    above = rho < 2 * radius
    wall = float(np.median(rho[above] * np.tan(evidence.elevation_rad[above]))) if above.any() else 0.0
    return RimPlane(points[above], evidence.llr[above] > 0, radius, wall)


def point_fix(position_m: Array, sigma_m: float, terrain: Terrain) -> Fix:
    """A fix of a method that states no covariance of its own: a round one of the method's published error per axis."""
    return Fix(
        position_enu_m=np.array([*position_m, terrain.camera_height_m]),
        covariance_m2=sigma_m**2 * np.eye(2),
        radius95_m=2.448 * sigma_m,
        radius999_m=3.717 * sigma_m,
        modes=(Mode(east_m=float(position_m[0]), north_m=float(position_m[1]), weight=1.0),),
        ambiguous=False,
        search="approximate",
    )
