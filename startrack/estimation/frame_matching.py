"""The sources of exposures matched with the sky above them, and one lens for several frames by these matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from startrack.camera import Camera
from startrack.catalog import Sky, StarCatalog, sky_at
from startrack.core.runner import map_in_threads
from startrack.core.types import Array, BadInput, Bools, Centroids, Exposure, Ints, NotIdentified
from startrack.estimation.adjust import Observations, observations
from startrack.estimation.false_alarm import CELLS_ACROSS
from startrack.estimation.lens_fit import MIN_LENS_STARS, WIDEST_GAP_RAD, LensFit, fit_lens
from startrack.estimation.match import DEPTH_BELOW_THRESHOLD_MAG, instrumental_mag, is_isolated, match_by_brightness
from startrack.exposure import NO_TIME
from startrack.frames import Site, off_axis_rad
from startrack.terrain import site_of_terrain

TOLERANCE_MAG = 0.9
BLENDED_MAG = 2.0  # a neighbour less than this fainter than the star shifts its centroid
BLENDED_SIGMAS = 3.5  # of the PSF
DEPTH_MAG = 0.5  # stars are predicted to this much below the faintest source
ZERO_POINT_STARS = 4000  # brightest stars used for the zero point
MIN_STARS_FOR_SHAPE = 30
NEAR_CURVE_MAG = 1.2  # stars with a zero point this close to the curve are used in its fit
CURVE_ROUNDS = 4
LIMIT_QUANTILE = 0.85
RING_RAD = WIDEST_GAP_RAD  # width of the ring added in each round
SMALLEST_GROWTH_RAD = np.radians(0.5)
BRIGHTEST_SOURCES = 1000  # sources used; hot pixels may outnumber the bright stars
JOINT_GATES_PX = (6.0, 4.0, 3.0, 2.0)  # the first while the region grows, the others for all stars
LAST_GATE_SIGMAS = 4.5  # of the residuals, for the last gates
NARROWEST_GATE_PX = 0.8
GROWTH_ROUNDS = 16
FINAL_ROUNDS = 8
SETTLED_FRACTION = 0.003  # change of the number of matches
MIN_FOR_POLYNOMIAL = 25
RAD_PER_COEFFICIENT = np.radians(25.0)
KNOWN_QUANTILE = 0.95


@dataclass(frozen=True, kw_only=True)
class Frame:
    """An exposure with its sources and its sky."""

    exposure: Exposure
    time_utc: datetime
    sources: Centroids  # fluxes in ADU
    sky: Sky


def frame_of(exposure: Exposure, found: Centroids, catalog: StarCatalog, site: Site | None) -> Frame:
    """The frame of an exposure whose point sources are `found`. Raises BadInput no_time."""
    time_utc = require_time(exposure)
    sources = Centroids(**{f.name: getattr(found, f.name) for f in fields(Centroids)})
    where = None if site is None else site.with_air(exposure.air)
    return Frame(exposure=exposure, time_utc=time_utc, sources=sources, sky=sky_at(catalog, time_utc, where))


def require_time(exposure: Exposure) -> datetime:
    """The middle of the exposure. Raises BadInput no_time if it is not known."""
    if exposure.time_utc is None:
        raise BadInput("no_time", f"{exposure.name}: {NO_TIME}")
    return exposure.time_utc


def require_body(exposure: Exposure, site: Site | None) -> None:
    """Raise BadInput bad_terrain where the exposure names a terrain on another body than the site."""
    if site is None or exposure.terrain is None:
        return
    body = site_of_terrain(exposure.terrain).body
    if body != site.body:
        raise BadInput(
            "bad_terrain",
            f"{exposure.name} names the terrain {Path(exposure.terrain).name}, which is on the {body.title()}, but the "
            f"site is on the {site.body.title()}: correct the site, or the terrain in the image's sidecar or header",
        )


@dataclass(frozen=True)
class BrightStars:
    """Unblended stars (n,) bright enough to be detected where the sky is open, wherever they are predicted."""

    star: Ints  # indices into the frame's sky
    xy_px: Array  # (n, 2)
    found: Bools  # whether there is a source of equal brightness


@dataclass(frozen=True)
class FrameMatches:
    """Matches of one frame, and how many there should be."""

    detection: Ints  # (n,) indices into the frame's sources
    star: Ints  # (n,) indices into the frame's sky
    expected: int  # bright stars predicted where the sky is open
    expected_found: int  # those with a source of equal brightness
    significant: int  # bright sources within the angle searched
    significant_matched: int
    bright: BrightStars

    def __len__(self) -> int:
        return len(self.star)

    @property
    def fraction(self) -> float:
        """The larger of two fractions: bright stars with a source, and bright sources with a star.

        Clouds and trees reduce the first, hot pixels and lamps the second, a wrong lens both.
        """
        return max(self.expected_found / max(self.expected, 1), self.significant_matched / max(self.significant, 1))


def match_frame(frame: Frame, camera: Camera, R_cam_icrs: Array, within_rad: float, gate_px: float) -> FrameMatches:
    """Unblended nearest pairs of equal brightness within the gate, up to the angle `within_rad` off the axis."""
    from scipy.spatial import cKDTree

    found, stars = frame.sources, frame.sky.stars
    source_mag = instrumental_mag(found.flux_e)
    tree = cKDTree(found.xy_px)
    zero_mag = zero_point(frame, camera, R_cam_icrs, within_rad, gate_px, tree)
    limit = float(source_mag.max()) + DEPTH_MAG
    faintest_v = limit + BLENDED_MAG + float(np.max(zero_mag(np.linspace(0.0, within_rad, 50))))
    count = int(np.searchsorted(stars.v_mag, faintest_v))
    px, angle, seen = predict_pixels(frame, camera, R_cam_icrs, within_rad, count)
    star_mag = stars.v_mag[:count] - zero_mag(angle)  # instrumental
    seen = seen[star_mag[seen] < limit + BLENDED_MAG]
    detection, star, _ = match_by_brightness(
        tree, px, seen, gate_px, star_mag=star_mag, star_sigma_mag=stars.v_sigma_mag[:count],
        detection_mag=source_mag, saturated=found.saturated, limit_mag=limit, tolerance_mag=TOLERANCE_MAG,
    )  # fmt: skip
    faintest = float(np.quantile(source_mag[detection], LIMIT_QUANTILE)) if len(detection) else -np.inf
    bright = seen[star_mag[seen] < faintest - DEPTH_BELOW_THRESHOLD_MAG]
    expected = bright[_is_open_sky(px[bright], found.xy_px[detection], frame.exposure.size_px)]
    both = np.concatenate([star, bright])
    is_alone = is_isolated(px[both], both, px, seen, stars.v_mag, BLENDED_SIGMAS * found.psf_sigma_px, BLENDED_MAG)
    alone, single = is_alone[: len(star)], bright[is_alone[len(star) :]]
    significant = (camera.angle_rad(found.xy_px) < within_rad) & (source_mag < faintest - DEPTH_BELOW_THRESHOLD_MAG)
    return FrameMatches(
        detection=detection[alone],
        star=star[alone],
        expected=len(expected),
        expected_found=int(np.isin(expected, star).sum()),
        significant=int(significant.sum()),
        significant_matched=int(np.count_nonzero(significant[detection])),
        bright=BrightStars(single, px[single], np.isin(single, star)),
    )


def match_frames(
    frames: Sequence[Frame], camera: Camera, R_cam_icrs: Array, within_rad: float, gate_px: float
) -> tuple[FrameMatches, ...]:
    """Matches of each of the `frames` with its attitude of `R_cam_icrs` (frames, 3, 3), as by `match_frame`."""

    def match(frame: Frame, R: Array) -> FrameMatches:
        return match_frame(frame, camera, R, within_rad, gate_px)

    return tuple(map_in_threads(match, frames, R_cam_icrs))


def predict_pixels(
    frame: Frame, camera: Camera, R_cam_icrs: Array, within_rad: float, count: int
) -> tuple[Array, Array, Ints]:
    """Pixels (n, 2) and off-axis angles (n,) of the `count` brightest stars, and the indices of those in the `frame`.

    `camera` and `R_cam_icrs` place them; those within `within_rad` of the axis are computed.
    """
    rays_icrs = frame.sky.stars.rays_icrs[:count]
    widest = min(within_rad, camera.lens.max_invertible_rad)
    near = np.flatnonzero(rays_icrs @ R_cam_icrs[2] > np.cos(widest))
    rays = rays_icrs[near] @ R_cam_icrs.T
    px, angle = np.zeros((len(rays_icrs), 2)), np.zeros(len(rays_icrs))
    px[near] = camera.project_unlimited(rays)
    angle[near] = off_axis_rad(rays)
    width, height = frame.exposure.size_px
    inside = np.all((px[near] > -0.5) & (px[near] < np.array([width, height]) - 0.5), axis=1)
    return px, angle, near[inside]


def zero_point(
    frame: Frame, camera: Camera, R_cam_icrs: Array, within_rad: float, gate_px: float, tree: Any
) -> Callable[[Array], Array]:
    """Zero point [mag] of a `frame` as a function of the angle off the axis; with vignetting and, roughly, extinction.

    `camera` and `R_cam_icrs` predict the stars up to `within_rad` off the axis, `tree` holds the sources, which are
    taken within `gate_px`.
    """
    found, v_mag = frame.sources, frame.sky.stars.v_mag
    px, angle, seen = predict_pixels(frame, camera, R_cam_icrs, within_rad, ZERO_POINT_STARS)
    distance, nearest = tree.query(px[seen], distance_upper_bound=gate_px)
    hit = np.isfinite(distance)
    hit[hit] &= ~found.saturated[nearest[hit]]
    angle_rad, zero_mag = angle[seen[hit]], v_mag[seen[hit]] - instrumental_mag(found.flux_e[nearest[hit]])
    # A robust parabola, constant beyond the angles of the stars.
    if not len(zero_mag):
        return np.poly1d([0.0])
    fit = np.poly1d([float(np.median(zero_mag))])
    if len(zero_mag) < MIN_STARS_FOR_SHAPE:
        return fit
    for _ in range(CURVE_ROUNDS):
        close = np.abs(zero_mag - fit(angle_rad)) < NEAR_CURVE_MAG
        if close.sum() < MIN_STARS_FOR_SHAPE:
            break
        fit = np.poly1d(np.polyfit(angle_rad[close], zero_mag[close], 2))
    low, high = np.min(angle_rad), np.max(angle_rad)
    return lambda a: fit(np.clip(a, low, high))


def _is_open_sky(px: Array, xy_px: Array, size_px: tuple[int, int]) -> Bools:
    """Whether the pixels (n, 2) lie in a cell of the frame with a match; the others are cloud, tree or wall."""
    cell = max(size_px) / CELLS_ACROSS
    columns = int(np.ceil(size_px[0] / cell)) + 2
    numbers = [np.clip(np.rint(p / cell), 0, None).astype(int) @ np.array([1, columns]) for p in (px, xy_px)]
    return np.isin(*numbers)


@dataclass(frozen=True)
class JointFit:
    """The lens of several frames with the matches that it was fitted to."""

    frames: tuple[Frame, ...]
    matches: tuple[FrameMatches, ...]
    points: Observations
    fit: LensFit
    gate_px: float
    birge_ratio: float = 1.0  # by which the errors of regions exceed those of their stars; in the lens's covariance


def grow_from_matches(
    frame: Frame, camera: Camera, R_cam_icrs: Array, star: Ints, detection: Ints
) -> tuple[Camera, Array]:
    """Camera and attitude of one frame, grown ring by ring from the matches (star, detection) to the edge of the frame.

    Only bright sources are used: with all of them a gate this wide would give as many wrong matches as right ones.
    Raises NotIdentified where too few stars agree.
    """
    frame = replace(frame, sources=frame.sources.take(slice(BRIGHTEST_SOURCES)))
    bright = np.flatnonzero(detection < BRIGHTEST_SOURCES)
    bright = bright[np.argsort(detection[bright])]
    points = _points((frame,), [(detection[bright], star[bright])])
    off_axis = off_axis_rad(points.rays_icrs @ R_cam_icrs.T)
    known = float(np.quantile(off_axis, KNOWN_QUANTILE)) if len(off_axis) else 0.0
    fit = _fit_points(points, camera, R_cam_icrs[None], _coefficients(known, len(points)))
    for _ in range(GROWTH_ROUNDS):
        within = known + RING_RAD
        matched = match_frame(frame, fit.camera, fit.R_cam_icrs[0], within, JOINT_GATES_PX[0])
        if len(matched) < MIN_LENS_STARS:
            break
        points = _points((frame,), [(matched.detection, matched.star)])
        fit = _fit_points(points, fit.camera, fit.R_cam_icrs, _coefficients(within, len(matched)))
        reached = fit.camera.calibrated_angle_rad
        if reached < known + SMALLEST_GROWTH_RAD:
            break
        known = reached
    return fit.camera, fit.R_cam_icrs[0]


def fit_frames(
    frames: tuple[Frame, ...], camera: Camera, R_cam_icrs: Array, progress: Callable[[str], None] = lambda text: None
) -> JointFit:
    """The lens of all frames together: matches with a shrinking gate and fits, until the matches settle.

    `R_cam_icrs` (frames, 3, 3) and the camera must be right within a few pixels where stars were matched. `progress` is
    called with a text in each of FINAL_ROUNDS or fewer rounds.
    """
    before, gates_px, gate_px = 0, JOINT_GATES_PX[1:], 0.0
    for k in range(FINAL_ROUNDS):
        progress(f"fitting the lens to all images, round {k + 1}")
        first = k < len(gates_px)
        gate_px = gates_px[k] if first else gate_px
        within = camera.calibrated_angle_rad + RING_RAD
        matches = match_frames(frames, camera, R_cam_icrs, within, gate_px)
        points = _points(frames, [(matched.detection, matched.star) for matched in matches])
        fit = _fit_points(points, camera, R_cam_icrs, _coefficients(within) if first else None)
        camera, R_cam_icrs = fit.camera, fit.R_cam_icrs
        total = sum(map(len, matches))
        if k > len(gates_px) and abs(total - before) <= SETTLED_FRACTION * total:
            break
        before = total
        gate_px = float(np.clip(LAST_GATE_SIGMAS * fit.rms_px / np.sqrt(2.0), NARROWEST_GATE_PX, gates_px[-1]))
    return JointFit(frames=frames, matches=matches, points=points, fit=fit, gate_px=gate_px)


def _fit_points(points: Observations, camera: Camera, R_cam_icrs: Array, coefficients: int | None) -> LensFit:
    """Lens and attitudes that fit the observations. Raises NotIdentified where there are none."""
    if not len(points):
        raise NotIdentified("no star lies where the camera predicts it")
    start = replace(camera, covariance=None, covariance_order=())
    return fit_lens(start, R_cam_icrs, points, coefficients=coefficients)


def _points(frames: tuple[Frame, ...], matches: list[tuple[Ints, Ints]]) -> Observations:
    """Observations of the sources and stars of the `frames` that are matched: indices of both, frame by frame."""
    pairs = [(f.sources.take(detection), f.sky.stars.rays_icrs[star])
             for f, (detection, star) in zip(frames, matches, strict=True)]  # fmt: skip
    return observations(
        [found.xy_px for found, _ in pairs], [rays for _, rays in pairs], [found.covariance_px2 for found, _ in pairs]
    )


def _coefficients(angle_rad: float, stars: int | None = None) -> int:
    """Number of the default lens's coefficients that stars out to this angle determine; without `stars` of many."""
    return 1 if stars is not None and stars < MIN_FOR_POLYNOMIAL else 1 + int(angle_rad // RAD_PER_COEFFICIENT)
