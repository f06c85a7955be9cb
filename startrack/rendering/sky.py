"""Diffuse brightness of the sky, and its step at the skyline to the brightness of the ground."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Bools, Ints
from startrack.frames import azel_from_rays, rays_from_azel
from startrack.rendering.scene import Scene

ARCSEC2_PER_SR = (180 * 3600 / np.pi) ** 2
EDGE_WIDTH_SIGMAS = 4.0  # distance from the skyline up to which the PSF-smoothed step is computed
TANGENT_NODES_SIGMAS = np.linspace(-3.5, 3.5, 11)  # trapezoid over a Gaussian: exact to 1e-9 for a smooth skyline
LENS_SAMPLES = 4096
ROWS_PER_BLOCK = 64
GRADIENT_STEP_PX = 0.01
DECENTRING_STEP_PX = 16  # linear interpolation of a decentring p at the focal length f is then right to 200 p / f px


def sky_e_per_s(camera: Camera, sky_v_mag_arcsec2: float | None, angle_rad: Array) -> Array:
    """Electrons per second and pixel (n,) of a `camera` from the diffuse sky, `angle_rad` (n,) off the axis.

    zero_point 10^(-0.4 `sky_v_mag_arcsec2`) x the pixel's solid angle in square arcseconds x throughput; 0 for a black
    sky (None).
    """
    sensor = camera.sensor
    if sensor is None or sky_v_mag_arcsec2 is None:
        return np.zeros(np.shape(angle_rad))
    arcsec2 = camera.pixel_solid_angle_sr(angle_rad) * ARCSEC2_PER_SR
    return sensor.zero_point_e_per_s * 10 ** (-0.4 * sky_v_mag_arcsec2) * arcsec2 * sensor.throughput(angle_rad)


def sky_gradient(scene: Scene, east: Array, north: Array) -> Array:
    """The sky's light in directions of components `east`, `north` in enu, relative to its mean; 1 without a gradient.

    The `scene` states the gradient.
    """
    to_east, to_north, _ = scene.sky_gradient * rays_from_azel(scene.sky_gradient_azimuth_rad, 0.0)
    return np.maximum(1 + to_east * east + to_north * north, 0.0)


def diffuse_e(scene: Scene) -> Array:
    """Electrons (H, W) float64 of diffuse light: sky above the skyline, ground below it, zero off the image circle.

    sky x (ground + (1 - ground) c), c the fraction of the pixel's PSF that lies above the skyline.
    """
    sky, part, above = _sky_and_ground(scene)
    if scene.terrain is None:
        return sky
    edge = _skyline_pixels(above, _sigma_px(scene)) & (sky > 0)
    y, x = np.nonzero(edge)
    part[edge] = _part_at_edge(scene, np.stack([x, y], axis=-1))
    return sky * part


def diffuse_at_e(scene: Scene, xy_px: Ints, edge: Bools) -> Array:
    """The electrons (n,) that `diffuse_e` has in pixels `xy_px` (n, 2) of a `scene`.

    `edge` (n,): those close to the skyline.
    """
    sky, part, _ = _sky_function(scene)(*scene.camera.radial(xy_px.astype(np.float64)))
    part[edge] = _part_at_edge(scene, xy_px[edge])
    return sky * part


def _part_at_edge(scene: Scene, xy_px: Ints) -> Array:
    """Light (n,) over the sky's of pixels (n, 2) near the skyline."""
    ground = 1.0 if scene.terrain is None else scene.ground_brightness(_azel(scene, xy_px.astype(np.float64))[0])
    return np.asarray(ground + (1 - ground) * coverage(scene, xy_px))


