"""Hypotheses of a camera of which little is known: similar triangles give scale and attitude, bright stars the odds."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.camera import Camera
from startrack.identification.index import bright_stars_apart
from startrack.identification.proximity_mask import SkyMap, sky_map
from startrack.identification.radial_lens_family import Family, angle
from startrack.identification.region_growing import Start
from startrack.identification.shape_index import SimilarTriangles, similar_triangles
from startrack.identification.triangles import Triangles, triad, triangles
from startrack.types import Array, Bools, Ints, Stars

HEMISPHERE_SR = 2 * np.pi
STARS_OF_HEMISPHERE = 200  # pattern stars of the whole sky for a lens that sees half of it
MOST_PATTERN_STARS = 25_000
REACH_OF_HEMISPHERE_RAD = np.radians(45.0)
NEAR_OF_HEMISPHERE_RAD = np.radians(1.5)
NARROWEST_NEAR_RAD = np.radians(0.15)
LOCAL_REACHES = 1.2  # of the patterns' reach: there an imperfect lens still fits
CANDIDATES_AT_ONCE = 20_000
MOST_STARTS = 6  # of one lens and window; the true one is all but always the likeliest
VERIFIED = ((24, -1.5), (48, -4.0))  # detections held against the stars, and log odds to go on
DEEPEST_VERIFIED = 80
GIVEN = 3  # a triangle's own stars are hits whatever it is
KEPT_INDEXES = 6


@dataclass(frozen=True)
class Guess:
    """A lens of the family to start from: the focal length is uncertain by the index's tolerance of size."""

    focal_px: float
    shape: float
    centre_px: tuple[float, float]


@dataclass(frozen=True)
class Window:
    """Ranks of brightness, `first` to `end`, whose triangles are tried, unless they lie wholly before `done`."""

    first: int
    done: int
    end: int


@dataclass(frozen=True)
class Patterns:
    """The catalogue's side: triangles of the brightest stars, and where these are."""

    star: Ints  # (m,) indices in Stars
    rays_icrs: Array  # (m, 3)
    reach_rad: float
    triangles: SimilarTriangles
    map: SkyMap

    @cached_property
    def log_tail(self) -> Array:
        """log P(at least k of n random directions near a bright star), [n, k]."""
        from scipy.special import betainc

        n, k = np.meshgrid(np.arange(101), np.arange(101), indexing="ij")
        tail = betainc(np.maximum(k, 1), np.maximum(n - k, 0) + 1, self.map.covered)
        return np.where(k > 0, np.log(np.maximum(tail, 1e-300)), 0.0)


@dataclass(frozen=True)
class PatternSizes:
    """How the catalogue's patterns are cut for a field of view."""

    stars: int  # brightest of the whole sky
    reach_rad: float  # longest side of a triangle
    near_rad: float  # a detection this close to a bright star is a hit
    shape_tolerance: float
    size_tolerance: float


def wide_sizes(field_sr: float) -> PatternSizes:
    """Patterns for a lens that bends: loose triangles of few stars."""
    part = min(field_sr / HEMISPHERE_SR, 1.0)
    stars = int(min(STARS_OF_HEMISPHERE / part, MOST_PATTERN_STARS))
    reach, near = REACH_OF_HEMISPHERE_RAD * np.sqrt(part), NEAR_OF_HEMISPHERE_RAD * np.sqrt(part)
    return PatternSizes(stars, float(reach), float(max(near, NARROWEST_NEAR_RAD)), 0.02, 0.13)


def narrow_sizes(field_sr: float, stars_of_field: int, reach_of_field: float) -> PatternSizes:
    """Patterns for a lens that is almost a pinhole: sharp triangles, of so many stars in the field, up to this long."""
    diameter = float(np.sqrt(4 * field_sr / np.pi))
    stars = int(min(stars_of_field * 4 * np.pi / field_sr, MOST_PATTERN_STARS))
    near = max(0.015 * diameter, NARROWEST_NEAR_RAD)
    return PatternSizes(stars, reach_of_field * diameter, float(near), 0.004, 0.12)


def patterns_for(stars: Stars, sizes: PatternSizes) -> Patterns:
    """Patterns of the stars (sorted, brightest first); the last few are kept, and serve for some years around."""
    import hashlib

    key = (sizes, len(stars), hashlib.sha1(np.round(stars.rays_icrs[:500], 3).tobytes()).hexdigest())
    if key not in _KEPT:
        star = bright_stars_apart(stars, sizes.stars)
        rays = stars.rays_icrs[star]
        found = triangles(rays, sizes.reach_rad * (1 + sizes.size_tolerance))
        similar = similar_triangles(found, sizes.shape_tolerance, sizes.size_tolerance)
        _KEPT[key] = Patterns(star, rays, sizes.reach_rad, similar, sky_map(rays, sizes.near_rad))
        while len(_KEPT) > KEPT_INDEXES:
            _KEPT.popitem(last=False)
    _KEPT.move_to_end(key)
    return _KEPT[key]


_KEPT: OrderedDict[tuple[PatternSizes, int, str], Patterns] = OrderedDict()


