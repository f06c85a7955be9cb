"""The marks of the annotated picture in pixels of the exposure, and the file that holds picture and marks apart."""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.chain import Detected, Identified, Inputs, Located, Measured, Oriented
from startrack.core.errors import BadInput
from startrack.core.types import Array, Bools
from startrack.exposure import insert_png_chunks, png_chunks
from startrack.frames import azel_from_rays, heading_pitch_roll_from_R_body_enu, rays_from_azel
from startrack.output.picture.axes import known_runs
from startrack.output.picture.canvas import encoded_bytes
from startrack.output.values import R_body_enu, skyline_position_m

AZIMUTHS_RAD = np.linspace(0.0, 2 * np.pi, 1441)
DIMMEST_HIDDEN_V_MAG = 3.0  # a fainter planet behind the wall is not missed
HIGHEST_COMPASS_DEG = 60.0
TICKS_DEG = range(0, 360, 10)
COMPASS = {0: "N", 90: "E", 180: "S", 270: "W"}
TICK_DEG, LETTER_DEG = 2.2, 5.0  # above the foot of a tick of the compass


@dataclass(frozen=True)
class BodyMark:
    """A planet, moon or sun in the frame."""

    name: str
    xy_px: Array  # (2,)
    hidden: bool  # behind the terrain


def overlay_of(value: Inputs) -> dict[str, Any]:
    """Marks of a stage's `value` for JSON: those that no table of the result holds. Pixels of the exposure.

    `size` of the exposure; `others`, point sources that are no named star; `skyline`, its stretches in the frame;
    `measured`, where the light of the sky shows it; `bodies`; `compass`, [azimuth_deg, foot, top, letter] of each tick;
    `nose`, [foot, top, letter] of the rover's nose, or None.
    """
    measured = value if isinstance(value, Measured) else None
    return {
        "size": list(value.exposure.size_px),
        "others": _pairs(value.detections.xy_px[other_sources(value)]) if isinstance(value, Detected) else [],
        "skyline": [_pairs(stretch) for stretch in skyline_stretches_px(value)],
        "measured": _pairs(measured_skyline_px(value)),
        "bodies": [[body.name, *_pairs(body.xy_px), body.hidden] for body in bodies_in_frame(value)],
        "compass": [] if measured is None else _compass(measured),
        "nose": None if measured is None else _nose(measured),
    }


def other_sources(value: Detected) -> Bools:
    """Which detections (n,) are no identified star, and lie where light of the lens can reach."""
    others = is_within_image_circle(value, value.detections.xy_px)
    if isinstance(value, Identified):
        others[value.identification.detection] = False
    return others


def is_within_image_circle(value: Inputs, xy_px: Array) -> Bools:
    """Whether light of the lens can reach the pixels (n, 2); all, where the camera is not known."""
    if value.camera is None or value.camera.size_px != value.exposure.size_px:
        return np.ones(len(xy_px), dtype=bool)
    return value.camera.angle_rad(xy_px) <= value.camera.max_angle_rad


def bodies_in_frame(value: Inputs) -> list[BodyMark]:
    """Planets, Moon, Earth and Sun in the frame; those behind the terrain only if they are bright."""
    if not isinstance(value, Oriented):
        return []
    found = []
    for body in value.bodies:
        xy_px, inside = value.camera.project(body.ray_icrs @ value.attitude.R_cam_icrs.T)
        hidden = _is_below_skyline(value, body.ray_icrs)
        if inside and not (hidden and body.v_mag > DIMMEST_HIDDEN_V_MAG):
            found.append(BodyMark(body.name, xy_px, hidden))
    return found


def skyline_stretches_px(value: Inputs) -> list[Array]:
    """The skyline that the terrain shows from the fix, as stretches (n, 2) that the lens images."""
    if not isinstance(value, Located):
        return []
    xy_px, imaged = project_azel(value, AZIMUTHS_RAD, horizon_at_fix(value))
    return [xy_px[run] for run in known_runs(imaged)]


def measured_skyline_px(value: Inputs) -> Array:
    """Pixels (n, 2) where the light of the sky, and the stars with it, show the skyline."""
    if not isinstance(value, Located) or value.sky_light is None or value.skyline is None:
        return np.empty((0, 2))
    skyline = value.skyline
    by_sky = skyline.known & (skyline.source != "stars")
    xy_px, imaged = project_azel(value, skyline.azimuth_rad[by_sky], skyline.elevation_rad[by_sky])
    return xy_px[imaged]


def compass_feet(value: Measured) -> dict[int, float]:
    """Elevation [deg] of the foot of each tick of the compass by its azimuth [deg]: as low as the frame shows."""
    lowest = {azimuth_deg: lowest_deg(value, np.radians(azimuth_deg)) for azimuth_deg in TICKS_DEG}
    return {azimuth_deg: low for azimuth_deg, low in lowest.items() if low is not None}


