"""Whether a narrow view of the sky is the right one: matches by place and brightness, and the odds against chance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack.camera import Camera
from startrack.identification.match import alike
from startrack.identification.matching import Light, Pairs
from startrack.identification.unknown_lens_plane import FEWEST, View
from startrack.types import Array, Detections, Ints, Stars

NEAR_PX = 6.0
GATE_PX = 1.5
FIRST_MATCHES = 200  # brightest, that tell the brightness scale
JUDGED = 400  # brightest detections that the odds are worked out for
ON_PLACE = 0.5  # of the stars near their places lie on them where the lens is understood
STARS_OF_A_RING, MOST_RINGS = 8, 12
SMALLEST_RADIUS_PX = 0.6
GIVEN = 3  # matches that the pattern brings about by itself
TIMES_CHANCE = 3.0
LEAST_ERROR_PX = 0.1  # of a centroid against the lens
CELLS = 12  # across the frame, in which detections are counted
BLEND_SIGMAS, WIDEST_BLEND_PX = 3.0, 4.5
ENOUGH_TO_BEND, BENT = 25, 0.7  # a lens that is no pinhole leaves this part of the residual


@dataclass(frozen=True)
class Judged:
    """A view with its matches and the odds."""

    view: View
    camera: Camera  # calibrated as far out as stars lie on their places
    detection: Ints
    star: Ints
    log_chance: float  # that a random sky would be matched as well by one of all trials
    unexplained: int

    @property
    def R_cam_icrs(self) -> Array:
        """(3, 3)"""
        return self.view.R_cam_icrs


def judged(view: View, detections: Detections, stars: Stars, tree: Any, tried: int) -> Judged | None:
    """The view refined by stars (around it, brightest first) of the right brightness; None where it falls apart.

    `tree`: of all the detections' places.
    """
    pairs = _pairs(view, detections, stars, tree)
    on = None if pairs is None else _plain(pairs, _within(pairs), detections)
    if pairs is None or on is None or len(on) < FEWEST:
        return None
    xy_px, rays = detections.xy_px[pairs.detection[on]], stars.rays_icrs[pairs.star[on]]
    view = view.fitted(xy_px, rays, GATE_PX / 4, bend=len(on) >= ENOUGH_TO_BEND)
    view = _simpler(view, xy_px, rays, GATE_PX / 4)
    pairs = _pairs(view, detections, stars, tree)
    if pairs is None:
        return None
    off_axis_px = np.linalg.norm(detections.xy_px - view.middle_px, axis=1)
    known_px = _known_px(pairs, off_axis_px)
    if known_px is None:
        return None
    on = _within(pairs)
    on = on[off_axis_px[pairs.detection[on]] <= known_px]
    if len(on) < FEWEST:
        return None
    log_chance = _log_chance(view, pairs, on, detections.xy_px[:JUDGED], stars, known_px)
    on = _plain(pairs, on, detections)
    camera = view.camera()
    known_rad = float(camera.angle_rad(view.middle_px + np.array([known_px, 0.0])))
    return Judged(
        view=view,
        camera=replace(camera, calibrated_angle_rad=min(known_rad, camera.max_angle_rad)),
        detection=pairs.detection[on],
        star=pairs.star[on],
        log_chance=log_chance + float(np.log(max(tried, 1))),
        unexplained=pairs.unexplained(detections.snr, GATE_PX),
    )


def _within(pairs: Pairs) -> Ints:
    """Numbers of the pairs of each other's nearest, equally bright, that lie closer than the gate."""
    return pairs.nearest[pairs.distance_px[pairs.nearest] < GATE_PX]


def _simpler(view: View, xy_px: Array, rays_icrs: Array, sigma_px: float) -> View:
    """A pinhole, unless the view's own lens brings the stars (n, 3) much nearer to the pixels (n, 2)."""
    if not view.bend:
        return view
    pinhole = view.straight().fitted(xy_px, rays_icrs, sigma_px, bend=False, steps=2)
    left = [np.sum(np.square(xy_px - v.project(rays_icrs)[0])) for v in (view, pinhole)]
    return view if len(xy_px) >= ENOUGH_TO_BEND and left[0] < BENT**2 * left[1] else pinhole


