"""One-to-one matches of detections with predicted stars, by place and brightness."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack.camera import Camera
from startrack.types import Array, Bools, Detections, Ints, Stars

BLEND_FLUX_RATIO = 0.25  # a neighbour with more than this part of a star's light makes the identity ambiguous
BRIGHT_STARS = 5000  # enough of the sky's brightest to set the brightness scale
FIRST_MATCHES = 200
MAGNITUDE_TOLERANCE = 0.8
DEPTH_BELOW_THRESHOLD_MAG = 0.7
SIGNIFICANT_SNR = 10.0


@dataclass(frozen=True)
class Matches:
    """Matched pairs and what the frame's brightness scale turned out to be."""

    detection: Ints  # (n,)
    star: Ints  # (n,)
    distance_px: Array  # (n,)
    zero_mag: float  # V of a star of unit flux
    predicted: int  # stars predicted in the field brighter than the detection limit
    coincident_px: Array  # (m,) distances of all stars from detections of their brightness, blends included
    alike: float  # probability that a star and a detection taken at random agree in brightness


def match(
    detections: Detections, camera: Camera, stars: Stars, R_cam_icrs: Array, gate_px: float, radius_px: float
) -> Matches:
    """Mutual nearest neighbours within the gate whose brightness agrees; blends of similar stars are left out.

    The brightness scale comes from the frame itself: the median over the brightest stars predicted.
    """
    from scipy.spatial import cKDTree

    none = np.zeros(0, dtype=np.int64)
    if not len(detections):
        return Matches(none, none, np.zeros(0), 0.0, 0, np.zeros(0), 1.0)
    tree = cKDTree(detections.xy_px)
    brightness = -2.5 * np.log10(np.maximum(detections.flux_e, 1e-9))

    def nearest_to(count: int) -> tuple[Array, Ints, Array, Ints, Bools]:
        """Predicted pixels and, of the `count` brightest stars, those in the frame with their nearest detections."""
        predicted_px, inside = camera.project(stars.rays_icrs[:count] @ R_cam_icrs.T)
        seen = np.flatnonzero(inside)
        distance, nearest = tree.query(predicted_px[seen], distance_upper_bound=gate_px)
        return predicted_px, seen, distance, nearest, np.isfinite(distance)

    _, seen, _, nearest, hit = nearest_to(BRIGHT_STARS)
    measured = hit.copy()
    measured[hit] = ~detections.saturated[nearest[hit]]  # a saturated star's flux is a lower bound
    first = np.flatnonzero(measured if np.count_nonzero(measured) >= 3 else hit)[:FIRST_MATCHES]
    if len(first) < 3:
        return Matches(none, none, np.zeros(0), 0.0, len(seen), np.zeros(0), 1.0)
    zero_mag = float(np.median(stars.v_mag[seen[first]] - brightness[nearest[first]]))
    limit = zero_mag + float(np.max(brightness)) + DEPTH_BELOW_THRESHOLD_MAG
    faintest = limit - 2.5 * np.log10(BLEND_FLUX_RATIO)
    predicted_px, seen, distance, nearest, hit = nearest_to(int(np.searchsorted(stars.v_mag, faintest)))
    candidates = hit & (stars.v_mag[seen] < limit)
    measured_mag = brightness[nearest[candidates]] + zero_mag
    star = seen[candidates]
    tolerance = np.hypot(MAGNITUDE_TOLERANCE, 2 * stars.v_sigma_mag[star])
    saturated = detections.saturated[nearest[candidates]] & (stars.v_mag[star] < measured_mag)
    agrees = (np.abs(stars.v_mag[star] - measured_mag) < tolerance) | saturated
    star, detection = star[agrees], nearest[candidates][agrees]
    distance = distance[candidates][agrees]
    keep = _nearest_of_each(detection, distance)
    star, detection, distance = star[keep], detection[keep], distance[keep]
    alone = _not_blended(detections.xy_px[detection], star, predicted_px, seen, stars.v_mag, radius_px)
    bright = stars.v_mag[seen][stars.v_mag[seen] < limit - DEPTH_BELOW_THRESHOLD_MAG]
    return Matches(
        detection[alone], star[alone], distance[alone], zero_mag, len(bright), distance,
        alike(bright, brightness + zero_mag),
    )  # fmt: skip


def alike(v_mag: Array, measured_mag: Array, dimmed_mag: float = MAGNITUDE_TOLERANCE) -> float:
    """Part of the pairs of a star and a detection that agree in brightness, the star dimmed by so much at most."""
    ordered = np.sort(measured_mag)
    first = np.searchsorted(ordered, v_mag - MAGNITUDE_TOLERANCE)
    last = np.searchsorted(ordered, v_mag + dimmed_mag)
    return float((last - first).sum() / (len(v_mag) * len(ordered))) if len(v_mag) else 1.0


def _nearest_of_each(detection: Ints, distance: Array) -> Ints:
    """Indices of the closest star of each detection."""
    order = np.lexsort((distance, detection))
    _, first = np.unique(detection[order], return_index=True)
    return np.sort(order[first])


def _not_blended(xy_px: Array, star: Ints, predicted_px: Array, seen: Ints, v_mag: Array, radius_px: float) -> Array:
    """Whether no other star of comparable light falls within the radius of the detections (n, 2)."""
    from scipy.spatial import cKDTree

    near = cKDTree(predicted_px[seen]).query_ball_point(xy_px, radius_px)
    faintest = v_mag[star] - 2.5 * np.log10(BLEND_FLUX_RATIO)
    return np.array(
        [
            not any(seen[j] != s and v_mag[seen[j]] < limit for j in others)
            for others, s, limit in zip(near, star, faintest, strict=True)
        ],
        dtype=bool,
    )


def brightest(detections: Detections, most: int) -> Detections:
    """The first `most` detections."""
    return taken(detections, slice(most))


def taken(detections: Detections, which: Any) -> Detections:
    """The detections selected by a slice or index array."""
    names = ("xy_px", "covariance_px2", "flux_e", "flux_sigma_e", "snr", "saturated")
    return replace(detections, **{name: getattr(detections, name)[which] for name in names})


def unexplained_by(
    detections: Detections, camera: Camera, stars: Stars, R_cam_icrs: Array, zero_mag: float, gate_px: float
) -> int:
    """Significant detections with no catalogue star near that could be a part of their light."""
    from scipy.spatial import cKDTree

    significant = np.flatnonzero(detections.snr > SIGNIFICANT_SNR)
    if not len(significant):
        return 0
    faintest = zero_mag - 2.5 * np.log10(detections.flux_e[significant].min()) + 2.0
    px, inside = camera.project(stars.rays_icrs[: int(np.searchsorted(stars.v_mag, faintest))] @ R_cam_icrs.T)
    if not inside.any():
        return len(significant)
    distance, _ = cKDTree(px[inside]).query(detections.xy_px[significant], distance_upper_bound=gate_px)
    return int(np.count_nonzero(~np.isfinite(distance)))
