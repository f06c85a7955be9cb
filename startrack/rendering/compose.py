"""Rendering of a scene: light on the sensor, the sensor's own charge, and the readout."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, Exposure, Stars
from startrack.frames import off_axis_rad
from startrack.rendering.defects import add_cosmic_rays, add_hot_pixels
from startrack.rendering.field_stars import concatenate_stars
from startrack.rendering.scene import Scene, Truth
from startrack.rendering.sensor import ADC_MAX_ADU, read_out
from startrack.rendering.sky import diffuse_e
from startrack.rendering.sources import add_sources, flux_e, is_above_terrain


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
