"""From one image to the position: the chain of the stages, and the values that they return."""

from startrack.chain import detect, identify, identify_blind, locate, locate_exposure
from startrack.chain.stages import Settings

__all__ = ["Settings", "detect", "identify", "identify_blind", "locate", "locate_exposure"]
