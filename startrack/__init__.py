"""Rover position and attitude from one picture of the stars."""

__version__ = "0.1.0"
