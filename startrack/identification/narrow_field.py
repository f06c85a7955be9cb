"""Narrow fields of roughly known width: triangles vote for views, and a pinhole is fitted and verified."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from startrack.core.types import Array, Centroids, Ints, Stars
from startrack.estimation.false_alarm import (
    PATTERN_MATCHES,
    coincidence_probability,
    density_per_px2,
    log_p_value_bound,
    log_trials,
)
from startrack.estimation.match import CandidatePairs, PhotometricScale, match_nearest
from startrack.identification.hypotheses import ShapePatterns, family_rays, narrow_sizes, patterns_for
from startrack.identification.index import PerObject
from startrack.identification.pinhole_view import PinholeView
from startrack.identification.radial_lens_family import PINHOLE
from startrack.identification.triangles import Triangles, triad_attitude, triangles
from startrack.identification.verify_unknown_lens import (
    FEWEST,
    NEAR_PX,
    RADIUS_SIGMAS,
    SMALLEST_RADIUS_PX,
    TESTED,
    VerifiedLens,
    agreement_of,
    significance,
    trusted_radius,
)

STARS_IN_FIELD, SIDE_OF_FIELD = 24, 0.4  # pattern stars; longest side of their triangles over the field's diameter
ROUNDS = ((0, 10), (0, 16), (8, 22), (0, 22), (20, 34))  # ranks of brightness whose triangles vote together
MAX_VOTED = 150  # triangles with the most votes whose attitudes are compared
SAME_ATTITUDE_RAD, SAME_SCALE_1 = 0.02, 0.01
MIN_AGREEING = 3
VIEWS_OF_ROUND = 4
# Detections, stars for each, the gate (part of the frame's width, but at least pixels), and the largest log p-value
# bound of the matches in the inner half of the gate.
STAGES = ((60, 1.5, 0.010, 6.0, -4.0), (120, 1.5, 0.005, 4.0, -8.0), (400, 2.0, 0.0, 2.5, -10.0))
STEPS = 2
MARGIN = 1.15  # of the frame: the focal length is not known
GATE_PX = 1.5
SCALE_MATCHES = 200  # brightest, for the photometric scale
SMALLEST_ERROR_PX = 0.1  # of a centroid against the lens
BLEND_SIGMAS, WIDEST_BLEND_PX = 3.0, 4.5
MIN_FOR_DISTORTION, DISTORTED_RMS_1 = 25, 0.7  # a distorted lens leaves less than this part of the residual


class NearStars(NamedTuple):
    """Catalogue stars near a view."""

    rays_icrs: Array  # (n, 3)
    v_mag: Array  # (n,)
    v_sigma_mag: Array  # (n,)


@dataclass(frozen=True)
class VerifiedView:
    """A view with its verified lens; `around` are the catalogue indices to which the lens's `star` refers."""

    view: PinholeView
    around: Ints
    lens: VerifiedLens


