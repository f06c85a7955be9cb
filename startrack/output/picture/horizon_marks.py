"""The ground on the picture: the wall, the skyline at the fix, the compass and where the rover's nose points."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.frames import azel_from_rays, heading_pitch_roll_from_R_body_enu, rays_from_azel
from startrack.output.picture.backdrop import View
from startrack.output.picture.canvas import Canvas, around
from startrack.output.picture.palette import DIM_INK, FAINT_INK, INK, SKYLINE
from startrack.output.values import R_body_enu, place_m
from startrack.stages import Inputs, Located, Measured
from startrack.types import Array, Bools

AZIMUTHS_RAD = np.linspace(0.0, 2 * np.pi, 1441)
WALL_STEP = 4  # the wall's mask is reckoned at every fourth pixel and interpolated
EDGE_RAD = 0.003  # width of its edge
COMPASS = {0: "N", 90: "E", 180: "S", 270: "W"}
HIGHEST_COMPASS_DEG = 60.0
LETTER_SIZE = 30.0


def wall_mask(value: Inputs, size: tuple[int, int]) -> NDArray[np.float32] | None:
    """1 below the skyline of the fix and 0 above it, (H, W) of a picture of the size (W, H); None without a fix."""
    if not isinstance(value, Located):
        return None
    cells = [np.arange(0.5, -(-n // WALL_STEP)) * n / -(-n // WALL_STEP) for n in size]
    scale = np.array(value.camera.size_px) / size
    xy_px = np.stack(np.meshgrid(*cells), axis=-1) * scale - 0.5
    azimuth, elevation = azel_from_rays(value.camera.unproject(xy_px) @ value.R_cam_enu)
    below = np.interp(azimuth, AZIMUTHS_RAD, _horizon(value)) - elevation
    # The signed distance is what may be interpolated; cut off afterwards, it gives a sharp and smooth edge.
    below_rad = np.asarray(cv2.resize(below.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))
    return np.clip(below_rad * np.float32(1 / EDGE_RAD) + np.float32(0.5), 0, 1)


def draw_skyline(canvas: Canvas, view: View, value: Inputs) -> None:
    """The skyline that the terrain shows from the fix."""
    if not isinstance(value, Located):
        return
    xy_px, imaged = _project(value, AZIMUTHS_RAD, _horizon(value))
    for start, stop in _runs(imaged):
        if stop - start > 1:
            canvas.curve(view.at(xy_px[start:stop]), SKYLINE, 2.5)


def draw_compass(canvas: Canvas, view: View, value: Inputs) -> None:
    """The letters of the compass, the rover's nose, and ticks each ten degrees: at the horizontal, or as low as the
    frame shows."""
    if not isinstance(value, Measured):
        return
    lowest_deg = {azimuth_deg: _lowest_deg(value, np.radians(azimuth_deg)) for azimuth_deg in range(0, 360, 10)}
    feet = {azimuth_deg: lowest for azimuth_deg, lowest in lowest_deg.items() if lowest is not None}
    for azimuth_deg in sorted(COMPASS.keys() & feet.keys()):
        at = _place(view, value, np.radians(azimuth_deg), feet[azimuth_deg] + 5.0)
        canvas.text(at, COMPASS[azimuth_deg], LETTER_SIZE, INK, "mm", halo=True)
    _draw_nose(canvas, view, value)
    for azimuth_deg, lowest in feet.items():
        main, letter = azimuth_deg % 30 == 0, azimuth_deg in COMPASS
        azimuth_rad = np.radians(azimuth_deg)
        ends = [_place(view, value, azimuth_rad, lowest + reach) for reach in (0.0, 2.2 if main else 1.2)]
        canvas.line(np.array(ends), INK if letter else DIM_INK if main else FAINT_INK, 2 if main else 1)
        at = _place(view, value, azimuth_rad, lowest + 5.0)
        if main and not letter and canvas.is_free(around(at, 24.0)):
            canvas.text(at, str(azimuth_deg), 15.0, DIM_INK, "mm", halo=True)


def _draw_nose(canvas: Canvas, view: View, value: Measured) -> None:
    """An arrow head where the rover's nose points: at the edge of the picture, or further in where a letter stands."""
    heading, _, _ = heading_pitch_roll_from_R_body_enu(R_body_enu(value))
    lowest = _lowest_deg(value, heading)
    if lowest is None:
        return
    for further_in_deg in (0.5, 8.5, 16.5):
        tip = _place(view, value, heading, lowest + further_in_deg)
        along = tip - _place(view, value, heading, lowest + further_in_deg + 6.0)
        along /= np.linalg.norm(along)
        base, name = tip - 26.0 * along, tip - 48.0 * along
        if canvas.is_free(around(base, 20.0)) and canvas.is_free(around(name, 20.0)):
            break
    across = np.array([-along[1], along[0]])
    canvas.area([tip, base + 12.0 * across, base + 5.0 * along, base - 12.0 * across], INK)
    canvas.keep_free(around(0.5 * (tip + base), 20.0))
    canvas.text(name, "forward", 17.0, INK, "mm", halo=True)


def _place(view: View, value: Measured, azimuth_rad: float, elevation_deg: float) -> Array:
    """Canvas place (2,) of a direction."""
    return view.at(_project(value, np.array([azimuth_rad]), np.radians([elevation_deg]))[0][0])


def _horizon(value: Located) -> Array:
    return value.terrain.horizon_rad(np.array([place_m(value.fix)]), AZIMUTHS_RAD)


def _project(value: Measured, azimuth_rad: Array, elevation_rad: Array) -> tuple[Array, Bools]:
    """Pixels (n, 2), and which directions (n,) the lens images, within the frame or not."""
    rays_cam = rays_from_azel(azimuth_rad, elevation_rad) @ value.R_cam_enu.T
    xy_px, _ = value.camera.project(rays_cam)
    angle = np.arctan2(np.hypot(rays_cam[:, 0], rays_cam[:, 1]), rays_cam[:, 2])
    return xy_px, angle <= min(value.camera.max_angle_rad, value.camera.lens.max_invertible_rad)


def _lowest_deg(value: Measured, azimuth_rad: float) -> float | None:
    """Lowest elevation, from the horizontal up, that the frame shows at the azimuth; None where there is none."""
    elevation_deg = np.arange(0.0, HIGHEST_COMPASS_DEG, 0.5)
    rays_cam = rays_from_azel(azimuth_rad, np.radians(elevation_deg)) @ value.R_cam_enu.T
    _, inside = value.camera.project(rays_cam)
    return float(elevation_deg[np.argmax(inside)]) if inside.any() else None


def _runs(mask: Bools) -> list[tuple[int, int]]:
    """Start and end of each stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
