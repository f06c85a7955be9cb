"""Detection: exposure to point sources."""

from startrack.detect.detector import Detector, electrons

__all__ = ["Detector", "electrons"]