def tick_px(value: Measured, azimuth_rad: float, foot_rad: float) -> Array:
    """Pixels (3, 2) of the foot and the top of a tick of the compass, and of the middle of its letter."""
    elevation_rad = foot_rad + np.radians([0.0, TICK_DEG, LETTER_DEG])
    return project_azel(value, np.full(3, azimuth_rad), elevation_rad)[0]


def heading_rad(value: Measured) -> float:
    """Azimuth of the rover's nose."""
    heading, _, _ = heading_pitch_roll_from_R_body_enu(R_body_enu(value))
    return heading


def lowest_deg(value: Measured, azimuth_rad: float) -> float | None:
    """Lowest elevation, from the horizontal up, that the frame shows at the azimuth; None where there is none."""
    elevation_deg = np.arange(0.0, HIGHEST_COMPASS_DEG, 0.5)
    rays_cam = rays_from_azel(azimuth_rad, np.radians(elevation_deg)) @ value.R_cam_enu.T
    _, inside = value.camera.project(rays_cam)
    return float(elevation_deg[np.argmax(inside)]) if inside.any() else None


def horizon_at_fix(value: Located) -> Array:
    """Elevation of the horizon at the fix, at AZIMUTHS_RAD."""
    return value.terrain.horizon_rad(np.array([skyline_position_m(value)]), AZIMUTHS_RAD)


def project_azel(value: Measured, azimuth_rad: Array, elevation_rad: Array) -> tuple[Array, Bools]:
    """Pixels (n, 2), and which directions (n,) the lens images, within the frame or not."""
    rays_cam = rays_from_azel(azimuth_rad, elevation_rad) @ value.R_cam_enu.T
    xy_px, _ = value.camera.project(rays_cam)
    angle = np.arctan2(np.hypot(rays_cam[:, 0], rays_cam[:, 1]), rays_cam[:, 2])
    return xy_px, angle <= min(value.camera.max_angle_rad, value.camera.lens.max_invertible_rad)


def _compass(value: Measured) -> list[list[Any]]:
    ticks = ((deg, tick_px(value, *np.radians([deg, foot_deg]))) for deg, foot_deg in compass_feet(value).items())
    return [[deg, *_pairs(xy_px)] for deg, xy_px in ticks]


def _nose(value: Measured) -> list[Any] | None:
    azimuth_rad = heading_rad(value)
    foot_deg = lowest_deg(value, azimuth_rad)
    return None if foot_deg is None else _pairs(tick_px(value, azimuth_rad, np.radians(foot_deg)))


def _is_below_skyline(value: Inputs, ray_icrs: Array) -> bool:
    if not isinstance(value, Located):
        return False
    azimuth, elevation = azel_from_rays(value.R_enu_icrs @ ray_icrs)
    horizon = value.terrain.horizon_rad(np.array([skyline_position_m(value)]), np.array([azimuth]))
    return bool(elevation < horizon[0])


def _pairs(xy_px: Array) -> list[Any]:
    return np.round(xy_px, 1).tolist()


BARE_CHUNK, MARKS_CHUNK = b"stPX", b"stOV"  # a JPEG; compressed JSON
JPEG_QUALITY = 88  # 270 kB of 1400 x 1400 px, in 10 ms; WebP has 150 kB and takes 200 ms


@dataclass(frozen=True)
class Layers:
    """The exposure (H, W, 3), red, green, blue, and the marks of `overlay_of`."""

    bare: NDArray[np.uint8]
    overlay: dict[str, Any]


def add_layers(png: bytes, layers: Layers) -> bytes:
    """The PNG file with the layers before its picture data."""
    jpeg = encoded_bytes(".jpg", layers.bare[:, :, ::-1], cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)
    text = json.dumps(layers.overlay, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return insert_png_chunks(png, [(BARE_CHUNK, jpeg), (MARKS_CHUNK, zlib.compress(text.encode("utf-8")))])


def layers_of(png: bytes) -> Layers | None:
    """The layers of a PNG file; None where it has none, or is damaged."""
    try:
        found = {kind: body for kind, body in png_chunks(png) if kind in (BARE_CHUNK, MARKS_CHUNK)}
    except BadInput:  # the page shows what there is
        return None
    if len(found) < 2:
        return None
    bare = cv2.imdecode(np.frombuffer(found[BARE_CHUNK], np.uint8), cv2.IMREAD_COLOR)
    overlay = json.loads(zlib.decompress(found[MARKS_CHUNK]))
    return None if bare is None else Layers(np.asarray(bare[:, :, ::-1], dtype=np.uint8), overlay)
