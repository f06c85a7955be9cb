"""Identification of the stars among the detections, with a camera file or from a field of view alone."""

from startrack.identification.attitude_search import INLIER_PX, MIN_MATCHES
from startrack.identification.lens_guesses import WIDE_FIELD_RAD
from startrack.identification.lost_in_space import MAX_FALSE_ALARM, Identifier
from startrack.identification.near_sky import NearSky
from startrack.identification.unknown_lens import UnknownLensSolution, advise_on_fields, identify_unknown_lens
from startrack.identification.verify_unknown_lens import coincidence_radius_px

__all__ = [
    "INLIER_PX", "MAX_FALSE_ALARM", "MIN_MATCHES", "WIDE_FIELD_RAD", "Identifier", "NearSky", "UnknownLensSolution",
    "advise_on_fields", "coincidence_radius_px", "identify_unknown_lens",
]  # fmt: skip