def coverage(scene: Scene, xy_px: Ints | Array) -> Array:
    """Fraction (n,) of the PSF about each pixel (n, 2) that lies above the skyline; for pixels near the skyline.

    In the pixel plane, r the direction of constant azimuth and t the one across it:
    c = integral over t of N(t; 0, s) Phi((elevation - H(azimuth)) / (s d elevation/dr)), both evaluated at t. A jagged
    skyline is resolved to the width of the PSF; s^2 = psf_sigma^2 + 1/12 includes the pixel's own width.
    """
    from scipy.special import ndtr

    if scene.terrain is None:
        return np.ones(len(xy_px))
    sigma = _sigma_px(scene)
    xy_px = np.asarray(xy_px, dtype=np.float64)
    across, slope_rad_per_px = _local_axes(scene, xy_px)
    weights = np.exp(-0.5 * TANGENT_NODES_SIGMAS**2)
    weights /= weights.sum()
    azimuths, horizon = scene.skyline_rad
    total = np.zeros(len(xy_px))
    for node, weight in zip(TANGENT_NODES_SIGMAS * sigma, weights, strict=True):
        azimuth, elevation = _azel(scene, xy_px + node * across)
        height = elevation - np.interp(azimuth, azimuths, horizon)
        total += weight * ndtr(height / (sigma * slope_rad_per_px))
    return total


def _sigma_px(scene: Scene) -> float:
    return float(np.sqrt(scene.sensor.psf_sigma_px**2 + 1 / 12))


def _azel(scene: Scene, xy_px: Array) -> tuple[Array, Array]:
    return azel_from_rays(scene.camera.unproject(xy_px) @ scene.R_cam_enu)


def _local_axes(scene: Scene, xy_px: Array) -> tuple[Array, Array]:
    """Unit vectors t (n, 2) across the direction of constant azimuth, and the rise (n,) [rad/px] of elevation along it.

    They are from the four neighbours at a small step: d(elevation)/d(px) and d(azimuth)/d(px).
    """
    slopes = []
    for axis in np.eye(2):
        azimuth1, elevation1 = _azel(scene, xy_px + GRADIENT_STEP_PX * axis)
        azimuth0, elevation0 = _azel(scene, xy_px - GRADIENT_STEP_PX * axis)
        azimuth_step = (azimuth1 - azimuth0 + np.pi) % (2 * np.pi) - np.pi
        slopes.append((azimuth_step / (2 * GRADIENT_STEP_PX), (elevation1 - elevation0) / (2 * GRADIENT_STEP_PX)))
    (azimuth_x, elevation_x), (azimuth_y, elevation_y) = slopes
    length = np.maximum(np.hypot(azimuth_x, azimuth_y), 1e-12)
    across = np.stack([azimuth_x, azimuth_y], axis=-1) / length[:, None]
    return across, np.maximum(np.abs(elevation_x * across[:, 1] - elevation_y * across[:, 0]), 1e-12)


def _skyline_pixels(above: Bools, sigma_px: float) -> Bools:
    """Pixels (H, W) with both sky and wall within the width of the PSF."""
    import cv2

    half_px = int(np.ceil(EDGE_WIDTH_SIGMAS * sigma_px)) + 1
    kernel = np.ones((2 * half_px + 1, 2 * half_px + 1), dtype=np.uint8)
    mask = above.astype(np.uint8)
    return cv2.dilate(mask, kernel) != cv2.erode(mask, kernel)


def _sky_and_ground(scene: Scene) -> tuple[Array, Array, Bools]:
    """Sky light [e] without terrain, its part that is seen, and whether the pixel is above the skyline, all (H, W).

    The part is 1 above the skyline, the ground's light over the sky's below it.
    """
    camera, (width, height) = scene.camera, scene.camera.size_px
    fx, fy = camera.handed_focal_px
    u = (np.arange(width) - camera.centre_px[0]) / fx
    v = (np.arange(height)[:, None] - camera.centre_px[1]) / fy
    shift_of, sky_at = _decentring_of_rows(camera), _sky_function(scene)
    sky, part, above = np.empty((height, width)), np.empty((height, width)), np.ones((height, width), dtype=bool)
    for top in range(0, height, ROWS_PER_BLOCK):
        rows = slice(top, min(top + ROWS_PER_BLOCK, height))
        du, dv = shift_of(rows)
        sky[rows], part[rows], above[rows] = sky_at(u - du, v[rows] - dv)
    return sky, part, above


