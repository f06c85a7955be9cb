"""Rendering of a scene: light on the sensor, charge that is not light, the readout, and the truth beside the image.

NAME.truth.json and NAME.truth.ecsv are for tests and scorers only.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Sensor
from startrack.core.ecsv import Column, ecsv_text
from startrack.core.files import write_atomically
from startrack.core.types import Array, Exposure, Stars
from startrack.frames import off_axis_rad, quat_xyzw_from_R
from startrack.rendering.scene import HotPixels, Scene, Truth
from startrack.rendering.sky import diffuse_e
from startrack.rendering.sources import add_sources, flux_e, is_above_terrain, splat

ADC_MAX_ADU = 65535.0  # 16 bits
POISSON_UP_TO_E = 64.0  # above it the normal distribution is used (skewness under 1/8), five times as fast
HOT_E_PER_S = (50.0, 50_000.0)  # dark current of hot pixels: even in its logarithm, from barely visible to glaring
TRACK_MEAN_PX = 6.0  # exponential length: most rays pass steeply, a few graze along the chip
TRACK_LONGEST_PX = 80.0
TRACK_E_PER_PX = 150.0  # median charge along a track, log-normal; a muon leaves about 80 e per micrometre of silicon
TRACK_LOG_SIGMA = 0.8
TRACK_SIGMA_PX = 0.35  # charge spreads over neighbours by diffusion, much less than light does
TRACK_STEP_PX = 0.25


def render(scene: Scene, *, rng: np.random.Generator) -> tuple[Exposure, Truth]:
    """The exposure of a scene, and the truth about it. The same scene and state of `rng` give the same pixels.

    Raises BadInput: bad_calibration when the camera has no sensor.
    """
    electrons = light_e(scene)
    electrons += scene.sensor.dark_e_per_s * scene.exposure_s
    add_hot_pixels(electrons, scene.hot_pixels, scene.exposure_s)
    add_cosmic_rays(electrons, scene.cosmic_rays, rng=rng)
    exposure = Exposure(
        pixels_adu=read_out(electrons, scene.sensor, rng=rng),
        name=scene.name,
        time_utc=scene.time_utc,
        time_sigma_s=0.0,
        exposure_s=scene.exposure_s,
        camera=scene.camera_ref or scene.camera.name,
        terrain=scene.terrain_ref or (scene.terrain.name if scene.terrain else None),
        saturation_adu=ADC_MAX_ADU,
    )
    return exposure, truth_of(scene)


def light_e(scene: Scene) -> Array:
    """Mean photoelectrons (H, W) of the scene: diffuse sky and wall, stars, bodies; no noise, no dark current."""
    image_e = diffuse_e(scene)
    add_sources(image_e, scene)
    return image_e


def truth_of(scene: Scene) -> Truth:
    """Pixel at mid-exposure of each star and body of a `scene`, its stated flux, and whether the terrain hides it."""
    n = len(scene.bodies)
    bodies = Stars(
        catalog_id=np.array([body.name for body in scene.bodies], dtype=np.str_),
        hip=np.zeros(n, dtype=np.int64),
        rays_icrs=np.array([body.ray_icrs for body in scene.bodies]).reshape(n, 3),
        v_mag=np.array([body.v_mag for body in scene.bodies]),
        v_sigma_mag=np.zeros(n),
    )
    sources = Stars.concatenate(scene.stars, bodies)
    rays_enu = sources.rays_icrs @ scene.R_enu_icrs.T
    rays_cam = rays_enu @ scene.R_cam_enu.T
    xy_px, inside = scene.camera.project(rays_cam)
    sources, rays_enu = sources.take(inside), rays_enu[inside]
    return Truth(
        position_enu_m=scene.position_enu_m,
        R_cam_enu=scene.R_cam_enu,
        R_cam_icrs=scene.R_cam_icrs,
        sources=sources,
        xy_px=xy_px[inside],
        flux_e=flux_e(
            scene.sensor, scene.dimmed_mag(sources.v_mag, rays_enu), off_axis_rad(rays_cam[inside]), scene.exposure_s
        ),
        hidden=~is_above_terrain(scene, rays_enu),
    )


def truth_paths(image: str | Path) -> tuple[Path, Path]:
    """Paths of NAME.truth.json and NAME.truth.ecsv beside the image NAME.png."""
    path = Path(image)
    return path.with_name(f"{path.stem}.truth.json"), path.with_name(f"{path.stem}.truth.ecsv")


def write_truth(
    image: str | Path, truth: Truth, settings: dict[str, Any], *, to_v_mag: float, overwrite: bool = False
) -> tuple[Path, Path]:
    """Write the truth beside the image and return both paths; the table holds the sources down to `to_v_mag`.

    `settings` are further keys of the JSON file (exposure, seed, ...). Raises BadInput bad_image where a file is
    there and not `overwrite`, or cannot be written.
    """
    pose_path, table_path = truth_paths(image)
    pose = {
        "position_enu_m": truth.position_enu_m.tolist(),
        "quat_xyzw_cam_icrs": quat_xyzw_from_R(truth.R_cam_icrs).tolist(),
        "R_cam_enu": truth.R_cam_enu.tolist(),
        "sources_visible": int((~truth.hidden).sum()),
        "sources_hidden": int(truth.hidden.sum()),
        **settings,
    }
    text = json.dumps(pose, ensure_ascii=False, allow_nan=False, indent=1)
    write_atomically(pose_path, text.encode("utf-8") + b"\n", overwrite=overwrite)
    write_atomically(table_path, truth_ecsv(truth, to_v_mag).encode("utf-8"), overwrite=overwrite)
    return pose_path, table_path


def truth_ecsv(truth: Truth, to_v_mag: float) -> str:
    """The table of sources down to `to_v_mag` as the text of an ECSV file, in the order of the truth."""
    kept = truth.sources.v_mag <= to_v_mag
    name, (x_px, y_px) = truth.sources.catalog_id[kept], truth.xy_px[kept].T
    origin = "at mid-exposure; (0, 0) is the centre of the top-left pixel"
    return ecsv_text([
        Column("catalog_id", name, "string", description="HIP, FIELD (not in the catalogue) or the name of a body"),
        Column("x_px", x_px, "float64", "pix", "%.4f", origin),
        Column("y_px", y_px, "float64", "pix", "%.4f", "at mid-exposure"),
        Column("v_mag", truth.sources.v_mag[kept], "float64", "mag", "%.4f", "as the catalogue states it"),
        Column("flux_e", truth.flux_e[kept], "float64", "electron", "%.6g", "whole PSF, from v_mag"),
        Column("hidden", truth.hidden[kept], "bool", description="the terrain hides it at mid-exposure"),
    ])  # fmt: skip


def draw_hot_pixels(size_px: tuple[int, int], count: int, *, rng: np.random.Generator) -> HotPixels:
    """Hot pixels, `count` random ones (`rng`) of a sensor of `size_px` (W, H); currents log-uniform in HOT_E_PER_S."""
    width, height = size_px
    index = rng.choice(width * height, size=min(count, width * height), replace=False)
    low, high = np.log(HOT_E_PER_S)
    return HotPixels(
        xy_px=np.stack([index % width, index // width], axis=-1),
        dark_e_per_s=np.exp(rng.uniform(low, high, len(index))),
    )


def add_hot_pixels(image_e: Array, hot: HotPixels, exposure_s: float) -> None:
    """Add to the image (H, W) [e] the hot pixels' dark charge. Raises ValueError where one is off the frame."""
    height, width = image_e.shape
    if np.any((hot.xy_px < 0) | (hot.xy_px >= [width, height])):
        raise ValueError("a hot pixel is off the frame")
    np.add.at(image_e, (hot.xy_px[:, 1], hot.xy_px[:, 0]), hot.dark_e_per_s * exposure_s)


