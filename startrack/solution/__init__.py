"""What a caller of the library gets: a solution, and its position and attitude as values with units."""

from startrack.solution.solution import Solution
from startrack.solution.values import Ellipse, Orientation, Position

__all__ = ["Ellipse", "Orientation", "Position", "Solution"]
