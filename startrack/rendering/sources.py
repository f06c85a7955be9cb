"""Stars and bodies in the image: visibility, pixels and electrons; and random stars that the catalogue lacks.

The estimator's PSF is deliberately not used here: a half-pixel error in it must not cancel against the renderer's.
"""

from __future__ import annotations

import math

import numpy as np

from startrack.camera import Camera, Sensor
from startrack.core import STAR_COUNT_SLOPE
from startrack.core.types import Array, Body, Bools, Stars
from startrack.frames import R_from_rotvec, azel_from_rays, off_axis_rad
from startrack.rendering.scene import Scene
from startrack.rendering.sky import sky_e_per_s

# A stamp ends where a star leaves less than this in a pixel: far under any sensor's noise, even summed over the rim.
INVISIBLE_E_PER_PX = 0.02
MIN_RADIUS_PX = 3
LIMIT_SNR = 5.0  # at which an image just shows a star
CHUNK_ELEMENTS = 1 << 20  # of stamps spread at a time; keeps the work inside the processor's cache
TRAIL_VISIBLE_PX = 0.02  # motion during the exposure below which a star is a point
TRAIL_STEP_PX = 0.2  # a step s adds s^2/12 to the variance of the trail's profile: 0.003 px^2
DISK_STEP_PX = 0.5  # spacing of the points that make up a disk
# Mean radius over mean distance: the Sun from 1 au (IAU 2015 nominal radius), Earth and Moon from 384,400 km.
ANGULAR_RADIUS_RAD = {"Sun": 6.957e8 / 1.495978707e11, "Earth": 6.3710e6 / 3.844e8, "Moon": 1.7374e6 / 3.844e8}
# Stars brighter than V over the whole sky: N = N_REF e^(GROWTH (V - V_REF)).
V_REF_MAG = 7.0
N_REF = 15_600  # Hipparcos with the Bright Star Catalogue has 15,479 to V 7.0 and lacks about 1 % there
# Against an independent list to V 7.5 Hipparcos lacks 0.3 % at V 6.0-6.5 and 1.1 % at 6.5-7.0.
FIRST_LACKING_MAG = 6.5
MIN_LACKING = 0.01
BIN_MAG = 0.25
CLUSTER_RAD = 0.07  # scatter of a field star about a catalogue star: 4 degrees


def flux_e(sensor: Sensor, v_mag: Array, angle_rad: Array, exposure_s: float) -> Array:
    """Electrons (n,) of a `sensor` in the whole PSF: zero_point 10^(-0.4 `v_mag`) `exposure_s` throughput(`angle_rad`).

    The angles (n,) are off the axis.
    """
    return sensor.zero_point_e_per_s * 10 ** (-0.4 * np.asarray(v_mag)) * exposure_s * sensor.throughput(angle_rad)


def is_above_terrain(scene: Scene, rays_enu: Array) -> Bools:
    """Whether the directions (n, 3) are above the horizon of the terrain, a hard edge."""
    if scene.terrain is None:
        return np.ones(len(rays_enu), dtype=bool)
    azimuth, elevation = azel_from_rays(rays_enu)
    return elevation > scene.horizon_rad(azimuth)


def add_sources(image_e: Array, scene: Scene) -> None:
    """Add to the image (H, W) [e] the stars and bodies of the scene, trailed where the sky's rotation is visible."""
    parts = [(scene.stars.rays_icrs, scene.stars.v_mag + scene.v_error_mag)]
    parts += [_body_points(body, max(scene.camera.focal_px)) for body in scene.bodies]
    rays_icrs, v_mag = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    rays_enu = rays_icrs @ scene.R_enu_icrs.T
    v_mag = scene.dimmed_mag(v_mag, rays_enu)
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


