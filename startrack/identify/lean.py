"""Identification of a short list within a millisecond: triangles of its brightest few, all arrays small."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.camera import Camera
from startrack.identify.chance import ChanceModel
from startrack.identify.index import PatternIndex
from startrack.identify.kept import KeptPerObject
from startrack.identify.near import BLEND_MAG, Light, NearStars, Pairs, middle
from startrack.identify.triangles import triangles_of_few
from startrack.orient import rotation, wahba
from startrack.types import Array, Bools, Detections, Ints, Stars

DEPTHS = (7, 10, 14, 20, 28, 40, 56)  # brightest detections that form triangles, round by round
AT_ONCE = 48
MOST_VERIFIED = 480  # per round
MOST_CANDIDATES = 1200  # matching triangles per round; all count as tried
AGREE_RAD = 0.012
FEWEST_HITS = 6
PLAUSIBLE = 1e-2  # chance of a match that is worth refining; the refined one is judged by the real limit
FIRST_GATE_PX, GATE_PX = 3.0, 6.0
FIRST_MATCHES = 200
ROUNDS = 4  # of matching and turning; one where the bright stars alone have settled the attitude
SETTLED_PX = 0.15
OUTLIER_CHI2 = 16.0
CHI2_2DOF_MEDIAN = 1.3863


@dataclass(frozen=True)
class Scale:
    """Angular sizes [rad] of a pixel: on the axis, and the largest anywhere and in any direction."""

    on_axis: float
    largest: float

    @classmethod
    def of(cls, camera: Camera) -> Scale:
        axis = camera.unproject(np.array([camera.centre_px]))[0]
        off_axis = np.arctan2(np.hypot(axis[0], axis[1]), axis[2]) + 0.01
        angle = np.linspace(0.01, min(camera.max_angle_rad, camera.lens.max_invertible_rad) - 1e-3, 64)
        focal = min(camera.focal_px)
        radial, across = 1.0 / camera.lens.slope(angle), np.sin(angle) / camera.lens.rho(angle)
        largest = min(1.05 * float(np.maximum(radial, across).max() / focal), 3.0 / focal)
        return cls(float(camera.mean_scale_rad_per_px(off_axis)), largest)


scale_of = KeptPerObject(Scale.of)


@dataclass(frozen=True)
class Found:
    """An attitude with its matches; `pairs` and `matched` speak of the list that was searched."""

    R_cam_icrs: Array
    pairs: Pairs
    matched: Ints  # numbers of pairs: mutual nearest, agreeing in brightness, within the widest gate
    predicted_v_mag: Array  # of the stars in the frame that must have been detected


@dataclass
class LeanSearch:
    """Attitudes of a short list of detections, and their refinement."""

    camera: Camera
    detections: Detections  # inside the image circle, brightest first
    rays_cam: Array  # (n, 3)
    stars: Stars
    index: PatternIndex  # triangles of the sky's brightest
    near: NearStars
    chance: ChanceModel  # of all the rays
    tried: int = 0

    def attitudes(self, tolerance_px: float) -> Iterator[tuple[Array, Ints, Ints]]:
        """R_cam_icrs that chance hardly explains, with the detections and stars that coincide at it."""
        tolerance = tolerance_px * scale_of(self.camera).on_axis
        for done, depth in zip((0, *DEPTHS), DEPTHS, strict=False):
            if done >= len(self.rays_cam):
                return
            image = triangles_of_few(self.rays_cam[:depth], self.index.reach_rad, done)
            left, right = self.index.candidates(image, tolerance)
            self.tried += len(left)
            if len(left) > MOST_CANDIDATES:
                left, right = left[:MOST_CANDIDATES], right[:MOST_CANDIDATES]
            if len(left):
                cam = self.rays_cam[image.vertices[left]]
                icrs = self.index.rays_icrs[self.index.triangles.vertices[right]]
                yield from self._plausible(cam, icrs, 2.0 * tolerance)

    def _plausible(self, cam: Array, icrs: Array, radius_rad: float) -> Iterator[tuple[Array, Ints, Ints]]:
        """Of the attitudes that turn the rays icrs (m, 3, 3) to cam (m, 3, 3), those that the bright stars support."""
        best = _most_agreed(cam, icrs)[:MOST_VERIFIED]
        for start in (0, *range(1, len(best), AT_ONCE)):
            chunk = best[start : start + AT_ONCE] if start else best[:1]  # the first is nearly always right
            R = wahba(cam[chunk], icrs[chunk], np.ones((len(chunk), 3)))
            cosines, inside = self._cosines(R)
            on = (cosines.max(axis=2) > np.cos(radius_rad)) & inside
            hits, predicted = np.add.reduce(on, axis=1), np.add.reduce(inside, axis=1)
            log_chance = self.chance.log_odds(hits, predicted, radius_rad) + np.log(self.tried)
            for i in np.argsort(log_chance, kind="stable"):
                if log_chance[i] > np.log(PLAUSIBLE) or hits[i] < FEWEST_HITS:
                    break
                star = np.flatnonzero(on[i])
                yield R[i], cosines[i, star].argmax(axis=1), self.index.star[star]

    def _cosines(self, R: Array) -> tuple[Array, Bools]:
        """Of the angles (h, m, n) between bright stars and detections at attitudes (h, 3, 3); the stars (h, m) in view.

        All against all: for some hundred of each that is quicker than a tree.
        """
        predicted = self.index.rays_icrs @ np.swapaxes(R, 1, 2)  # (h, m, 3) in cam
        return predicted @ self.rays_cam.T, predicted[..., 2] > np.cos(self.camera.max_angle_rad)

    def refined(self, R: Array, detection: Ints, star: Ints) -> Found | None:
        """Attitude and matches by place and brightness, from the bright stars (k,) that lie on detections (k,)."""
        d, stars = self.detections, self.stars
        R = _turned(self.rays_cam[detection], stars.rays_icrs[star], np.ones(len(star)), R)
        first = np.argsort(star)[:FIRST_MATCHES]
        light = Light.of(d.flux_e, d.saturated, stars.v_mag[star[first]], detection[first])
        count, bright = np.searchsorted(stars.v_mag, [light.limit_mag + BLEND_MAG, light.certain_mag]).tolist()
        reach_px = max(GATE_PX, 3.0 * d.psf_sigma_px) + 1.0
        near = self.near.pairs(self.rays_cam @ R, reach_px * scale_of(self.camera).largest, count)
        for _ in range(ROUNDS):
            pairs, visible = self._placed(R, near, light, bright)
            some = pairs.nearest[pairs.distance_px[pairs.nearest] < FIRST_GATE_PX]
            if len(some) < FEWEST_HITS:
                return None
            used, variance = self.agree(pairs, some)
            rays_cam, rays_icrs = self.rays_cam[pairs.detection[some]], stars.rays_icrs[pairs.star[some]]
            better = _turned(rays_cam, rays_icrs, used / variance, R)
            moved_px = np.abs(better - R).max() / scale_of(self.camera).on_axis
            if moved_px < SETTLED_PX:
                break
            R = better
        return Found(better, pairs, pairs.nearest, stars.v_mag[:bright][visible])

    def _placed(self, R: Array, near: tuple[Ints, Ints], light: Light, bright: int) -> tuple[Pairs, Bools]:
        """The pairs (detection, star) as they lie at this attitude; which of the `bright` first stars are in view."""
        detection, star = near
        stars = self.stars
        # One projection for both: for a hundred stars the calls cost more than the arithmetic.
        rays = np.concatenate([stars.rays_icrs[star], stars.rays_icrs[:bright]])
        px, inside = self.camera.project(rays @ R.T)
        off = px[: len(star)] - self.detections.xy_px[detection]
        distance = np.where(inside[: len(star)], np.sqrt(np.einsum("ni,ni->n", off, off)), np.inf)
        pairs = Pairs(detection, star, distance, stars.v_mag[star], stars.v_sigma_mag[star], light)
        return pairs, inside[len(star) :]

    def agree(self, pairs: Pairs, which: Ints) -> tuple[Bools, Array]:
        """Which of the pairs are no outliers, and the variance per axis [px^2] of each, the common error added."""
        squared = np.square(pairs.distance_px[which])
        stated = self.variance_px2[pairs.detection[which]]
        common = max(middle(squared) / CHI2_2DOF_MEDIAN - middle(stated), 1e-6)
        return squared < OUTLIER_CHI2 * (stated + common), stated + common

    @cached_property
    def variance_px2(self) -> Array:
        """Of each detection (n,), mean of both axes."""
        return 0.5 * (self.detections.covariance_px2[:, 0, 0] + self.detections.covariance_px2[:, 1, 1])


def _turned(rays_cam: Array, rays_icrs: Array, weights: Array, R: Array) -> Array:
    """The rotation that turns rays_icrs (n, 3) best to rays_cam (n, 3), one Newton step from the nearby R.

    With B = sum w cam (R icrs)^T: a small turn v obeys (tr B - B) v = the skew part of B; then made exact (Rodrigues).
    """
    B = (rays_cam * weights[:, None]).T @ (rays_icrs @ R.T)
    skew = np.array([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]])
    turned: Array = rotation(np.linalg.solve((B[0, 0] + B[1, 1] + B[2, 2]) * np.eye(3) - 0.5 * (B + B.T), skew)) @ R
    return turned


def _most_agreed(cam: Array, icrs: Array) -> Ints:
    """Order of the attitudes that turn icrs (m, 3, 3) to cam (m, 3, 3): those that most others agree with come first.

    True ones agree among each other, chance ones do not.
    """
    if len(cam) < 3:
        return np.arange(len(cam))
    R = np.swapaxes(np.linalg.solve(icrs, cam), 1, 2).reshape(len(cam), 9)
    R /= np.linalg.norm(R, axis=1, keepdims=True) / np.sqrt(3.0)
    agreed = np.count_nonzero(R @ R.T > 3.0 - AGREE_RAD**2, axis=1)  # the trace is 1 + 2 cos of the angle between
    return np.argsort(-agreed, kind="stable")
