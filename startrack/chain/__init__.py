"""Chain of the stages from one image to the position, and the values that they return."""

from startrack.chain.fingerprint import MISSING, are_unchanged, content_sha256, input_hashes, job_sha256
from startrack.chain.inputs import (
    Image,
    Time,
    angle_rad,
    camera_input,
    duration_s,
    exposure_input,
    field_of_view_rad,
    is_list_of_centroids,
    load_camera_input,
    settings_input,
    terrain_input,
    time_input,
)
from startrack.chain.measured_skyline import (
    CORRELATION_RAD,
    PlacedBySkyline,
    SkylineErrors,
    StatedAttitude,
    locate_skyline,
    skyline_exposure,
    skyline_points,
)
from startrack.chain.measurement import CERTAIN_PROBABILITY, COMPLETE_V_MAG, locate_rays, mask_unpredictable
from startrack.chain.near_attitude import NearAttitude, read_near_attitude
from startrack.chain.orientation import fit_orientation
from startrack.chain.pipeline import (
    add_timing,
    detect,
    identify,
    identify_blind,
    load_named,
    locate,
    locate_exposure,
    locate_measured,
)  # fmt: skip
from startrack.chain.sky_state import stating_sky
from startrack.chain.stages import (
    STAGES,
    Detected,
    FirstLook,
    Identified,
    Inputs,
    Located,
    Measured,
    Oriented,
    Outcome,
    Positioned,
    Refused,
    SecondLook,
    Settings,
    StarFix,
    StarRays,
    identified_names,
    last_value,
)
from startrack.chain.two_looks import EDGE_SIGMA_PX

__all__ = [
    "CERTAIN_PROBABILITY", "COMPLETE_V_MAG", "CORRELATION_RAD", "EDGE_SIGMA_PX", "MISSING", "STAGES", "Detected",
    "FirstLook", "Identified", "Image", "Inputs", "Located", "Measured", "NearAttitude", "Oriented", "Outcome",
    "PlacedBySkyline", "Positioned", "Refused", "SecondLook", "Settings", "SkylineErrors", "StarFix", "StarRays",
    "StatedAttitude", "Time", "add_timing", "angle_rad", "are_unchanged", "camera_input", "content_sha256", "detect",
    "duration_s", "exposure_input", "field_of_view_rad", "fit_orientation", "identified_names", "identify",
    "identify_blind", "input_hashes", "is_list_of_centroids", "job_sha256", "last_value", "load_camera_input",
    "load_named", "locate", "locate_exposure", "locate_measured", "locate_rays", "locate_skyline", "mask_unpredictable",
    "read_near_attitude", "settings_input", "skyline_exposure", "skyline_points", "stating_sky", "terrain_input",
    "time_input",
]  # fmt: skip