def _plain(pairs: Pairs, which: Ints, detections: Detections) -> Ints:
    """Of the one-to-one pairs those whose star is beyond doubt: where stars share a light, the one that outshines."""
    some = detections.covariance_px2[pairs.detection[which]]
    variance_px2 = 0.5 * (some[:, 0, 0] + some[:, 1, 1]) + LEAST_ERROR_PX**2
    return pairs.plain(which, variance_px2, min(BLEND_SIGMAS * detections.psf_sigma_px, WIDEST_BLEND_PX))


def _pairs(view: View, detections: Detections, stars: Stars, tree: Any) -> Pairs | None:
    """All pairs (detection, star) near each other; None where they are too few to tell the brightness scale."""
    from scipy.spatial import cKDTree

    px, inside = view.project(stars.rays_icrs)
    seen = np.flatnonzero(inside)
    found = tree.sparse_distance_matrix(cKDTree(px[seen]), NEAR_PX, output_type="ndarray")
    found = found[np.lexsort((found["j"], found["i"]))]
    detection, star, distance = found["i"].astype(np.int64), seen[found["j"]], found["v"]
    close = np.flatnonzero(distance < GATE_PX)
    if len(close) < FEWEST:
        return None
    close = close[np.argsort(star[close], kind="stable")][:FIRST_MATCHES]
    light = Light.of(detections.flux_e, detections.saturated, stars.v_mag[star[close]], detection[close])
    return Pairs(detection, star, distance, stars.v_mag[star], stars.v_sigma_mag[star], light)


def _known_px(pairs: Pairs, off_axis_px: Array) -> float | None:
    """Distance from the middle up to which the stars near their places lie on them; None where they do so nowhere."""
    near = pairs.nearest[pairs.detection[pairs.nearest] < JUDGED]
    near = near[np.argsort(off_axis_px[pairs.detection[near]])]
    on_place = pairs.distance_px[near] < GATE_PX
    known = None
    for ring in np.array_split(np.arange(len(near)), max(min(len(near) // STARS_OF_A_RING, MOST_RINGS), 1)):
        if not len(ring) or on_place[ring].mean() < ON_PLACE:
            break
        known = float(off_axis_px[pairs.detection[near[ring[on_place[ring]][-1]]]])
    return known


def _log_chance(view: View, pairs: Pairs, on: Ints, xy_px: Array, stars: Stars, known_px: float) -> float:
    """log P by chance of as many stars on the brightest detections (n, 2), up to so far off the axis: a binomial tail.

    `on`: the numbers of the pairs on their places.
    """
    from scipy.special import betainc

    rms_px = float(np.sqrt(np.mean(np.square(pairs.distance_px[on]))))
    radius_px = float(np.clip(2.5 * rms_px, SMALLEST_RADIUS_PX, GATE_PX))
    hits = int(np.count_nonzero((pairs.detection[on] < len(xy_px)) & (pairs.distance_px[on] < radius_px)))
    measured = pairs.light.measured_mag[: len(xy_px)]
    px, inside = view.project(stars.rays_icrs)
    inside &= np.linalg.norm(px - view.middle_px, axis=1) <= known_px
    bright = stars.v_mag[inside & (stars.v_mag < measured.max())]
    predicted = max(len(bright), hits)
    known = np.linalg.norm(xy_px - view.middle_px, axis=1) <= known_px
    each = -np.expm1(-_density_px2(xy_px[known], view.size_px) * np.pi * radius_px**2) * alike(bright, measured)
    if hits < TIMES_CHANCE * predicted * each:
        return 0.0
    n, k = max(predicted - GIVEN, 0), max(hits - GIVEN, 0)
    return float(np.log(max(betainc(k, n - k + 1, each), 1e-300))) if k else 0.0


def _density_px2(xy_px: Array, size_px: tuple[int, int]) -> float:
    """Detections per px^2 where the detections are: of counts c in cells, sum c (c - 1) over sum c."""
    cell = max(size_px) / CELLS
    column, row = (np.maximum(xy_px, 0.0) / cell).astype(np.int64).T
    counts = np.bincount(row * CELLS + column).astype(np.float64)
    typical = float(np.sum(counts * (counts - 1.0)) / max(np.sum(counts), 1.0))
    return max(typical / cell**2, len(xy_px) / (size_px[0] * size_px[1]))
