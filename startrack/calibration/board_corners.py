"""Corners of chessboards and ChArUco boards in pictures: OpenCV's detectors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from startrack.types import Array, BadInput, Exposure


@dataclass(frozen=True)
class Board:
    """A flat pattern. Places on it are in squares."""

    columns: int  # inner corners of a chessboard, squares of a ChArUco board
    rows: int
    charuco: str | None = None  # name of the dictionary, such as DICT_5X5_100
    marker_part: float = 0.75  # marker's side over square's


@dataclass(frozen=True)
class Corners:
    """What was found in one picture."""

    xy_px: Array  # (n, 2)
    place: Array  # (n, 3) on the board, in squares, z = 0


def corners(exposure: Exposure, board: Board) -> Corners | None:
    """Corners in a picture; None where the board was not found."""
    grey = _grey(exposure)
    return _chessboard(grey, board) if board.charuco is None else _charuco(grey, board)


def _grey(exposure: Exposure) -> Any:
    """The picture in 8 bits, which is what the detectors read; its 0.5 and 99.5 percentiles at the ends."""
    p = np.asarray(exposure.pixels_adu)
    low, high = np.percentile(p[::3, ::3], [0.5, 99.5])
    return np.clip((p - low) * (255.0 / max(high - low, 1e-6)), 0, 255).astype(np.uint8)


def _chessboard(grey: Any, board: Board) -> Corners | None:
    import cv2

    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, px = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=flags)
    if not found or px is None:
        return None
    x, y = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    place = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(np.float64)
    return Corners(px.reshape(-1, 2).astype(np.float64), place)


def _charuco(grey: Any, board: Board) -> Corners | None:
    import cv2

    name = str(board.charuco)
    if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
        raise BadInput("bad_calibration", f"{name} is no ArUco dictionary that OpenCV knows, such as DICT_5X5_100")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    pattern = cv2.aruco.CharucoBoard((board.columns, board.rows), 1.0, board.marker_part, dictionary)
    px, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(grey)
    if ids is None or px is None or len(ids) < 4:
        return None
    place = np.asarray(pattern.getChessboardCorners(), dtype=np.float64)[np.asarray(ids).ravel()]
    return Corners(np.asarray(px, dtype=np.float64).reshape(-1, 2), place)
