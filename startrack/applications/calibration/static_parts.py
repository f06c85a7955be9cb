"""Parts of the image that stay in place while the sky moves: lamps and dust, hot pixels, and what hides the sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial, reduce

import numpy as np

from startrack.camera import Camera
from startrack.core.runner import map_in_threads
from startrack.core.statistics import robust_sigma
from startrack.core.types import Array, Bools, Ints
from startrack.estimation.frame_matching import BrightStars, Frame, JointFit, match_frames
from startrack.exposure import combine_masks

SAME_PX = 0.7
TURNED_PX = 4.0  # motion of the sky above which a source that keeps its pixel is not a star
HOT_SIGMA = 8.0
MAX_HOT_PIXELS = 20_000
STAR_RADIUS_PX = 3
BESIDE = np.array([[0, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0]])  # twice the mean of the four
SKY_RING_1 = 0.03  # width of the rings about the axis, in focal lengths
RING_EVERY_PX = 3  # of the pixels in rows and columns that give a ring's median
LIGHT_SMOOTH_PX = 5  # odd, 5 at most: of the light
SPOT_PX = 9  # narrower dark spots are noise: 1.6 times the sky's light a pixel masks 0.05 % of open sky (5 px: 0.6 %)
PLACE_PX = 16  # a star that stays within such a square is one star, however many frames show it
HALF_1 = 0.5  # of the sky's light: a pixel with more is more sky than obstacle; 1 in 1,000 stars are at less than 0.57
SHOWN_1 = 0.03  # of bright stars behind trees, found through gaps: 2 of 57 at light below 0.4, four clear nights
WRONG_1 = 0.001  # largest probability of open sky at a pixel that is proposed


def has_turned(one: Array, other: Array, size_px: tuple[int, int]) -> bool:
    """Whether the sky has clearly moved in the image between two attitudes (3, 3), except near the rotation's axis."""
    return turn_rad(one, other) * max(size_px) / 4.0 > TURNED_PX


def turn_rad(one: Array, other: Array) -> float:
    """The angle [rad] of the rotation between two attitudes (3, 3)."""
    between = other @ one.T
    return float(np.arctan2(np.linalg.norm(between - between.T) / np.sqrt(8.0), (np.trace(between) - 1.0) / 2.0))


def remove_static_sources(frames: tuple[Frame, ...], R_cam_icrs: Array) -> tuple[Frame, ...]:
    """The frames without sources that keep their pixel while the sky moves: hot pixels, dust, lamps.

    `R_cam_icrs`: attitudes (frames, 3, 3).
    """
    from scipy.spatial import cKDTree

    trees = [cKDTree(frame.sources.xy_px) for frame in frames]

    def moving(frame: Frame, R: Array) -> Frame:
        static = np.zeros(len(frame.sources), dtype=bool)
        for tree, other in zip(trees, R_cam_icrs, strict=True):
            if has_turned(R, other, frame.exposure.size_px):
                static |= np.isfinite(tree.query(frame.sources.xy_px, distance_upper_bound=SAME_PX)[0])
        return replace(frame, sources=frame.sources.take(~static))

    return tuple(map_in_threads(moving, frames, R_cam_icrs))


def find_hot_pixels(joint: JointFit) -> Array | None:
    """Pixels (n, 2), x and y, that stand out in all frames although the sky has turned; None where it has not."""
    R, size_px = joint.fit.R_cam_icrs, joint.fit.camera.size_px
    others = [i for i in range(1, len(joint.frames)) if has_turned(R[0], R[i], size_px)]
    if not others:
        return None
    least = reduce(np.minimum, map_in_threads(partial(_excess_sigmas, joint), [0, *others]))
    y, x = np.nonzero(least > HOT_SIGMA)
    order = np.argsort(-least[y, x], kind="stable")[:MAX_HOT_PIXELS]
    return np.stack([x[order], y[order]], axis=1).astype(np.float64)


def _excess_sigmas(joint: JointFit, i: int) -> Array:
    """Excess (H, W) of the pixels of frame `i` over those around them, in sigmas of noise; 0 at identified stars."""
    import cv2

    frame = joint.frames[i]
    image = np.asarray(frame.exposure.pixels_adu)
    excess = image - cv2.medianBlur(image, 5)
    noise = robust_sigma(excess[::3, ::3], 0.0) or 1.0
    # The light of a star or planet spreads over neighbouring pixels, that of a hot pixel does not.
    sigmas = np.asarray((excess - cv2.filter2D(np.maximum(excess, 0.0), -1, BESIDE)) / np.float32(noise))
    reach = STAR_RADIUS_PX
    for x, y in np.rint(frame.sources.xy_px[joint.matches[i].detection]).astype(int).tolist():
        sigmas[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1] = 0.0
    return sigmas


