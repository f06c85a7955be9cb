"""Detection: exposure to point sources."""

from startrack.detect.detector import Detector
from startrack.detect.frame import electrons

__all__ = ["Detector", "electrons"]
