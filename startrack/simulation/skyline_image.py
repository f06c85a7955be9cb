"""The image of a scene near its skyline, and all that the pipeline measures of the scene before it has a position.

The pixels in a band about the true skyline are rendered; the others count as dead. Positions of the stars that an image
shows are drawn with the errors of a matched filter, and the pipeline fits attitude and lens to them. The photometry is
that of `simulate_rays`. What is left out: hot pixels and cosmic rays, trails, light of bodies, shifts by blends.
"""

from __future__ import annotations

from datetime import datetime

import numpy as np

from startrack.camera import Camera, with_update
from startrack.catalog import StarCatalog
from startrack.chain import Identified, Measured, fit_orientation, identified_names
from startrack.core.types import Array, Bools, Detections, Exposure, Identification, Image, Ints, SmoothImage
from startrack.detection import Detector, electrons, source_variances
from startrack.evidence import BAND_PX, half_width, mask_obstacles, skyline_band
from startrack.psf import noise_area_px, pixel_profile
from startrack.rendering import EDGE_WIDTH_SIGMAS, Scene, diffuse_at_e, read_out, splat
from startrack.simulation.star_rays import SimulatedStars, simulate_stars
from startrack.terrain import Terrain, require_site

MOVED_PX = 8.0  # by which the skyline of a fix by the stars may stand beside the true one
SHINING_PX = 12.0  # from the band to the last stars whose light is rendered


def draw_camera(camera: Camera, *, rng: np.random.Generator) -> Camera:
    """True camera, drawn by `rng` from the covariance that the file of `camera` states; `camera` itself without one."""
    if camera.covariance is None:
        return camera
    order = camera.covariance_order
    step = rng.multivariate_normal(np.zeros(len(order)), camera.covariance)
    return with_update(camera, dict(zip(order, step.tolist(), strict=True)))


def simulate_measured(
    scene: Scene, catalog: StarCatalog, terrain: Terrain, camera: Camera, *, time_utc: datetime,
    time_sigma_s: float | None, rng: np.random.Generator,
) -> Measured:  # fmt: skip
    """Measured stars and pixels of the image of a `scene`, as the pipeline has them before the position.

    The scene holds the truth, with its camera; `camera` is the stated one. `catalog`, `terrain`, `time_utc`,
    `time_sigma_s` [s] and `rng` are those of `simulate_rays`. Raises BadInput as that does, NotIdentified where no
    attitude fits the stars that are seen.
    """
    stars = simulate_stars(scene, catalog, terrain, time_utc=time_utc, time_sigma_s=time_sigma_s, rng=rng)
    width, height = camera.size_px
    pixels_adu, band = draw_band(stars, rng=rng)
    exposure = Exposure(pixels_adu=pixels_adu, time_utc=time_utc, exposure_s=scene.exposure_s)
    image_e, dead = electrons(exposure, camera)
    level_e, noise_e = np.median(image_e[band]) if band.any() else 0.0, stars.noise_e
    background, noise = (
        SmoothImage(np.full((1, width), one, np.float32), height, height) for one in (level_e, noise_e)
    )
    sigma_px, star, flux_e = scene.sensor.psf_sigma_px, *_seen(stars)
    flux_2, place_2 = source_variances(flux_e, noise_e**2, sigma_px, 1.0)
    peak_e = flux_e * np.square(pixel_profile(np.zeros(1), sigma_px, 0)[0][0, 0])
    detections = Detections(
        xy_px=stars.xy_px[star] + np.sqrt(place_2)[:, None] * rng.standard_normal((len(star), 2)),
        covariance_px2=place_2[:, None, None] * np.eye(2), flux_e=flux_e, flux_sigma_e=np.sqrt(flux_2),
        snr=flux_e / np.sqrt(flux_2), saturated=peak_e > stars.saturation_e, psf_sigma_px=sigma_px, image_e=image_e,
        dead=dead | ~band, background=background, noise=noise,
    )  # fmt: skip
    known, site = _identify(stars, star), require_site(terrain)
    identified = Identified(
        exposure=exposure, camera=camera, terrain=terrain, catalog_name=catalog.name,
        detections=mask_obstacles(detections, stars.mask), stars=stars.catalog, site=site,
        identification=known, names=identified_names(detections, known, scene.bodies),
    )  # fmt: skip
    oriented, rays = fit_orientation(identified), vars(stars.rays)
    return Measured(**vars(oriented) | rays | {"site": site}, scale=stars.scale)


def draw_band(stars: SimulatedStars, *, rng: np.random.Generator) -> tuple[Image, Bools]:
    """Counts (H, W) [ADU] of the pixels near the skyline, and which (H, W) these are; the others are 0.

    The light is that of the `stars` and the sky, its noise is drawn by `rng`. The band is wide enough for the pixels of
    the sky, and for stars, at the skyline of a position that is MOVED_PX off.
    """
    scene, sensor = stars.scene, stars.scene.sensor
    width, height = scene.camera.size_px
    edge_px = EDGE_WIDTH_SIGMAS * np.hypot(sensor.psf_sigma_px, 0.5)
    band_px = BAND_PX + MOVED_PX + half_width(sensor.psf_sigma_px)
    edge, band, reached = (
        skyline_band((height, width), scene.camera, scene.R_cam_enu, scene.horizon_rad, reach_px)
        for reach_px in (edge_px, band_px, band_px + SHINING_PX)
    )
    pixel = np.flatnonzero(band)
    xy_px = np.stack([pixel % width, pixel // width], axis=-1)
    light_e = np.zeros((height, width))
    near = reached[tuple(np.clip(np.rint(stars.xy_px[:, ::-1]), 0, (height - 1, width - 1)).astype(np.int64).T)]
    splat(light_e, stars.xy_px[near], stars.flux_e[near], sensor.psf_sigma_px)
    mean_e = light_e[band] + diffuse_at_e(scene, xy_px, edge[band]) + sensor.dark_e_per_s * scene.exposure_s
    pixels_adu = np.zeros((height, width), dtype=np.float32)
    pixels_adu[band] = read_out(mean_e, sensor, rng=rng)
    return pixels_adu, band


def _seen(stars: SimulatedStars) -> tuple[Ints, Array]:
    """The shining stars (n,) that a detector finds in the frame, brightest first, and their light [e]."""
    scene = stars.scene
    least_e = Detector().threshold_snr * stars.noise_e * np.sqrt(noise_area_px(scene.sensor.psf_sigma_px))
    inside = ((stars.xy_px > 0) & (stars.xy_px < np.array(scene.camera.size_px) - 1)).all(axis=1)
    star = np.flatnonzero((stars.flux_e > least_e) & inside)
    star = star[np.argsort(-stars.flux_e[star], kind="stable")]
    return star, stars.flux_e[star]


def _identify(stars: SimulatedStars, star: Ints) -> Identification:
    """Identification of the shining stars `star` (n,) that are seen as those of the catalogue, by Hipparcos number."""
    hip = stars.scene.stars.hip[stars.shining[star]]
    order = np.argsort(stars.catalog.hip, kind="stable")
    row = order[np.minimum(np.searchsorted(stars.catalog.hip[order], hip), len(order) - 1)]
    known = np.flatnonzero((hip > 0) & (stars.catalog.hip[row] == hip))
    return Identification(
        detection=known, star=row[known], R_cam_icrs=stars.scene.R_cam_icrs, false_alarm_probability=0.0, unexplained=0
    )
