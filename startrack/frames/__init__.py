"""Frames, angles, time and the orientation of Moon and Earth: the only rooms that know them.

`icrs` -> (R_enu_icrs) -> `enu` of a site. Importing this is light; SPICE and ERFA load when they are first needed.
"""

from startrack.frames.observer import R_enu_icrs, observer_state, observer_velocity_m_s
from startrack.frames.rays import (
    SPEED_OF_LIGHT_M_S,
    aberrate,
    angle_between_rad,
    azel_from_rays,
    rays_from_azel,
    refract_rad,
)
from startrack.frames.rotations import R_from_quat_xyzw, quat_xyzw_from_R
from startrack.frames.site import (
    MOON_RADIUS_M,
    R_enu_fixed,
    Site,
    enu_from_latlon,
    latlon_from_enu,
    position_fixed_m,
)
from startrack.frames.spice import R_mcmf_icrs, barycentric_state, et_s
from startrack.frames.time import as_utc, format_utc, parse_utc

__all__ = [
    "MOON_RADIUS_M",
    "SPEED_OF_LIGHT_M_S",
    "R_enu_fixed",
    "R_enu_icrs",
    "R_from_quat_xyzw",
    "R_mcmf_icrs",
    "Site",
    "aberrate",
    "angle_between_rad",
    "as_utc",
    "azel_from_rays",
    "barycentric_state",
    "enu_from_latlon",
    "et_s",
    "format_utc",
    "latlon_from_enu",
    "observer_state",
    "observer_velocity_m_s",
    "parse_utc",
    "position_fixed_m",
    "quat_xyzw_from_R",
    "rays_from_azel",
    "refract_rad",
]
