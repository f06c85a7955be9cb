"""Frames, rotations, time, and the orientation of Moon and Earth.

`icrs` -> (R_enu_icrs) -> `enu` of a site. SPICE, ERFA and SciPy are imported at their first use.
"""

from startrack.frames.air import (
    AIR_KEYS,
    AIR_TABLE,
    EARTH_RADIUS_M,
    EXTINCTION_SIGMA_MAG,
    LOWEST_PREDICTED_RAD,
    USUAL_EXTINCTION_MAG,
    USUAL_SIGMA_1,
    Air,
    airmass,
    turn_sky,
)
from startrack.frames.directions import (
    ORTHONORMAL_1,
    SPEED_OF_LIGHT_M_S,
    R_body_enu_from_heading_pitch_roll,
    R_from_quat_xyzw,
    R_from_rotvec,
    aberrate,
    angle_between_rad,
    azel_from_rays,
    heading_pitch_roll_from_R_body_enu,
    length_xy,
    nearest_rotation,
    off_axis_rad,
    quat_xyzw_from_R,
    rays_from_azel,
    tum_line,
    turn_azel,
    wahba,
)
from startrack.frames.orientation import EPHEMERIS_YEARS, R_mcmf_icrs, barycentric_state, et_s, ut1_sigma_s
from startrack.frames.site import (
    MOON_RADIUS_M,
    R_enu_fixed,
    R_enu_icrs,
    Site,
    enu_from_latlon,
    latlon_from_enu,
    observer_state,
    observer_velocity_m_s,
    position_fixed_m,
    sky_rotvec_rad,
    sphere_radius_m,
)
from startrack.frames.time import as_utc, format_utc, parse_utc, seconds_since_2000

__all__ = [
    "AIR_KEYS", "AIR_TABLE", "EARTH_RADIUS_M", "EPHEMERIS_YEARS", "EXTINCTION_SIGMA_MAG", "LOWEST_PREDICTED_RAD",
    "MOON_RADIUS_M", "ORTHONORMAL_1", "SPEED_OF_LIGHT_M_S", "USUAL_EXTINCTION_MAG", "USUAL_SIGMA_1", "Air",
    "R_body_enu_from_heading_pitch_roll", "R_enu_fixed", "R_enu_icrs", "R_from_quat_xyzw", "R_from_rotvec",
    "R_mcmf_icrs", "Site", "aberrate", "airmass", "angle_between_rad", "as_utc", "azel_from_rays", "barycentric_state",
    "enu_from_latlon", "et_s", "format_utc", "heading_pitch_roll_from_R_body_enu", "latlon_from_enu", "length_xy",
    "nearest_rotation", "observer_state", "observer_velocity_m_s", "off_axis_rad", "parse_utc", "position_fixed_m",
    "quat_xyzw_from_R", "rays_from_azel", "seconds_since_2000", "sky_rotvec_rad", "sphere_radius_m", "tum_line",
    "turn_azel", "turn_sky", "ut1_sigma_s", "wahba",
]  # fmt: skip
