"""Detection: exposure to point sources."""

from startrack.detection.detector import Detector
from startrack.detection.frame import electrons

__all__ = ["Detector", "electrons"]
