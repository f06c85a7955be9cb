"""The stars' rays of a scene, as the pipeline would measure them in its image.

What is left out: errors of the attitude and of the lens (a hundredth of a pixel), hot pixels and cosmic rays (the
photometry masks them), light of the bodies beyond their glare, trails, and errors of the background near the skyline.
`skyline_image.py` adds pixels near the skyline.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from startrack.catalog import StarCatalog, airmass_at, apparent_stars
from startrack.chain import CERTAIN_PROBABILITY, StarRays, mask_unpredictable
from startrack.core.types import TIME_SIGMA_S, Array, BadInput, Bools, Ints, Mask, Stars
from startrack.evidence import (
    SCALE_SNR,
    SCALE_STARS,
    FluxScale,
    Photometry,
    Skyline,
    Sources,
    StarPhotometer,
    add_obstacles,
    expect_stars,
    expected_flux_scale,
    fit_flux_scale,
    half_width,
    neighbour_profiles,
    order_by_cell,
    profiles_of,
)
from startrack.exposure import combine_masks
from startrack.frames import R_enu_icrs, azel_from_rays, off_axis_rad
from startrack.kernels.library import kernel
from startrack.localization import clock_at
from startrack.psf import noise_area_px, pixel_profile
from startrack.rendering import Scene, flux_e, sky_e_per_s, sky_gradient
from startrack.terrain import ForwardingTerrain, Terrain, require_site

NEIGHBOUR_SIGMAS = 3.0  # of the PSF beyond half a stamp, to the last star whose light is subtracted, as in `measure`
UNDECIDED_RAD = np.radians(0.2)  # from the skyline: here the visibility of a neighbour is not known


@dataclass(frozen=True, eq=False)
class Starlight:
    """The stars that shine on a frame (m), and its PSF."""

    xy_px: Array  # (m, 2)
    flux_e: Array  # (m,) whole PSF
    psf_sigma_px: float

    def measure(
        self, sources: Sources, pixel_variance_e2: Array, saturation_e: float, *, rng: np.random.Generator
    ) -> Photometry:
        """Photometry of `sources` (n): a draw, by `rng`, of what `startrack.evidence.photometry.measure` would find.

        The background is known, and the noise of a pixel without stars is the same over the stamp of a star,
        `pixel_variance_e2` (n,). The weights are those of linear least squares for flux and local level; the light of
        `sources` is subtracted as expected, all light of the stars here adds to the flux and to its noise. The errors
        of overlapping stamps are drawn independently. A star with a pixel above `saturation_e` is not usable.
        """
        from scipy.spatial import cKDTree

        sigma, radius = self.psf_sigma_px, half_width(self.psf_sigma_px)
        reach_px = np.hypot(radius, radius) + NEIGHBOUR_SIGMAS * sigma  # from the corners of a stamp
        lowest_px = np.floor(sources.xy_px.min(axis=0, initial=0.0) - reach_px)
        near = (self.xy_px > lowest_px).all(axis=1)
        own_px = sources.xy_px - lowest_px
        mean, shot, *_ = _collect(own_px, sigma, self.xy_px[near] - lowest_px, self.flux_e[near], reach_px)
        light, visible = sources.flux_e, sources.visible
        spread = visible * (1.0 - visible) + visible * np.square(sources.fraction_sigma)
        subtracted, subtracted_shot, unsure, own_shot, strength = _collect(
            own_px, sigma, own_px, light * visible, radius + NEIGHBOUR_SIGMAS * sigma, np.square(light) * spread
        )
        without_stars = pixel_variance_e2 / strength
        noise_e = np.sqrt(np.maximum(without_stars + shot, 0.0))
        flux = mean - subtracted + noise_e * rng.standard_normal(len(mean))
        peak = self.flux_e * np.square(pixel_profile(np.zeros(1), sigma, 0)[0][0, 0])
        bright = self.xy_px[peak > saturation_e]
        distance, _ = cKDTree(bright).query(sources.xy_px, distance_upper_bound=radius)
        return Photometry(
            flux_e=flux, variance_e2=without_stars + subtracted_shot, own_shot=own_shot,
            neighbour_variance_e2=unsure, usable=np.isinf(distance),
        )  # fmt: skip


def _collect(
    xy_px: Array, sigma_px: float, others_px: Array, weight: Array, reach_px: float, square_weight: Array | None = None
) -> Array:
    """Sums (5, n) for the stamps about stars (n, 2), over others (m, 2) within reach; no position is negative.

    Rows of the result: parts of the others' light that the stamps collect, times `weight`; the variance that
    each of their electrons adds, times `weight`; squares of the parts, times `square_weight`; the variance that each
    electron of the star itself adds; the strength of the fit. Others with a `square_weight` are the stars themselves.
    """
    size_px = np.maximum(xy_px.max(axis=0, initial=0.0), others_px.max(axis=0, initial=0.0)) + 1.0
    order, first, columns = order_by_cell(others_px, (int(size_px[1]), int(size_px[0])), reach_px)
    number = np.full(len(order), -1) if square_weight is None else order
    squares = np.zeros(len(order)) if square_weight is None else square_weight[order]
    found, beyond = np.empty((len(xy_px), 5)), int(reach_px) + 2
    profiles = np.pad(neighbour_profiles(sigma_px), ((0, 0), (beyond, beyond)))
    others_px = others_px[order]
    _collect_light(
        xy_px, *profiles_of(xy_px, profiles), others_px, *profiles_of(others_px, profiles), number, weight[order],
        squares, first, columns, reach_px, reach_px, half_width(sigma_px), found,
    )  # fmt: skip
    return np.ascontiguousarray(found.T)


_SIDES = ("across: float32[{0}, wide]", "down: float32[{0}, wide]", "centre: int64[{0}, 2]")
_collect_light = kernel(
    "collect_light", "xy_px: float64[n, 2]", *(side.format("n") for side in _SIDES), "others_px: float64[m, 2]",
    *(f"others_{side.format('m')}" for side in _SIDES), "number: int64[m]", "weight: float64[m]",
    "square_weight: float64[m]", "first: int64[cells + 1]", "columns: int64", "side_px: float64", "reach_px: float64",
    "radius: int64", "found: out float64[n, 5]",
)  # fmt: skip


class SeenGround(ForwardingTerrain):
    """The ground `whole` with its horizon traced once, from the position of the camera (2,)."""

    def __init__(self, whole: Terrain, position_m: Array) -> None:
        super().__init__(whole)
        self.skyline = Skyline.trace(position_m, whole)

    without_table = Terrain.without_table  # itself

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation (n,) [rad] at azimuths (n,), whatever the position."""
        return self.skyline(azimuths_rad)


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedStars:
    """The stars of a scene as they shine, and as they are measured."""

    scene: Scene  # its terrain is a `SeenGround`
    shining: Ints  # (m,) of the scene's stars: those that nothing hides
    xy_px: Array  # (m, 2)
    flux_e: Array  # (m,) whole PSF
    noise_e: float  # of a pixel halfway between the axis and the edge of the view
    saturation_e: float  # of a pixel
    catalog: Stars  # at the stated time
    scale: FluxScale
    mask: Mask | None  # of the camera, and of obstacles
    rays: StarRays


