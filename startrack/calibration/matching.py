"""One-to-one matches of a frame's sources with predicted stars, by place and by brightness."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from startrack.calibration.frame import Frame
from startrack.camera import Camera
from startrack.types import Array, Bools, Ints

MAGNITUDE_TOLERANCE = 0.9
BLEND_MAG = 2.0  # a neighbour less than this fainter than the star shifts its centroid
BLEND_PX = 3.5  # times the PSF's sigma
DEPTH_MAG = 0.5  # beyond the faintest source that stars are predicted for
SCALE_STARS = 4000
FEWEST_FOR_SHAPE = 30
SECURE_MAG = 0.7  # a star this much brighter than the frame's limit must be seen where the sky is open
LIMIT_QUANTILE = 0.85
CELL_PARTS = 12  # of the frame's longer side: a cell without any source is not open sky


@dataclass(frozen=True)
class Matched:
    """Pairs of one frame, and how many there should be."""

    detection: Ints  # (n,) indices into the frame's detections
    star: Ints  # (n,) indices into the frame's sky
    expected: int  # bright stars predicted where the sky is open
    expected_found: int  # of them, those with a source of their brightness
    significant: int  # bright sources within the angle searched
    significant_matched: int

    def __len__(self) -> int:
        return len(self.star)

    @property
    def fraction(self) -> float:
        """The larger of: bright stars that have a source, bright sources that have a star.

        Clouds and trees take from the first, hot pixels and lamps from the second; a wrong map takes from both.
        """
        return max(
            self.expected_found / self.expected if self.expected else 0.0,
            self.significant_matched / self.significant if self.significant else 0.0,
        )


def match_frame(frame: Frame, camera: Camera, R_cam_icrs: Array, within_rad: float, gate_px: float) -> Matched:
    """Nearest pairs closer than the gate and alike in brightness, unblended, up to the angle `within_rad` off axis."""
    from scipy.spatial import cKDTree

    found, stars = frame.detections, frame.sky.stars
    source_mag = -2.5 * np.log10(np.maximum(found.flux_e, 1e-9))
    tree = cKDTree(found.xy_px)
    zero = _brightness(frame, camera, R_cam_icrs, within_rad, gate_px, tree)
    limit = float(source_mag.max()) + DEPTH_MAG
    faintest_v = limit + BLEND_MAG + float(np.max(zero(np.linspace(0.0, within_rad, 50))))
    count = int(np.searchsorted(stars.v_mag, faintest_v))
    px, angle, seen = _predicted(frame, camera, R_cam_icrs, within_rad, count)
    expected_mag = stars.v_mag[:count] - zero(angle)  # in the instrument's magnitudes
    seen = seen[expected_mag[seen] < limit + BLEND_MAG]
    distance, nearest = tree.query(px[seen], distance_upper_bound=gate_px)
    hit = np.isfinite(distance) & (expected_mag[seen] < limit)
    star, detection = _alike(frame, seen[hit], nearest[hit], distance[hit], expected_mag, source_mag)
    alone = _alone(px, seen, star, stars.v_mag, BLEND_PX * found.psf_sigma_px)
    faintest = float(np.quantile(source_mag[detection], LIMIT_QUANTILE)) if len(detection) else -np.inf
    bright = seen[expected_mag[seen] < faintest - SECURE_MAG]
    expected = bright[_open(px[bright], found.xy_px[detection], frame.size_px)]
    significant = (camera.angle_rad(found.xy_px) < within_rad) & (source_mag < faintest - SECURE_MAG)
    return Matched(
        detection=detection[alone],
        star=star[alone],
        expected=len(expected),
        expected_found=int(np.isin(expected, star).sum()),
        significant=int(significant.sum()),
        significant_matched=int(np.count_nonzero(significant[detection])),
    )


def _alike(
    frame: Frame, star: Ints, detection: Ints, distance: Array, expected_mag: Array, source_mag: Array
) -> tuple[Ints, Ints]:
    """Of the pairs (n,) those that are equally bright, and of each source's the closest: stars and sources."""
    brighter = expected_mag[star] - source_mag[detection]
    alike = np.abs(brighter) < np.hypot(MAGNITUDE_TOLERANCE, 2.0 * frame.sky.stars.v_sigma_mag[star])
    alike |= frame.detections.saturated[detection] & (brighter < 0)
    star, detection, distance = star[alike], detection[alike], distance[alike]
    keep = _nearest_of_each(detection, distance)
    return star[keep], detection[keep]


