"""Evidence: exposure, attitude and catalogue to rays that say "light" or "wall"."""

from startrack.evidence.scale import FluxScale, flux_scale
from startrack.evidence.stars import StarEvidence, StarLight

__all__ = ["FluxScale", "StarEvidence", "StarLight", "flux_scale"]
