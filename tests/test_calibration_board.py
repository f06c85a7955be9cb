"""`startrack calibrate board` on boards drawn through a lens that is written out here."""

from __future__ import annotations

import json
from functools import lru_cache

import cv2
import numpy as np
import pytest
from schema_helpers import check_printed_schema
from scipy.spatial.transform import Rotation

from startrack.applications.calibration.board import Board, Corners, calibrate_board, find_corners
from startrack.applications.calibration.initial_states import BoardState, initial_board_state
from startrack.camera import Camera, KannalaBrandt, load_camera
from startrack.cli.main import main
from startrack.core.types import Exposure, NotIdentified
from startrack.estimation.adjust import observations
from startrack.estimation.lens_fit import fit_state
from startrack.exposure import write_exposure

SIZE_PX = (640, 480)
TRUTH = Camera(
    name="truth", size_px=SIZE_PX, focal_px=(190.0, 190.0), centre_px=(323.0, 236.5), max_angle_rad=1.7,
    calibrated_angle_rad=1.6, lens=KannalaBrandt((-0.03, 0.004)),
)  # fmt: skip
COLUMNS, ROWS = 9, 6
CHESSBOARD = Board(COLUMNS, ROWS, None, 0.75)
SUPERSAMPLED = 2
POSES = (  # rotation of the board about cam axes [degrees], position of its centre [squares]
    ((0, 0, 0), (0, 0, 5.5)),
    ((35, 0, 10), (-2, 0, 5.0)),
    ((-35, 10, 0), (2.5, 0.5, 5.0)),
    ((0, 40, 0), (4, -1, 4.0)),
    ((0, -40, 20), (-4.5, 0, 4.0)),
    ((25, 25, 90), (0, 2.5, 5.5)),
    ((-30, -20, 45), (0, -2, 4.5)),
    ((10, 55, 0), (5.5, 0.5, 2.6)),
    ((-10, -55, 0), (-5.5, -0.5, 2.6)),
)


@lru_cache
def pixel_rays(dx, dy):
    x, y = np.meshgrid(np.arange(SIZE_PX[0]), np.arange(SIZE_PX[1]))
    return TRUTH.unproject(np.stack([x + dx, y + dy], axis=-1))


def board_positions(pose, rays):
    """Intersections (n, 2) of the rays with the board [squares, from the first inner corner], and their depth."""
    rotation_deg, middle = pose
    R = Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix()  # board to cam
    origin = np.array(middle) - R @ [(COLUMNS - 1) / 2, (ROWS - 1) / 2, 0.0]
    depth = (origin @ R[:, 2]) / (rays @ R[:, 2])
    return ((rays * depth[..., None] - origin) @ R)[..., :2], depth


def draw_picture(pose, colour):
    """A picture of the board; `colour` gives the brightness at positions on it."""
    step = (np.arange(SUPERSAMPLED) - (SUPERSAMPLED - 1) / 2) / SUPERSAMPLED
    total = np.zeros(SIZE_PX[::-1])
    for dx in step:
        for dy in step:
            position, depth = board_positions(pose, pixel_rays(dx, dy))
            total += np.where(depth > 0, colour(position), 0.4)
    noise = np.random.default_rng(3).normal(0, 40, total.shape)
    return Exposure(pixels_adu=(8000 * total / SUPERSAMPLED**2 + 500 + noise).astype(np.float32), name="board")


def chessboard(position):
    column, row = np.floor(position[..., 0]) + 1, np.floor(position[..., 1]) + 1
    inside = (column >= 0) & (column <= COLUMNS) & (row >= 0) & (row <= ROWS)
    return np.where(inside, (column + row) % 2, 1.0)


def charuco(columns, rows):
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    side = 60
    pattern = cv2.aruco.CharucoBoard((columns, rows), 1.0, 0.75, dictionary)
    picture = pattern.generateImage((columns * side, rows * side), marginSize=0).astype(float) / 255.0

    def colour(position):
        x, y = (np.floor((position[..., k] + 1) * side).astype(int) for k in (0, 1))
        inside = (x >= 0) & (y >= 0) & (x < columns * side) & (y < rows * side)
        return np.where(inside, picture[np.clip(y, 0, rows * side - 1), np.clip(x, 0, columns * side - 1)], 1.0)

    return colour


