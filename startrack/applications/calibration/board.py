"""Calibration from pictures of a chessboard or a ChArUco board; OpenCV finds the corners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from startrack.applications.calibration import acceptance
from startrack.applications.calibration.initial_states import corner_angle_rad, initial_board_state
from startrack.core.types import Array, BadInput, Exposure, NotIdentified
from startrack.estimation.adjust import Observations, observations
from startrack.estimation.lens_fit import LensFit, fit_state

MIN_PICTURES = 3
MIN_CORNERS = 100
MIN_CHARUCO_CORNERS = 4
CONTRAST_PERCENTILES = (0.5, 99.5)


@dataclass(frozen=True)
class Board:
    """A flat pattern; positions on it are in squares."""

    columns: int  # inner corners of a chessboard, squares of a ChArUco board
    rows: int
    charuco: str | None  # name of the dictionary, such as DICT_5X5_100; None: a chessboard
    marker_fraction: float  # marker's side over the square's


class Corners(NamedTuple):
    """Corners found in one picture."""

    xy_px: Array  # (n, 2)
    position: Array  # (n, 3) on the board, in squares, z = 0


def find_corners(exposure: Exposure, board: Board) -> Corners | None:
    """Corners in a picture; None where the board is not found. Raises BadInput for an unknown dictionary."""
    p = np.asarray(exposure.pixels_adu)  # the detectors need 8 bits
    low, high = np.percentile(p[::3, ::3], CONTRAST_PERCENTILES)
    grey = np.clip((p - low) * (255.0 / max(high - low, 1e-6)), 0, 255).astype(np.uint8)
    return _find_chessboard(grey, board) if board.charuco is None else _find_charuco(grey, board)


def _find_chessboard(grey: Any, board: Board) -> Corners | None:
    import cv2

    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, px = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=flags)
    if not found or px is None:
        return None
    x, y = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    position = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(np.float64)
    return Corners(px.reshape(-1, 2).astype(np.float64), position)


def _find_charuco(grey: Any, board: Board) -> Corners | None:
    import cv2

    name = str(board.charuco)
    number = vars(cv2.aruco).get(name) if name.startswith("DICT_") else None
    if number is None:
        raise BadInput("bad_calibration", f"{name} is not an ArUco dictionary of OpenCV, such as DICT_5X5_100")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    pattern = cv2.aruco.CharucoBoard((board.columns, board.rows), 1.0, board.marker_fraction, dictionary)
    px, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(grey)
    if ids is None or px is None or len(ids) < MIN_CHARUCO_CORNERS:
        return None
    position = np.asarray(pattern.getChessboardCorners(), dtype=np.float64)[np.asarray(ids).ravel()]
    return Corners(np.asarray(px, dtype=np.float64).reshape(-1, 2), position)


@dataclass(frozen=True, kw_only=True)
class BoardCalibration(acceptance.CheckedCamera):
    """A lens calibrated with boards, and its acceptance checks."""

    fit: LensFit
    images: tuple[str, ...]


def calibrate_board(
    exposures: Sequence[Exposure],
    board: Board,
    *,
    name: str = "camera",
    progress: Callable[[str], None] = lambda text: None,
) -> BoardCalibration:
    """The camera called `name`, from `exposures` of one flat `board`. `progress` gets a text for each exposure.

    Raises BadInput (size_mismatch), NotIdentified (no_stars: no board).
    """
    found: list[Corners] = []
    images: list[str] = []
    refused: list[acceptance.RefusedImage] = []
    for exposure in exposures:
        if exposure.size_px != exposures[0].size_px:
            raise BadInput("size_mismatch", f"{exposure.name} has another size than {exposures[0].name}")
        progress(f"searching the board in {exposure.name}")
        seen = find_corners(exposure, board)
        if seen is None:
            refused.append(
                acceptance.RefusedImage(name=exposure.name, reason="no_stars", message="the board was not found")
            )
        else:
            found.append(seen)
            images.append(exposure.name)
    if not found:
        raise NotIdentified("the board was found in no picture: are --pattern and --charuco right?", reason="no_stars")
    progress("fitting the lens")
    points = observations([c.xy_px for c in found], [c.position for c in found])
    fit = fit_state(initial_board_state(points, exposures[0].size_px), points)
    edge = min(corner_angle_rad(fit.camera), fit.camera.lens.max_invertible_rad)
    camera = replace(fit.camera, name=name, max_angle_rad=max(edge, fit.camera.calibrated_angle_rad))
    return BoardCalibration(
        camera=camera,
        fit=fit,
        checks=_check_acceptance(fit, points, len(found)),
        images=tuple(images),
        refused=tuple(refused),
    )


def _check_acceptance(fit: LensFit, points: Observations, pictures: int) -> tuple[acceptance.Check, ...]:
    """All checks, the most informative first."""
    ring = acceptance.rings_and_sectors(fit.camera, points.take(fit.used))[1]
    rings = int(np.sum(np.bincount(ring, minlength=acceptance.IMAGE_RINGS) >= acceptance.STARS_PER_RING))
    used = int(fit.used.sum())
    tilt = "more pictures: the board tilted by 30 degrees and more, near and far, and in every corner of the image"
    return (
        acceptance.minimum_check("pictures with a board", pictures, MIN_PICTURES, "insufficient_geometry", tilt),
        acceptance.minimum_check("corners", used, MIN_CORNERS, "insufficient_geometry", tilt),
        acceptance.held_out_check(fit.held_out_rms_px, "a flat board and sharp pictures are needed"),
        acceptance.ring_check("rings with corners", rings, tilt),
        acceptance.map_check(fit.camera, tilt),
    )  # fmt: skip
