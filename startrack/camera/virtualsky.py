"""The overlay of VirtualSky in indi-allsky: an equisolid fisheye near the zenith, fitted to a camera.

VirtualSky draws a star of J2000, without precession and refraction, at its altitude and azimuth for a latitude and a
longitude. indi-allsky (indi_allsky/lens_solver/projection.py) places the drawing by six numbers. With the zenith
distance z, psi = azimuth - LENS_AZIMUTH and the radius r = (diameter / 2) sin(z / 2) / sin 45 degrees:
x = width / 2 + OFFSET_X - r sin psi, y = height / 2 - OFFSET_Y - r cos psi. The offsets of latitude and longitude are
the tilt of the camera.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from startrack.camera.camera import Camera, cap_grid, require_not_mirrored
from startrack.camera.platepar import DAY_S, SIDEREAL_DEG
from startrack.core.types import Array, BadInput
from startrack.frames import Site, seconds_since_2000

DRAWN_RAYS = 2000
LOWEST_RAD = np.radians(5.0)  # elevation to which the drawing is fitted
FIRST_TURNS_RAD = np.arange(8) * np.pi / 4  # about the axis, from which the fit begins


@dataclass(frozen=True)
class VirtualSkyOverlay:
    """Text of indi-allsky's keys, with the errors of its ideal lens [px] above 5 degrees of elevation."""

    text: str
    largest_px: float
    rms_px: float


def virtualsky_of(camera: Camera, R_cam_icrs: Array, time: datetime, site: Site) -> VirtualSkyOverlay:
    """Overlay for a `camera` with the attitude `R_cam_icrs` (3, 3) at a `time` and a `site` on the Earth.

    Raises BadInput bad_calibration for a mirrored camera.
    """
    from scipy.optimize import least_squares

    require_not_mirrored(camera)
    rays = cap_grid(min(camera.calibrated_angle_rad, camera.lens.max_invertible_rad), DRAWN_RAYS)
    px, inside = camera.project(rays)
    rays_icrs, px = rays[inside] @ np.asarray(R_cam_icrs, dtype=float), px[inside]
    days = seconds_since_2000(time) / DAY_S
    sidereal = np.radians((SIDEREAL_DEG[0] + SIDEREAL_DEG[1] * days) % 360.0) + site.longitude_rad
    up = np.sin(site.latitude_rad) * rays_icrs[:, 2] + np.cos(site.latitude_rad) * (
        rays_icrs[:, 0] * np.cos(sidereal) + rays_icrs[:, 1] * np.sin(sidereal)
    )
    rays_icrs, px = rays_icrs[up > np.sin(LOWEST_RAD)], px[up > np.sin(LOWEST_RAD)]
    if not len(px):
        raise BadInput("bad_calibration", "the image shows no sky above the site: are attitude, time and site right?")

    def drawn_px(p: Array) -> Array:
        """Pixels (n, 2) for azimuth, tilts in latitude and longitude [rad], diameter and offsets [px]."""
        return _draw(rays_icrs, sidereal + p[2], site.latitude_rad + p[1], p, camera.size_px)

    zenith = int(np.argmax(up[up > np.sin(LOWEST_RAD)]))
    middle = px[zenith] - np.array(camera.size_px) / 2
    diameter = 4.0 * np.sin(0.25 * np.pi) * float(np.mean(camera.focal_px))
    starts = [np.array([turn, 0.0, 0.0, diameter, middle[0], -middle[1]]) for turn in FIRST_TURNS_RAD]
    scale = np.array([1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0])
    fits = [least_squares(lambda p: (drawn_px(p) - px).ravel(), start, x_scale=scale) for start in starts]
    best = min(fits, key=lambda fit: fit.cost).x
    if best[3] < 0.0:  # the same drawing: a turn by half a circle
        best[[0, 3]] = best[0] + np.pi, -best[3]
    azimuth, tilt, turn = (round(float(np.degrees(a)), 2) for a in best[:3])
    rounded = [np.radians(azimuth), np.radians(tilt), np.radians(turn), *np.rint(best[3:])]
    off_px = np.linalg.norm(drawn_px(np.array(rounded)) - px, axis=1)
    values = {
        "LENS_AZIMUTH": azimuth % 360.0,
        "VIRTUALSKY": {
            "IMAGE_CIRCLE_DIAMETER": int(rounded[3]), "LATITUDE_OFFSET": tilt, "LONGITUDE_OFFSET": turn,
            "OFFSET_X": int(rounded[4]), "OFFSET_Y": int(rounded[5]),
        },
    }  # fmt: skip
    rms_px = float(np.sqrt(np.mean(off_px**2)))
    return VirtualSkyOverlay(json.dumps(values, indent=4) + "\n", float(off_px.max()), rms_px)


def _draw(rays_icrs: Array, sidereal: float, latitude: float, p: Array, size_px: tuple[int, int]) -> Array:
    """Pixels (n, 2) of stars (n, 3) in indi-allsky's drawing; `p`: azimuth, two tilts [rad], diameter, offsets [px]."""
    x = rays_icrs[:, 0] * np.cos(sidereal) + rays_icrs[:, 1] * np.sin(sidereal)
    east = rays_icrs[:, 1] * np.cos(sidereal) - rays_icrs[:, 0] * np.sin(sidereal)
    north = np.cos(latitude) * rays_icrs[:, 2] - np.sin(latitude) * x
    up = np.sin(latitude) * rays_icrs[:, 2] + np.cos(latitude) * x
    psi = np.arctan2(east, north) - p[0]
    r = 0.5 * p[3] * np.sin(0.5 * np.arccos(np.clip(up, -1.0, 1.0))) / np.sin(0.25 * np.pi)
    centre = size_px[0] / 2 + p[4], size_px[1] / 2 - p[5]
    return np.stack([centre[0] - r * np.sin(psi), centre[1] - r * np.cos(psi)], axis=1)
