"""Hypotheses of an unknown camera: similar triangles propose scale and attitude, bright stars or votes rank them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import Camera
from startrack.core.time_limit import check_time
from startrack.core.types import Array, Bools, Ints
from startrack.estimation.false_alarm import PATTERN_MATCHES, log_trials
from startrack.identification.lens_guesses import LensGuess, RadialFamily, family_angle, unknown_camera
from startrack.identification.near_sky import NearSky
from startrack.identification.region_growing import LensHypothesis
from startrack.identification.similar_triangles import MAX_DETECTIONS, ShapePatterns
from startrack.identification.triangles import Triangles, triad_attitude, triangles

LOCAL_SIDES = 1.2  # of the longest side, about the triangle: within it an imperfect lens still fits
CANDIDATES_AT_ONCE = 20_000
MAX_HYPOTHESES = 6  # of one lens and window; the true one is nearly always the likeliest
# Detections tested, and the log p-value below which the test goes on; random skies reach -15 in a whole search.
VERIFICATION_STAGES = ((24, -1.5), (48, -4.0), (80, -11.0))
MAX_VOTED = 150  # triangles with the most votes whose attitudes are compared
SAME_VIEW_RAD = 0.02  # difference of views that agree; half of it in the logarithm of the focal length
MIN_AGREEING = 3
VIEWS_OF_ROUND = 4


@dataclass(frozen=True)
class Window:
    """Ranks of brightness, `first` to `end`, whose triangles are tried, unless all vertices come before `done`."""

    first: int
    done: int
    end: int


def family_rays(xy_px: Array, guess: LensGuess, focal_px: Array | float, mirrored: Bools | None = None) -> Array:
    """Rays (..., 3) of pixels (..., 2) through a lens of the family whose focal length is `focal_px`, which broadcasts.

    `mirrored` (m,): which of the pixels (m, n, 2) are those of a mirror image.
    """
    off = xy_px - np.array(guess.centre_px, dtype=xy_px.dtype)
    r = np.hypot(off[..., 0], off[..., 1])
    a = family_angle(r / focal_px, guess.shape)
    scale = np.sin(a) / np.maximum(r, 1e-9)
    rays = np.stack([off[..., 0] * scale, off[..., 1] * scale, np.cos(a)], axis=-1)
    if mirrored is not None:
        rays[mirrored, :, 0] *= -1
    return rays


class HypothesisSearch:
    """Lens hypotheses from the brightest detections (n, 2), no two of which are close together.

    With `near_sky` only those that may point into that part of the sky, as far as a lens determines the axis from one
    triangle: to `margin_rad`.
    """

    def __init__(
        self, xy_px: Array, size_px: tuple[int, int], near_sky: NearSky | None = None, margin_rad: float = 0.0
    ) -> None:
        self.xy_px, self.size_px = xy_px[:MAX_DETECTIONS], size_px
        self.near_sky, self.margin_rad = near_sky, margin_rad
        self.tried = 0  # of the whole sky

    @property
    def log_trials(self) -> float:
        """Logarithm of the number of hypotheses so far that chance would propose in the part of the sky searched."""
        return log_trials(self.tried, 1.0 if self.near_sky is None else self.near_sky.part)

    def likely_hypotheses(self, patterns: ShapePatterns, guess: LensGuess, window: Window) -> list[LensHypothesis]:
        """The likeliest hypotheses from the window's triangles, by the bright stars near which detections lie."""
        image, left, right = self._similar_triangles(patterns, guess, window)
        xy = self.xy_px[window.first :]
        found: list[LensHypothesis] = []
        for part in np.array_split(np.arange(len(left)), len(left) // CANDIDATES_AT_ONCE + 1) if len(left) else ():
            check_time()
            pairs = image.take(left[part]), patterns.triangles.triangles.take(right[part])
            found += self._rank_by_stars(patterns, guess, xy, *pairs)
        return sorted(found, key=lambda hypothesis: hypothesis.log_p)[:MAX_HYPOTHESES]

    def voted_hypotheses(self, patterns: ShapePatterns, guess: LensGuess, window: Window) -> list[LensHypothesis]:
        """One hypothesis for each of the largest groups of the window's triangles that agree in attitude and scale.

        Triangles vote for their pairs of a detection and a star: a pair of a wrong one occurs once, a right one often.
        """
        image, left, right = self._similar_triangles(patterns, guess, window)
        if not len(left):
            return []
        xy, catalogue = self.xy_px[window.first : window.end], patterns.triangles.triangles
        reflected = image.handedness[left] != catalogue.handedness[right]
        pair = (image.vertices[left] + len(xy) * reflected[:, None]) * len(patterns.star) + catalogue.vertices[right]
        votes = np.bincount(pair.ravel())[pair].min(axis=1)
        most = np.argsort(-votes, kind="stable")[:MAX_VOTED]
        image, catalogue = image.take(left[most]), catalogue.take(right[most])
        focal, mirrored, cam, R = _solve_triangles(patterns, guess, xy, image, catalogue)
        flat, log_focal = R.reshape(len(R), 9), np.log(focal)
        same = flat @ flat.T > 3.0 - SAME_VIEW_RAD**2  # the trace is 1 + 2 cos of the angle between
        same &= (np.abs(log_focal[:, None] - log_focal) < SAME_VIEW_RAD / 2) & (mirrored[:, None] == mirrored)
        found = []
        free = np.ones(len(R), dtype=bool)
        for _ in range(VIEWS_OF_ROUND):
            count = np.where(free, np.count_nonzero(same & free, axis=1), 0)
            best = int(np.argmax(count))
            if count[best] < MIN_AGREEING:
                break
            camera = self._camera(guess, focal[best], mirrored[best])
            found.append(LensHypothesis(camera, R[best], cam[best].mean(axis=0), 0.0))
            free &= ~same[best]
        return found

    def _similar_triangles(
        self, patterns: ShapePatterns, guess: LensGuess, window: Window
    ) -> tuple[Triangles, Ints, Ints]:
        """Triangles of the window, and the pairs (image triangle, catalogue triangle) of similar ones."""
        check_time()
        rays = family_rays(self.xy_px[window.first : window.end], guess, guess.focal_px)
        image = triangles(rays, patterns.longest_side_rad)
        image = image.take(image.vertices.max(axis=1, initial=0) >= window.done - window.first)
        left, right = patterns.triangles.candidates(image)
        self.tried += len(left)
        if self.near_sky is not None and len(left):
            pairs = image.take(left), patterns.triangles.triangles.take(right)
            R = _solve_triangles(patterns, guess, self.xy_px[window.first :], *pairs)[-1]
            there = self.near_sky.contains(R, self.margin_rad)
            left, right = left[there], right[there]
        return image, left, right

    def _rank_by_stars(
        self, patterns: ShapePatterns, guess: LensGuess, xy_px: Array, image: Triangles, catalogue: Triangles
    ) -> list[LensHypothesis]:
        focal, mirrored, cam, R = _solve_triangles(patterns, guess, xy_px, image, catalogue)
        middle = cam.sum(axis=1)
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        alive = np.arange(len(R))
        log_p = np.zeros(len(R))
        for verified, limit in VERIFICATION_STAGES:
            deeper = _log_p_value(
                patterns, xy_px[:verified], R[alive], guess, focal[alive], mirrored[alive], middle[alive]
            )
            log_p = np.minimum(log_p, deeper)
            alive, log_p = alive[log_p < limit], log_p[log_p < limit]
        best = np.argsort(log_p, kind="stable")[:MAX_HYPOTHESES]
        return [
            LensHypothesis(self._camera(guess, focal[i], mirrored[i]), R[i], middle[i], float(value))
            for i, value in zip(alive[best], log_p[best], strict=True)
        ]

    def _camera(self, guess: LensGuess, focal: float, mirrored: bool) -> Camera:
        return unknown_camera(self.size_px, float(focal), guess.centre_px, RadialFamily(guess.shape), bool(mirrored))


def _solve_triangles(
    patterns: ShapePatterns, guess: LensGuess, xy_px: Array, image: Triangles, catalogue: Triangles
) -> tuple[Array, Bools, Array, Array]:
    """Focal length (m,), handedness (m,), rays (m, 3, 3) and R_cam_icrs (m, 3, 3) of pairs of similar triangles (m)."""
    focal = guess.focal_px * np.mean(image.sides_rad / catalogue.sides_rad, axis=1)
    mirrored = image.handedness != catalogue.handedness
    cam = family_rays(xy_px[image.vertices], guess, focal[:, None], mirrored)
    return focal, mirrored, cam, triad_attitude(cam, patterns.rays_icrs[catalogue.vertices])


def _log_p_value(
    patterns: ShapePatterns, xy_px: Array, R: Array, guess: LensGuess, focal: Array, mirrored: Bools, middle: Array
) -> Array:
    """Log p-value of the detections near bright stars: about the triangle, or in the whole field if smaller."""
    # Single precision is a thousandth of the mask's cells, and twice as fast.
    single = np.float32
    xy_px = np.broadcast_to(xy_px.astype(single), (len(R), *xy_px.shape))
    R, middle = R.astype(single), middle.astype(single)
    rays = family_rays(xy_px, guess, focal[:, None].astype(single), mirrored)
    hit = patterns.mask(rays @ R)
    local = np.einsum("hni,hi->hn", rays, middle) > np.cos(LOCAL_SIDES * patterns.longest_side_rad)
    table, free = patterns.log_p_table, PATTERN_MATCHES
    everywhere = table[max(xy_px.shape[1] - free, 0), np.maximum(hit.sum(axis=1) - free, 0)]
    around = np.maximum(local.sum(axis=1) - free, 0), np.maximum((hit & local).sum(axis=1) - free, 0)
    return np.minimum(everywhere, table[around])


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