def exposure_for_snr(camera: Camera, sky_v_mag_arcsec2: float | None, *, v_mag: float, snr: float = LIMIT_SNR) -> float:
    """Seconds in which a star of `v_mag` on the axis reaches the matched-filter ratio `snr`.

    `sky_v_mag_arcsec2` is the brightness of the sky (None: black).

    snr^2 = S^2 / (S + A (read^2 + B)), S and B the electrons of the star and of one pixel's sky and dark current in
    the time t, A = 4 pi (sigma^2 + 1/12) the PSF's noise area: a quadratic in t. The camera must have a sensor.
    """
    sensor, area_px, background = _noise_on_axis(camera, sky_v_mag_arcsec2)
    star = sensor.zero_point_e_per_s * 10 ** (-0.4 * v_mag)
    linear = snr**2 * (star + area_px * background)
    constant = snr**2 * area_px * sensor.read_noise_e**2
    return float((linear + np.sqrt(linear**2 + 4 * star**2 * constant)) / (2 * star**2))


def limiting_v_mag(
    camera: Camera, sky_v_mag_arcsec2: float | None, *, exposure_s: float, snr: float = LIMIT_SNR
) -> float:
    """Magnitude of the star on the axis of a `camera` that reaches `snr` in `exposure_s`.

    The sky has the brightness `sky_v_mag_arcsec2`. It is the inverse of `exposure_for_snr`.
    """
    sensor, area_px, background = _noise_on_axis(camera, sky_v_mag_arcsec2)
    noise_e2 = area_px * (sensor.read_noise_e**2 + background * exposure_s)
    star_e = 0.5 * (snr**2 + np.sqrt(snr**4 + 4 * snr**2 * noise_e2))
    return float(-2.5 * np.log10(star_e / (sensor.zero_point_e_per_s * exposure_s)))


def _noise_on_axis(camera: Camera, sky_v_mag_arcsec2: float | None) -> tuple[Sensor, float, float]:
    """The sensor, the PSF's noise area [px], and the electrons per second of a pixel's sky and dark current."""
    sensor = camera.sensor
    if sensor is None:
        raise ValueError(f"camera {camera.name} has no sensor")
    sky = float(sky_e_per_s(camera, sky_v_mag_arcsec2, np.zeros(1))[0])
    return sensor, 4 * np.pi * (sensor.psf_sigma_px**2 + 1 / 12), sensor.dark_e_per_s + sky


def _body_points(body: Body, focal_px: float) -> tuple[Array, Array]:
    """Unit vectors (n, 3) and magnitudes (n,) of equal points evenly over the disk of a body, without phases."""
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


