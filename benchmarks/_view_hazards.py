"""Hazards of the picture: processing of its pixels, and things that block part of the view. No file states them.

The function of each changes a frame (H, W) [ADU] and draws its sizes at random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from _sensor_hazards import Ridged, with_sensor
from _sky_hazards import dust, mast, second_skyline, vignetting
from _sky_view import Hazard, Rng, View, draw

from startrack.camera import Camera
from startrack.core.types import Array
from startrack.frames import R_from_rotvec
from startrack.rendering import Scene
from startrack.terrain import Cylinder

EIGHT_BITS_E = 4.0  # electrons of one step


def subtract_dark(frame: Array, view: View, rng: Rng) -> Array:
    """Bias and dark level taken away, what is below zero clipped; 0 to 1 sigma of the noise may stay."""
    level, sigma = dark_level(frame, view)
    return np.clip(frame - level + rng.uniform(-0.5, 1.0) * sigma, 0, None)


def threshold(frame: Array, view: View, rng: Rng) -> Array:
    """Pixels below 2 to 5 sigma above the dark level set to 0."""
    level, sigma = dark_level(frame, view)
    return np.where(frame > level + rng.uniform(2, 5) * sigma, frame, 0.0)


def median_filter(frame: Array, view: View, rng: Rng) -> Array:
    """A median over 3 or 5 pixels squared."""
    return np.asarray(cv2.medianBlur(frame.astype(np.uint16), int(rng.choice([3, 5]))), dtype=float)


def gaussian_filter(frame: Array, view: View, rng: Rng) -> Array:
    """A Gaussian of 0.6 to 2 px."""
    return np.asarray(cv2.GaussianBlur(frame, (0, 0), rng.uniform(0.6, 2.0)))


def compress(quality: tuple[int, int]) -> Callable[[Array, View, Rng], Array]:
    """JPEG in 8 bits, of a quality between two."""

    def damage(frame: Array, view: View, rng: Rng) -> Array:
        eight = to_eight_bits(frame, view, rng).astype(np.uint8)
        setting = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(*quality, endpoint=True))]
        return np.asarray(cv2.imdecode(cv2.imencode(".jpg", eight, setting)[1], cv2.IMREAD_UNCHANGED), dtype=float)

    return damage


def to_eight_bits(frame: Array, view: View, rng: Rng) -> Array:
    """Steps of EIGHT_BITS_E above the bias."""
    sensor = view.scene.sensor
    return np.clip(np.rint((frame - sensor.bias_adu) * sensor.gain_e_per_adu / EIGHT_BITS_E), 0, 255)


def eight_bits_without_offset(frame: Array, view: View, rng: Rng) -> Array:
    """The same after the dark level was taken away."""
    level, _ = dark_level(frame, view)
    return to_eight_bits(frame - level + view.scene.sensor.bias_adu, view, rng)


def coarse_steps(frame: Array, view: View, rng: Rng) -> Array:
    """Steps of 16 ADU."""
    return np.asarray(np.floor(frame / 16) * 16)


def gamma(frame: Array, view: View, rng: Rng) -> Array:
    """A gamma of 0.45 to 1.3."""
    return np.asarray(65535 * (frame / 65535) ** rng.uniform(0.45, 1.3))


def haze(frame: Array, view: View, rng: Rng) -> Array:
    """Half to nine tenths of the light lost."""
    level, _ = dark_level(frame, view)
    return level + (frame - level) * rng.uniform(0.1, 0.5)


def pure_noise(frame: Array, view: View, rng: Rng) -> Array:
    """No light at all."""
    return dark_noise(frame, view, rng)


def motion_blur(frame: Array, view: View, rng: Rng) -> Array:
    """Light drawn out over 6 to 40 px."""
    length, angle = rng.uniform(6, 40), rng.uniform(0, np.pi)
    kernel = np.zeros((41, 41), np.float32)
    half = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
    cv2.line(kernel, *(tuple(int(v) for v in np.rint(20 + sign * half)) for sign in (-1, 1)), 1.0)
    return blur_light(frame, view, kernel, rng)


def defocus(frame: Array, view: View, rng: Rng) -> Array:
    """Light spread over a disc of 2 to 8 px."""
    radius = rng.uniform(2, 8)
    y, x = np.mgrid[-9:10, -9:10]
    return blur_light(frame, view, np.clip(radius + 0.5 - np.hypot(x, y), 0, 1).astype(np.float32), rng)


def ghost(frame: Array, view: View, rng: Rng) -> Array:
    """A second image of the sky, of 5 to 30 % of its light, 1.5 to 25 px aside."""
    level, _ = dark_level(frame, view)
    way = rng.uniform(1.5, 25) * np.exp(1j * rng.uniform(0, 2 * np.pi))
    return frame + rng.uniform(0.05, 0.3) * (shift(frame, way.real, way.imag) - level)


def mirrored_ghost(view: View, rng: Rng) -> Array:
    """The image mirrored through the frame's centre, of 1 to 5 % of its light."""
    return view.light_e + draw(0.01, 0.05, rng) * view.light_e[::-1, ::-1]


