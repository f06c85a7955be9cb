"""Exposure to point sources; damage of its noise."""

from startrack.detection.background import smallest_step
from startrack.detection.damage import COARSE_STEPS, Damage, find_damage
from startrack.detection.detector import Detector
from startrack.detection.frame import electrons

__all__ = ["COARSE_STEPS", "Damage", "Detector", "electrons", "find_damage", "smallest_step"]
