"""Exposure, attitude and catalogue to rays, each with the log-likelihood ratio of sky against ground."""

from startrack.evidence.damaged_response import DamagedResponse, measure_noise, measure_response
from startrack.evidence.flux_scale import FluxScale, flux_scale
from startrack.evidence.sky_light import SkyLight
from startrack.evidence.sky_step import (
    Skyline,
    SkyStep,
    height_above_px,
    measure_sky_step,
    reliable_azimuths,
    subtract_sky_step,
)  # fmt: skip
from startrack.evidence.star_evidence import StarEvidence, StarPhotometry

__all__ = [
    "DamagedResponse",
    "FluxScale",
    "SkyLight",
    "SkyStep",
    "Skyline",
    "StarEvidence",
    "StarPhotometry",
    "flux_scale",
    "height_above_px",
    "measure_noise",
    "measure_response",
    "measure_sky_step",
    "reliable_azimuths",
    "subtract_sky_step",
]
