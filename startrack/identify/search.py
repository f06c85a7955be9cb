"""Attitudes that matching triangles or pairs suggest, the most agreed upon first, held against the bright stars."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from startrack.camera import Camera
from startrack.identify.chance import ChanceModel
from startrack.identify.index import PatternIndex
from startrack.identify.pairs import PairIndex
from startrack.identify.triangles import triangles
from startrack.orient import wahba
from startrack.types import Array, Ints, Stars

MOST_CANDIDATES = 60_000  # matching triangles per round
MOST_HYPOTHESES = 1024  # of them whose attitude is held against the stars
MOST_TRIANGLES = 20_000  # of the image, per round
FEWEST_AGREEING_PAIRS = 4  # six stars have fifteen
GRIDS = 3
HYPOTHESES_AT_ONCE = 256
VERIFICATION_STARS = 400
FEWEST_HITS = 6
PLAUSIBLE = 1e-2  # chance of a match that is worth refining; the refined one is judged by the real limit


class Search:
    """Hypotheses, and their verification against the bright stars."""

    def __init__(self, camera: Camera, rays_cam: Array, stars: Stars, tried: int = 0) -> None:
        """`rays_cam` (n, 3) of the detections, brightest first; `tried` hypotheses have failed already."""
        self.camera, self.rays_cam, self.stars = camera, rays_cam, stars
        self.tried = tried  # matching triangles and pairs so far
        axis = camera.unproject(np.array([camera.centre_px]))[0]
        off_axis = np.arctan2(np.hypot(axis[0], axis[1]), axis[2]) + 0.01
        self.scale_rad_per_px = float(camera.mean_scale_rad_per_px(off_axis))

    def by_triangles(self, index: PatternIndex, tolerance_px: float, detections: tuple[int, int]) -> Iterator[Array]:
        """Attitudes R_cam_icrs that chance hardly explains.

        From triangles of the `detections[1]` brightest detections that are not all among the first `detections[0]`.
        """
        tolerance = tolerance_px * self.scale_rad_per_px
        done, depth = detections
        image = triangles(self.rays_cam[:depth], index.reach_rad, MOST_TRIANGLES)
        fresh = image.vertices.max(axis=1, initial=0) >= done
        image = replace(
            image, vertices=image.vertices[fresh], sides_rad=image.sides_rad[fresh], handed=image.handed[fresh]
        )
        left, right = index.candidates(image, tolerance)
        mismatch = np.abs(image.sides_rad[left] - index.triangles.sides_rad[right]).max(axis=1)
        order = np.argsort(mismatch / image.sides_rad[left, 0], kind="stable")[:MOST_CANDIDATES]
        cam = self.rays_cam[image.vertices[left[order]]]
        icrs = index.rays_icrs[index.triangles.vertices[right[order]]]
        bright = self.stars.rays_icrs[index.star[: max(VERIFICATION_STARS, len(index.star) // 2)]]
        # A triangle's attitude is as good as its shorter sides.
        agreed = _agreement(triad(cam, icrs), 12.0 * tolerance / index.reach_rad)
        yield from self._plausible(cam, icrs, agreed, bright, 4 * depth, tolerance)

    def by_pairs(self, index: PairIndex, tolerance_px: float, detections: int) -> Iterator[Array]:
        """Attitudes R_cam_icrs that chance hardly explains, from pairs of the few brightest detections."""
        tolerance = tolerance_px * self.scale_rad_per_px
        image, catalogue = index.candidates(self.rays_cam[:detections], tolerance)
        cam, icrs = self.rays_cam[image], index.rays_icrs[catalogue]
        agreed = _agreement(triad(cam, icrs), 2.0 * tolerance / index.narrowest_rad)
        self.tried += int(np.count_nonzero(agreed < FEWEST_AGREEING_PAIRS))
        some = agreed >= FEWEST_AGREEING_PAIRS
        yield from self._plausible(cam[some], icrs[some], agreed[some], index.rays_icrs, 4 * detections, tolerance)

    def _plausible(
        self, cam: Array, icrs: Array, agreed: Ints, bright_icrs: Array, depth: int, tolerance_rad: float
    ) -> Iterator[Array]:
        """Of the attitudes that turn the rays icrs (m, k, 3) to cam (m, k, 3), those that the bright stars support.

        True ones agree among each other, chance ones do not: those that `agreed` (m,) most are tried first.
        """
        self.tried += len(cam)
        if not len(cam):
            return
        best = np.argsort(-agreed, kind="stable")[:MOST_HYPOTHESES]
        seen = ChanceModel(self.rays_cam[:depth])
        for start in range(0, len(best), HYPOTHESES_AT_ONCE):
            chunk = best[start : start + HYPOTHESES_AT_ONCE]
            R = wahba(cam[chunk], icrs[chunk], np.ones(cam[chunk].shape[:2]))
            hits, predicted = self._hits(R, bright_icrs, seen, 2.0 * tolerance_rad)
            log_chance = seen.log_odds(hits, predicted, 2.0 * tolerance_rad) + np.log(self.tried)
            for i in np.argsort(log_chance, kind="stable"):
                if log_chance[i] > np.log(PLAUSIBLE) or hits[i] < FEWEST_HITS:
                    break
                yield R[i]

    def _hits(self, R: Array, bright_icrs: Array, seen: ChanceModel, radius_rad: float) -> tuple[Ints, Ints]:
        """Bright stars (hypotheses,) that fall on detections, and those that fall into the field."""
        predicted = bright_icrs @ np.swapaxes(R, 1, 2)  # (hypotheses, stars, 3) in cam
        inside = predicted[..., 2] > np.cos(self.camera.max_angle_rad)
        inside[inside] = self.camera.project(predicted[inside])[1]
        distance = np.full(inside.shape, np.inf)
        distance[inside], _ = seen.tree.query(predicted[inside], distance_upper_bound=2 * np.sin(radius_rad / 2))
        return np.isfinite(distance).sum(axis=1), inside.sum(axis=1)


def triad(cam: Array, icrs: Array) -> Array:
    """R_cam_icrs (m, 3, 3) from the first two of the rays (m, k, 3): quick, and good enough to be compared."""

    def frame(rays: Array) -> Array:
        a = rays[:, 0]
        c = np.cross(a, rays[:, 1])
        c /= np.linalg.norm(c, axis=1, keepdims=True)
        return np.stack([a, c, np.cross(a, c)], axis=2)

    return frame(cam) @ np.swapaxes(frame(icrs), 1, 2)


def _agreement(R: Array, radius_rad: float) -> Ints:
    """About how many of the rotations (m, 3, 3) each one has within the radius, itself included (m,).

    Counted in the cells of grids over the unit quaternions, each grid shifted against the others: one of them will not
    cut a group apart.
    """
    q = _quaternions(R)
    most = np.zeros(len(R), dtype=np.int64)
    for shift in np.linspace(0.0, 1.0, GRIDS, endpoint=False):
        cell = np.floor(q / radius_rad + shift).astype(np.int64)  # quaternions differ by half the angle
        key = ((cell[:, 0] * 2_000_003 + cell[:, 1]) * 2_000_003 + cell[:, 2]) * 2 + (cell[:, 3] % 2)
        _, group, count = np.unique(key, return_inverse=True, return_counts=True)
        most = np.maximum(most, count[group])
    return most


def _quaternions(R: Array) -> Array:
    """Unit quaternions x, y, z, w (m, 4) with w >= 0 of rotations (m, 3, 3)."""
    x, y, z = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    squares = np.stack([1 + x - y - z, 1 - x + y - z, 1 - x - y + z, 1 + x + y + z], axis=1)
    q = np.sqrt(np.maximum(squares, 0.0)) / 2
    for i, (j, k) in enumerate(((2, 1), (0, 2), (1, 0))):
        q[:, i] = np.copysign(q[:, i], R[:, j, k] - R[:, k, j])
    return q
