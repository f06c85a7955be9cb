"""Hazards for the sky's light: light and shadow near the skyline that are on no map and in no camera file.

The function of each draws its sizes at random.
"""

from __future__ import annotations

import cv2
import numpy as np
from _sensor_hazards import (
    blurred,
    bright_wall,
    correlated_noise,
    eight_bits,
    flat_field,
    low_ridge,
    narrow_lens,
    rows_and_columns,
    state_edge,
    state_eight_bits,
    uneven_dark,
)  # fmt: skip
from _sky_view import Hazard, Rng, View, draw, smooth_noise, turn

from startrack.core.types import Array


def cloud(view: View, rng: Rng) -> Array:
    """A patch of 5 to 30 degrees near the skyline, brighter (to four times) or darker than the sky."""
    width, height, middle = np.radians([rng.uniform(5, 30), rng.uniform(3, 15), rng.uniform(-2, 12)])
    off = turn(view.azimuth_rad, rng.uniform(0, 2 * np.pi)) / (width / 2)
    patch = np.exp(-0.5 * (off**2 + ((view.above_rad - middle) / height) ** 2))
    if rng.random() < 0.5:
        return view.with_sky(1 + draw(0.2, 3, rng) * patch)
    dim = 1 - rng.uniform(0.2, 0.8) * patch
    return view.with_sky(dim, dim)


def lit_rim(view: View, rng: Rng) -> Array:
    """A strip 0.3 to 2 degrees high at the top of the wall, along 20 to 120 degrees, in reflected sunlight."""
    height, width, soft = np.radians([draw(0.3, 2, rng), rng.uniform(20, 120), rng.uniform(1, 20)])
    along = np.clip((width / 2 - np.abs(turn(view.azimuth_rad, rng.uniform(0, 2 * np.pi)))) / soft + 0.5, 0, 1)
    strip = np.clip((view.above_rad + height) / np.radians(0.1) + 0.5, 0, 1) * (1 - view.part)
    return view.light_e + draw(20, 300, rng) * along * strip * view.inside


def light_leak(view: View, rng: Rng) -> Array:
    """A smooth glow from one side, or a ring of it at the edge of the lens."""
    edge, turned = view.scene.camera.max_angle_rad, rng.uniform(0, 2 * np.pi)
    if rng.random() < 0.5:
        glow = np.exp(-0.5 * (view.distance_rad(edge, turned) / np.radians(rng.uniform(15, 50))) ** 2)
    else:
        glow = np.exp((view.angle_rad - edge) / np.radians(rng.uniform(5, 25)))
        glow *= 1 + rng.uniform(0, 0.8) * np.cos(view.turn_rad - turned)
    return view.light_e + draw(10, 200, rng) * glow * view.inside


def vignetting(view: View, rng: Rng) -> Array:
    """A lens that loses 20 to 60 % of the light at 80 degrees off the axis."""
    lost = rng.uniform(0.2, 0.6) * (view.angle_rad / np.radians(80)) ** rng.choice([2, 4])
    return view.light_e * np.maximum(1 - lost, 0.05)


def mast(view: View, rng: Rng) -> Array:
    """A dark or lit bar of 20 to 130 px from the edge to the zenith."""
    r = view.distance_rad(0.0, 0.0) * view.scene.camera.focal_px[0]
    off = turn(view.turn_rad, rng.uniform(0, 2 * np.pi))
    bar = (np.abs(r * np.sin(off)) < rng.uniform(10, 65)) & (np.cos(off) > 0)
    soft = cv2.GaussianBlur(bar.astype(float), (0, 0), rng.uniform(1, 3))
    return view.light_e * (1 - soft) + rng.choice([0.0, draw(20, 500, rng)]) * soft * view.inside


def zodiacal(view: View, rng: Rng) -> Array:
    """A bright cone that stands on the skyline, 0.5 to 5 times the sky."""
    width, high = np.radians([rng.uniform(8, 25), rng.uniform(10, 40)])
    off = turn(view.azimuth_rad, rng.uniform(0, 2 * np.pi)) * np.cos(view.elevation_rad)
    off += rng.uniform(-0.6, 0.6) * view.elevation_rad
    narrower = np.maximum(1.2 - view.elevation_rad / np.radians(70), 0.15)
    cone = np.exp(-0.5 * (off / (width * narrower)) ** 2 - view.elevation_rad / high)
    return view.with_sky(1 + draw(0.5, 5, rng) * cone)