def _sky_function(scene: Scene) -> Callable[[Array, Array], tuple[Array, Array, Bools]]:
    """Function of places x, y in the image [focal lengths], decentring removed: sky light [e], its part, above or not.

    The part of the sky's light is that of the pixel's centre: 1 above the skyline, the ground's below it.
    """
    rho, sky_e, side, axial = _lens_table(scene)
    tan_horizon = None if scene.terrain is None else np.tan(np.minimum(scene.skyline_rad[1], 1.5707))
    east, north, up = scene.R_cam_enu.T

    def sky_at(x: Array, y: Array) -> tuple[Array, Array, Bools]:
        r = np.sqrt(x * x + y * y)
        sky = np.interp(r, rho, sky_e, right=0.0)
        s, c = np.interp(r, rho, side), np.interp(r, rho, axial)
        e, n, h = ((axis[0] * x + axis[1] * y) * s + axis[2] * c for axis in (east, north, up))
        if scene.sky_gradient:
            sky *= sky_gradient(scene, e, n)
        part = np.ones(sky.shape)
        if tan_horizon is None:
            return sky, part, np.ones(sky.shape, dtype=bool)
        above = _is_above_horizon(e, n, h, scene.skyline_rad[0], tan_horizon)
        part[~above] = scene.ground_brightness(np.arctan2(e[~above], n[~above]))
        return sky, part, above

    return sky_at


def _decentring_of_rows(camera: Camera) -> Callable[[slice], Array]:
    """Function of rows: the shift (2, rows, W) that decentring adds there [focal lengths]; 0 of a centred lens.

    It is smooth, and its inverse is slow: it is interpolated between the points of a coarse grid.
    """
    width, height = camera.size_px
    if not camera.decentring:
        return lambda rows: np.zeros((2, 1, 1))
    knots_x, knots_y = (np.arange(0, size + DECENTRING_STEP_PX, DECENTRING_STEP_PX) for size in (width, height))
    xy_px = np.stack(np.meshgrid(knots_x, knots_y), axis=-1).astype(np.float64)
    shifted = (xy_px - camera.centre_px) / camera.handed_focal_px
    grid = np.moveaxis(shifted, -1, 0) - np.stack(camera.radial(xy_px))
    by_x = _linear_weights(np.arange(width), knots_x)
    return lambda rows: _linear_weights(np.arange(rows.start, rows.stop), knots_y) @ grid @ by_x.T


def _linear_weights(at_px: Ints, knots_px: Ints) -> Array:
    """Weights (n, k) of the values at evenly spaced knots (k,) in the linear interpolation at points (n,)."""
    return np.maximum(1.0 - np.abs(at_px[:, None] - knots_px) / DECENTRING_STEP_PX, 0.0)


def _is_above_horizon(east: Array, north: Array, up: Array, azimuths: Array, tan_horizon: Array) -> Bools:
    """Whether directions are above the horizon; the azimuth is computed only where the answer depends on it."""
    level = np.hypot(east, north)
    above = up > tan_horizon.max() * level
    unclear = ~above & (up > tan_horizon.min() * level)
    azimuth = np.arctan2(east[unclear], north[unclear]) % (2 * np.pi)
    above[unclear] = up[unclear] > np.interp(azimuth, azimuths, tan_horizon) * level[unclear]
    return above


def _lens_table(scene: Scene) -> tuple[Array, Array, Array, Array]:
    """Table of the radius rho [focal lengths]: rho, sky light per pixel [e], sin a / rho and cos a."""
    from scipy.special import ndtr

    camera = scene.camera
    top = min(camera.max_angle_rad + 0.05, camera.lens.max_invertible_rad * 0.9999)
    angle = np.linspace(1e-6, top, LENS_SAMPLES)
    rho = camera.lens.rho(angle)
    rim_px = (camera.lens.rho(np.array(min(camera.max_angle_rad, top))) - rho) * np.mean(camera.focal_px)
    sky_e = sky_e_per_s(camera, scene.sky_v_mag_arcsec2, angle) * scene.exposure_s * ndtr(rim_px / _sigma_px(scene))
    return rho, sky_e, np.sin(angle) / rho, np.cos(angle)
