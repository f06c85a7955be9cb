"""The step of the sky's own light at the skyline: measured in the frame and taken out, so that stars can be measured.

The sky shines faintly and the wall does not. A star beside the edge is measured on half a step, which would add light
to the one just above the skyline and take it from the one just below. The step is the same all along the skyline, so
the median of the pixels at equal distances from it is the step without the stars, whatever lens, vignetting and
background model have made of it; an error of the skyline itself shifts this profile and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.frames import azel_from_rays, rays_from_azel
from startrack.terrain import Terrain
from startrack.types import Array, Bools, Detections, Ints

BAND_PX = 12.0  # both ways; the background model knows no edge sharper than that
STEP_PX = 0.5
SECTORS = 36
SKYLINE_POINTS = 1440
SKYLINE_SAMPLES = 7200  # one in 3 arcmin: half a pixel of a 180-degree fisheye
MADE_OF_NOISE = 0.6745  # median of the absolute value of a standard normal variable
MOST_SHIFT_PX = 0.7  # one sigma
STEEPEST = 1.0
FEWEST_PX = 12  # for a median
MEDIAN_LOSS = 1.2533  # standard deviation of the median of normal values, as a multiple of that of their mean
SIGNIFICANT_SIGMAS = 5.0  # of a step that is stated as the brightness of the sky
ARCSEC2_PER_SR = (180 * 3600 / np.pi) ** 2

Horizon = Callable[[Array], Array]  # azimuths (n,) to elevations (n,) [rad]


@dataclass(frozen=True)
class Skyline:
    """The horizon of one place: elevations [rad] at equally spaced azimuths, called with azimuths (n,) [rad]."""

    elevation_rad: Array

    @classmethod
    def seen_from(cls, place_m: Array, terrain: Terrain) -> Skyline:
        """The horizon of the place (2,) [m]: asked once, since real ground takes its time to answer."""
        azimuth = np.linspace(0.0, 2 * np.pi, SKYLINE_SAMPLES, endpoint=False)
        return cls(terrain.horizon_rad(np.asarray(place_m)[None, :], azimuth))

    def __call__(self, azimuth_rad: Array) -> Array:
        at = np.mod(azimuth_rad, 2 * np.pi) * (len(self.elevation_rad) / (2 * np.pi))
        low = at.astype(np.int64) % len(self.elevation_rad)
        part = at - np.floor(at)
        return (1 - part) * self.elevation_rad[low] + part * self.elevation_rad[(low + 1) % len(self.elevation_rad)]


@dataclass(frozen=True, eq=False)
class SkyStep:
    """The pixels beside the skyline, and how much brighter the sky above it is than the ground below."""

    horizon: Horizon  # of the position that the step belongs to
    rows: Ints  # (n,) of the pixels within BAND_PX of the skyline
    columns: Ints  # (n,)
    azimuth_rad: Array  # (n,) in enu
    above_px: Array  # (n,) distance above the skyline, negative below it
    light_e: float  # median pixel of the sky minus that of the ground; 0 where only one of them is in view
    sigma_e: float  # standard deviation of light_e
    noise_e: float  # median noise of one pixel
    angle_rad: float  # off the camera's axis, of the median pixel

    @property
    def exceeds_noise(self) -> bool:
        """Whether the step is larger than the noise of a pixel: a smaller one shifts no star's flux by much."""
        return self.light_e >= self.noise_e

    def brightness_mag_arcsec2(self, camera: Camera, exposure_s: float | None) -> float | None:
        """Brightness of the sky beyond that of the ground [V mag/arcsec2], by the zero point of the `camera`.

        The step per solid angle of the pixel, throughput and second of the exposure (`exposure_s`). None where the
        step is not significant, or the camera has no zero point, or the exposure no known duration.
        """
        sensor = camera.sensor
        if sensor is None or not exposure_s or not self.light_e > SIGNIFICANT_SIGMAS * self.sigma_e:
            return None
        angle = np.array(self.angle_rad)
        arcsec2 = float(camera.pixel_solid_angle_sr(angle)) * ARCSEC2_PER_SR * float(sensor.throughput(angle))
        return float(-2.5 * np.log10(self.light_e / (arcsec2 * exposure_s * sensor.zero_point_e_per_s)))


