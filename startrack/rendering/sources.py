"""Stars and bodies in the image: their visibility, pixels and electrons."""

from __future__ import annotations

import numpy as np

from startrack.camera import Camera, Sensor
from startrack.core.types import Array, Body, Bools
from startrack.frames import R_from_rotvec, azel_from_rays, off_axis_rad
from startrack.rendering.psf import splat
from startrack.rendering.scene import Scene

TRAIL_VISIBLE_PX = 0.02  # motion during the exposure below which a star is a point
TRAIL_STEP_PX = 0.2  # a step s adds s^2/12 to the variance of the trail's profile: 0.003 px^2
DISK_STEP_PX = 0.5  # spacing of the points that make up a disk
# Mean radius over mean distance: the Sun from 1 au (IAU 2015 nominal radius), Earth and Moon from 384,400 km.
ANGULAR_RADIUS_RAD = {"Sun": 6.957e8 / 1.495978707e11, "Earth": 6.3710e6 / 3.844e8, "Moon": 1.7374e6 / 3.844e8}


def flux_e(sensor: Sensor, v_mag: Array, angle_rad: Array, exposure_s: float) -> Array:
    """Electrons (n,) in the whole PSF: zero_point 10^(-0.4 V) exposure throughput(angle)."""
    return sensor.zero_point_e_per_s * 10 ** (-0.4 * np.asarray(v_mag)) * exposure_s * sensor.throughput(angle_rad)


def is_above_terrain(scene: Scene, rays_enu: Array) -> Bools:
    """Whether the directions (n, 3) are above the horizon of the terrain, a hard edge."""
    if scene.terrain is None:
        return np.ones(len(rays_enu), dtype=bool)
    azimuth, elevation = azel_from_rays(rays_enu)
    return elevation > scene.horizon_rad(azimuth)


def add_sources(image_e: Array, scene: Scene) -> None:
    """Add to the image (H, W) [e] the stars and bodies of the scene, trailed where the sky's rotation is visible."""
    rays_icrs, v_mag = _points(scene)
    rays_enu = rays_icrs @ scene.R_enu_icrs.T
    rotations = _step_rotations(scene)
    limit_rad = scene.camera.max_angle_rad + float(np.linalg.norm(scene.sky_rotvec_rad))
    nearby = off_axis_rad(rays_enu @ scene.R_cam_enu.T) <= limit_rad
    rays_enu, v_mag = rays_enu[nearby], v_mag[nearby]
    for rotation in rotations:
        rotated_enu = rays_enu @ rotation.T
        rays_cam = rotated_enu @ scene.R_cam_enu.T
        angle = off_axis_rad(rays_cam)
        shines = (angle <= scene.camera.max_angle_rad) & is_above_terrain(scene, rotated_enu)
        xy_px, _ = scene.camera.project(rays_cam[shines])
        flux = flux_e(scene.sensor, v_mag[shines], angle[shines], scene.exposure_s / len(rotations))
        splat(image_e, xy_px, flux, scene.sensor.psf_sigma_px)


def exposure_for_snr(camera: Camera, sky_v_mag_arcsec2: float | None, *, v_mag: float, snr: float) -> float:
    """Seconds in which a star of `v_mag` on the axis reaches the matched-filter ratio `snr`.

    `sky_v_mag_arcsec2` is the brightness of the sky (None: black).

    snr^2 = S^2 / (S + A (read^2 + B)), S and B the electrons of the star and of one pixel's sky and dark current in
    the time t, A = 4 pi (sigma^2 + 1/12) the PSF's noise area: a quadratic in t. The camera must have a sensor.
    """
    from startrack.rendering.sky import sky_e_per_s

    sensor = camera.sensor
    if sensor is None:
        raise ValueError(f"camera {camera.name} has no sensor")
    star = sensor.zero_point_e_per_s * 10 ** (-0.4 * v_mag)
    area_px = 4 * np.pi * (sensor.psf_sigma_px**2 + 1 / 12)
    background = sensor.dark_e_per_s + float(sky_e_per_s(camera, sky_v_mag_arcsec2, np.zeros(1))[0])
    linear = snr**2 * (star + area_px * background)
    constant = snr**2 * area_px * sensor.read_noise_e**2
    return float((linear + np.sqrt(linear**2 + 4 * star**2 * constant)) / (2 * star**2))


def limiting_v_mag(camera: Camera, sky_v_mag_arcsec2: float | None, *, exposure_s: float, snr: float) -> float:
    """Magnitude of the star on the axis of a `camera` that reaches `snr` in `exposure_s`.

    The sky has the brightness `sky_v_mag_arcsec2`. The inverse of `exposure_for_snr`.
    """
    from startrack.rendering.sky import sky_e_per_s

    sensor = camera.sensor
    if sensor is None:
        raise ValueError(f"camera {camera.name} has no sensor")
    area_px = 4 * np.pi * (sensor.psf_sigma_px**2 + 1 / 12)
    background = sensor.dark_e_per_s + float(sky_e_per_s(camera, sky_v_mag_arcsec2, np.zeros(1))[0])
    noise_e2 = area_px * (sensor.read_noise_e**2 + background * exposure_s)
    star_e = 0.5 * (snr**2 + np.sqrt(snr**4 + 4 * snr**2 * noise_e2))
    return float(-2.5 * np.log10(star_e / (sensor.zero_point_e_per_s * exposure_s)))


def _points(scene: Scene) -> tuple[Array, Array]:
    """Directions (n, 3) and true magnitudes (n,) of all points of light; a disk of a body is many points."""
    parts = [(scene.stars.rays_icrs, scene.stars.v_mag + scene.v_error_mag)]
    parts += [_body_points(body, max(scene.camera.focal_px)) for body in scene.bodies]
    return np.concatenate([rays for rays, _ in parts]), np.concatenate([v_mag for _, v_mag in parts])


def _body_points(body: Body, focal_px: float) -> tuple[Array, Array]:
    """A body as equal points evenly over its disk (a sunflower spiral); phases and dark limbs are left out."""
    radius = ANGULAR_RADIUS_RAD.get(body.name, 0.0)
    count = max(1, int(np.ceil(np.pi * (radius * focal_px / DISK_STEP_PX) ** 2)))
    k = np.arange(count)
    distance = radius * np.sqrt((k + 0.5) / count) if count > 1 else np.zeros(1)
    angle = k * np.pi * (3 - np.sqrt(5))
    centre = body.ray_icrs / np.linalg.norm(body.ray_icrs)
    across = np.cross(centre, np.eye(3)[np.argmin(np.abs(centre))])
    across /= np.linalg.norm(across)
    offsets = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(centre, across)
    rays = np.cos(distance)[:, None] * centre + np.sin(distance)[:, None] * offsets
    return rays, np.full(count, body.v_mag + 2.5 * np.log10(count))


def _step_rotations(scene: Scene) -> list[Array]:
    """Rotations (3, 3) of the sky at the middles of equal steps of the exposure, relative to mid-exposure."""
    angle = float(np.linalg.norm(scene.sky_rotvec_rad))
    # Farthest off axis a fisheye stretches the circle around it by up to angle / sin(angle): pi/2 at 90 degrees.
    motion_px = angle * max(scene.camera.focal_px) * np.pi / 2
    if motion_px < TRAIL_VISIBLE_PX:
        return [np.eye(3)]
    steps = int(np.ceil(motion_px / TRAIL_STEP_PX))
    return [R_from_rotvec(scene.sky_rotvec_rad * ((k + 0.5) / steps - 0.5)) for k in range(steps)]
