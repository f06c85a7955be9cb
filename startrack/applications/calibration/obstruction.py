"""What stands between the camera and the sky: cells of the frame in which no star is ever seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from startrack.applications.calibration.frame import Frame
from startrack.applications.calibration.matching import match_frame
from startrack.applications.calibration.region_growing import JointFit
from startrack.core.types import Array, Bools, Ints
from startrack.exposure import combine_masks

CELLS_PX = (128, 64, 32, 16)  # sides; the smallest that have enough stars trace the outline
MAX_RATE_1 = 0.95  # of bright stars that are detected where the sky is open: variable stars, and errors of catalogues
MIN_RATE_1 = 0.5  # of a frame that is used; below it clouds hide most stars
FALSE_ALARM = 0.01  # expected cells of open sky without a star, all tests of a calibration together


@dataclass(frozen=True)
class PredictedStars:
    """Bright stars (n,) predicted in all frames; a star has a row in each frame."""

    star: Ints  # a number of the star
    xy_px: Array  # (n, 2)
    found: Bools
    rate: Array  # of such stars detected under the open sky of the frame


def find_obstructions(joint: JointFit, frames: Sequence[Frame]) -> Bools | None:
    """Pixels (H, W) in cells that never show a star; None where there are none.

    `frames` are those of the `joint` fit with all their sources.
    """
    obstructed = obstructed_cells(_predict_all(joint, frames), joint.fit.camera.size_px)
    return obstructed if obstructed.any() else None


def obstructed_cells(predicted: PredictedStars, size_px: tuple[int, int]) -> Bools:
    """Pixels (H, W) of an image of `size_px` (W, H) in cells where the `predicted` stars are missing.

    In a cell of open sky each bright star i, counted once however many frames show it there, is missed with probability
    1 - p_i, where p_i is the rate of detected bright stars in the frame's open sky. The probability that all are missed
    is the product P. The cell is obstructed where no star is found and P times the number of cells tested is below
    FALSE_ALARM. Squares of several sides are tested, each at four offsets, and the obstructed ones joined.
    """
    width, height = size_px
    obstructed = np.zeros((height, width), dtype=bool)
    grids = [(side, dx, dy) for side in CELLS_PX for dx in (0, side // 2) for dy in (0, side // 2)]
    tests = [_test_cells(predicted, *grid, width) for grid in grids]
    limit = np.log(FALSE_ALARM / max(sum(len(log_p) for _, log_p in tests), 1))
    for (side, dx, dy), (corners, log_p) in zip(grids, tests, strict=True):
        for x, y in corners[log_p < limit].tolist():
            obstructed[max(y - dy, 0) : y - dy + side, max(x - dx, 0) : x - dx + side] = True
    return obstructed


def _predict_all(joint: JointFit, frames: Sequence[Frame]) -> PredictedStars:
    """The bright stars of the frames without those in masked pixels; frames under clouds are left out."""
    camera = joint.fit.camera
    parts = []
    for frame, R in zip(frames, joint.fit.R_cam_icrs, strict=True):
        matched = match_frame(frame, camera, R, camera.calibrated_angle_rad, joint.gate_px)
        rate = matched.expected_found / max(matched.expected, 1)
        if rate < MIN_RATE_1:
            continue
        mask = combine_masks(frame.exposure.mask, None, frame.size_px, frame.exposure.correction)
        bright = matched.bright
        column, row = np.rint(bright.xy_px).astype(np.int64).T
        counts = np.ones(len(row), dtype=bool) if mask is None else ~mask.masked[row, column]
        hip = frame.sky.stars.hip[bright.star[counts]]
        parts.append((hip, bright.xy_px[counts], bright.found[counts], np.full(len(hip), min(rate, MAX_RATE_1))))
    if not parts:
        return PredictedStars(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, bool), np.zeros(0))
    return PredictedStars(*(np.concatenate(column) for column in zip(*parts, strict=True)))


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