class NarrowFieldSearch:
    """Search for views of a list of detections."""

    def __init__(
        self, centroids: Centroids, chosen: Ints, size_px: tuple[int, int], fov_rad: float, field_sr: float,
        stars: Stars,
    ) -> None:  # fmt: skip
        """`chosen`: detections without clumps; `field_sr`: solid angle of the frame, rounded so that indexes serve."""
        self.centroids, self.size_px, self.stars = centroids, size_px, stars
        self.xy_px = centroids.xy_px[chosen]
        self.focal_px = 0.5 * size_px[0] / np.tan(0.5 * fov_rad)
        self.field_sr = field_sr
        self.tried = 0
        self._trees: dict[int, Any] = {}

    def views(self) -> Iterator[VerifiedView]:
        """Views that most of the bright stars support, likely ones first."""
        patterns = patterns_for(self.stars, narrow_sizes(self.field_sr, STARS_IN_FIELD, SIDE_OF_FIELD))
        seen: list[Array] = []
        for first, end in ROUNDS:
            if first and len(self.xy_px) <= first + 4:
                continue
            for view in self._voted_views(patterns, self.xy_px[first:end]):
                if any(np.trace(R.T @ view.R_cam_icrs) > 3.0 - SAME_ATTITUDE_RAD**2 for R in seen):
                    continue
                seen.append(view.R_cam_icrs)
                found = self._grow_view(view)
                if found is not None:
                    yield found

    def _voted_views(self, patterns: ShapePatterns, xy_px: Array) -> list[PinholeView]:
        """The views with the largest number of agreeing triangles."""
        centre = (0.5 * (self.size_px[0] - 1), 0.5 * (self.size_px[1] - 1))
        image = triangles(family_rays(xy_px, centre, self.focal_px, PINHOLE), patterns.longest_side_rad)
        left, right = patterns.triangles.candidates(image)
        self.tried += len(left)
        if not len(left):
            return []
        catalogue = patterns.triangles.triangles
        mirrored = image.handedness[left] != catalogue.handedness[right]
        # A pair (detection, star) of a wrong triangle occurs once, a right one in many triangles.
        pair = (image.vertices[left] + len(xy_px) * mirrored[:, None]) * len(patterns.star) + catalogue.vertices[right]
        votes = np.bincount(pair.ravel())[pair].min(axis=1)
        most = np.argsort(-votes, kind="stable")[:MAX_VOTED]
        return self._agreeing_views(patterns, xy_px, image.take(left[most]), catalogue.take(right[most]))

    def _agreeing_views(
        self, patterns: ShapePatterns, xy_px: Array, image: Triangles, catalogue: Triangles
    ) -> list[PinholeView]:
        """One view for each group of pairs of triangles (m) that agree in attitude, scale and handedness."""
        scale = np.mean(image.sides_rad / catalogue.sides_rad, axis=1)
        mirrored = image.handedness != catalogue.handedness
        off = xy_px[image.vertices] - 0.5 * (np.array(self.size_px) - 1.0)
        off[mirrored, :, 0] *= -1
        focal = self.focal_px * scale
        cam = np.concatenate([off, np.broadcast_to(focal[:, None, None], (*off.shape[:2], 1))], axis=2)
        cam /= np.linalg.norm(cam, axis=2, keepdims=True)
        R = triad_attitude(cam, patterns.rays_icrs[catalogue.vertices])
        flat = R.reshape(len(R), 9)
        same = flat @ flat.T > 3.0 - SAME_ATTITUDE_RAD**2  # the trace is 1 + 2 cos of the angle between
        same &= np.abs(np.log(scale)[:, None] - np.log(scale)) < SAME_SCALE_1
        same &= mirrored[:, None] == mirrored
        views = []
        left = np.ones(len(R), dtype=bool)
        for _ in range(VIEWS_OF_ROUND):
            count = np.where(left, np.count_nonzero(same & left, axis=1), 0)
            best = int(np.argmax(count))
            if count[best] < MIN_AGREEING:
                break
            views.append(PinholeView(R[best], float(focal[best]), bool(mirrored[best]), self.size_px))
            left &= ~same[best]
        return views

    def _grow_view(self, view: PinholeView) -> VerifiedView | None:
        """The view fitted with more stars and smaller gates, and verified; None where too few stars agree."""
        corner = np.arctan(0.5 * MARGIN * np.hypot(*self.size_px) / view.focal_px)
        near = _star_tree_of(self.stars).query_ball_point(view.R_cam_icrs[2], 2 * np.sin(0.5 * corner))
        around = np.sort(np.asarray(near, dtype=np.int64))
        rays = self.stars.rays_icrs[around]
        for count, per_detection, fraction, least_px, most_log_p in STAGES:
            gate_px = max(fraction * self.size_px[0], least_px)
            xy = self.centroids.xy_px[:count]
            px, inside = view.project(rays)
            some = np.flatnonzero(inside)[: int(per_detection * len(xy)) + 5]
            detection, star, distance = match_nearest(self._tree(count), px[some], gate_px)
            density = len(xy) / (self.size_px[0] * self.size_px[1])
            if len(star) < FEWEST or log_p_value_bound(distance, gate_px, len(some), density) > most_log_p:
                return None
            distorted = len(star) >= MIN_FOR_DISTORTION
            view = view.fit(xy[detection], rays[some[star]], gate_px / 4, distorted, STEPS)
        return verify_view(view, self.centroids, self.stars, around, self._tree(len(self.centroids)), self.tried)

    def _tree(self, count: int) -> Any:
        """cKDTree of the first detections."""
        from scipy.spatial import cKDTree

        count = min(count, len(self.centroids))
        if count not in self._trees:
            self._trees[count] = cKDTree(self.centroids.xy_px[:count])
        return self._trees[count]


def _star_tree(stars: Stars) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(stars.rays_icrs, balanced_tree=False)


_star_tree_of = PerObject(_star_tree)


def verify_view(
    view: PinholeView, centroids: Centroids, catalogue: Stars, around: Ints, tree: Any, tried: int
) -> VerifiedView | None:
    """The view refined with stars of the right brightness, with its p-value; None where too few agree.

    `around`: indices of the catalogue's stars near the view. `tree`: cKDTree of all detections.
    """
    stars = NearStars(catalogue.rays_icrs[around], catalogue.v_mag[around], catalogue.v_sigma_mag[around])
    pairs = _candidate_pairs(view, centroids, stars, tree)
    if pairs is None:
        return None
    chosen = _select_unambiguous(pairs, _pairs_within_gate(pairs), centroids)
    if len(chosen) < FEWEST:
        return None
    xy_px, rays = centroids.xy_px[pairs.detection[chosen]], stars.rays_icrs[pairs.star[chosen]]
    view = view.fit(xy_px, rays, GATE_PX / 4, distorted=len(chosen) >= MIN_FOR_DISTORTION)
    view = _choose_lens(view, xy_px, rays, GATE_PX / 4)
    pairs = _candidate_pairs(view, centroids, stars, tree)
    if pairs is None:
        return None
    off_axis_px = np.linalg.norm(centroids.xy_px - view.centre_px, axis=1)
    near = pairs.one_to_one_pairs[pairs.detection[pairs.one_to_one_pairs] < TESTED]
    trusted_px = trusted_radius(off_axis_px[pairs.detection[near]], pairs.distance_px[near] < GATE_PX)
    if trusted_px is None:
        return None
    chosen = _pairs_within_gate(pairs)
    chosen = chosen[off_axis_px[pairs.detection[chosen]] <= trusted_px]
    if len(chosen) < FEWEST:
        return None
    log_p = _log_p_value(view, pairs, chosen, centroids, stars, trusted_px) + log_trials(tried)
    chosen = _select_unambiguous(pairs, chosen, centroids)
    camera = view.camera()
    trusted_rad = float(camera.angle_rad(view.centre_px + np.array([trusted_px, 0.0])))
    lens = VerifiedLens(
        camera=replace(camera, calibrated_angle_rad=min(trusted_rad, camera.max_angle_rad)),
        R_cam_icrs=view.R_cam_icrs,
        detection=pairs.detection[chosen],
        star=pairs.star[chosen],
        log_p=log_p,
        unexplained=pairs.count_unexplained(centroids.snr, GATE_PX),
    )
    return VerifiedView(view, around, lens)