def measure_sky_step(
    image_e: NDArray[np.float32],
    dead: Bools,
    detections: Detections,
    camera: Camera,
    R_cam_enu: Array,
    horizon: Horizon,
) -> SkyStep | None:
    """The step of the sky's light at a `horizon` (azimuths to elevations [rad]); None where it is not in view.

    `image_e` (H, W) in electrons, `dead` (H, W) marks pixels to leave out, `detections` has the noise of the pixels,
    `camera` and `R_cam_enu` say where the skyline lies in the image.
    """
    rows, columns = np.nonzero(_band(detections.background_e.shape, camera, R_cam_enu, horizon) & ~dead)
    if not len(rows):
        return None
    azimuth, above = _above_px(np.stack([columns, rows], axis=1).astype(float), camera, R_cam_enu, horizon)
    near = np.abs(above) < BAND_PX
    rows, columns, azimuth, above = rows[near], columns[near], azimuth[near], above[near]
    if not len(rows):
        return None
    light_e, sigma_e = _step_e(image_e[rows, columns], above)
    middle = len(rows) // 2
    angle = np.partition(camera.angle_rad(np.stack([columns, rows], axis=1).astype(float)), middle)[middle]
    noise_e = float(np.median(detections.noise_e[rows, columns]))
    return SkyStep(horizon, rows, columns, azimuth, above, light_e, sigma_e, noise_e, float(angle))


def subtract_sky_step(step: SkyStep, image_e: NDArray[np.float32], detections: Detections) -> Detections:
    """The `detections` with the `step` in their background, and the noise of the pixels on either side of it.

    `image_e` (H, W) is the image in electrons in which the step was measured.
    """
    rows, columns, azimuth, above = step.rows, step.columns, step.azimuth_rad, step.above_px
    rest = (image_e - detections.background_e)[rows, columns].astype(np.float64)
    spread = detections.noise_e[rows, columns].astype(np.float64)
    steps = int(2 * BAND_PX / STEP_PX)
    cell = (azimuth / (2 * np.pi) * SECTORS).astype(np.int64) % SECTORS * steps + _step_of(above, steps)
    middle = _medians(rest, cell, SECTORS * steps).reshape(SECTORS, steps)
    background, noise = detections.background_e.copy(), detections.noise_e.copy()
    profile = _interpolated(middle, azimuth, above)
    background[rows, columns] += profile.astype(np.float32)
    across = _step_of(above, steps)  # all sectors together: the noise is known better than it varies
    ratio = _medians(np.abs(rest - profile) / spread, across, steps) / MADE_OF_NOISE
    ratio = np.where(ratio > 0, ratio, 1.0)
    noise[rows, columns] *= ratio[across].astype(np.float32)
    return replace(detections, background_e=background, noise_e=noise)


def reliable_azimuths(horizon: Horizon, shifted: list[Horizon], camera: Camera) -> Callable[[Array], Bools]:
    """A function of azimuths (n,): whether the skyline there is level enough and known to a part of a pixel.

    `horizon` is that of the position, `shifted` those one sigma of the position away, along each axis of its
    covariance; `camera` gives the scale of a pixel. Right below a wall a small shift turns the whole skyline: no step
    of light can be subtracted there.
    """
    azimuth = np.linspace(0.0, 2 * np.pi, SKYLINE_POINTS, endpoint=False)
    here = horizon(azimuth)
    px_per_rad = max(camera.focal_px)
    shift_px = np.sqrt(sum(np.square(other(azimuth) - here) for other in shifted)) * px_per_rad
    run = 2 * np.pi / SKYLINE_POINTS * np.cos(here)
    steep = np.abs(np.roll(here, -1) - np.roll(here, 1)) / (2 * run)
    good = (shift_px < MOST_SHIFT_PX) & (steep < STEEPEST)

    def known(azimuth_rad: Array) -> Bools:
        return np.asarray(good[np.rint(azimuth_rad / (2 * np.pi) * SKYLINE_POINTS).astype(np.int64) % SKYLINE_POINTS])

    return known


def near_skyline(azimuth_rad: Array, elevation_rad: Array, camera: Camera, horizon: Horizon, within_px: float) -> Bools:
    """Which directions (n,) lie within so many pixels of the skyline."""
    scale = float(camera.mean_scale_rad_per_px(np.array(camera.max_angle_rad / 2)))
    return np.asarray(np.abs(elevation_rad - horizon(azimuth_rad)) < within_px * scale)


