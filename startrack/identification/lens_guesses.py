"""Guesses of an unknown lens before any star is known: its bend, focal length, centre and pixel aspect.

A small angle of any lens is that of a pinhole: narrow fields have one guess of the bend, wide ones several. The focal
length follows from the field of view and the frame, or from the image circle of a fisheye lens; where a range of fields
is stated, or the image circle is not seen, a ladder of focal lengths leaves no gap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from startrack.core.types import Array, ImageCircle
from startrack.estimation.radial_fit import PINHOLE_BEND, radius_of

WIDE_FIELD_RAD = float(np.radians(100.0))  # from here up, a field of view is the angle of the image circle
NARROW_FIELD_RAD = float(np.radians(40.0))  # up to here all lenses are nearly pinholes
WIDE_BENDS = (-0.02, 0.02, -0.107, 0.16)
MIDDLE_BENDS = (PINHOLE_BEND, 0.053, -0.027)
WIDEST_ARGUMENT_RAD = np.radians(80.0)  # of sine or tangent, at the edge of the field
CIRCLES = (0.42, 1.0)  # radius of the image circle over the frame's shorter side: between these
LARGEST_CIRCLE = 0.56  # of the frame's diagonal
SEEN_CIRCLES = (1.0, 1.25)  # radius at half the field over that of the visible disc: a dome may hide the horizon
LADDER_STEP = 0.4  # of the logarithm of the field of view, in a range of them
FOCAL_STEP = 0.26  # of the logarithm of the focal length: triangles of a wide lens agree to half of it
SLACK = 0.02  # of the logarithm of the focal length, beyond the range
FIELD_STEPS_PER_E = 4.0  # indexes are made for solid angles a fourth part of a factor e apart


@dataclass(frozen=True)
class LensGuess:
    """A lens whose focal length is known to a factor."""

    focal_px: float  # geometric mean of fx and fy
    log_spread: float  # largest difference of the logarithm of the focal length
    bend: float
    centre_px: tuple[float, float]
    aspect: float = 1.0  # fx / fy

    def with_aspect(self, aspect: float, keeps_width: bool) -> LensGuess:
        """Copy with other pixels, fx as it is where the field of view is that across the width."""
        focal_px = self.focal_px * (aspect**-0.5 if keeps_width else 1.0)
        return replace(self, aspect=aspect, focal_px=focal_px)

    @property
    def scale_px(self) -> Array:
        """Ratios (2,) of fx and fy to the focal length."""
        return np.array([self.aspect**0.5, self.aspect**-0.5])


@dataclass(frozen=True)
class Field:
    """A field of view, and the guesses of lenses that have it."""

    fov_rad: float  # across the frame's width, or that of the whole image circle if the field is wide
    largest_rad: float  # likewise, the largest
    is_wide: bool
    guesses: tuple[LensGuess, ...]
    solid_angle_sr: float  # of the frame or the image circle, rounded so that indexes serve many fields

    @property
    def is_narrow(self) -> bool:
        """Whether all lenses are nearly pinholes in it."""
        return self.fov_rad <= NARROW_FIELD_RAD


def guess_fields(
    size_px: tuple[int, int], lowest_rad: float, highest_rad: float, circles: tuple[ImageCircle | None, ...]
) -> list[Field]:
    """The fields of view between two, wide ones first, with the lenses that a frame (W, H) may have there.

    `circles`: image circles that are assumed for a wide field, in turn; None: by the frame.
    """
    found = []
    if highest_rad >= WIDE_FIELD_RAD:
        found += [_wide_field(size_px, max(lowest_rad, WIDE_FIELD_RAD), highest_rad, circle) for circle in circles]
    top = min(highest_rad, WIDE_FIELD_RAD)
    if lowest_rad < WIDE_FIELD_RAD:
        steps = max(int(np.ceil(np.log(top / lowest_rad) / LADDER_STEP)), 1)
        edges = np.geomspace(top, lowest_rad, steps + 1).tolist()
        found += [_plane_field(size_px, low, high) for high, low in pairwise(edges)]
    return found


def _plane_field(size_px: tuple[int, int], low_rad: float, high_rad: float) -> Field:
    """A field of less than 100 degrees across the width of the frame."""
    width, height = size_px
    fov_rad = float(np.sqrt(low_rad * high_rad))
    bends = (PINHOLE_BEND,) if fov_rad <= NARROW_FIELD_RAD else MIDDLE_BENDS
    centre_px = ((width - 1) / 2, (height - 1) / 2)
    guesses = tuple(
        _guess(width / 2 / radius_of(np.array([high_rad / 2, low_rad / 2]), bend), bend, centre_px) for bend in bends
    )
    half = np.tan(fov_rad / 2)
    other = half * height / width
    solid_sr = 4 * np.arcsin(half * other / np.sqrt((1 + half**2) * (1 + other**2)))
    return Field(fov_rad, high_rad, False, guesses, _rounded(solid_sr))


def _guess(focal_px: Array, bend: float, centre_px: tuple[float, float]) -> LensGuess:
    """Guess of a lens whose focal length lies between two (2,) [px]."""
    low, high = np.log(focal_px).tolist()
    return LensGuess(float(np.exp(0.5 * (low + high))), 0.5 * (high - low) + SLACK, bend, centre_px)


def _wide_field(size_px: tuple[int, int], low_rad: float, high_rad: float, circle: ImageCircle | None) -> Field:
    """A field from 100 degrees up, that of an image circle: as large as the visible one, or by the frame."""
    fov_rad = float(np.sqrt(low_rad * high_rad))
    if circle is not None:
        centre_px, radii_px = circle.centre_px, circle.radius_px * np.array(SEEN_CIRCLES)
    else:
        centre_px = ((size_px[0] - 1) / 2, (size_px[1] - 1) / 2)
        radii_px = np.minimum(min(size_px) * np.array(CIRCLES), LARGEST_CIRCLE * np.hypot(*size_px))
    guesses = []
    for bend in WIDE_BENDS:
        most_rad = WIDEST_ARGUMENT_RAD / np.sqrt(3 * bend if bend > 0 else -6 * bend)
        if low_rad / 2 > most_rad:
            continue
        half_rad = np.minimum(np.array([high_rad, low_rad]) / 2, most_rad)
        low, high = np.log(radii_px / radius_of(half_rad, bend)).tolist()
        steps = max(int(np.ceil((high - low) / FOCAL_STEP)), 1)
        logs = low + (np.arange(steps) + 0.5) * (high - low) / steps
        spread = 0.5 * (high - low) / steps + SLACK
        guesses += [LensGuess(float(np.exp(one)), spread, bend, centre_px) for one in logs]
    solid_sr = 2 * np.pi * (1 - np.cos(min(fov_rad / 2, np.pi / 2)))
    return Field(fov_rad, high_rad, True, tuple(guesses), _rounded(solid_sr))


def _rounded(solid_sr: float) -> float:
    """Solid angle [sr] rounded to a fourth part of a factor e, so that similar fields share their patterns."""
    return float(np.exp(np.round(FIELD_STEPS_PER_E * np.log(solid_sr)) / FIELD_STEPS_PER_E))
