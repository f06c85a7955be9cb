"""Evidence: exposure, attitude and catalogue to rays that say "light" or "wall"."""

from startrack.evidence.flux_scale import FluxScale, flux_scale
from startrack.evidence.sky_step import Skyline, known_well, levelled, near_skyline
from startrack.evidence.star_evidence import StarEvidence, StarLight

__all__ = ["FluxScale", "Skyline", "StarEvidence", "StarLight", "flux_scale", "known_well", "levelled", "near_skyline"]
