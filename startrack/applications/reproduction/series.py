"""Startrack on many exposures, at the level of evidence: at rest, and on the drive of Kua's earlier work."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import numpy as np

from startrack.applications.reproduction.published.kua_drive import ODOMETRY_SIGMA_1, STOPS
from startrack.applications.reproduction.scene import Scene
from startrack.applications.tracking import (
    ObservedFrame,
    Odometry,
    TrackErrors,
    estimate_frame,
    estimate_track,
    rows_near_skyline,
)
from startrack.catalog import load_catalog
from startrack.chain import locate_rays
from startrack.core.types import Array, NotLocated
from startrack.simulation import simulate_rays
from startrack.terrain import require_site

REST_EXPOSURES = 6
REST_EVERY_S = {"moon": 12 * 3600.0, "earth": 327.0}  # three days on the Moon, half an hour on the Earth
STOP_EVERY_S = {"moon": 1800.0, "earth": 600.0}  # of a drive
LEVEL_XYZW = (0.0, 0.0, 0.0, 1.0)


def locate_by_rest(scene: Scene) -> Array:
    """Position (2,) [m] by all exposures of a camera at rest at the place of a `scene`. Raises NotLocated."""
    positions = np.tile(scene.truth_m, (REST_EXPOSURES, 1))
    frames, shared = _observe(scene, positions, np.zeros((REST_EXPOSURES - 1, 2)), REST_EVERY_S)
    return estimate_track(frames, scene.terrain, shared, at_rest=True).smoothed.position_enu_m[-1, :2]


def locate_by_stops(scene: Scene) -> Array:
    """Position (2,) [m] at the end of the drive to the place of a `scene`. Raises NotLocated."""
    frames, shared = _observe(scene, scene.drive.positions_m, scene.drive.legs_m, STOP_EVERY_S)
    odometry = Odometry(
        time_s=np.array([frame.time_utc.timestamp() for frame in frames]),
        position_m=np.pad(np.cumsum(scene.drive.legs_m, axis=0), ((1, 0), (0, 1))),
        quat_xyzw=np.tile(LEVEL_XYZW, (STOPS, 1)),
    )
    track = estimate_track(frames, scene.terrain, shared, odometry=odometry)
    return track.smoothed.position_enu_m[-1, :2]


def _observe(
    scene: Scene, positions_m: Array, moves_m: Array, every_s: dict[str, float]
) -> tuple[list[ObservedFrame], TrackErrors]:
    """Exposures at positions (n, 2), and the errors that they share; the first is searched, the others by moves."""
    terrain, catalog = scene.terrain, load_catalog()
    frames: list[ObservedFrame] = []
    start = scene.pictures.pose(0).time_utc
    moved = np.pad(np.cumsum(moves_m, axis=0), ((1, 0), (0, 0)))
    for k, (east, north) in enumerate(positions_m.tolist()):
        when = start + timedelta(seconds=k * every_s[require_site(terrain).body])
        exposed, rng = replace(scene.pictures, time_utc=when, east_m=east, north_m=north).scene(k)
        rays = simulate_rays(exposed, catalog, terrain, rng=rng)
        if not frames:
            fix, shared = locate_rays(rays).fix, TrackErrors.of(terrain, rays.clock)
            if fix.ambiguous:
                raise NotLocated("several positions fit the first exposure")
        odometry_m2 = np.square(ODOMETRY_SIGMA_1 * np.hypot(*moves_m[:k].T)).sum()
        at, covariance = fix.compared_at_m + moved[k], fix.covariance_m2 + odometry_m2 * np.eye(2)
        rows = rows_near_skyline(rays.evidence(), terrain, at)
        estimate = estimate_frame(rows, terrain, shared, at, covariance)
        frames.append(ObservedFrame(f"exposure-{k:02d}", when, np.eye(3), (estimate,), rows))
    return frames, shared