def splat(image_e: Array, xy_px: Array, flux_e: Array, sigma_px: float) -> None:
    """Add to the image (H, W) [e] a Gaussian PSF, integrated over each pixel, for every source.

    image[y, x] += flux (Phi((x + 1/2 - x0)/s) - Phi((x - 1/2 - x0)/s)) (the same in y). Sources may lie off the frame.

    Args:
        image_e: (H, W) float64, C-contiguous; changed in place.
        xy_px: (n, 2) centres x0, y0; (0, 0) is the centre of the top-left pixel.
        flux_e: (n,) whole-PSF flux [electrons].
        sigma_px: standard deviation s of the Gaussian before integration over the pixel.
    """
    height, width = image_e.shape
    flat = image_e.reshape(-1)
    radii = stamp_radius_px(flux_e, sigma_px)
    near = np.all((xy_px > -0.5 - radii[:, None]) & (xy_px < np.array([width, height]) - 0.5 + radii[:, None]), axis=1)
    for radius in np.unique(radii[near]):
        members = np.flatnonzero(near & (radii == radius))
        step = max(1, CHUNK_ELEMENTS // (2 * radius + 1) ** 2)
        for start in range(0, len(members), step):
            chunk = members[start : start + step]
            columns, across = _profile(xy_px[chunk, 0], sigma_px, radius, width)
            rows, down = _profile(xy_px[chunk, 1], sigma_px, radius, height)
            light = (down * flux_e[chunk, None])[:, :, None] * across[:, None, :]
            index = (rows * width)[:, :, None] + columns[:, None, :]
            np.add.at(flat, index.reshape(-1), light.reshape(-1))


def stamp_radius_px(flux_e: Array, sigma_px: float) -> Array:
    """Half widths (n,) [px, whole] of the stamps outside which a source leaves under INVISIBLE_E_PER_PX in a pixel."""
    wide2 = sigma_px**2 + 1 / 12  # the pixel's own second moment widens the PSF
    peak = np.maximum(np.asarray(flux_e) / (2 * math.pi * wide2), INVISIBLE_E_PER_PX)
    radius = np.sqrt(2 * wide2 * np.log(peak / INVISIBLE_E_PER_PX))
    return np.maximum(np.ceil(radius).astype(np.int64), min(MIN_RADIUS_PX, math.ceil(4 * sigma_px)))


def _profile(centres_px: Array, sigma_px: float, radius: int, size: int) -> tuple[Array, Array]:
    """Pixel numbers (n, 2 r + 1) and the fractions of the flux in them; zero, and a legal number, off the frame."""
    from scipy.special import ndtr

    pixels = np.rint(centres_px).astype(np.int64)[:, None] + np.arange(-radius, radius + 1)
    edges = np.concatenate([pixels - 0.5, pixels[:, -1:] + 0.5], axis=1)
    fraction = np.diff(ndtr((edges - centres_px[:, None]) / sigma_px), axis=1)
    on_frame = (pixels >= 0) & (pixels < size)
    return np.where(on_frame, pixels, 0), np.where(on_frame, fraction, 0.0)


def draw_v_errors(stars: Stars, scatter_mag: float, *, rng: np.random.Generator) -> Array:
    """True minus stated magnitude (n,) of `stars`, drawn from `rng`: normal, sigma and `scatter_mag` in quadrature."""
    return rng.standard_normal(len(stars)) * np.hypot(stars.v_sigma_mag, scatter_mag)


def draw_field_stars(stars: Stars, to_v_mag: float, *, rng: np.random.Generator) -> Stars:
    """Random stars (from `rng`) that the catalogue `stars` lacks, to `to_v_mag`: ids "FIELD n", hip 0, brightest first.

    In each quarter of a magnitude from FIRST_LACKING_MAG on, as many as the counts N(V) above exceed the catalogue's,
    and at least 1 % of the catalogue's. They follow the density of the catalogue: each lies near a randomly chosen
    catalogue star; uniform without catalogue stars.
    """
    edges = np.arange(FIRST_LACKING_MAG, to_v_mag + 1e-9, BIN_MAG)
    rays, v_mag = np.empty((0, 3)), np.empty(0)
    if len(edges) > 1:
        expected = np.diff(N_REF * np.exp(STAR_COUNT_SLOPE * (edges - V_REF_MAG)))
        listed = np.histogram(stars.v_mag, edges)[0]
        lacking = rng.poisson(np.maximum(expected - listed, MIN_LACKING * listed))
        low = np.repeat(edges[:-1], lacking)
        # Inverse of the cumulative e^(GROWTH V) within a bin.
        steep = np.expm1(STAR_COUNT_SLOPE * BIN_MAG)
        v_mag = np.sort(low + np.log1p(rng.random(len(low)) * steep) / STAR_COUNT_SLOPE)
        rays = rng.standard_normal((len(v_mag), 3))
        if len(stars):
            rays = stars.rays_icrs[rng.integers(len(stars), size=len(v_mag))] + CLUSTER_RAD * rays
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    n = len(v_mag)
    ids = np.char.add("FIELD ", np.arange(1, n + 1).astype(str))
    return Stars(catalog_id=ids, hip=np.zeros(n, dtype=np.int64), rays_icrs=rays, v_mag=v_mag, v_sigma_mag=np.zeros(n))