def simulate_rays(
    scene: Scene,
    catalog: StarCatalog,
    terrain: Terrain | None = None,
    *,
    time_utc: datetime | None = None,
    time_sigma_s: float | None = TIME_SIGMA_S,
    rng: np.random.Generator,
) -> StarRays:
    """The photometry of the catalogue's stars in the image of a `scene`, drawn without its pixels.

    The scene holds the truth. What the files of the image state is given beside it:

    Args:
        scene: scene with a terrain and a time; its camera has a sensor.
        catalog: list of the stars that are measured.
        terrain: the map (None: the scene's terrain, which is the ground).
        time_utc: the stated time (None: the true one).
        time_sigma_s: its stated error (None: nobody states it).
        rng: generator of the noise.

    Raises BadInput: bad_terrain and no_time where scene or map lack what relates the stars to the ground.
    """
    return simulate_stars(scene, catalog, terrain, time_utc=time_utc, time_sigma_s=time_sigma_s, rng=rng).rays


def simulate_stars(
    scene: Scene, catalog: StarCatalog, terrain: Terrain | None, *, time_utc: datetime | None,
    time_sigma_s: float | None, rng: np.random.Generator,
) -> SimulatedStars:  # fmt: skip
    """The stars of a `scene` and their photometry.

    `catalog`, `terrain`, `time_utc`, `time_sigma_s` [s], `rng` and the errors are those of `simulate_rays`.
    """
    ground = scene.terrain
    if ground is None:
        raise BadInput("bad_terrain", "the scene has no terrain: nothing hides the stars")
    terrain = terrain or ground
    site = require_site(terrain)
    if scene.time_utc is None:
        raise BadInput("no_time", "the time of the scene is not known")
    camera, sensor, when = scene.camera, scene.sensor, time_utc or scene.time_utc
    scene = replace(scene, terrain=SeenGround(ground, scene.position_enu_m[:2]))
    shining, angle_rad = _shining_stars(scene)
    v_mag, error_mag = scene.stars.v_mag[shining], scene.v_error_mag[shining]
    # Noise of a star's flux halfway between the axis and the edge of the view.
    half = 0.5 * scene.camera.max_angle_rad
    ray = np.array([[np.sin(half), 0.0, np.cos(half)]]) @ scene.R_cam_enu
    pixel_e2 = float(_pixel_variance_e2(scene, ray, np.ones(1, dtype=np.bool_))[0])
    typical_e = float(np.sqrt(pixel_e2 * noise_area_px(sensor.psf_sigma_px)))
    zero_mag = 2.5 * float(np.log10(sensor.zero_point_e_per_s * scene.exposure_s))
    rays_icrs = scene.stars.rays_icrs[shining]
    shown_mag = scene.dimmed_mag(v_mag + error_mag, rays_icrs @ scene.R_enu_icrs.T)
    light_e = flux_e(sensor, shown_mag, angle_rad, scene.exposure_s)
    bright = light_e > SCALE_SNR * typical_e
    scale = expected_flux_scale(zero_mag, typical_e, v_mag, error_mag)
    if terrain.air is not None and np.count_nonzero(bright) > SCALE_STARS:
        rays_enu, noise_e = rays_icrs[bright] @ scene.R_enu_icrs.T, np.full(np.count_nonzero(bright), typical_e)
        scale = fit_flux_scale(
            light_e[bright], noise_e, v_mag[bright], rays_icrs[bright] @ scene.R_cam_icrs.T, camera,
            airmass_at(rays_enu, site),
        )  # fmt: skip
    stars, R_enu = apparent_stars(catalog, when, site), R_enu_icrs(site, when)
    mask = add_obstacles(combine_masks(None, camera.mask, camera.size_px), camera, scene.R_cam_enu.T, terrain)
    found = expect_stars(
        camera, stars, list(scene.bodies), scene.R_cam_icrs, R_enu, scale, psf_sigma_px=sensor.psf_sigma_px,
        noise_e=typical_e, mask=mask,
        air=airmass_at(stars.rays_icrs @ R_enu.T, site),
    )  # fmt: skip
    true = np.asarray(stars.rays_icrs[found.star] @ scene.R_enu_icrs.T)  # directions at the true time
    above = _height_above(scene, true)
    sure = np.where(above > 0, CERTAIN_PROBABILITY, 1.0 - CERTAIN_PROBABILITY)
    visible = np.where(np.abs(above) < UNDECIDED_RAD, 0.5, sure)[found.measurable]
    variance = _pixel_variance_e2(scene, true, above > 0)[found.measurable]
    xy_px, _ = camera.project(rays_icrs @ scene.R_cam_icrs.T)
    saturation_e = sensor.gain_e_per_adu * (sensor.saturation_adu - sensor.bias_adu)
    sources = found.sources(visible)
    light = Starlight(xy_px, light_e, sensor.psf_sigma_px).measure(sources, variance, saturation_e, rng=rng)
    measured = mask_unpredictable(StarPhotometer().judge(found, light), terrain)
    sigma_s = TIME_SIGMA_S if time_sigma_s is None else time_sigma_s
    clock = clock_at(site, when, sigma_s, is_stated=time_sigma_s is not None)
    return SimulatedStars(
        scene=scene, shining=shining, xy_px=xy_px, flux_e=light_e, noise_e=float(np.sqrt(pixel_e2)),
        saturation_e=saturation_e, catalog=stars, scale=scale, mask=mask,
        rays=StarRays(terrain=terrain, R_enu_icrs=R_enu, clock=clock, photometry=measured),
    )  # fmt: skip


