"""Cells of heights in which the log-likelihood of a sector's skyline is quadratic, as the kernels read them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from startrack.core.types import Array, Ints
from startrack.kernels.library import kernel

LOW_RAD, HIGH_RAD = np.radians(-12.0), np.radians(20.0)  # window of heights: beyond it a skyline is no skyline
GUIDE = 256  # heights of the guide to the cells, to each side


class Profiles(NamedTuple):
    """F of each sector in cells of heights, quadratic in each, as the kernels read it.

    Cell k reaches from x[k] to x[k + 1]; the last one of a sector is a sentinel.
    """

    first: Ints  # (SECTORS + 1,) cell where each sector begins
    x: Array  # (m,) [rad]
    left: Array  # (m,) F at the begin of a cell
    right: Array  # (m,) and at its end
    bend: Array  # (m,) 4 (F in the middle - mean of both)
    integral: Array  # (m,) of exp(F - free) from the lowest height to x
    free: Array  # (SECTORS,) R
    guide: Ints  # (SECTORS, 2 GUIDE + 1) cells of heights closer to each other about 0, where a search begins
    scale: (
        Array  # (SECTORS,) exp(R + H - N): H is the sum of the stars above the window, N the greater one of R + H and 0
    )
    hidden: Array  # (SECTORS,) exp(-N): of a sector in which everything is hidden, the stars above the window too
    offset: Array  # (SECTORS,) N: all likelihoods of a sector are less it


FORMS = {"first": "int64[sectors + 1]", "guide": "int32[sectors, guides]"}
FORMS |= dict.fromkeys(("x", "left", "right", "bend", "integral"), "float64[m]")
FORMS |= dict.fromkeys(("free", "scale", "hidden"), "float64[sectors]")


def declare(names: str, prefix: str = "", size: str = "m") -> list[str]:
    """Declarations of the arrays of Profiles with these `names`, for a kernel; `size`: name of the number of cells."""
    return [f"{prefix}{name}: {FORMS[name].replace('[m]', f'[{size}]')}" for name in names.split()]


def take(profiles: Profiles, names: str) -> list[Array]:
    """The arrays of `profiles` with these `names`, as `declare` declares them."""
    return [getattr(profiles, name) for name in names.split()]


Cells = tuple[Ints, Array, Array, Array, Array, Array, Array, Any]  # the first fields of Profiles


def integrate_cells(first: Ints, x: Array, left: Array, right: Array, bend: Array, width: float) -> Cells:
    """The cells with `integral`, `free` and the guide, for a window of that `width`; each cell by Simpson's rule."""
    sectors = len(first) - 1
    integral, free = np.zeros(len(x)), np.zeros(sectors)
    guide = np.empty((sectors, 2 * GUIDE + 1), np.int32)
    _integrate(first, x, left, right, bend, width, HIGH_RAD, integral, free, guide)
    return first, x, left, right, bend, integral, free, guide


_integrate = kernel(
    "integrate_cells", *declare("first x left right bend"), "width: float64", "highest: float64",
    "integral: out float64[m]", "free: out float64[sectors]", "guide: out int32[sectors, guides]",
)  # fmt: skip
