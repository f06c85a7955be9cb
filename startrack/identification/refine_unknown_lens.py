"""The last steps of a blind identification: the lens as a polynomial, all stars matched, the odds against chance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera, Pinhole
from startrack.identification.chance import ChanceModel
from startrack.identification.match import brightest, match, unexplained_by
from startrack.identification.radial_lens_family import PINHOLE, Family
from startrack.identification.region_growing import Grown, as_polynomial, fit, mutual_pairs
from startrack.types import Array, Detections, Ints, Stars

STEPS = ((4.0, 200), (2.5, 500), (1.8, 3000))  # gate [px] and brightest detections
GATES_PX = (2.0, 1.5)
JUDGED = 400  # brightest detections that the odds are worked out for
NEAR_PX = 6.0
SMALLEST_RADIUS_PX = 0.6
ON_PLACE = 0.5  # of the stars near their places lie on them where the lens is understood
STARS_OF_A_RING = 8
MOST_RINGS = 12
FEWEST = 5
GIVEN = 8  # matches that a fit of attitude and lens can bring about by itself; fewer for a pinhole
GIVEN_PINHOLE = 3
TIMES_CHANCE = 3.0
ORDERS = ((150, 4), (60, 3), (25, 2), (0, 1))  # coefficients of the polynomial from this many matches on
BETTER = 0.9  # a pinhole gives way to a polynomial that leaves this part of its residual
ENOUGH_FOR_CENTRE = 30


@dataclass(frozen=True)
class Polished:
    """Camera, attitude and matches with the odds against them."""

    camera: Camera
    R_cam_icrs: Array
    detection: Ints
    star: Ints
    log_chance: float  # that a random sky would be matched as well by one of all trials
    unexplained: int

    @property
    def matched(self) -> int:
        """Number of matches."""
        return len(self.star)


def polished(grown: Grown, detections: Detections, stars: Stars, tried: int, widest_rad: float) -> Polished | None:
    """The grown hypothesis refined and judged; None where it falls apart."""
    fits = [_refined(camera, grown.R_cam_icrs, detections, stars, widest_rad) for camera in _lenses(grown, widest_rad)]
    found = [f for f in fits if f is not None]
    if not found:
        return None
    camera, R, rms_px = found[0]
    if len(found) > 1 and found[1][2] < BETTER * rms_px:
        camera, R, rms_px = found[1]
    known_rad = _understood_rad(detections, camera, stars, R)
    if known_rad is None:
        return None
    camera = replace(camera, calibrated_angle_rad=min(known_rad, camera.max_angle_rad))
    return _judged(camera, R, detections, stars, tried)


def _lenses(grown: Grown, widest_rad: float) -> list[Camera]:
    """The lens to begin with: polynomial; or pinhole, and a polynomial if it is none."""
    n = len(grown.star)
    order = next(order for fewest, order in ORDERS if n >= fewest)
    polynomial = _bounded(as_polynomial(grown.camera, order, widest_rad), widest_rad)
    lens = grown.camera.lens
    if not (isinstance(lens, Family) and lens.shape == PINHOLE):
        return [polynomial]
    pinhole = _bounded(replace(grown.camera, lens=Pinhole()), widest_rad)
    return [pinhole, polynomial] if n >= ORDERS[-2][0] else [pinhole]


def _refined(
    camera: Camera, R: Array, detections: Detections, stars: Stars, widest_rad: float
) -> tuple[Camera, Array, float] | None:
    """Camera, attitude and RMS [px] after ever smaller gates and deeper lists; last by brightness too."""
    prior = camera
    for gate_px, count in STEPS:
        xy = detections.xy_px[:count]
        detection, star, _ = mutual_pairs(camera, R, xy, stars.rays_icrs, gate_px)
        if len(star) < FEWEST:
            return None
        camera, R, _ = fit(
            camera, R, xy[detection], stars.rays_icrs[star], _free(camera, len(star)), gate_px / 4, prior
        )
        camera = _bounded(camera, widest_rad)
    for gate_px in GATES_PX:
        matches = match(detections, camera, stars, R, gate_px, _blend_px(detections))
        if len(matches.star) < FEWEST:
            return None
        xy, rays = detections.xy_px[matches.detection], stars.rays_icrs[matches.star]
        camera, R, distance = fit(camera, R, xy, rays, _free(camera, len(rays)), gate_px / 4, prior)
        camera = _bounded(camera, widest_rad)
    return camera, R, float(np.sqrt(np.mean(distance**2)))


def _free(camera: Camera, matched: int) -> tuple[str, ...]:
    if isinstance(camera.lens, Pinhole):
        return ("scale",)
    return ("scale", "k", "centre") if matched >= ENOUGH_FOR_CENTRE else ("scale", "k")


def _bounded(camera: Camera, widest_rad: float) -> Camera:
    """The camera's largest angles where the frame or the lens's polynomial ends."""
    width, height = camera.size_px
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=float)
    reach = float(np.max(camera.angle_rad(corners)))
    widest = min(max(widest_rad, reach) if isinstance(camera.lens, Pinhole) else widest_rad * 1.3, reach)
    widest = min(widest, camera.lens.max_invertible_rad)
    return replace(camera, max_angle_rad=widest, calibrated_angle_rad=widest)


def _blend_px(detections: Detections) -> float:
    return 3.0 * min(detections.psf_sigma_px, 1.5)


def _understood_rad(detections: Detections, camera: Camera, stars: Stars, R: Array) -> float | None:
    """Angle off the axis up to which the stars near their places lie on them; None where they do so nowhere."""
    matches = match(brightest(detections, JUDGED), camera, stars, R, NEAR_PX, 0.0)
    off_axis = camera.angle_rad(detections.xy_px[matches.detection])
    order = np.argsort(off_axis)
    on_place = matches.distance_px[order] < GATES_PX[-1]
    understood = None
    for ring in np.array_split(np.arange(len(order)), max(min(len(order) // STARS_OF_A_RING, MOST_RINGS), 1)):
        if not len(ring) or on_place[ring].mean() < ON_PLACE:
            break
        understood = float(off_axis[order[ring[on_place[ring]][-1]]])
    return understood


def _judged(camera: Camera, R: Array, detections: Detections, stars: Stars, tried: int) -> Polished | None:
    """All matches where the lens is understood, and the odds that chance would give the brightest of them."""
    matches = match(detections, camera, stars, R, GATES_PX[-1], _blend_px(detections))
    inside = camera.angle_rad(detections.xy_px[matches.detection]) <= camera.calibrated_angle_rad
    detection, star = matches.detection[inside], matches.star[inside]
    if len(star) < FEWEST:
        return None
    judged = brightest(detections, JUDGED)
    known = replace(camera, max_angle_rad=camera.calibrated_angle_rad)
    some = match(judged, known, stars, R, GATES_PX[-1], 0.0)
    rms_px = float(np.sqrt(np.mean(matches.distance_px[inside] ** 2)))
    radius_px = float(np.clip(2.5 * rms_px, SMALLEST_RADIUS_PX, GATES_PX[-1]))
    hits = int(np.count_nonzero(some.coincident_px < radius_px))
    predicted = max(some.predicted, hits)
    rays = camera.unproject(judged.xy_px[camera.angle_rad(judged.xy_px) <= camera.calibrated_angle_rad])
    chance = ChanceModel(rays)
    radius_rad = radius_px * float(camera.mean_scale_rad_per_px(np.array(camera.calibrated_angle_rad / 2)))
    expected = predicted * float(chance.probability(radius_rad)) * some.alike
    given = GIVEN_PINHOLE if isinstance(camera.lens, Pinhole) else GIVEN
    odds = float(chance.log_odds(np.array(hits), np.array(predicted), radius_rad, given, some.alike))
    if hits < TIMES_CHANCE * expected:
        odds = 0.0
    return Polished(
        camera=camera,
        R_cam_icrs=R,
        detection=detection,
        star=star,
        log_chance=odds + float(np.log(max(tried, 1))),
        unexplained=unexplained_by(detections, camera, stars, R, matches.zero_mag, GATES_PX[-1]),
    )
