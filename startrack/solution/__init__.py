"""Results of the library's functions: a solution, and its position and attitude as values with units."""

from startrack.solution.solution import Solution
from startrack.solution.values import Ellipse, Orientation, Position

__all__ = ["Ellipse", "Orientation", "Position", "Solution"]