def add_cosmic_rays(image_e: Array, count: int, *, rng: np.random.Generator) -> None:
    """Add to the image (H, W) [e] `count` straight tracks at random positions, directions, lengths and charges."""
    height, width = image_e.shape
    for _ in range(count):
        centre = rng.uniform([-0.5, -0.5], [width - 0.5, height - 0.5])
        direction = rng.uniform(0, np.pi)
        length = min(rng.exponential(TRACK_MEAN_PX), TRACK_LONGEST_PX)
        e_per_px = TRACK_E_PER_PX * np.exp(TRACK_LOG_SIGMA * rng.standard_normal())
        points = max(1, int(np.ceil(length / TRACK_STEP_PX)))
        along = (np.arange(points) + 0.5) / points * length - length / 2
        xy_px = centre + along[:, None] * np.array([np.cos(direction), np.sin(direction)])
        # A steep ray still crosses the depth of one pixel.
        splat(image_e, xy_px, np.full(points, e_per_px * max(length, 1.0) / points), TRACK_SIGMA_PX)


def photons(mean_e: Array, *, rng: np.random.Generator) -> NDArray[np.float32]:
    """Poisson-distributed electrons (H, W) about the mean (H, W) [e]; rounded normal draws from 64 e on."""
    bright = mean_e > POISSON_UP_TO_E
    electrons = np.empty(mean_e.shape, dtype=np.float32)
    electrons[~bright] = rng.poisson(mean_e[~bright])
    mean = mean_e[bright]
    electrons[bright] = np.maximum(np.rint(mean + np.sqrt(mean) * rng.standard_normal(len(mean))), 0.0)
    return electrons


def read_out(mean_e: Array, sensor: Sensor, *, rng: np.random.Generator) -> NDArray[np.float32]:
    """Numbers [ADU, whole] that the `sensor` gives for `mean_e`, the mean electrons of light and dark current.

    Both have the same shape. The noise is drawn by `rng`.
    adu = round((Poisson(mean) + N(0, read noise)) / gain + bias), clipped to 0..saturation and to 16 bits.
    """
    electrons = photons(mean_e, rng=rng)
    if sensor.read_noise_e > 0:
        electrons += np.float32(sensor.read_noise_e) * rng.standard_normal(mean_e.shape, dtype=np.float32)
    adu = np.rint(electrons / np.float32(sensor.gain_e_per_adu) + np.float32(sensor.bias_adu))
    return np.clip(adu, 0.0, min(sensor.saturation_adu, ADC_MAX_ADU)).astype(np.float32, copy=False)
