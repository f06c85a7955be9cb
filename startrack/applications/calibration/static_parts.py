"""What keeps its place in the image while the sky moves: lamps and dust, hot pixels, and what hides the sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce

import numpy as np

from startrack.camera import Camera
from startrack.core.runner import map_in_threads
from startrack.core.statistics import robust_sigma
from startrack.core.types import Array, Bools, Ints
from startrack.estimation.frame_matching import Frame, match_frames
from startrack.estimation.joint_fit import JointFit
from startrack.exposure import combine_masks

SAME_PX = 0.7
TURNED_PX = 4.0  # motion of the sky above which a source that keeps its pixel is not a star
HOT_SIGMA = 8.0
MAX_HOT_PIXELS = 20_000
STAR_RADIUS_PX = 3
BESIDE = np.array([[0, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0]])  # twice the mean of the four
CELLS_PX = (128, 64, 32, 16)  # sides; the smallest that have enough stars trace the outline
MAX_RATE_1 = 0.95  # of bright stars that are detected where the sky is open: variable stars, and errors of catalogues
MIN_RATE_1 = 0.8  # of a frame that is used: on clear dark nights 0.88 to 0.93, under clouds 0.58 to 0.73
SKY_RING_1 = 0.03  # width of the rings about the axis, in focal lengths
DARKER_1 = 0.7  # part of the sky's light at the same angle: trees 0 to 0.65, clouds from 0.93
LEAST_DARK_1 = 0.25  # part of a cell that is as dark
LIGHT_SMOOTH_PX = 5  # odd, 5 at most: of the light
FALSE_ALARM = 0.01  # expected cells of open sky without a star, all tests of a calibration together


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
    """How far each pixel (H, W) of frame `i` exceeds those around it, in sigmas of the noise; 0 at identified stars."""
    import cv2

    frame = joint.frames[i]
    image = np.asarray(frame.exposure.pixels_adu)
    excess = image - cv2.medianBlur(image, 5)
    noise = robust_sigma(excess[::3, ::3], 0.0) or 1.0
    # The light of a star or planet spreads over neighbouring pixels, that of a hot pixel does not.
    sigmas = np.asarray((excess - cv2.filter2D(np.maximum(excess, 0.0), -1, BESIDE)) / noise, dtype=np.float64)
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
    rate: Array  # of such stars detected under the open sky of the frame


def find_obstructions(joint: JointFit, frames: Sequence[Frame], level_adu: float | None) -> tuple[Bools | None, str]:
    """Dark pixels (H, W) in cells that never show a star, None where there are none; and why nothing can be said.

    `frames` are those of the `joint` fit with all their sources, `level_adu` that without light. Bright stars count,
    those in masked pixels do not, and frames under clouds are left out.
    """
    camera, dark = joint.fit.camera, []
    if level_adu is None:
        return None, "the level without light is not known: give --bias"
    parts = [(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, bool), np.zeros(0))]
    matches = match_frames(frames, camera, joint.fit.R_cam_icrs, camera.calibrated_angle_rad, joint.gate_px)
    for frame, matched in zip(frames, matches, strict=True):
        bright = matched.bright
        if bright.rate < MIN_RATE_1:
            continue
        mask = combine_masks(frame.exposure.mask, None, camera.size_px, frame.exposure.correction)
        column, row = np.rint(bright.xy_px).astype(np.int64).T
        counts = np.ones(len(row), dtype=bool) if mask is None else ~mask.masked[row, column]
        hip = frame.sky.stars.hip[bright.star[counts]]
        parts.append((hip, bright.xy_px[counts], bright.found[counts], np.full(len(hip), min(bright.rate, MAX_RATE_1))))
        dark.append(_light_part(frame, camera, level_adu) < DARKER_1)
    if not dark:
        return None, f"no picture shows {100 * MIN_RATE_1:.0f} % of its bright stars: a clear, dark night is needed"
    predicted = PredictedStars(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    obstructed = obstructed_cells(predicted, np.asarray(np.mean(dark, axis=0) > 0.5))
    return obstructed if obstructed.any() else None, ""


def _light_part(frame: Frame, camera: Camera, level_adu: float) -> Array:
    """The light (H, W) of a frame above `level_adu`, smoothed, over its median in rings about the axis."""
    import cv2
    from scipy.ndimage import median

    light = cv2.medianBlur(np.asarray(frame.exposure.pixels_adu, dtype=np.float32), LIGHT_SMOOTH_PX) - level_adu
    height, width = light.shape
    x, y = ((np.arange(n) - c) / f for n, c, f in zip((width, height), camera.centre_px, camera.focal_px, strict=True))
    ring = (np.hypot(x, y[:, None]) / SKY_RING_1).astype(np.int64)
    sky = np.asarray(median(light, ring, np.arange(ring.max() + 1)))[ring]
    return np.asarray(np.divide(light, sky, out=np.ones_like(sky), where=sky > 0))


def obstructed_cells(predicted: PredictedStars, dark: Bools) -> Bools:
    """The `dark` pixels of an image (H, W) in cells where the `predicted` stars are missing.

    In a cell of open sky each bright star i, counted once however many frames show it there, is missed with probability
    1 - p_i, where p_i is the rate of detected bright stars in the frame's open sky. The probability that all are missed
    is the product P. The cell is obstructed where no star is found, P times the number of cells tested is below
    FALSE_ALARM, and LEAST_DARK_1 of it is dark. Squares of several sides are tested, each at four offsets, and the dark
    pixels of the obstructed ones joined.
    """
    obstructed = np.zeros_like(dark)
    grids = [(side, dx, dy) for side in CELLS_PX for dx in (0, side // 2) for dy in (0, side // 2)]
    tests = [_test_cells(predicted, *grid, dark.shape[1]) for grid in grids]
    limit = np.log(FALSE_ALARM / max(sum(len(log_p) for _, log_p in tests), 1))
    for (side, dx, dy), (corners, log_p) in zip(grids, tests, strict=True):
        for x, y in corners[log_p < limit].tolist():
            cell = np.s_[max(y - dy, 0) : y - dy + side, max(x - dx, 0) : x - dx + side]
            if dark[cell].mean() >= LEAST_DARK_1:
                obstructed[cell] |= dark[cell]
    return obstructed


def _test_cells(predicted: PredictedStars, side: int, dx: int, dy: int, width: int) -> tuple[Ints, Array]:
    """Upper left corners (m, 2) of the cells with stars, shifted by (dx, dy), and log P (m,); 0 where one is found."""
    column, row = np.rint(predicted.xy_px).astype(np.int64).T
    column, row = (column + dx) // side, (row + dy) // side
    columns = width // side + 2
    stars = int(predicted.star.max(initial=0)) + 1
    key = (row * columns + column) * stars + predicted.star
    pairs, first, pair = np.unique(key, return_index=True, return_inverse=True)
    found = np.bincount(pair, predicted.found, len(pairs)) > 0
    cells, cell = np.unique(pairs // stars, return_inverse=True)
    log_p = np.asarray(np.bincount(cell, np.log1p(-predicted.rate[first]), len(cells)), dtype=np.float64)
    log_p[np.bincount(cell, found, len(cells)) > 0] = 0.0
    return np.stack([cells % columns, cells // columns], axis=1).astype(np.int64) * side, log_p
