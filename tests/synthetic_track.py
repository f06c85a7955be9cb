"""A track with made-up numbers, for pictures and pages: one refused frame, one left out, one slip."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np

from startrack.applications.tracking import Track, TrackFrame, Trajectory
from startrack.core.types import Array
from startrack.frames import Site
from startrack.terrain import Cylinder, Terrain

SITE = Site("moon", np.radians(-89.66), np.radians(129.78))
CRATER = Cylinder(
    name="crater", site=SITE, diameter_m=20_000.0, depth_m=2000.0, camera_height_m=1.5, search_radius_m=9_000.0
)
NASTY = "frame </script><b>3</b>.png"
FRAMES = 8


def synthetic_track(
    terrain: Terrain = CRATER, *, start_m: tuple[float, float] = (2000.0, -1000.0), frames: int = FRAMES,
    step_m: float = 50.0, at_rest: bool = False, unknown: int = 0,
) -> Track:  # fmt: skip
    """A track of `frames` from `start_m`; nothing is known of the first `unknown` ones."""
    rng = np.random.default_rng(5)
    turn = np.cumsum(rng.normal(0.2, 0.2, frames))
    step = 0.0 if at_rest else step_m
    smoothed = np.asarray(start_m) + np.cumsum(step * np.stack([np.cos(turn), np.sin(turn)], axis=-1), axis=0)
    shape = np.array([[1.0, 0.4], [0.4, 0.5]])
    count = np.arange(1, frames + 1)
    filtered_m2 = (9.0 / count)[:, None, None] * shape
    smoothed_m2 = 0.3 * filtered_m2 + 0.4 * shape
    if at_rest:
        smoothed_m2 = np.broadcast_to(1.3 * filtered_m2[-1], filtered_m2.shape)
    filtered = smoothed + np.einsum("nij,nj->ni", np.linalg.cholesky(filtered_m2), rng.normal(size=(frames, 2)))
    status = ["used"] * frames
    if not at_rest:
        status[2:4] = ["refused", "left_out"]
    known = np.arange(frames) >= unknown
    return Track(
        frames=tuple(_frame(k, status[k]) for k in range(frames)),
        filtered=_trajectory(filtered, filtered_m2, known), smoothed=_trajectory(smoothed, smoothed_m2, known),
        bias_rad=1e-4, bias_sigma_rad=5e-5, clock=None, depth=None, width=None,
        slipped=(np.arange(frames - 1) == 5) & (not at_rest), at_rest=at_rest, terrain=terrain,
    )  # fmt: skip


def odometry_alone(track: Track) -> Array:
    """Positions (n, 2) that drift to the north."""
    position = track.smoothed.position_enu_m[:, :2]
    return np.asarray(position + np.arange(len(position))[:, None] * [0.0, 3.0])


def _frame(k: int, status: str) -> TrackFrame:
    time = datetime(2030, 6, 1, tzinfo=UTC) + timedelta(minutes=15 * k)
    reason, message = {
        "refused": ("no_stars", "no star found"), "left_out": ("inconsistent_evidence", "it contradicts the others"),
        "used": ("", ""),
    }[status]  # fmt: skip
    search = "" if status == "refused" else "beam" if k == 6 else "proven"
    return TrackFrame(NASTY if k == 2 else f"frame-{k + 1}.png", time, status, reason, message, None, search)


def _trajectory(position_m: Array, covariance_m2: Array, known: Array) -> Trajectory:
    position = np.where(known[:, None], np.column_stack([position_m, np.zeros(len(position_m))]), np.nan)
    return Trajectory.of_normal(position, np.where(known[:, None, None], covariance_m2, np.inf))
