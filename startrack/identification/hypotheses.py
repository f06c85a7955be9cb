"""Hypotheses of an unknown camera: similar triangles propose scale and attitude, the bright stars rank them."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Bools, Ints, Stars
from startrack.estimation.false_alarm import PATTERN_MATCHES, log_p_value
from startrack.identification.index import separate_bright_stars
from startrack.identification.proximity_mask import ProximityMask, proximity_mask
from startrack.identification.radial_lens_family import RadialFamily, angle
from startrack.identification.region_growing import LensHypothesis
from startrack.identification.triangles import ShapeIndex, Triangles, shape_index, triad_attitude, triangles

HEMISPHERE_SR = 2 * np.pi
STARS_OF_HEMISPHERE = 200  # pattern stars of the whole sky for a lens with half of it in view
MAX_PATTERN_STARS = 25_000
SIDE_OF_HEMISPHERE_RAD = np.radians(45.0)
NEAR_OF_HEMISPHERE_RAD = np.radians(1.5)
NARROWEST_NEAR_RAD = np.radians(0.15)
LOCAL_SIDES = 1.2  # of the longest side, about the triangle: within it an imperfect lens still fits
CANDIDATES_AT_ONCE = 20_000
MAX_HYPOTHESES = 6  # of one lens and window; the true one is nearly always the likeliest
MAX_DETECTIONS = 100
VERIFICATION_STAGES = (
    (24, -1.5),
    (48, -4.0),
)  # detections tested against the stars; log p-value below which the test goes on
MAX_VERIFIED = 80
CACHED_PATTERNS = 6


@dataclass(frozen=True)
class LensGuess:
    """A lens of the family; its focal length is uncertain by the size tolerance of the patterns."""

    focal_px: float
    shape: float
    centre_px: tuple[float, float]


@dataclass(frozen=True)
class Window:
    """Ranks of brightness, `first` to `end`, whose triangles are tried, unless all vertices come before `done`."""

    first: int
    done: int
    end: int


@dataclass(frozen=True)
class ShapePatterns:
    """Triangles of the brightest catalogue stars by shape, and a mask of the sky near these stars."""

    star: Ints  # (m,) indices in Stars
    rays_icrs: Array  # (m, 3)
    longest_side_rad: float
    triangles: ShapeIndex
    mask: ProximityMask

    @cached_property
    def log_p_table(self) -> Array:
        """log P(at least k of n random directions near a bright star), [n, k]."""
        n, k = np.meshgrid(np.arange(MAX_DETECTIONS + 1), np.arange(MAX_DETECTIONS + 1), indexing="ij")
        return log_p_value(k, n, self.mask.sky_fraction, free=0)


@dataclass(frozen=True)
class PatternSizes:
    """Numbers of catalogue patterns for a field of view."""

    stars: int  # brightest of the whole sky
    longest_side_rad: float
    near_rad: float  # a detection this close to a bright star is a hit
    shape_tolerance: float
    size_tolerance: float


def wide_sizes(field_sr: float) -> PatternSizes:
    """Sizes for an unknown distorting lens: few stars, wide tolerances."""
    fraction = min(field_sr / HEMISPHERE_SR, 1.0)
    stars = int(min(STARS_OF_HEMISPHERE / fraction, MAX_PATTERN_STARS))
    side, near = SIDE_OF_HEMISPHERE_RAD * np.sqrt(fraction), NEAR_OF_HEMISPHERE_RAD * np.sqrt(fraction)
    return PatternSizes(stars, float(side), float(max(near, NARROWEST_NEAR_RAD)), 0.02, 0.13)


def narrow_sizes(field_sr: float, stars_in_field: int, side_of_field: float) -> PatternSizes:
    """Sizes for a lens close to a pinhole: narrow tolerances.

    `stars_in_field`: pattern stars in a field; `side_of_field`: longest side over the field's diameter.
    """
    diameter = float(np.sqrt(4 * field_sr / np.pi))
    stars = int(min(stars_in_field * 4 * np.pi / field_sr, MAX_PATTERN_STARS))
    near = max(0.015 * diameter, NARROWEST_NEAR_RAD)
    return PatternSizes(stars, side_of_field * diameter, float(near), 0.004, 0.12)


def patterns_for(stars: Stars, sizes: PatternSizes) -> ShapePatterns:
    """Patterns of the stars (sorted, brightest first).

    The last few are kept; the key rounds the stars' directions, so that catalogues of nearby years share them.
    """
    import hashlib

    key = (sizes, len(stars), hashlib.sha1(np.round(stars.rays_icrs[:500], 3).tobytes()).hexdigest())
    if key not in _CACHE:
        star = separate_bright_stars(stars, sizes.stars)
        rays = stars.rays_icrs[star]
        found = triangles(rays, sizes.longest_side_rad * (1 + sizes.size_tolerance))
        index = shape_index(found, sizes.shape_tolerance, sizes.size_tolerance)
        _CACHE[key] = ShapePatterns(star, rays, sizes.longest_side_rad, index, proximity_mask(rays, sizes.near_rad))
        while len(_CACHE) > CACHED_PATTERNS:
            _CACHE.popitem(last=False)
    _CACHE.move_to_end(key)
    return _CACHE[key]


_CACHE: OrderedDict[tuple[PatternSizes, int, str], ShapePatterns] = OrderedDict()


def family_rays(xy_px: Array, centre_px: tuple[float, float], focal_px: Array | float, shape: float) -> Array:
    """Rays (..., 3) of pixels (..., 2) through a lens of the family, not mirrored; focal lengths broadcast."""
    off = xy_px - np.array(centre_px, dtype=xy_px.dtype)
    r = np.hypot(off[..., 0], off[..., 1])
    a = angle(r / focal_px, shape)
    scale = np.sin(a) / np.maximum(r, 1e-9)
    return np.stack([off[..., 0] * scale, off[..., 1] * scale, np.cos(a)], axis=-1)


class HypothesisSearch:
    """Lens hypotheses from the brightest detections (n, 2), no two of which are close together."""

    def __init__(self, xy_px: Array, size_px: tuple[int, int]) -> None:
        self.xy_px, self.size_px = xy_px[:MAX_DETECTIONS], size_px
        self.tried = 0

    def hypotheses(
        self, patterns: ShapePatterns, guess: LensGuess, window: Window, most_log_p: float
    ) -> list[LensHypothesis]:
        """The likeliest hypotheses from the window's triangles, with a log p-value below `most_log_p`."""
        xy = self.xy_px[window.first :]
        rays = family_rays(xy[: window.end - window.first], guess.centre_px, guess.focal_px, guess.shape)
        image = triangles(rays, patterns.longest_side_rad)
        image = image.take(image.vertices.max(axis=1, initial=0) >= window.done - window.first)
        left, right = patterns.triangles.candidates(image)
        self.tried += len(left)
        if not len(left):
            return []
        found: list[LensHypothesis] = []
        for part in np.array_split(np.arange(len(left)), len(left) // CANDIDATES_AT_ONCE + 1):
            found += self._likely_hypotheses(patterns, guess, xy, image.take(left[part]), right[part], most_log_p)
        return sorted(found, key=lambda hypothesis: hypothesis.log_p)[:MAX_HYPOTHESES]

    def _likely_hypotheses(
        self, patterns: ShapePatterns, guess: LensGuess, xy_px: Array, image: Triangles, right: Ints, most_log_p: float
    ) -> list[LensHypothesis]:
        """Hypotheses from pairs of an image triangle and a catalogue triangle."""
        catalogue = patterns.triangles.triangles.take(right)
        focal = guess.focal_px * np.mean(image.sides_rad / catalogue.sides_rad, axis=1)
        mirrored = image.handedness != catalogue.handedness
        cam = self._rays(xy_px[image.vertices], guess, focal, mirrored)
        R = triad_attitude(cam, patterns.rays_icrs[catalogue.vertices])
        middle = cam.sum(axis=1)
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        alive = np.arange(len(R))
        log_p = np.zeros(len(R))
        for verified, limit in (*VERIFICATION_STAGES, (MAX_VERIFIED, most_log_p)):
            deeper = self._log_p_value(
                patterns, xy_px[:verified], R[alive], guess, focal[alive], mirrored[alive], middle[alive]
            )
            log_p = np.minimum(log_p, deeper)
            alive, log_p = alive[log_p < limit], log_p[log_p < limit]
        best = np.argsort(log_p, kind="stable")[:MAX_HYPOTHESES]
        return [
            LensHypothesis(self._camera(guess, focal[i], bool(mirrored[i])), R[i], middle[i], float(value))
            for i, value in zip(alive[best], log_p[best], strict=True)
        ]

    def _rays(self, xy_px: Array, guess: LensGuess, focal: Array, mirrored: Bools) -> Array:
        rays = family_rays(xy_px, guess.centre_px, focal[:, None].astype(xy_px.dtype), guess.shape)
        rays[mirrored, :, 0] *= -1
        return rays

    def _log_p_value(
        self, patterns: ShapePatterns, xy_px: Array, R: Array, guess: LensGuess, focal: Array, mirrored: Bools,
        middle: Array,
    ) -> Array:  # fmt: skip
        """Log p-value of the detections near bright stars: about the triangle, or in the whole field if smaller."""
        # Single precision is a thousandth of the mask's cells, and twice as fast.
        single, R, middle = np.float32, R.astype(np.float32), middle.astype(np.float32)
        rays = self._rays(np.broadcast_to(xy_px.astype(single), (len(R), *xy_px.shape)), guess, focal, mirrored)
        hit = patterns.mask(rays @ R)
        local = np.einsum("hni,hi->hn", rays, middle) > np.cos(LOCAL_SIDES * patterns.longest_side_rad)
        table, free = patterns.log_p_table, PATTERN_MATCHES
        everywhere = table[max(len(xy_px) - free, 0), np.maximum(hit.sum(axis=1) - free, 0)]
        around = np.maximum(local.sum(axis=1) - free, 0), np.maximum((hit & local).sum(axis=1) - free, 0)
        return np.minimum(everywhere, table[around])

    def _camera(self, guess: LensGuess, focal: float, mirrored: bool) -> Camera:
        lens = RadialFamily(guess.shape)
        widest = lens.max_invertible_rad
        return Camera(
            name="unknown", size_px=self.size_px, focal_px=(float(focal), float(focal)), centre_px=guess.centre_px,
            max_angle_rad=widest, calibrated_angle_rad=widest, lens=lens, mirrored=mirrored,
        )  # fmt: skip


def remove_clumps(xy_px: Array, smallest_px: float, most: int) -> Ints:
    """Indices of the first (brightest) of the points (n, 2), none closer than `smallest_px` to an earlier one."""
    from scipy.spatial import cKDTree

    some = xy_px[: 10 * most]
    pairs = cKDTree(some).query_pairs(smallest_px, output_type="ndarray")
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    alive = np.ones(len(some), dtype=bool)
    for i, j in pairs:
        if alive[i]:
            alive[j] = False
    return np.flatnonzero(alive)[:most]