def moved_between(view: View, rng: Rng) -> Array:
    """Half of the exposure each at two places 100 to 900 m apart."""
    turn, far_m = rng.uniform(0, 2 * np.pi), draw(100, 900, rng)
    place_m = view.scene.position_enu_m + far_m * np.array([np.sin(turn), np.cos(turn), 0.0])
    return 0.5 * (view.light_e + View.of(replace(view.scene, position_enu_m=place_m)).light_e)


def turned_between(view: View, rng: Rng) -> Array:
    """Half of the exposure each with two attitudes, turned by 1 to 90 degrees against each other."""
    axis = rng.standard_normal(3)
    turn = R_from_rotvec(np.radians(draw(1, 90, rng)) * axis / np.linalg.norm(axis))
    return 0.5 * (view.light_e + View.of(replace(view.scene, R_cam_enu=view.scene.R_cam_enu @ turn)).light_e)


def shifted_sensor(frame: Array, view: View, rng: Rng) -> Array:
    """The image shifted by 1 to 2 px."""
    way = rng.uniform(1, 2) * np.exp(1j * rng.uniform(0, 2 * np.pi))
    return shift(frame, way.real, way.imag)


def lost_rows(frame: Array, view: View, rng: Rng) -> Array:
    """One to four rows lost in readout: those below move up."""
    rows = rng.choice(len(frame), rng.integers(1, 5), replace=False)
    return np.concatenate([np.delete(frame, rows, axis=0), frame[-len(rows) :]])


def hot_pixels(frame: Array, view: View, rng: Rng) -> Array:
    """10,000 to 50,000 hot pixels."""
    found = frame.copy()
    where = rng.choice(frame.size, int(draw(10_000, 50_000, rng)), replace=False)
    found.reshape(-1)[where] += np.exp(rng.uniform(np.log(100), np.log(3e4), len(where)))
    return found


def satellites(frame: Array, view: View, rng: Rng) -> Array:
    """One to six trails across the frame."""
    trails = np.zeros(frame.shape, np.float32)
    for _ in range(rng.integers(1, 7)):
        ends = rng.integers(0, frame.shape[1], (2, 2))
        cv2.line(trails, *(tuple(int(v) for v in end) for end in ends), draw(50, 3000, rng), 2, cv2.LINE_AA)
    return frame + trails


