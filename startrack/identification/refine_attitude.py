"""From a rough attitude to a settled one, with the stars matched: one look-up, and a few turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import Camera
from startrack.frames import wahba
from startrack.identification.attitudes import Turned
from startrack.identification.index import Patterns
from startrack.identification.matching import Light, Pairs, middle
from startrack.identification.scale import scale_of
from startrack.types import Array, Bools, Detections, Ints

FEWEST = 6
FIRST_GATE_PX, GATE_PX = 3.0, 6.0
ON_PLACE_PX, ON_PLACE_CHI2 = 1.5, 16.0  # from its star, the larger counts
BLEND_SIGMAS = 3.0
ROUNDS = 4  # of matching and turning; one where the bright stars alone have settled the attitude
SETTLED_PX = 0.15
MOST_STRAYED_PX = 0.7  # from the attitude at which stars were looked up
OUTLIER_CHI2 = 16.0
CHI2_2DOF_MEDIAN = 1.3863


@dataclass(frozen=True)
class Found:
    """An attitude with its matches."""

    R_cam_icrs: Array
    pairs: Pairs
    matched: Ints  # (m,) numbers of pairs: mutual nearest, agreeing in brightness, within the widest gate
    named: Bools  # (m,) near enough to bear the star's name
    on_place: Bools  # (m,) as near as the centroids' stated errors let expect
    variance_px2: Array  # (m,) per axis, the error common to all stars added
    visible_v_mag: Array  # of the stars in the image circle that must have been detected


@dataclass(frozen=True)
class Refiner:
    """Attitude and matches by place and brightness."""

    camera: Camera
    detections: Detections
    rays_cam: Array  # (n, 3)
    variance_px2: Array  # (n,) per axis
    patterns: Patterns

    def __call__(self, turned: Turned) -> Found | None:
        """From the bright stars that lie on detections at a rough attitude; None where they do not hold."""
        d, stars, scale = self.detections, self.patterns.stars, scale_of(self.camera)
        R = wahba(self.rays_cam[turned.detection], stars.rays_icrs[turned.star])
        light = Light.of(d.flux_e, d.saturated, stars.v_mag[turned.star], turned.detection)
        limit, bright = np.searchsorted(stars.v_mag, [light.limit_mag, light.certain_mag]).tolist()
        near = turned.near
        strayed_px = np.abs(turned.R_cam_icrs - R).max() / scale.on_axis
        if near is None or near.depth < limit or strayed_px > MOST_STRAYED_PX:
            near = self.patterns.near(self.rays_cam @ R, reach_px(d) * scale.largest, limit)
        detection, star = near.ray, near.star
        rays_icrs, v_mag, v_sigma_mag = stars.rays_icrs[star], stars.v_mag[star], stars.v_sigma_mag[star]
        xy_px = d.xy_px[detection]
        for _ in range(ROUNDS):
            px, inside = self.camera.project(rays_icrs @ R.T)
            off = px - xy_px
            distance = np.sqrt(np.einsum("ni,ni->n", off, off))
            distance[~inside | (distance > GATE_PX)] = np.inf
            pairs = Pairs(detection, star, distance, v_mag, v_sigma_mag, light)
            matched = pairs.nearest
            if len(matched) < FEWEST:
                return None
            agree, variance = self._agree(pairs, matched)
            used = matched[agree]
            if len(used) < FEWEST:
                return None
            better = wahba(self.rays_cam[detection[used]] / variance[agree][:, None], rays_icrs[used])
            moved_px = np.abs(better - R).max() / scale.on_axis
            if moved_px < SETTLED_PX:
                break
            R = better
        visible = stars.rays_icrs[:bright] @ R[2] > np.cos(self.camera.max_angle_rad)
        squared, strain = np.square(pairs.distance_px[matched]), pairs.strain[matched]
        on_place = squared < np.maximum(ON_PLACE_PX**2, ON_PLACE_CHI2 * self.variance_px2[detection[matched]])
        # Neither place nor brightness may be at the edge of what is allowed if the other is.
        named = on_place & agree & (squared / (OUTLIER_CHI2 * variance) + strain * strain < 1.0)
        return Found(better, pairs, matched, named, on_place, variance, stars.v_mag[:bright][visible])

    def _agree(self, pairs: Pairs, which: Ints) -> tuple[Bools, Array]:
        """Which of the pairs are no outliers, and the variance per axis [px^2] of each, the common error added."""
        distance = pairs.distance_px[which]
        stated = self.variance_px2[pairs.detection[which]]
        first = distance < FIRST_GATE_PX
        if not first.any():
            return first, stated
        squared = np.square(distance)
        common = max(middle(squared[first]) / CHI2_2DOF_MEDIAN - middle(stated[first]), 1e-6)
        variance = stated + common
        return first & (squared < OUTLIER_CHI2 * variance), variance


def reach_px(detections: Detections) -> float:
    """How far from a detection a star matters, at a rough attitude."""
    return max(GATE_PX, BLEND_SIGMAS * detections.psf_sigma_px) + 1.0
