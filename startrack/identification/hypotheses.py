"""Hypotheses of an unknown lens: similar triangles of detections and of the catalogue vote for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.limits import check_time
from startrack.core.types import Array, Bools, Ints
from startrack.estimation.false_alarm import log_trials
from startrack.estimation.radial_fit import angle_of
from startrack.identification.lens_guesses import LensGuess
from startrack.identification.lens_view import LensHypothesis, LensView
from startrack.identification.near_sky import NearSky
from startrack.identification.similar_triangles import ShapePatterns
from startrack.identification.triangles import Triangles, triad_attitude, triangles

MOST_DETECTIONS = 100  # of which patterns are made
# Difference of views that agree, over the tolerance of the shapes: of the attitudes, and of the logarithm of the scale.
SAME_VIEW_1, SAME_SCALE_1 = 5.0, 2.5
MIN_AGREEING = 2
VOTED_EACH = 40  # triangles with the most votes whose attitudes are compared, for each view


@dataclass(frozen=True)
class Window:
    """Ranks of brightness, `first` to `end`, whose triangles vote together, and how many views of them are grown."""

    first: int
    end: int
    views: int = 4


class HypothesisSearch:
    """Lens hypotheses from the brightest detections (n, 2), no two of which are close together.

    With `near_sky` only those that may point into that part of the sky, as far as a lens determines the axis from one
    triangle: to `margin_rad`.
    """

    def __init__(
        self, xy_px: Array, size_px: tuple[int, int], near_sky: NearSky | None = None, margin_rad: float = 0.0
    ) -> None:
        self.xy_px, self.size_px = xy_px[:MOST_DETECTIONS], size_px
        self.near_sky, self.margin_rad = near_sky, margin_rad
        self.tried = 0  # of the whole sky

    @property
    def log_trials(self) -> float:
        """Logarithm of the number of hypotheses so far that chance would propose in the part of the sky searched."""
        return log_trials(self.tried, 1.0 if self.near_sky is None else self.near_sky.part)

    def voted_hypotheses(self, patterns: ShapePatterns, guess: LensGuess, window: Window) -> list[LensHypothesis]:
        """Hypotheses, one for each of the largest groups of the window's triangles that agree in attitude and scale.

        Triangles vote for their pairs of a detection and a star: a pair of a wrong one occurs once, a right one often.
        """
        check_time()
        xy, catalogue = self.xy_px[window.first : window.end], patterns.index.triangles
        image = triangles(rays_of(xy, guess, guess.focal_px), patterns.longest_side_rad * np.exp(guess.log_spread))
        image = image.take(np.argsort(image.vertices.max(axis=1, initial=0), kind="stable"))  # bright ones first
        left, right = patterns.index.candidates(image, guess.log_spread)
        self.tried += len(left)
        if self.near_sky is not None and len(left):
            R = _solve_triangles(patterns, guess, xy, image.take(left), catalogue.take(right))[-1]
            there = self.near_sky.contains(R, self.margin_rad)
            left, right = left[there], right[there]
        if not len(left):
            return []
        reflected = image.handedness[left] != catalogue.handedness[right]
        pair = (image.vertices[left] + len(xy) * reflected[:, None]) * len(patterns.star) + catalogue.vertices[right]
        votes = np.bincount(pair.ravel())[pair].min(axis=1)
        most_voted = VOTED_EACH * window.views
        last = max(len(votes) - most_voted, 0)
        most = np.flatnonzero(votes >= np.partition(votes, last)[last])
        most = most[np.argsort(-votes[most], kind="stable")[:most_voted]]
        focal_px, mirrored, cam, R = _solve_triangles(
            patterns, guess, xy, image.take(left[most]), catalogue.take(right[most])
        )
        tolerance = patterns.index.shape_tolerance
        flat, log_focal = R.reshape(len(R), 9), np.log(focal_px)
        same = flat @ flat.T > 3.0 - (SAME_VIEW_1 * tolerance) ** 2  # the trace is 1 + 2 cos of the angle between
        same &= (np.abs(log_focal[:, None] - log_focal) < SAME_SCALE_1 * tolerance) & (mirrored[:, None] == mirrored)
        found = []
        free = np.ones(len(R), dtype=bool)
        for _ in range(window.views):
            count = np.where(free, np.count_nonzero(same & free, axis=1), 0)
            best = int(np.argmax(count))
            if count[best] < MIN_AGREEING:
                break
            lens = np.array([log_focal[best], np.log(guess.aspect), guess.bend, *guess.centre_px])
            view = LensView(R[best], lens, bool(mirrored[best]), self.size_px)
            found.append(LensHypothesis(view, cam[best].mean(axis=0) @ R[best], int(count[best])))
            free &= ~same[best]
        return found


def rays_of(xy_px: Array, guess: LensGuess, focal_px: Array | float, mirrored: Bools | None = None) -> Array:
    """Rays (..., 3) of pixels (..., 2) through the lens of a guess whose focal length is `focal_px`, which broadcasts.

    `mirrored` (m,): which of the pixels (m, n, 2) are those of a mirror image.
    """
    off = (xy_px - np.array(guess.centre_px)) / guess.scale_px
    r = np.hypot(off[..., 0], off[..., 1])
    angle = angle_of(r / focal_px, guess.bend)
    scale = np.sin(angle) / np.maximum(r, 1e-9)
    rays = np.stack([off[..., 0] * scale, off[..., 1] * scale, np.cos(angle)], axis=-1)
    if mirrored is not None:
        rays[mirrored, :, 0] *= -1
    return rays


def _solve_triangles(
    patterns: ShapePatterns, guess: LensGuess, xy_px: Array, image: Triangles, catalogue: Triangles
) -> tuple[Array, Bools, Array, Array]:
    """Focal length (m,), handedness (m,), rays (m, 3, 3) and R_cam_icrs (m, 3, 3) of pairs of similar triangles (m)."""
    focal_px = guess.focal_px * np.mean(image.sides_rad / catalogue.sides_rad, axis=1)
    mirrored = image.handedness != catalogue.handedness
    cam = rays_of(xy_px[image.vertices], guess, focal_px[:, None], mirrored)
    return focal_px, mirrored, cam, triad_attitude(cam, patterns.rays_icrs[catalogue.vertices])


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
