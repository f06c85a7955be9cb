"""Identification: detections to catalogue stars, lost in space."""

from startrack.identification.lost_in_space import Identifier

__all__ = ["Identifier"]
