"""Which detection is which catalogue star, with a camera file or from a field of view alone."""

from startrack.identification.centroids import IdentifiedCentroids, identify_centroids
from startrack.identification.lens_guesses import WIDE_FIELD_RAD
from startrack.identification.lost_in_space import MAX_FALSE_ALARM, Identifier
from startrack.identification.near_sky import NearSky
from startrack.identification.second_field import check_single_field
from startrack.identification.unknown_lens import UnknownLensSolution, advise_on_fields, identify_unknown_lens
from startrack.identification.verify_unknown_lens import coincidence_radius_px

__all__ = [
    "MAX_FALSE_ALARM", "WIDE_FIELD_RAD", "IdentifiedCentroids", "Identifier", "NearSky", "UnknownLensSolution",
    "advise_on_fields", "check_single_field", "coincidence_radius_px", "identify_centroids", "identify_unknown_lens",
]  # fmt: skip
