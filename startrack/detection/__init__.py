"""Exposure to point sources; damage of its noise."""

from startrack.detection.damage import Damage, find_damage
from startrack.detection.detector import Detector
from startrack.detection.frame import electrons

__all__ = ["Damage", "Detector", "electrons", "find_damage"]
