"""Rendering of a scene: light on the sensor, its own charge, the readout, and the truth beside the image.

NAME.truth.json and NAME.truth.ecsv are for tests and scorers only.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from startrack.core.files import write_atomically
from startrack.core.types import Array, Exposure, Stars
from startrack.frames import off_axis_rad, quat_xyzw_from_R
from startrack.rendering.scene import Scene, Truth
from startrack.rendering.sensor import ADC_MAX_ADU, add_cosmic_rays, add_hot_pixels, read_out
from startrack.rendering.sky import diffuse_e
from startrack.rendering.sources import add_sources, concatenate_stars, flux_e, is_above_terrain

# ECSV 1.0 (astropy enhancement proposal 6), written as text: astropy.table would take longer than the rendering.
_COLUMNS = (
    ("catalog_id", "string", None, "HIP, FIELD (not in the catalogue) or the name of a body"),
    ("x_px", "float64", "pix", "at mid-exposure; (0, 0) is the centre of the top-left pixel"),
    ("y_px", "float64", "pix", "at mid-exposure"),
    ("v_mag", "float64", "mag", "as the catalogue states it"),
    ("flux_e", "float64", "electron", "whole PSF, from v_mag"),
    ("hidden", "bool", None, "the terrain hides it at mid-exposure"),
)


def render(scene: Scene, *, rng: np.random.Generator) -> tuple[Exposure, Truth]:
    """The exposure of a scene, and the truth about it. The same scene and state of `rng` give the same pixels.

    Raises:
        BadInput: bad_calibration when the camera has no sensor.
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
    sources = concatenate_stars(scene.stars, _bodies_as_stars(scene))
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
        flux_e=flux_e(scene.sensor, sources.v_mag, off_axis_rad(rays_cam[inside]), scene.exposure_s),
        hidden=~is_above_terrain(scene, rays_enu),
    )


def _bodies_as_stars(scene: Scene) -> Stars:
    n = len(scene.bodies)
    return Stars(
        catalog_id=np.array([body.name for body in scene.bodies], dtype=np.str_),
        hip=np.zeros(n, dtype=np.int64),
        rays_icrs=np.array([body.ray_icrs for body in scene.bodies]).reshape(n, 3),
        v_mag=np.array([body.v_mag for body in scene.bodies]),
        v_sigma_mag=np.zeros(n),
    )


def truth_paths(image: str | Path) -> tuple[Path, Path]:
    """NAME.truth.json and NAME.truth.ecsv beside the image NAME.png."""
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
    head = ["# %ECSV 1.0", "# ---", "# datatype:"]
    for name, kind, unit, description in _COLUMNS:
        unit_text = f"unit: {unit}, " if unit else ""
        head.append(f"# - {{name: {name}, {unit_text}datatype: {kind}, description: '{description}'}}")
    head += ["# schema: astropy-2.0", " ".join(name for name, *_ in _COLUMNS)]
    kept = truth.sources.v_mag <= to_v_mag
    rows = zip(
        truth.sources.catalog_id[kept].tolist(),
        truth.xy_px[kept].tolist(),
        truth.sources.v_mag[kept].tolist(),
        truth.flux_e[kept].tolist(),
        truth.hidden[kept].tolist(),
        strict=True,
    )
    body = [f'"{name}" {x:.4f} {y:.4f} {v:.4f} {flux:.6g} {hidden}' for name, (x, y), v, flux, hidden in rows]
    return "\n".join(head + body) + "\n"