def _shining_stars(scene: Scene) -> tuple[Ints, Array]:
    """The scene's stars (m,) in the image circle that the ground leaves visible at mid-exposure, and their angles."""
    angle = off_axis_rad(scene.stars.rays_icrs @ scene.R_cam_icrs.T)
    star = np.flatnonzero(angle <= scene.camera.max_angle_rad)
    star = star[_height_above(scene, scene.stars.rays_icrs[star] @ scene.R_enu_icrs.T) > 0]
    return star, angle[star]


def _height_above(scene: Scene, rays_enu: Array) -> Array:
    """Height (n,) [rad] of directions (n, 3) above the true horizon."""
    azimuth, elevation = azel_from_rays(rays_enu)
    return np.asarray(elevation - scene.horizon_rad(azimuth))


def _pixel_variance_e2(scene: Scene, rays_enu: Array, above: Bools) -> Array:
    """Variance (n,) [e^2] of a pixel without stars in directions (n, 3), above the skyline or not."""
    sensor = scene.sensor
    angle = off_axis_rad(rays_enu @ scene.R_cam_enu.T)
    sky = sky_e_per_s(scene.camera, scene.sky_v_mag_arcsec2, angle)
    ground = scene.ground_brightness(azel_from_rays(rays_enu)[0])
    sky = sky * sky_gradient(scene, rays_enu[:, 0], rays_enu[:, 1]) * np.where(above, 1.0, ground)
    rounding = sensor.gain_e_per_adu**2 / 12
    return np.asarray((sky + sensor.dark_e_per_s) * scene.exposure_s + sensor.read_noise_e**2 + rounding)