def milky_way(view: View, rng: Rng) -> Array:
    """A patchy band of unresolved light, 20 to 60 % of the sky, across the rim."""
    pole = rng.standard_normal(3)
    pole /= np.linalg.norm(pole)
    level = np.cos(view.elevation_rad)
    sine = pole[0] * level * np.sin(view.azimuth_rad) + pole[1] * level * np.cos(view.azimuth_rad)
    sine += pole[2] * np.sin(view.elevation_rad)
    large, small = (smooth_noise(view.part.shape, cell_px, rng) for cell_px in (60, 15))
    patches = np.clip(1 + 0.4 * large + 0.3 * small, 0, 3)
    band = np.exp(-0.5 * (np.arcsin(np.clip(sine, -1, 1)) / np.radians(rng.uniform(4, 12))) ** 2)
    return view.with_sky(1 + rng.uniform(0.2, 0.6) * band * patches)


def second_skyline(view: View, rng: Rng) -> Array:
    """The sky darker by 40 to 100 % between the skyline and a curve 1 to 5 px above it."""
    down, across = np.gradient(view.above_rad)
    scale = np.clip(np.hypot(down, across) * view.scene.camera.focal_px[0], 0.3, 3.0) / view.scene.camera.focal_px[0]
    over = np.clip(view.above_rad / scale - rng.uniform(1, 5) + 0.5, 0, 1)
    keeps = rng.uniform(0, 0.6)
    return view.with_sky(keeps + (1 - keeps) * over)


def dust(view: View, rng: Rng) -> Array:
    """20 to 150 dark soft discs of 4 to 40 px, most of them near the skyline."""
    passed = np.ones(view.part.shape, dtype=np.float32)
    rows, columns = np.nonzero((np.abs(view.above_rad) < np.radians(4)) & (view.inside > 0))
    for _ in range(int(rng.integers(20, 150))):
        one, radius, deep, soft = (
            rng.integers(len(rows)),
            rng.uniform(4, 40),
            rng.uniform(0.3, 1),
            rng.uniform(0.1, 0.5),
        )
        row, column = (rows[one], columns[one]) if rng.random() < 0.7 else rng.integers(passed.shape)
        top, left = max(row - 60, 0), max(column - 60, 0)
        around = passed[top : row + 61, left : column + 61]
        y, x = np.mgrid[top : top + around.shape[0], left : left + around.shape[1]]
        around *= 1 - deep * np.clip((1 - np.hypot(y - row, x - column) / radius) / soft + 0.5, 0, 1)
    return view.light_e * passed


HAZARDS = {
    "none": Hazard(),
    "cloud": Hazard(cloud),
    "lit rim": Hazard(lit_rim),
    "light leak": Hazard(light_leak),
    "vignetting not stated": Hazard(vignetting),
    "image circle ends near the skyline": Hazard(scene=narrow_lens, stated=state_edge),
    "mast": Hazard(mast),
    "zodiacal cone": Hazard(zodiacal),
    "Milky Way": Hazard(milky_way),
    "wall that reflects 20 to 60 %": Hazard(scene=bright_wall),
    "low ridge on no map": Hazard(scene=low_ridge),
    "second skyline 1 to 5 px higher": Hazard(second_skyline),
    "noise as smooth as the PSF": Hazard(noise_e=correlated_noise),
    "pattern of rows and columns": Hazard(noise_e=rows_and_columns),
    "PSF of 1.5 to 2 px, not stated": Hazard(scene=blurred),
    "dust near the skyline": Hazard(dust),
    "flat field wrong by 1 %": Hazard(flat_field),
    "uneven dark current": Hazard(uneven_dark),
    "8 bits": Hazard(scene=eight_bits, stated=state_eight_bits),
}