@dataclass(frozen=True)
class PredictedStars:
    """Bright stars (n,) predicted in all frames; a star has a row in each frame."""

    star: Ints  # a number of the star
    xy_px: Array  # (n, 2)
    found: Bools

    def once(self) -> PredictedStars:
        """Copy with each star once at each place, found if a frame shows it there."""
        key = np.column_stack([self.star, (self.xy_px // PLACE_PX).astype(np.int64)])
        places, first, place = np.unique(key, axis=0, return_index=True, return_inverse=True)
        found = np.bincount(place.ravel(), self.found, len(places)) > 0
        return PredictedStars(self.star[first], self.xy_px[first], found)

    def light_1(self, light_1: Array) -> Array:
        """The light (n,) at the stars, of an image `light_1` (H, W)."""
        column, row = np.rint(self.xy_px).astype(np.int64).T
        return light_1[row, column]


def find_obstructions(joint: JointFit, frames: Sequence[Frame], level_adu: float | None) -> tuple[Bools | None, str]:
    """Pixels (H, W) so dark that no star is seen behind them, None where there are none; and why nothing can be said.

    `frames` are those of the `joint` fit with all their sources, `level_adu` that without light. Bright stars count,
    those in masked pixels do not, and frames are left out whose missing stars stand together under bright sky.
    """
    camera, parts, total = joint.fit.camera, list[PredictedStars](), np.zeros(joint.fit.camera.size_px[::-1])
    if level_adu is None:
        return None, "the level without light is not known: give --bias"
    off_axis_1 = _off_axis_1(camera)
    matches = match_frames(frames, camera, joint.fit.R_cam_icrs, camera.calibrated_angle_rad, joint.gate_px)
    lights = map_in_threads(lambda frame: _light_1(frame, off_axis_1, level_adu), frames)
    for frame, matched, light_1 in zip(frames, matches, lights, strict=True):
        stars = _unmasked_stars(frame, matched.bright, camera)
        if _is_clear(stars, light_1):
            parts.append(stars)
            total += light_1
    if not parts:
        return None, "in no picture most stars beside a missing star are seen: a clear, dark night is needed"
    predicted = PredictedStars(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(parts[0])))
    beyond = off_axis_1 > float(camera.lens.rho(np.array(camera.calibrated_angle_rad)))
    obstructed = find_obstructed(predicted, np.where(beyond, np.inf, total / len(parts)))
    return obstructed if obstructed.any() else None, ""


def _unmasked_stars(frame: Frame, bright: BrightStars, camera: Camera) -> PredictedStars:
    """The `bright` stars of a frame that no mask hides."""
    mask = combine_masks(frame.exposure.mask, None, camera.size_px, frame.exposure.correction)
    column, row = np.rint(bright.xy_px).astype(np.int64).T
    counts = np.ones(len(row), dtype=bool) if mask is None else ~mask.masked[row, column]
    return PredictedStars(frame.sky.stars.hip[bright.star[counts]], bright.xy_px[counts], bright.found[counts])


def _is_clear(stars: PredictedStars, light_1: Array) -> bool:
    """Whether most stars of a frame beside a missed one are found, where the sky has more than its median light.

    Clouds and the Moon hide neighbours together. Obstacles do, too, but they are darker.
    """
    from scipy.spatial import cKDTree

    if len(stars.found) < 2:
        return False
    nearest = cKDTree(stars.xy_px).query(stars.xy_px, k=2)[1][:, 1]
    beside_missed = stars.found[~stars.found[nearest] & (stars.light_1(light_1) > 1.0)]
    return bool(2 * np.count_nonzero(beside_missed) >= len(beside_missed))


def _off_axis_1(camera: Camera) -> Array:
    """Distance of the pixels (H, W) from the centre, in focal lengths."""
    x, y = ((np.arange(n) - c) / f for n, c, f in zip(camera.size_px, camera.centre_px, camera.focal_px, strict=True))
    return np.hypot(x, y[:, None])


def _light_1(frame: Frame, off_axis_1: Array, level_adu: float) -> Array:
    """The light (H, W) of a frame above `level_adu`, without small spots, over its median in rings about the axis."""
    import cv2
    from scipy.ndimage import median

    light = cv2.medianBlur(np.asarray(frame.exposure.pixels_adu, dtype=np.float32), LIGHT_SMOOTH_PX) - level_adu
    spot = np.ones((SPOT_PX, SPOT_PX), np.uint8)
    light = np.asarray(cv2.morphologyEx(light, cv2.MORPH_CLOSE, spot), dtype=np.float64)
    ring = (off_axis_1 / SKY_RING_1).astype(np.int64)
    some = np.s_[::RING_EVERY_PX, ::RING_EVERY_PX]
    sky = np.asarray(median(light[some], ring[some], np.arange(ring.max() + 1)))[ring]
    return np.asarray(np.divide(light, sky, out=np.ones_like(sky), where=sky > 0))


def find_obstructed(predicted: PredictedStars, light_1: Array) -> Bools:
    """The pixels (H, W) that are open sky with a probability below WRONG_1.

    `light_1` (H, W) is the light of the pixels as a part of the sky's. Pixels darker than a limit are obstructed. The
    limit is unknown: there is none, or it lies anywhere from 0 to HALF_1, with equal probabilities. The `predicted`
    stars decide: of those behind an obstacle SHOWN_1 are found, of the others a part that is unknown. A pixel is open
    with the probability that the limit is darker than the pixel.
    """
    from scipy.special import betaln

    stars = predicted.once()
    at_star = np.clip(stars.light_1(light_1), 0.0, HALF_1)
    order = np.argsort(at_star, kind="stable")
    limit_1 = np.concatenate([[0.0], at_star[order], [HALF_1]])
    found, missed = (np.concatenate([[0], np.cumsum(stars.found[order] == seen)]) for seen in (True, False))
    log_p = found * np.log(SHOWN_1) + missed * np.log1p(-SHOWN_1)  # limits between two stars
    log_p += betaln(1 + found[-1] - found, 1 + missed[-1] - missed)
    p = np.exp(log_p - log_p.max())
    darker = np.cumsum(np.concatenate([HALF_1 * p[:1], np.diff(limit_1) * p]))  # p[0] is that of no limit
    return np.asarray(np.interp(light_1, limit_1, darker / darker[-1]) < WRONG_1)
