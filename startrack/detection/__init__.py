"""Detection: exposure to point sources."""

from startrack.detection.detector import Detector
from startrack.detection.frame import electrons, electrons_at

__all__ = ["Detector", "electrons", "electrons_at"]