def map_error_px(camera):
    """RMS inside the calibrated angle, best rotation removed."""
    z = np.linspace(np.cos(camera.calibrated_angle_rad), 1, 600)
    b = 2.4 * np.arange(600)
    rays = np.stack([np.sqrt(1 - z * z) * np.cos(b), np.sqrt(1 - z * z) * np.sin(b), z], axis=1)
    rays = rays[TRUTH.project(rays)[1]]
    miss = (camera.project(rays)[0] - TRUTH.project(rays)[0]).ravel()
    by_rotation = TRUTH.jacobian_px_per_rad(rays).reshape(-1, 3)
    miss -= by_rotation @ np.linalg.lstsq(by_rotation, miss, rcond=None)[0]
    return float(np.sqrt(2 * np.mean(miss**2)))


@pytest.fixture(scope="module")
def chessboards():
    return [draw_picture(pose, chessboard) for pose in POSES]


def test_drawn_corners_are_found_where_they_are(chessboards):
    """The drawing and OpenCV's detector agree; the other tests rely on both."""
    found = find_corners(chessboards[1], CHESSBOARD)
    position, _ = board_positions(POSES[1], TRUTH.unproject(found.xy_px))
    assert np.median(np.abs(position - np.rint(position))) < 0.005
    assert np.abs(position - np.rint(position)).max() < 0.1


def test_chessboards_give_the_lens(chessboards):
    found = calibrate_board(chessboards, CHESSBOARD)
    assert found.accepted, found.failed_checks
    assert len(found.images) >= 7
    assert found.fit.held_out_rms_px < 0.3
    assert map_error_px(found.camera) < 0.25
    assert found.camera.focal_px[0] == pytest.approx(190, abs=1.5)
    assert 50 < np.degrees(found.camera.calibrated_angle_rad) < 100


def test_charuco_boards_give_the_lens():
    colour = charuco(COLUMNS + 1, ROWS + 1)
    pictures = [draw_picture(pose, colour) for pose in POSES[:8]]
    found = calibrate_board(pictures, Board(COLUMNS + 1, ROWS + 1, "DICT_5X5_100", 0.75))
    assert len(found.images) >= 5
    assert map_error_px(found.camera) < 0.4


def test_exact_corners_give_the_exact_lens_past_90_degrees():
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(9.0), np.arange(6.0))
    board = np.stack([x.ravel(), y.ravel(), np.zeros(54)], axis=1)
    wide = Camera(
        name="wide", size_px=(1000, 1000), focal_px=(260.0, 260.0), centre_px=(498.0, 503.0), max_angle_rad=2.0,
        calibrated_angle_rad=1.9, lens=KannalaBrandt((0.02, -0.003)),
    )  # fmt: skip
    seen = []
    for off in np.radians([0, 20, 45, 60, 75, 85, 90]):
        for b in rng.uniform(0, 2 * np.pi, 2):
            middle = 6 * np.array([np.sin(off) * np.cos(b), np.sin(off) * np.sin(b), np.cos(off)])
            facing = Rotation.align_vectors([middle], [[0, 0, 1.0]])[0] * Rotation.from_rotvec(rng.normal(0, 0.4, 3))
            points = facing.apply(board - [4, 2.5, 0]) + middle
            seen.append(Corners(wide.project(points)[0] + rng.normal(0, 0.02, (54, 2)), board))
    points = observations([s.xy_px for s in seen], [s.position for s in seen])
    state = initial_board_state(points, (1000, 1000))
    assert isinstance(state, BoardState)
    fit = fit_state(state, points)
    assert fit.camera.focal_px[0] == pytest.approx(260, abs=0.05)
    assert np.degrees(fit.camera.calibrated_angle_rad) > 95
    assert fit.held_out_rms_px == pytest.approx(0.02 * np.sqrt(2), rel=0.15)


def test_the_command(chessboards, tmp_path, capsys):
    for number, picture in enumerate(chessboards):
        sixteen = Exposure(pixels_adu=np.rint(picture.pixels_adu), name=f"board{number}")
        write_exposure(tmp_path / f"board{number}.png", sixteen)
    words = [str(path) for path in sorted(tmp_path.glob("board*.png"))]
    out = tmp_path / "camera.toml"
    assert main(["calibrate", "board", *words, "--pattern", f"{COLUMNS}x{ROWS}", "-o", str(out), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["status"] == "ok"
    check_printed_schema("calibration", record)
    assert load_camera(out).focal_px[0] == pytest.approx(190, abs=1.5)


def test_pictures_without_a_board_are_refused(chessboards):
    with pytest.raises(NotIdentified, match="pattern") as refusal:
        calibrate_board([draw_picture(POSES[0], lambda position: np.full(position.shape[:-1], 0.5))], CHESSBOARD)
    assert refusal.value.reason == "no_stars"
    one = calibrate_board(chessboards[:1], CHESSBOARD)
    assert not one.accepted
    assert one.failed_checks[0].reason == "insufficient_geometry"
