"""Exposure to point sources; damage of its noise."""

from startrack.detection.background import image_circle, smallest_step
from startrack.detection.damage import ROUNDED, Damage, find_damage, is_rounded
from startrack.detection.detector import Detector, PositionDetector, source_variances
from startrack.detection.frame import MIN_BINNED_SIGMA_PX, electrons
from startrack.detection.peaks import disc_px, find_blobs, light_at
from startrack.detection.psf_width import WIDTH_TOLERANCE

__all__ = [
    "MIN_BINNED_SIGMA_PX", "ROUNDED", "WIDTH_TOLERANCE", "Damage", "Detector", "PositionDetector", "disc_px",
    "electrons", "find_blobs", "find_damage", "image_circle", "is_rounded", "light_at", "smallest_step",
    "source_variances",
]  # fmt: skip
