"""Catalogue patterns for one field of view: triangles and pairs of bright stars, and grids of stars by depth.

Patterns and the angular size of a camera's pixels are computed once per catalogue and camera, and kept.
"""

from __future__ import annotations

import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Stars
from startrack.identification.star_grid import Neighbours, StarGrid
from startrack.identification.triangles import BRIGHT, DEEP, PairIndex, PatternIndex, build_index, build_pairs

FEWEST_STARS = 1000  # brightest stars in the smallest grid; each next one holds twice as many
CACHED_PATTERNS = 6  # of catalogues and fields
SCALE_GRID = 33  # pixels per axis at which the solid angle of the field is summed
SCALE_ANGLES = 64
LARGEST_SCALE_1 = 3.0  # limit of the scale over that on the axis, for lenses strongly compressed at the edge

Computed = TypeVar("Computed")


class PerObject(Generic[Computed]):
    """Cache of `compute(thing)`: computed once per object and kept as long as the object lives.

    The key is the object, not its value: comparing catalogues would take longer than the computation saves.
    """

    def __init__(self, compute: Callable[[Any], Computed]) -> None:
        self._compute = compute
        self._cache: dict[int, tuple[weakref.ref[Any], Computed]] = {}

    def __call__(self, thing: Any) -> Computed:
        key = id(thing)
        entry = self._cache.get(key)
        if entry is None or entry[0]() is not thing:
            entry = (weakref.ref(thing, lambda _: self._cache.pop(key, None)), self._compute(thing))
            self._cache[key] = entry
        return entry[1]


@dataclass(frozen=True)
class PixelScale:
    """Angular size of a camera's pixels, and the field of view."""

    axis_rad_per_px: float
    largest_rad_per_px: float  # anywhere in the field and in any direction
    field_sr: float  # of the image circle, or of the frame where that is smaller
    frame_fraction: float  # of the image circle that the frame contains

    @property
    def diameter_rad(self) -> float:
        """Diameter of a flat disc with the field's solid angle."""
        return float(np.sqrt(4 * self.field_sr / np.pi))

    @classmethod
    def measure(cls, camera: Camera) -> PixelScale:
        """The scale of a camera, measured on grids of angles and of pixels."""
        axis = camera.unproject(np.array([camera.centre_px]))[0]
        off_axis = np.arctan2(np.hypot(axis[0], axis[1]), axis[2]) + 0.01
        angle = np.linspace(0.01, min(camera.max_angle_rad, camera.lens.max_invertible_rad) - 1e-3, SCALE_ANGLES)
        focal = min(camera.focal_px)
        radial, across = 1.0 / camera.lens.slope(angle), np.sin(angle) / camera.lens.rho(angle)
        largest = min(1.05 * float(np.maximum(radial, across).max() / focal), LARGEST_SCALE_1 / focal)
        width, height = camera.size_px
        x, y = np.meshgrid(np.linspace(0, width - 1, SCALE_GRID), np.linspace(0, height - 1, SCALE_GRID))
        off_axis_rad = camera.angle_rad(np.stack([x, y], axis=-1))
        lit = off_axis_rad[off_axis_rad < camera.max_angle_rad]
        field_sr = float(np.sum(camera.pixel_solid_angle_sr(lit) * (width * height / SCALE_GRID**2)))
        circle_sr = 2 * np.pi * (1 - np.cos(camera.max_angle_rad))
        on_axis = float(camera.mean_scale_rad_per_px(off_axis))
        return cls(on_axis, largest, field_sr, min(float(field_sr / circle_sr), 1.0))


pixel_scale_of = PerObject(PixelScale.measure)


class CatalogPatterns:
    """The indexes for a camera that sees `field_sr`, each built when it is first used."""

    def __init__(self, stars: Stars, field_sr: float) -> None:
        """Take `stars` that are sorted, brightest first."""
        self.stars, self.field_sr = stars, field_sr
        self._grids: dict[int, StarGrid] = {}

    @cached_property
    def bright_index(self) -> PatternIndex:
        """Index of the triangles of the brightest few stars."""
        return build_index(self.stars, self.field_sr, BRIGHT)

    @cached_property
    def deep_index(self) -> PatternIndex:
        """Index of the triangles of more stars."""
        return build_index(self.stars, self.field_sr, DEEP)

    @cached_property
    def pairs(self) -> PairIndex:
        """Index of the pairs of bright stars."""
        return build_pairs(self.stars, self.field_sr)

    def neighbours(self, rays_icrs: Array, radius_rad: float, count: int) -> Neighbours:
        """All pairs of a ray (n, 3) and a star closer than the radius, of the `count` brightest stars and some more."""
        level = FEWEST_STARS << max((count - 1) // FEWEST_STARS, 0).bit_length()
        if level not in self._grids:
            self._grids[level] = StarGrid(self.stars.rays_icrs[:level])
        return self._grids[level].neighbours(rays_icrs, 2 * np.sin(radius_rad / 2))


def patterns_of(stars: Stars, field_sr: float) -> CatalogPatterns:
    """The patterns of these stars; patterns of the last few catalogues and fields are kept."""
    return keep_last_few(_KEPT, (*sky_key_of(stars), field_sr), lambda: CatalogPatterns(stars, field_sr))


def keep_last_few(kept: OrderedDict[Any, Computed], key: Hashable, compute: Callable[[], Computed]) -> Computed:
    """The value of the `key`, computed unless it is among the last few that were asked for."""
    if key not in kept:
        kept[key] = compute()
        while len(kept) > CACHED_PATTERNS:
            kept.popitem(last=False)
    kept.move_to_end(key)
    return kept[key]


sky_key_of = PerObject(lambda stars: (len(stars), stars.rays_icrs[:2000].tobytes()))
_KEPT: OrderedDict[Any, CatalogPatterns] = OrderedDict()
