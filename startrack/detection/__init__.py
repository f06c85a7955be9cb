"""Exposure to point sources; damage of its noise."""

from startrack.detection.background import smallest_step
from startrack.detection.blobs import disc_px, find_blobs, light_at
from startrack.detection.damage import ROUNDED, Damage, find_damage, is_rounded
from startrack.detection.detector import Detector
from startrack.detection.frame import electrons
from startrack.detection.positions import PositionDetector

__all__ = [
    "ROUNDED", "Damage", "Detector", "PositionDetector", "disc_px", "electrons", "find_blobs", "find_damage",
    "is_rounded", "light_at", "smallest_step",
]  # fmt: skip