def _predicted(
    frame: Frame, camera: Camera, R_cam_icrs: Array, within_rad: float, count: int
) -> tuple[Array, Array, Ints]:
    """Pixels (n, 2) and off-axis angles (n,) of the `count` brightest stars, and which fall into the frame.

    Of the others the pixels and angles mean nothing.
    """
    rays_icrs = frame.sky.stars.rays_icrs[:count]
    reach = min(within_rad, camera.lens.max_invertible_rad)
    near = np.flatnonzero(rays_icrs @ R_cam_icrs[2] > np.cos(reach))
    rays = rays_icrs[near] @ R_cam_icrs.T
    px, angle = np.zeros((len(rays_icrs), 2)), np.zeros(len(rays_icrs))
    px[near] = camera.project_unlimited(rays)
    angle[near] = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    width, height = frame.size_px
    inside = np.all((px[near] > -0.5) & (px[near] < np.array([width, height]) - 0.5), axis=1)
    return px, angle, near[inside]


def _brightness(
    frame: Frame, camera: Camera, R_cam_icrs: Array, within_rad: float, gate_px: float, tree: Any
) -> Callable[[Array], Array]:
    """Zero point [mag] as a function of the angle off the axis: vignetting and, roughly, the air are in it."""
    found, v_mag = frame.detections, frame.sky.stars.v_mag
    px, angle, seen = _predicted(frame, camera, R_cam_icrs, within_rad, SCALE_STARS)
    distance, nearest = tree.query(px[seen], distance_upper_bound=gate_px)
    hit = np.isfinite(distance)
    hit[hit] &= ~found.saturated[nearest[hit]]
    source_mag = -2.5 * np.log10(np.maximum(found.flux_e[nearest[hit]], 1e-9))
    return _parabola(angle[seen[hit]], v_mag[seen[hit]] - source_mag)


def _parabola(angle_rad: Array, zero_mag: Array) -> Callable[[Array], Array]:
    """Robust parabola through zero points; constant beyond the angles of the stars, where it might do anything."""
    if not len(zero_mag):
        return np.poly1d([0.0])
    fit = np.poly1d([float(np.median(zero_mag))])
    if len(zero_mag) < FEWEST_FOR_SHAPE:
        return fit
    for _ in range(4):
        close = np.abs(zero_mag - fit(angle_rad)) < 1.2
        if close.sum() < FEWEST_FOR_SHAPE:
            break
        fit = np.poly1d(np.polyfit(angle_rad[close], zero_mag[close], 2))
    low, high = np.min(angle_rad), np.max(angle_rad)
    return lambda a: fit(np.clip(a, low, high))


def _nearest_of_each(detection: Ints, distance: Array) -> Ints:
    """Indices of the closest star of each detection."""
    order = np.lexsort((distance, detection))
    _, first = np.unique(detection[order], return_index=True)
    return np.sort(order[first])


def _alone(px: Array, seen: Ints, star: Ints, v_mag: Array, radius_px: float) -> Bools:
    """Whether no other star of comparable light falls near the stars (n,)."""
    from scipy.spatial import cKDTree

    if not len(star):
        return np.zeros(0, dtype=bool)
    near = cKDTree(px[seen]).query_ball_point(px[star], radius_px)
    limit = v_mag[star] + BLEND_MAG
    return np.array(
        [
            not any(seen[j] != s and v_mag[seen[j]] < faintest for j in others)
            for others, s, faintest in zip(near, star, limit, strict=True)
        ],
        dtype=bool,
    )


def _open(px: Array, xy_px: Array, size_px: tuple[int, int]) -> Bools:
    """Whether the pixels (n, 2) lie in a cell of the frame where a match lies too: elsewhere is cloud, tree or wall."""
    cell = max(size_px) / CELL_PARTS
    columns = int(np.ceil(size_px[0] / cell)) + 2
    numbers = [np.clip(np.rint(p / cell), 0, None).astype(int) @ np.array([1, columns]) for p in (px, xy_px)]
    return np.isin(*numbers)
