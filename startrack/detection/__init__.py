"""Exposure to point sources; damage of its noise."""

from startrack.detection.background import smallest_step
from startrack.detection.damage import ROUNDED, Damage, find_damage, is_rounded
from startrack.detection.detector import Detector
from startrack.detection.frame import electrons

__all__ = ["ROUNDED", "Damage", "Detector", "electrons", "find_damage", "is_rounded", "smallest_step"]
