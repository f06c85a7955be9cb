"""Evidence: exposure, attitude and catalogue to rays that say "light" or "wall"."""

from startrack.evidence.scale import FluxScale, flux_scale
from startrack.evidence.skyline import Skyline, known_well, levelled, near_skyline
from startrack.evidence.stars import StarEvidence, StarLight

__all__ = ["FluxScale", "Skyline", "StarEvidence", "StarLight", "flux_scale", "known_well", "levelled", "near_skyline"]
