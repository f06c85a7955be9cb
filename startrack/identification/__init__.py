"""Which detection is which catalogue star, with a camera file or from a field of view alone."""

from startrack.identification.centroids import IdentifiedCentroids, identify_centroids
from startrack.identification.lost_in_space import Identifier
from startrack.identification.unknown_lens import UnknownLensSolution, identify_unknown_lens

__all__ = ["IdentifiedCentroids", "Identifier", "UnknownLensSolution", "identify_centroids", "identify_unknown_lens"]
