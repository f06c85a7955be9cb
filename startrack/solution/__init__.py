"""Results of the library's functions: a solution, and its position, attitude and clock as values with units."""

from startrack.solution.solution import Solution
from startrack.solution.values import ClockOffset, Ellipse, Orientation, Position

__all__ = ["ClockOffset", "Ellipse", "Orientation", "Position", "Solution"]