def _pairs_within_gate(pairs: CandidatePairs) -> Ints:
    """Indices of the one-to-one pairs closer than the gate."""
    return pairs.one_to_one_pairs[pairs.distance_px[pairs.one_to_one_pairs] < GATE_PX]


def _choose_lens(view: PinholeView, xy_px: Array, rays_icrs: Array, sigma_px: float) -> PinholeView:
    """A pinhole, unless the distorted lens fits the stars (n, 3) at the pixels (n, 2) much better."""
    if not view.distortion:
        return view
    pinhole = view.to_pinhole().fit(xy_px, rays_icrs, sigma_px, distorted=False, steps=2)
    left = [np.sum(np.square(xy_px - v.project(rays_icrs)[0])) for v in (view, pinhole)]
    return view if len(xy_px) >= MIN_FOR_DISTORTION and left[0] < DISTORTED_RMS_1**2 * left[1] else pinhole


def _select_unambiguous(pairs: CandidatePairs, which: Ints, centroids: Centroids) -> Ints:
    """The one-to-one pairs with an unambiguous star."""
    some = centroids.covariance_px2[pairs.detection[which]]
    variance_px2 = 0.5 * (some[:, 0, 0] + some[:, 1, 1]) + SMALLEST_ERROR_PX**2
    return pairs.select_unambiguous(which, variance_px2, min(BLEND_SIGMAS * centroids.psf_sigma_px, WIDEST_BLEND_PX))


def _candidate_pairs(view: PinholeView, centroids: Centroids, stars: NearStars, tree: Any) -> CandidatePairs | None:
    """All pairs of a detection and a star near it; None where they are too few for a photometric scale."""
    from scipy.spatial import cKDTree

    px, inside = view.project(stars.rays_icrs)
    seen = np.flatnonzero(inside)
    found = tree.sparse_distance_matrix(cKDTree(px[seen]), NEAR_PX, output_type="ndarray")
    found = found[np.lexsort((found["j"], found["i"]))]
    detection, star, distance = found["i"].astype(np.int64), seen[found["j"]], found["v"]
    close = np.flatnonzero(distance < GATE_PX)
    if len(close) < FEWEST:
        return None
    close = close[np.argsort(star[close], kind="stable")][:SCALE_MATCHES]
    scale = PhotometricScale.from_matches(
        centroids.flux_e, centroids.saturated, stars.v_mag[star[close]], detection[close]
    )
    v_sigma_mag = stars.v_sigma_mag[star] + centroids.brightness_sigma_mag
    return CandidatePairs(detection, star, distance, stars.v_mag[star], v_sigma_mag, scale)


def _log_p_value(
    view: PinholeView, pairs: CandidatePairs, chosen: Ints, centroids: Centroids, stars: NearStars, trusted_px: float
) -> float:
    """Log p-value of the pairs `chosen` of the brightest detections, up to `trusted_px` from the centre."""
    xy_px = centroids.xy_px[:TESTED]
    rms_px = float(np.sqrt(np.mean(np.square(pairs.distance_px[chosen]))))
    radius_px = float(np.clip(RADIUS_SIGMAS * rms_px, SMALLEST_RADIUS_PX, GATE_PX))
    hits = int(np.count_nonzero((pairs.detection[chosen] < len(xy_px)) & (pairs.distance_px[chosen] < radius_px)))
    measured = pairs.scale.measured_mag[: len(xy_px)]
    px, inside = view.project(stars.rays_icrs)
    inside &= np.linalg.norm(px - view.centre_px, axis=1) <= trusted_px
    bright = stars.v_mag[inside & (stars.v_mag < measured.max())]
    predicted = max(len(bright), hits)
    known = np.linalg.norm(xy_px - view.centre_px, axis=1) <= trusted_px
    density = density_per_px2(xy_px[known], view.size_px)
    each = float(coincidence_probability(density * np.pi * radius_px**2)) * agreement_of(centroids, bright, measured)
    return significance(hits, predicted, each, PATTERN_MATCHES)
