"""The step of the sky's own light at the skyline: measured in the frame and taken out, so that stars can be measured.

The sky is faintly bright and the wall is not. A star beside the edge is measured on half a step, which would add light
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
from startrack.core.circle import interpolate_circle
from startrack.core.smooth_image import SmoothImage
from startrack.core.statistics import robust_sigma
from startrack.core.types import Array, Bools, Detections, Ints
from startrack.evidence.photometry import SURE_SIGMAS
from startrack.frames import azel_from_rays, off_axis_rad, rays_from_azel
from startrack.terrain import Terrain

BAND_PX = 12.0  # from the skyline to the last pixels that are used; the background model has no sharper edge
PROFILE_STEP_PX = 0.5
SIDES_PX = np.arange(0.5 * (BAND_PX + 1.0), BAND_PX, 3 * PROFILE_STEP_PX)  # of pixels on both sides
STEP_SECTORS = 36
SKYLINE_POINTS = 1440
SKYLINE_SAMPLES = 5 * SKYLINE_POINTS  # one in 3 arcmin: half a pixel of a 180-degree fisheye
ELEVATION_STEP_RAD = 1e-3  # of derivatives
MEDIAN_ABS_NORMAL = 0.6745  # median of the absolute value of a standard normal variable
MAX_SHIFT_PX = 0.7  # one sigma
MAX_SLOPE = 1.0
MIN_MEDIAN_PX = 12  # for a median
MEDIAN_LOSS = np.sqrt(np.pi / 2)  # standard deviation of the median of normal values, in that of their mean

Horizon = Callable[[Array], Array]  # azimuths (n,) to elevations (n,) [rad]


@dataclass(frozen=True)
class Skyline:
    """The horizon of one position: elevations [rad] at equally spaced azimuths, called with `azimuth_rad` (n,)."""

    elevation_rad: Array

    @classmethod
    def trace(cls, position_m: Array, terrain: Terrain, samples: int = SKYLINE_SAMPLES) -> Skyline:
        """The horizon of a `terrain` at `position_m` (2,), traced once at `samples` azimuths.

        On a height map that takes time.
        """
        azimuth = np.linspace(0.0, 2 * np.pi, samples, endpoint=False)
        return cls(terrain.horizon_rad(np.asarray(position_m)[None, :], azimuth))

    def __call__(self, azimuth_rad: Array) -> Array:
        return interpolate_circle(self.elevation_rad, azimuth_rad)

    def raised(self, by_rad: Array) -> Skyline:
        """The skyline higher by `by_rad` (n,) [rad], at the middles of n equal sectors from north eastward."""
        azimuth = np.linspace(0.0, 2 * np.pi, len(self.elevation_rad), endpoint=False)
        middle = (np.arange(len(by_rad)) + 0.5) * 2 * np.pi / len(by_rad)
        return Skyline(self.elevation_rad + np.interp(azimuth, middle, by_rad, period=2 * np.pi))


@dataclass(frozen=True, eq=False)
class SkyStep:
    """Brightness of the sky above that of the ground at the skyline, by pixels sampled on both sides."""

    horizon: Horizon  # of the position that the step belongs to
    light_e: float  # median pixel of the sky minus that of the ground; 0 where only one of them is in view
    sigma_e: float  # standard deviation of light_e
    noise_e: float  # median noise of one pixel
    angle_rad: float  # off the camera's axis, of the median sample

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
        if sensor is None or not exposure_s or not self.light_e > SURE_SIGMAS * self.sigma_e:
            return None
        angle = np.array(self.angle_rad)
        arcsec2 = float(camera.pixel_solid_angle_sr(angle)) * np.degrees(3600) ** 2
        per_s = arcsec2 * float(sensor.throughput(angle)) * sensor.zero_point_e_per_s
        return float(-2.5 * np.log10(self.light_e / (per_s * exposure_s)))


def measure_sky_step(detections: Detections, camera: Camera, R_cam_enu: Array, horizon: Horizon) -> SkyStep | None:
    """The step of the sky's light at a `horizon` (azimuths to elevations [rad]); None where it is not in view.

    Pixels of the `detections`' image are taken above and below the skyline, which `camera` and `R_cam_enu` place in it.
    """
    azimuth = np.linspace(0.0, 2 * np.pi, SKYLINE_SAMPLES // 4, endpoint=False)
    elevation = horizon(azimuth)
    angle = off_axis_rad(rays_from_azel(azimuth, elevation) @ R_cam_enu.T)
    offsets_px = np.concatenate([-SIDES_PX[::-1], SIDES_PX])
    shift_rad = np.multiply.outer(offsets_px, 1.0 / _px_per_rad(camera, angle))
    rays_enu = rays_from_azel(azimuth, elevation + shift_rad)
    xy_px, inside = camera.project(rays_enu @ R_cam_enu.T)
    columns, rows = np.rint(xy_px[inside]).astype(np.int64).T
    if not len(rows):
        return None
    light, live = detections.image_e[rows, columns], ~detections.dead[rows, columns]
    above = ((offsets_px[:, None] > 0) & inside)[inside]
    sides, light_e, sigma_e = (light[live & above], light[live & ~above]), 0.0, 0.0
    if all(map(len, sides)):
        (sky, sky_sigma), (ground, ground_sigma) = (_grouped_median(side) for side in sides)
        light_e, sigma_e = sky - ground, float(np.hypot(sky_sigma, ground_sigma))
    noise_e = float(np.median(detections.noise.at(rows, columns)))
    return SkyStep(horizon, light_e, sigma_e, noise_e, float(np.median(angle[inside.any(axis=0)])))


def subtract_sky_step(detections: Detections, camera: Camera, R_cam_enu: Array, horizon: Horizon) -> Detections:
    """The `detections` with the step at a `horizon` in their background, and the noise on either side of it.

    `camera` and `R_cam_enu` place the skyline in the image. The step is the median of the pixels at equal distances
    from the skyline, sector by sector.
    """
    band = skyline_band(detections.image_e.shape, camera, R_cam_enu, horizon)
    pixel, rays_cam = look_through(band & ~detections.dead, camera)
    azimuth, elevation = azel_from_rays(rays_cam @ R_cam_enu)
    above = (elevation - horizon(azimuth)) * _px_per_rad(camera, off_axis_rad(rays_cam))
    near = np.abs(above) < BAND_PX
    pixel, azimuth, above = pixel[near], azimuth[near], above[near]
    if not len(pixel):
        return detections
    background, noise = detections.background_e.copy(), detections.noise_e.copy()
    rest = (detections.image_e.ravel()[pixel] - background.ravel()[pixel]).astype(np.float64)
    spread = noise.ravel()[pixel].astype(np.float64)
    steps = int(2 * BAND_PX / PROFILE_STEP_PX)
    across = np.clip(((above + BAND_PX) / PROFILE_STEP_PX).astype(np.int64), 0, steps - 1)
    cell = (azimuth / (2 * np.pi) * STEP_SECTORS).astype(np.int64) % STEP_SECTORS * steps + across
    middle = _medians(rest, cell, STEP_SECTORS * steps).reshape(STEP_SECTORS, steps)
    profile = _interpolate_table(middle, azimuth, above)
    background.reshape(-1)[pixel] += profile.astype(np.float32)
    # All sectors together: the noise is known better than it varies.
    ratio = _medians(np.abs(rest - profile) / spread, across, steps) / MEDIAN_ABS_NORMAL
    ratio = np.where(ratio > 0, ratio, 1.0)
    noise.reshape(-1)[pixel] *= ratio[across].astype(np.float32)
    return replace(detections, background=SmoothImage.of(background), noise=SmoothImage.of(noise))


def reliable_azimuths(
    horizon: Horizon, shifted: list[Horizon], camera: Camera, R_cam_enu: Array
) -> Callable[[Array], Bools]:
    """A function of azimuths (n,): whether the skyline there is level enough and known to a part of a pixel.

    `horizon` is that of the position, `shifted` those one sigma of the position away, along each axis of its
    covariance; `camera` and `R_cam_enu` give the scale of a pixel. Right below a wall a small shift
    turns the whole skyline: no step of light can be subtracted there.
    """
    azimuth = np.linspace(0.0, 2 * np.pi, SKYLINE_POINTS, endpoint=False)
    here = horizon(azimuth)
    px_per_rad = _px_per_rad_at(azimuth, here, camera, R_cam_enu)
    shift_px = np.sqrt(sum(np.square(other(azimuth) - here) for other in shifted)) * px_per_rad
    run = 2 * np.pi / SKYLINE_POINTS * np.cos(here)
    steep = np.abs(np.roll(here, -1) - np.roll(here, 1)) / (2 * run)
    good = (shift_px < MAX_SHIFT_PX) & (steep < MAX_SLOPE)

    def is_reliable(azimuth_rad: Array) -> Bools:
        return np.asarray(good[np.rint(azimuth_rad / (2 * np.pi) * SKYLINE_POINTS).astype(np.int64) % SKYLINE_POINTS])

    return is_reliable


def height_above_px(
    azimuth_rad: Array, elevation_rad: Array, camera: Camera, R_cam_enu: Array, horizon: Horizon
) -> Array:
    """Height above a `horizon` [px] of directions (n,), `azimuth_rad` and `elevation_rad`.

    `camera` and `R_cam_enu` give the scale of a pixel in each direction.
    """
    px_per_rad = _px_per_rad_at(azimuth_rad, elevation_rad, camera, R_cam_enu)
    return np.asarray((elevation_rad - horizon(azimuth_rad)) * px_per_rad)


def skyline_band(
    shape: tuple[int, ...], camera: Camera, R_cam_enu: Array, horizon: Horizon, reach_px: float = BAND_PX
) -> Bools:
    """Pixels (H, W) of an image of that `shape` within `reach_px` of a `horizon`, with some to spare.

    `camera` and `R_cam_enu` place the skyline in the image.
    """
    azimuth = np.linspace(0.0, 2 * np.pi, SKYLINE_POINTS, endpoint=False)
    xy, inside = camera.project(rays_from_azel(azimuth, horizon(azimuth)) @ R_cam_enu.T)
    picture = np.full(shape, 0, dtype=np.uint8)  # np.zeros would take small memory pages
    points = np.rint(xy).astype(np.int32)
    both = np.flatnonzero(inside & np.roll(inside, 1))
    cv2.polylines(picture, list(np.stack([points[both - 1], points[both]], axis=1)), False, 1, int(2 * reach_px) + 3)
    return picture.view(np.bool_)


def look_through(chosen: Bools, camera: Camera) -> tuple[Ints, Array]:
    """Indices (n,) of the `chosen` pixels (H, W) in the flat image, and their directions (n, 3) from the `camera`."""
    pixel = np.flatnonzero(chosen)
    rows, columns = np.divmod(pixel, chosen.shape[1])
    return pixel, camera.unproject(np.stack([columns, rows], axis=1).astype(np.float64))


def _px_per_rad_at(azimuth_rad: Array, elevation_rad: Array, camera: Camera, R_cam_enu: Array) -> Array:
    """Scale of the image (n,) in directions of enu; beyond the lens's view that of its edge."""
    angle = off_axis_rad(rays_from_azel(azimuth_rad, elevation_rad) @ R_cam_enu.T)
    return _px_per_rad(camera, np.minimum(angle, camera.max_angle_rad))


