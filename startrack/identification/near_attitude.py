"""Pairs of a detection and a star near a rough attitude: the right ones agree with each other in their separations."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, Ints
from startrack.identification.index import CatalogPatterns

MOST_OFF_RAD = np.radians(12.0)  # of a rough attitude
MOST_OFF_OF_FIELD = 0.2  # of the field's diameter, at most
NEAR_DETECTIONS = 32  # brightest detections
NEAR_STARS_1 = 3  # brightest stars of the field for each of them
MOST_PAIRS = 200  # those closest together
AGREEING_1 = 0.5  # of the pairs that agree with the best one: a right pair agrees with all right ones


def agreeing_pairs(
    rays_cam: Array, R_cam_icrs: Array, patterns: CatalogPatterns, diameter_rad: float, tolerance: float
) -> tuple[Ints, Ints, int]:
    """The detections (k,) and stars (k,) of the largest group of pairs that one rotation explains; the number tried.

    `rays_cam` (n, 3): detections, brightest first. Stars are looked for about where the rough attitude `R_cam_icrs`
    places the detections, up to MOST_OFF_RAD or MOST_OFF_OF_FIELD of the field's `diameter_rad`. Any two pairs whose
    detections and stars are equally far apart, to a `tolerance` of the chord, propose an attitude: these are counted.
    """
    rays, radius = rays_cam[:NEAR_DETECTIONS], min(MOST_OFF_RAD, MOST_OFF_OF_FIELD * diameter_rad)
    depth = int(NEAR_STARS_1 * 4 * np.pi / patterns.field_sr * len(rays))
    near = patterns.neighbours(rays @ R_cam_icrs, radius, depth)
    bright = np.flatnonzero(near.star < depth)
    bright = np.sort(bright[np.argsort(near.chord[bright], kind="stable")[:MOST_PAIRS]])
    detection, star = near.ray[bright], near.star[bright]
    apart_cam, apart_icrs = (_chords(some) for some in (rays[detection], patterns.stars.rays_icrs[star]))
    agree = (np.abs(apart_cam - apart_icrs) < tolerance) & (detection[:, None] != detection) & (star[:, None] != star)
    votes = np.count_nonzero(agree, axis=1)
    if not votes.any():
        return detection[:0], star[:0], 0
    best = int(np.argmax(votes))
    group = np.flatnonzero((agree[best] | (np.arange(len(votes)) == best)) & (votes >= AGREEING_1 * votes[best]))
    group = group[np.argsort(-votes[group], kind="stable")]
    group = group[np.unique(detection[group], return_index=True)[1]]
    return detection[group], star[group], int(votes.sum()) // 2


def _chords(rays: Array) -> Array:
    """Distances (n, n) between unit vectors (n, 3)."""
    return np.sqrt(np.maximum(2.0 - 2.0 * (rays @ rays.T), 0.0))