def _band(shape: tuple[int, ...], camera: Camera, R_cam_enu: Array, horizon: Horizon) -> Bools:
    """Pixels (H, W) around the skyline, with some to spare."""
    azimuth = np.linspace(0.0, 2 * np.pi, SKYLINE_POINTS, endpoint=False)
    xy, inside = camera.project(rays_from_azel(azimuth, horizon(azimuth)) @ R_cam_enu.T)
    picture = np.zeros(shape, dtype=np.uint8)
    points = np.rint(xy).astype(np.int32)
    for i in range(len(points)):
        if inside[i - 1] and inside[i]:
            cv2.line(picture, points[i - 1].tolist(), points[i].tolist(), 1, int(2 * BAND_PX) + 5)
    return picture > 0


def _above_px(xy_px: Array, camera: Camera, R_cam_enu: Array, horizon: Horizon) -> tuple[Array, Array]:
    """Azimuth [rad] and height above the skyline [px] of pixels (n, 2)."""
    azimuth, elevation = azel_from_rays(camera.unproject(xy_px) @ R_cam_enu)
    px_per_rad = np.sqrt(camera.focal_px[0] * camera.focal_px[1]) * camera.lens.slope(camera.angle_rad(xy_px))
    return azimuth, (elevation - horizon(azimuth)) * px_per_rad


def _step_e(light_e: NDArray[np.float32], above_px: Array) -> tuple[float, float]:
    """How much brighter the sky is than the ground, well clear of the edge, and the standard deviation of that."""
    sky, wall = light_e[above_px > BAND_PX / 2], light_e[above_px < -BAND_PX / 2]
    if not len(sky) or not len(wall):
        return 0.0, 0.0
    level = _median(sky), _median(wall)
    spread = [
        float(np.median(np.abs(side - middle))) / MADE_OF_NOISE * MEDIAN_LOSS / np.sqrt(len(side))
        for side, middle in zip((sky, wall), level, strict=True)
    ]
    return level[0] - level[1], float(np.hypot(*spread))


def _median(values: NDArray[np.float32]) -> float:
    """The median of counts: within the one that holds it, by how many values lie on either side."""
    middle = float(np.median(values))
    below, equal, above = values < middle, values == middle, values > middle
    if not (below.any() and equal.any() and above.any()):
        return middle
    step = (float(values[above].min()) - float(values[below].max())) / 2
    return middle + step * (np.count_nonzero(above) - np.count_nonzero(below)) / (2 * np.count_nonzero(equal))


def _step_of(above_px: Array, steps: int) -> Ints:
    return np.clip(((above_px + BAND_PX) / STEP_PX).astype(np.int64), 0, steps - 1)


def _medians(values: Array, cell: Ints, cells: int) -> Array:
    """Median (cells,) of the values (n,) in each cell; 0 where there are too few."""
    order = np.lexsort((values, cell))
    count = np.bincount(cell, minlength=cells)
    middle = np.cumsum(count) - count + count // 2
    median = values[order][np.minimum(middle, len(values) - 1)]
    return np.where(count >= FEWEST_PX, median, 0.0)


def _interpolated(table: Array, azimuth_rad: Array, above_px: Array) -> Array:
    """Values (n,) of the table (sectors, steps), linear both ways; fading to nothing at the band's ends."""
    sectors, steps = table.shape
    s = azimuth_rad / (2 * np.pi) * sectors - 0.5
    d = np.clip((above_px + BAND_PX) / STEP_PX - 0.5, 0.0, steps - 1.001)
    s0, d0 = np.floor(s).astype(np.int64), np.floor(d).astype(np.int64)
    fs, fd = s - s0, d - d0
    low, high = table[s0 % sectors], table[(s0 + 1) % sectors]
    take = np.arange(len(d0))
    at = [(1 - fd) * rows[take, d0] + fd * rows[take, d0 + 1] for rows in (low, high)]
    fade = np.clip((BAND_PX - np.abs(above_px)) / 3.0, 0.0, 1.0)
    return fade * ((1 - fs) * at[0] + fs * at[1])
