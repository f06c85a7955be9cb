"""Identification: detections to catalogue stars, lost in space."""

from startrack.identify.identifier import Identifier

__all__ = ["Identifier"]