def _px_per_rad(camera: Camera, angle_rad: Array) -> Array:
    """Scale of the image away from its centre at angles off the axis (n,) [rad]."""
    return np.asarray(np.sqrt(camera.focal_px[0] * camera.focal_px[1]) * camera.lens.slope(angle_rad))


def _grouped_median(light_e: NDArray[np.float32]) -> tuple[float, float]:
    """Median of pixels (n,) and its standard deviation; whole counts are taken as spread evenly over their step.

    The median hardly feels the stars among the pixels, but plain it would be a whole number of counts.
    """
    values, counts = np.unique(light_e, return_counts=True)
    steps = np.diff(values)
    quantum = float(steps.min()) if len(steps) else 0.0
    below = np.cumsum(counts) - counts
    at = int(np.searchsorted(below, 0.5 * len(light_e), side="right")) - 1
    median = float(values[at]) + quantum * ((0.5 * len(light_e) - below[at]) / counts[at] - 0.5)
    return median, float(robust_sigma(light_e, median) * MEDIAN_LOSS / np.sqrt(len(light_e)))


def _medians(values: Array, cell: Ints, cells: int) -> Array:
    """Median (cells,) of the values (n,) in each cell; 0 where there are too few."""
    order = np.argsort(values)
    order = order[np.argsort(cell[order].astype(np.int16), kind="stable")]
    count = np.bincount(cell, minlength=cells)
    middle = np.cumsum(count) - count + count // 2
    median = values[order][np.minimum(middle, len(values) - 1)]
    return np.where(count >= MIN_MEDIAN_PX, median, 0.0)


def _interpolate_table(table: Array, azimuth_rad: Array, above_px: Array) -> Array:
    """Values (n,) of the table (sectors, steps), linear both ways; fading to nothing at the band's ends."""
    sectors, steps = table.shape
    s = azimuth_rad / (2 * np.pi) * sectors - 0.5
    d = np.clip((above_px + BAND_PX) / PROFILE_STEP_PX - 0.5, 0.0, steps - 1.001)
    s0, d0 = np.floor(s).astype(np.int64), np.floor(d).astype(np.int64)
    fs, fd = s - s0, d - d0
    at = [(1 - fd) * table[row, d0] + fd * table[row, d0 + 1] for row in (s0 % sectors, (s0 + 1) % sectors)]
    fade = np.clip((BAND_PX - np.abs(above_px)) / 3.0, 0.0, 1.0)
    return fade * ((1 - fs) * at[0] + fs * at[1])