def dead_quadrant(frame: Array, view: View, rng: Rng) -> Array:
    """A quarter of the frame without light: black, at the bias, or with the dark noise."""
    height, width = (n // 2 for n in frame.shape)
    top, left = height * rng.integers(2), width * rng.integers(2)
    found = frame.copy()
    quarter = np.s_[top : top + height, left : left + width]
    values = [np.zeros_like(frame), np.full_like(frame, view.scene.sensor.bias_adu), dark_noise(frame, view, rng)]
    found[quarter] = values[rng.integers(3)][quarter]
    return found


def other_strip(frame: Array, view: View, rng: Rng) -> Array:
    """A strip of 100 to 400 rows or columns of the sky turned by half a circle."""
    first, wide, found = rng.integers(100, len(frame) - 500), rng.integers(100, 400), frame.copy()
    strip = np.s_[first : first + wide] if rng.random() < 0.5 else np.s_[:, first : first + wide]
    found[strip] = frame[::-1, ::-1][strip]
    return found


def ridge(width_deg: tuple[float, float], height_deg: tuple[float, float]) -> Callable[[Scene, Rng], Scene]:
    """A ridge on no map, of a width and a height between two."""

    def change(scene: Scene, rng: Rng) -> Scene:
        assert isinstance(scene.terrain, Cylinder)
        width, height = np.radians([rng.uniform(*width_deg), rng.uniform(*height_deg)])
        shape = {"azimuth_rad": rng.uniform(0, 2 * np.pi), "width_rad": width, "height_rad": height}
        return replace(scene, terrain=Ridged(**{**vars(scene.terrain), **shape}))

    return change


def state_no_bias(camera: Camera, scene: Scene, rng: Rng) -> Camera:
    """The camera file of frames whose offset was taken away."""
    return replace(camera, sensor=replace(scene.sensor, bias_adu=0.0))


def state_eight_bits(camera: Camera, scene: Scene, rng: Rng) -> Camera:
    """The camera file of frames in 8 bits."""
    return with_sensor(scene, gain_e_per_adu=EIGHT_BITS_E, bias_adu=0.0, saturation_adu=255.0).camera


def dark_level(frame: Array, view: View) -> tuple[float, float]:
    """Level without light and noise [ADU], by the sensor."""
    scene, sensor = view.scene, view.scene.sensor
    dark_e = sensor.dark_e_per_s * scene.exposure_s
    sigma_e = np.sqrt(dark_e + sensor.read_noise_e**2)
    return sensor.bias_adu + dark_e / sensor.gain_e_per_adu, float(sigma_e / sensor.gain_e_per_adu)


def dark_noise(frame: Array, view: View, rng: Rng) -> Array:
    """A frame without light."""
    level, sigma = dark_level(frame, view)
    return np.asarray(level + sigma * rng.standard_normal(frame.shape))


def blur_light(frame: Array, view: View, kernel: Array, rng: Rng) -> Array:
    """The light spread by a kernel, under noise as in the frame."""
    level, _ = dark_level(frame, view)
    noise = dark_noise(frame, view, rng) - level
    return np.asarray(cv2.filter2D(frame, -1, kernel / kernel.sum())) + noise


def shift(frame: Array, x_px: float, y_px: float) -> Array:
    """The frame moved by parts of pixels."""
    matrix = np.array([[1.0, 0.0, x_px], [0.0, 1.0, y_px]])
    size = frame.shape[1], frame.shape[0]
    return np.asarray(cv2.warpAffine(frame, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


H = Hazard
VIEW_HAZARDS = {
    "untouched": H(),
    "satellite trails": H(pixels=satellites),
    "motion blur of 6 to 40 px": H(pixels=motion_blur),
    "out-of-focus discs of 2 to 8 px": H(pixels=defocus),
    "gamma of 0.45 to 1.3": H(pixels=gamma),
    "pure noise": H(pixels=pure_noise),
    "mirrored": H(pixels=lambda frame, view, rng: frame[:, ::-1]),
    "rotated by 90 degrees": H(pixels=lambda frame, view, rng: np.rot90(frame, int(rng.integers(1, 4)))),
    "haze": H(pixels=haze),
    "ghost image": H(pixels=ghost),
    "mirrored ghost": H(light=mirrored_ghost),
    "moved by 100 to 900 m between two halves": H(light=moved_between),
    "turned by 1 to 90 degrees between two halves": H(light=turned_between),
    "shifted by 1 to 2 px": H(pixels=shifted_sensor),
    "rows lost in readout": H(pixels=lost_rows),
    "10,000 to 50,000 hot pixels": H(pixels=hot_pixels),
    "vignetting not stated": H(light=vignetting),
    "dark level taken away, clipped at zero": H(pixels=subtract_dark, stated=state_no_bias),
    "thresholded": H(pixels=threshold),
    "median filter": H(pixels=median_filter),
    "Gaussian filter": H(pixels=gaussian_filter),
    "JPEG, quality 75 to 95": H(pixels=compress((75, 95)), stated=state_eight_bits),
    "JPEG, quality 30": H(pixels=compress((30, 30)), stated=state_eight_bits),
    "8 bits": H(pixels=to_eight_bits, stated=state_eight_bits),
    "8 bits after the offset was taken away": H(pixels=eight_bits_without_offset, stated=state_eight_bits),
    "steps of 16 ADU": H(pixels=coarse_steps),
    "dust near the skyline": H(light=dust),
    "mast": H(light=mast),
    "dead quadrant": H(pixels=dead_quadrant),
    "strip of another frame": H(pixels=other_strip),
    "high ridge, 30 to 90 by 5 to 20 degrees": H(scene=ridge((30, 90), (5, 20))),
    "low wide ridge, 70 to 150 by 1 to 3 degrees": H(scene=ridge((70, 150), (1, 3))),
    "small ridge, 10 to 60 by 0.2 to 1 degrees": H(scene=ridge((10, 60), (0.2, 1))),
    "second skyline 1 to 5 px higher": H(light=second_skyline),
}