def rays_of(xy_px: Array, centre_px: tuple[float, float], focal_px: Array | float, shape: float) -> Array:
    """Rays (..., 3) of pixels (..., 2) through a lens of the family, unmirrored; focal lengths broadcast."""
    off = xy_px - np.array(centre_px, dtype=xy_px.dtype)
    r = np.hypot(off[..., 0], off[..., 1])
    a = angle(r / focal_px, shape)
    scale = np.sin(a) / np.maximum(r, 1e-9)
    return np.stack([off[..., 0] * scale, off[..., 1] * scale, np.cos(a)], axis=-1)


class Hypotheses:
    """Starts from the brightest detections (n, 2), no two of them close together."""

    def __init__(self, xy_px: Array, size_px: tuple[int, int]) -> None:
        self.xy_px, self.size_px = xy_px[:100], size_px
        self.tried = 0

    def starts(self, patterns: Patterns, guess: Guess, window: Window, log_plausible: float) -> list[Start]:
        """The best of the hypotheses from the window's triangles, most likely first.

        Those whose hits chance explains with log probability above `log_plausible` are left out.
        """
        xy = self.xy_px[window.first :]
        seen = rays_of(xy[: window.end - window.first], guess.centre_px, guess.focal_px, guess.shape)
        image = triangles(seen, patterns.reach_rad)
        image = image.take(image.vertices.max(axis=1, initial=0) >= window.done - window.first)
        left, right = patterns.triangles.candidates(image)
        self.tried += len(left)
        if not len(left):
            return []
        found: list[Start] = []
        for part in np.array_split(np.arange(len(left)), len(left) // CANDIDATES_AT_ONCE + 1):
            found += self._likely(patterns, guess, xy, image.take(left[part]), right[part], log_plausible)
        return sorted(found, key=lambda start: start.log_chance)[:MOST_STARTS]

    def _likely(
        self, patterns: Patterns, guess: Guess, xy_px: Array, image: Triangles, right: Ints, log_plausible: float
    ) -> list[Start]:
        """Starts from pairs of an image triangle and a catalogue triangle."""
        catalogue = patterns.triangles.triangles.take(right)
        focal = guess.focal_px * np.mean(image.sides_rad / catalogue.sides_rad, axis=1)
        mirrored = image.handed != catalogue.handed
        cam = self._rays(xy_px[image.vertices], guess, focal, mirrored)
        R = triad(cam, patterns.rays_icrs[catalogue.vertices])
        middle = cam.sum(axis=1)
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        alive = np.arange(len(R))
        log_chance = np.zeros(len(R))
        for verified, log_limit in (*VERIFIED, (DEEPEST_VERIFIED, log_plausible)):
            odds = self._odds(patterns, xy_px[:verified], R[alive], guess, focal[alive], mirrored[alive], middle[alive])
            log_chance = np.minimum(log_chance, odds)
            alive, log_chance = alive[log_chance < log_limit], log_chance[log_chance < log_limit]
        best = np.argsort(log_chance, kind="stable")[:MOST_STARTS]
        return [
            Start(self._camera(guess, focal[i], bool(mirrored[i])), R[i], middle[i], float(chance))
            for i, chance in zip(alive[best], log_chance[best], strict=True)
        ]

    def _rays(self, xy_px: Array, guess: Guess, focal: Array, mirrored: Bools) -> Array:
        rays = rays_of(xy_px, guess.centre_px, focal[:, None].astype(xy_px.dtype), guess.shape)
        rays[mirrored, :, 0] *= -1
        return rays

    def _odds(
        self, patterns: Patterns, xy_px: Array, R: Array, guess: Guess, focal: Array, mirrored: Bools, middle: Array
    ) -> Array:
        """log P by chance of as many detections near bright stars, around the triangle or in the whole field."""
        # Single precision is a thousandth of the map's cells, and twice as fast.
        single, R, middle = np.float32, R.astype(np.float32), middle.astype(np.float32)
        rays = self._rays(np.broadcast_to(xy_px.astype(single), (len(R), *xy_px.shape)), guess, focal, mirrored)
        hit = patterns.map(rays @ R)
        local = np.einsum("hni,hi->hn", rays, middle) > np.cos(LOCAL_REACHES * patterns.reach_rad)
        table = patterns.log_tail
        everywhere = table[max(len(xy_px) - GIVEN, 0), np.maximum(hit.sum(axis=1) - GIVEN, 0)]
        around = np.maximum(local.sum(axis=1) - GIVEN, 0), np.maximum((hit & local).sum(axis=1) - GIVEN, 0)
        return np.minimum(everywhere, table[around])

    def _camera(self, guess: Guess, focal: float, mirrored: bool) -> Camera:
        widest = Family(guess.shape).max_invertible_rad
        return Camera(
            name="unknown", size_px=self.size_px, focal_px=(float(focal), float(focal)), centre_px=guess.centre_px,
            max_angle_rad=widest, calibrated_angle_rad=widest, lens=Family(guess.shape), mirrored=mirrored,
        )  # fmt: skip


def apart(xy_px: Array, closer_px: float, most: int) -> Ints:
    """The first (brightest) of the points (n, 2), none near an earlier one: clumps of false stars shrink to one."""
    from scipy.spatial import cKDTree

    some = xy_px[: 10 * most]
    pairs = cKDTree(some).query_pairs(closer_px, output_type="ndarray")
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    alive = np.ones(len(some), dtype=bool)
    for i, j in pairs:
        if alive[i]:
            alive[j] = False
    return np.flatnonzero(alive)[:most]
