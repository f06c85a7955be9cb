"""What the thesis's methods need of the evidence: a list of seen and of missing stars, on the plane of the rim."""

from __future__ import annotations

import numpy as np

from startrack.terrain import Cylinder, Terrain
from startrack.types import Array, BadInput, Bools, Evidence, Fix, Mode

DECISIVE_NATS = 5.0  # wrong for 1 star in 150; on a rendered 4 Mpx frame 3 nats double the pseudo-gradient's error


def cylinder_of(terrain: Terrain) -> Cylinder:
    """The terrain, if it is the cylinder that these methods are made for; raises BadInput bad_terrain otherwise."""
    if not isinstance(terrain, Cylinder):
        raise BadInput("bad_terrain", f"{terrain.name}: this method needs a [cylinder]")
    return terrain


def decided_stars(evidence: Evidence, cylinder: Cylinder) -> Evidence:
    """The stars that a detection list would hold or lack: with decisive evidence, and above the lowest skyline.

    Faint stars whose light was not measured either way are on no list. A star lower than the rim seen from the opposite
    wall is hidden from everywhere on the floor.
    """
    certainty = np.abs(evidence.llr)
    decisive = certainty >= min(DECISIVE_NATS, 0.5 * float(certainty.max(initial=0.0)))
    lowest_rad = np.arctan2(cylinder.wall_m, cylinder.diameter_m)
    return evidence.take(decisive & (evidence.elevation_rad > lowest_rad))


def seen_stars(evidence: Evidence) -> Bools:
    """Rays (n,) taken as seen: the likelier of the two, as a detection list would say."""
    return evidence.llr > 0


def on_rim_plane(evidence: Evidence, cylinder: Cylinder) -> Array:
    """Where the rays (n) pierce the plane of the rim, seen from the camera [m] (n, 2): rho_i u_i."""
    rho = cylinder.wall_m / np.tan(evidence.elevation_rad)
    return rho[:, None] * np.stack([np.sin(evidence.azimuth_rad), np.cos(evidence.azimuth_rad)], axis=1)


def point_fix(position_m: Array, sigma_m: float, cylinder: Cylinder) -> Fix:
    """A fix of a method that states no covariance of its own: a round one of the method's published error per axis."""
    return Fix(
        position_enu_m=np.array([*position_m, cylinder.camera_height_m]),
        covariance_m2=sigma_m**2 * np.eye(2),
        radius95_m=2.448 * sigma_m,
        radius999_m=3.717 * sigma_m,
        modes=(Mode(east_m=float(position_m[0]), north_m=float(position_m[1]), weight=1.0),),
        ambiguous=False,
    )
