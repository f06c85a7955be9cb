"""Narrow fields of which only the width is about known: triangles vote for pairs, and a pinhole is fitted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from startrack.identification.hypotheses import Patterns, narrow_sizes, patterns_for, rays_of
from startrack.identification.radial_lens_family import PINHOLE
from startrack.identification.triangles import Triangles, triad, triangles
from startrack.identification.unknown_lens_plane import FEWEST, View, nearest_pairs
from startrack.identification.unknown_lens_verify import ENOUGH_TO_BEND, Judged, judged
from startrack.identification.weak_cache import KeptPerObject
from startrack.types import Array, Detections, Ints, Stars

IN_FIELD, REACH = 24, 0.4  # pattern stars in the field; longest side of their triangles over the field's diameter
ROUNDS = ((0, 10), (0, 16), (8, 22), (0, 22), (20, 34))  # ranks of brightness whose triangles vote together
VOTED = 150  # triangles with the most votes whose attitudes are compared
AGREE_RAD, AGREE_SCALE = 0.02, 0.01
AGREEING = 3
VIEWS = 4  # of each round
# Detections, stars for each, the gate (part of the frame's width, but at least pixels), and the largest chance (its
# logarithm) of as many pairs in the inner half of the gate.
STAGES = ((60, 1.5, 0.010, 6.0, -4.0), (120, 1.5, 0.005, 4.0, -8.0), (400, 2.0, 0.0, 2.5, -10.0))
STEPS = 2
SPARE = 1.15  # around the frame, for the focal length is not known


@dataclass(frozen=True)
class Found:
    """A view of the sky with what speaks for it; `around` are the stars (indices) that `judged` speaks of."""

    view: View
    around: Ints
    judged: Judged


class NarrowSearch:
    """Views of a list of detections."""

    def __init__(
        self, detections: Detections, chosen: Ints, size_px: tuple[int, int], fov_rad: float, field_sr: float,
        stars: Stars,
    ) -> None:  # fmt: skip
        """`chosen`: detections without clumps; `field_sr`: the frame's solid angle, rounded so that indexes serve."""
        self.detections, self.size_px, self.stars = detections, size_px, stars
        self.xy_px = detections.xy_px[chosen]
        self.focal_px = 0.5 * size_px[0] / np.tan(0.5 * fov_rad)
        self.field_sr = field_sr
        self.tried = 0
        self._trees: dict[int, Any] = {}

    def found(self) -> Iterator[Found]:
        """Views that most of the bright stars support, with the odds against them; likely ones first."""
        patterns = patterns_for(self.stars, narrow_sizes(self.field_sr, IN_FIELD, REACH))
        seen: list[Array] = []
        for first, end in ROUNDS:
            if first and len(self.xy_px) <= first + 4:
                continue
            for view in self._voted(patterns, self.xy_px[first:end]):
                if any(np.trace(R.T @ view.R_cam_icrs) > 3.0 - AGREE_RAD**2 for R in seen):
                    continue
                seen.append(view.R_cam_icrs)
                found = self._grown(view)
                if found is not None:
                    yield found

    def _voted(self, patterns: Patterns, xy_px: Array) -> list[View]:
        """The few views on which most of the likely triangles agree."""
        middle = (0.5 * (self.size_px[0] - 1), 0.5 * (self.size_px[1] - 1))
        image = triangles(rays_of(xy_px, middle, self.focal_px, PINHOLE), patterns.reach_rad)
        left, right = patterns.triangles.candidates(image)
        self.tried += len(left)
        if not len(left):
            return []
        catalogue = patterns.triangles.triangles
        mirrored = image.handed[left] != catalogue.handed[right]
        # A false triangle's pairs (detection, star) are its own, a true one's are those of all true ones.
        pair = (image.vertices[left] + len(xy_px) * mirrored[:, None]) * len(patterns.star) + catalogue.vertices[right]
        votes = np.bincount(pair.ravel())[pair].min(axis=1)
        most = np.argsort(-votes, kind="stable")[:VOTED]
        return self._agreed(patterns, xy_px, image.take(left[most]), catalogue.take(right[most]))

    def _agreed(self, patterns: Patterns, xy_px: Array, image: Triangles, catalogue: Triangles) -> list[View]:
        """Views of pairs of triangles (m), one for each group that agrees in attitude, scale and handedness."""
        scale = np.mean(image.sides_rad / catalogue.sides_rad, axis=1)
        mirrored = image.handed != catalogue.handed
        off = xy_px[image.vertices] - 0.5 * (np.array(self.size_px) - 1.0)
        off[mirrored, :, 0] *= -1
        focal = self.focal_px * scale
        cam = np.concatenate([off, np.broadcast_to(focal[:, None, None], (*off.shape[:2], 1))], axis=2)
        cam /= np.linalg.norm(cam, axis=2, keepdims=True)
        R = triad(cam, patterns.rays_icrs[catalogue.vertices])
        flat = R.reshape(len(R), 9)
        alike = flat @ flat.T > 3.0 - AGREE_RAD**2  # the trace is 1 + 2 cos of the angle between
        alike &= np.abs(np.log(scale)[:, None] - np.log(scale)) < AGREE_SCALE
        alike &= mirrored[:, None] == mirrored
        views = []
        left = np.ones(len(R), dtype=bool)
        for _ in range(VIEWS):
            count = np.where(left, np.count_nonzero(alike & left, axis=1), 0)
            best = int(np.argmax(count))
            if count[best] < AGREEING:
                break
            views.append(View(R[best], float(focal[best]), bool(mirrored[best]), self.size_px))
            left &= ~alike[best]
        return views

    def _grown(self, view: View) -> Found | None:
        """The view refined with ever more stars and smaller gates, and judged; None where it falls apart."""
        corner = np.arctan(0.5 * SPARE * np.hypot(*self.size_px) / view.focal_px)
        near = _tree_of(self.stars).query_ball_point(view.R_cam_icrs[2], 2 * np.sin(0.5 * corner))
        around = np.sort(np.asarray(near, dtype=np.int64))
        rays = self.stars.rays_icrs[around]
        for count, per_detection, part, least_px, log_limit in STAGES:
            gate_px = max(part * self.size_px[0], least_px)
            xy = self.detections.xy_px[:count]
            px, inside = view.project(rays)
            some = np.flatnonzero(inside)[: int(per_detection * len(xy)) + 5]
            detection, star, distance = nearest_pairs(self._tree(count), px[some], gate_px)
            if len(star) < FEWEST or self._log_chance(distance, gate_px, len(some), len(xy)) > log_limit:
                return None
            bend = len(star) >= ENOUGH_TO_BEND
            view = view.fitted(xy[detection], rays[some[star]], gate_px / 4, bend, STEPS)
        stars = self.stars.take(around)
        said = judged(view, self.detections, stars, self._tree(len(self.detections)), self.tried)
        return None if said is None else Found(said.view, around, said)

    def _log_chance(self, distance_px: Array, gate_px: float, stars: int, detections: int) -> float:
        """About log P that chance brings as many of the stars within half the gate of a detection."""
        each = min(detections * np.pi * (0.5 * gate_px) ** 2 / (self.size_px[0] * self.size_px[1]), 1.0)
        expected = max(stars * each, 1e-6)
        hits = int(np.count_nonzero(distance_px < 0.5 * gate_px))
        return 0.0 if hits <= expected else float(hits - expected - hits * np.log(hits / expected))

    def _tree(self, count: int) -> Any:
        """k-d tree of the first detections."""
        from scipy.spatial import cKDTree

        count = min(count, len(self.detections))
        if count not in self._trees:
            self._trees[count] = cKDTree(self.detections.xy_px[:count])
        return self._trees[count]


def _sky_tree(stars: Stars) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(stars.rays_icrs, balanced_tree=False)


_tree_of = KeptPerObject(_sky_tree)
