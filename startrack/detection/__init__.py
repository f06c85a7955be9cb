"""Exposure to point sources; damage of its noise."""

from startrack.detection.background import smallest_step
from startrack.detection.damage import ROUNDED, Damage, find_damage, is_rounded
from startrack.detection.detector import Detector
from startrack.detection.frame import electrons
from startrack.detection.positions import PositionDetector

__all__ = [
    "ROUNDED", "Damage", "Detector", "PositionDetector", "electrons", "find_damage", "is_rounded", "smallest_step",
]  # fmt: skip
