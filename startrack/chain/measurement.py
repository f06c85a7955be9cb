"""The stars of one image, measured, and the position that they show; the same position for simulated stars."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from startrack.catalog import (
    airmass_at,
    apparent_stars,
    has_deep_catalog,
    hipparcos_rows_in_deep,
    load_catalog,
    load_deep_catalog,
)
from startrack.chain.orientation import require_time_and_site
from startrack.chain.stages import FirstLook, Measured, Oriented, Settings, StarFix, StarRays
from startrack.core.types import Array, Detections, Evidence, Fix, Ints, Stars, sector_of
from startrack.evidence import (
    BAND_PX,
    SKYLINE_SIGMAS,
    SURE_SIGMAS,
    FluxScale,
    SkyLight,
    SkylineBand,
    StarPhotometer,
    StarPhotometry,
    add_obstacles,
    filtered_noise_e,
    flux_scale,
    mask_obstacles,
    measure_response,
    take_out_sky_step,
    with_noise_of_blocks,
)  # fmt: skip
from startrack.frames import LOWEST_PREDICTED_RAD, R_enu_icrs, Site
from startrack.localization import (
    DEFAULT_LOCALIZER,
    Localizer,
    clock_at,
    is_noticeable,
    require_localizer,
    settle_steepness,
)
from startrack.terrain import Terrain

LOW_IN_AIR = "low in the air"
NEIGHBOURS_PX = 10.0  # of stars that are measured again: up to this distance from them the PSFs overlap
MOST_SHIFT_PX = SKYLINE_SIGMAS * 0.7  # of a skyline whose step is known where each star is
UNDECIDED_PX = 2.0  # farther from the skyline than this, the fix decides which stars are visible
CERTAIN_PROBABILITY = 0.99  # of being visible, or hidden, for the stars that the fix decides
OPEN_SKY_RAD = np.radians(45.0)  # no skyline is as high, except beside a wall
DEEP_PART = 0.5  # of the light of the stars that only the deep catalogue has
NO_DEEP_STARS = "the image does not show the faint stars of {}: only Hipparcos is used"
COMPLETE_V_MAG = 6.5  # frames with 5 sigma at this magnitude show many stars that Hipparcos lacks
AnyRays = TypeVar("AnyRays", bound=StarRays)


def measure_evidence(oriented: Oriented, terrain: Terrain, settings: Settings) -> Measured:
    """Photometry at every catalogue star in view, above a terrain.

    `oriented` is the exposure with its attitude; its time must be known, as `check_inputs` makes sure. `settings` has
    the photometry, and whether Gaia's stars are used. Raises BadInput (bad_terrain, no_time) where the frame `enu`
    cannot be related to the stars.
    """
    when, site = require_time_and_site(oriented.exposure, terrain)
    R_at_time = R_enu_icrs(site, when)
    masked = replace(oriented, detections=_mask_detections(oriented, terrain, R_at_time))
    used = add_gaia_stars(masked, site) if settings.deep_stars else masked
    note = ""
    scale, photometry = _measure_stars(used, terrain, R_at_time, settings.photometer)
    if used is not masked and not _shows_deep_stars(photometry, used.stars):
        used, note = masked, NO_DEEP_STARS.format(used.catalog_name)
        scale, photometry = _measure_stars(used, terrain, R_at_time, settings.photometer)
    response = None if oriented.damage is None else measure_response(photometry)
    return Measured(
        **vars(used) | {"terrain": terrain, "site": site}, R_enu_icrs=R_at_time, scale=scale, response=response,
        near=settings.near, catalog_note=note,
        clock=clock_at(site, when, oriented.exposure.time_sigma_s, oriented.exposure.time_sigma_is_stated),
        photometry=photometry if response is None else response.correct(photometry),
    )  # fmt: skip


def _mask_detections(oriented: Oriented, terrain: Terrain, R_enu_icrs: Array) -> Detections:
    """The same detections, the pixels of stated obstacles masked; of a damaged image with the noise of its blocks."""
    R_enu_cam = R_enu_icrs @ oriented.attitude_fit.attitude.R_cam_icrs.T
    mask = add_obstacles(oriented.detections.mask, oriented.camera, R_enu_cam, terrain, oriented.exposure.obstacles)
    detections = mask_obstacles(oriented.detections, mask)
    return detections if oriented.damage is None else with_noise_of_blocks(detections)


def _measure_stars(
    oriented: Oriented, terrain: Terrain, R_enu_icrs: Array, photometer: StarPhotometer
) -> tuple[FluxScale, StarPhotometry]:
    """Scale of the light of `oriented` stars by the identified ones, and by it the photometry of all of them."""
    found, stars = oriented.identification, oriented.stars
    scale = flux_scale(
        oriented.detections, oriented.camera, stars, (found.detection, found.star),
        oriented.attitude_fit.attitude.R_cam_icrs, airmass_at(stars.rays_icrs @ R_enu_icrs.T, terrain.site),
    )  # fmt: skip
    return scale, _photometry(oriented, terrain, R_enu_icrs, scale, photometer, oriented.detections)


def add_gaia_stars(oriented: Oriented, site: Site) -> Oriented:
    """Copy with the stars of the deeper Gaia list, if that is installed and the frame is deep enough to need it.

    `site` is where the camera stands, for the aberration. The scale by Hipparcos, through the air, tells how deep the
    frame is; that of the photometry is by the list that is used, above the air. Returns `oriented` itself where nothing
    changes: also with stars that are not the whole shipped catalogue, which are a choice of the caller's.
    """
    found, when = oriented.identification, oriented.exposure.time_utc
    if when is None or not has_deep_catalog() or not np.array_equal(oriented.stars.hip, load_catalog().hip):
        return oriented
    R_cam_icrs = oriented.attitude_fit.attitude.R_cam_icrs
    scale = flux_scale(oriented.detections, oriented.camera, oriented.stars, (found.detection, found.star), R_cam_icrs)
    limiting_mag = scale.zero_mag - 2.5 * np.log10(SURE_SIGMAS * filtered_noise_e(oriented.detections))
    if limiting_mag < COMPLETE_V_MAG:
        return oriented
    deep, row, named = load_deep_catalog(), hipparcos_rows_in_deep(), oriented.names.stars
    return replace(
        oriented,
        catalog_name=deep.name,
        stars=apparent_stars(deep, when, site),
        identification=replace(found, star=row[found.star]),
        names=replace(oriented.names, stars=replace(named, star=row[named.star])),
    )


def _shows_deep_stars(photometry: StarPhotometry, stars: Stars) -> bool:
    """Whether the image shows the stars that Hipparcos lacks, by their light together high above any skyline.

    Synthetic images of Hipparcos alone do not: every one of these stars would then be evidence of a wall.
    """
    high = photometry.usable & (stars.hip[photometry.star] == 0) & (photometry.elevation_rad > OPEN_SKY_RAD)
    if not high.any():
        return True
    expected, weight = photometry.expected_e[high], 1.0 / np.square(photometry.sigma_e[high])
    information = float(weight @ np.square(expected))
    part = float((weight * expected) @ photometry.flux_e[high]) / information
    return part + SURE_SIGMAS / np.sqrt(information) > DEEP_PART


def remeasure_stars(first: FirstLook, band: SkylineBand, light: SkyLight, photometer: StarPhotometer) -> Measured:
    """Copy of the measured stars whose light beside the skyline is measured without the step of the sky's `light`.

    `band` has the pixels beside the skyline of the `first` look, `photometer` measures them.
    """
    known, blocked = first.measured, first.fix.blocked
    stars = known.photometry
    sector = sector_of(stars.azimuth_rad)
    above_px = band.heights_px(stars.azimuth_rad, stars.elevation_rad)
    is_reliable = light.levels.covered[sector] & (band.reach_px[sector] < MOST_SHIFT_PX)
    is_reliable &= band.estimate.is_level(stars.azimuth_rad)
    wanted = (np.abs(above_px) < BAND_PX) & is_reliable
    if blocked is not None:
        wanted &= ~blocked.contain(stars.azimuth_rad)
    around = np.abs(above_px) < BAND_PX + NEIGHBOURS_PX
    # The fix determines the visibility of neighbours better than their faint flux does, except next to the skyline.
    undecided = (np.abs(above_px) < UNDECIDED_PX) | ~is_reliable
    by_fix = np.where(above_px > 0, CERTAIN_PROBABILITY, 1.0 - CERTAIN_PROBABILITY)
    visible = np.where(undecided, 1.0 / (1.0 + np.exp(-stars.llr)), by_fix)
    newer = _photometry(
        known, known.terrain, known.R_enu_icrs, known.scale, photometer, take_out_sky_step(band, light),
        stars.star[around], visible[around],
    )  # fmt: skip
    newer = newer if known.response is None else known.response.correct(newer)
    return replace(known, photometry=stars.replace_stars(newer, stars.star[wanted]))


def _photometry(
    oriented: Oriented,
    terrain: Terrain,
    R_enu_icrs: Array,
    scale: FluxScale,
    photometer: StarPhotometer,
    detections: Detections,
    only: Ints | None = None,
    visible: Array | None = None,
) -> StarPhotometry:
    """Photometry of all stars, or of those with the indices `only`; 0 evidence where the terrain is not known."""
    stars = oriented.stars
    air = airmass_at(stars.rays_icrs @ R_enu_icrs.T, terrain.site)
    found = photometer(
        detections,
        oriented.camera,
        stars if only is None else stars.take(only),
        list(oriented.bodies),
        oriented.attitude_fit.attitude.R_cam_icrs,
        R_enu_icrs,
        scale,
        oriented.attitude_fit.extra_sigma_px,
        visible,
        air if air is None or only is None else air[only],
    )
    found = found if only is None else replace(found, star=only[found.star])
    return mask_unpredictable(found, terrain)


def mask_unpredictable(photometry: StarPhotometry, terrain: Terrain) -> StarPhotometry:
    """The `photometry` without evidence where the `terrain` is not known, and of stars low in the air."""
    rays = photometry.azimuth_rad, photometry.elevation_rad
    if terrain.air is not None:
        photometry = photometry.mask_stars(np.where(rays[1] < LOWEST_PREDICTED_RAD, LOW_IN_AIR, ""))
    return photometry if terrain.is_informative(*rays).all() else photometry.mask_stars(terrain.mask_reason(*rays))


def locate_rays(rays: StarRays, localizer: Localizer | None = None) -> StarFix:
    """The position that explains photometry of stars, found in two passes; `localizer` None: the posterior.

    Raises NotLocated (or another NoSolution of the `localizer`) where the pipeline refuses an image with these `rays`.
    """
    localizer = localizer or require_localizer(DEFAULT_LOCALIZER)
    turned, rough = fix_roughly(rays, localizer)
    turned, fix = fix_again(turned, rough, localizer, turned.evidence())
    return StarFix(**vars(turned), fix=fix)


def fix_roughly(rays: AnyRays, localizer: Localizer) -> tuple[AnyRays, Fix]:
    """The `rays` on ground of the steepness that they show, under the sky of the time that they show; and their fix.

    Raises NotLocated as the `localizer` does.
    """
    rows = replace(rays.evidence(), is_first_look=True)
    on_ground = replace(rays, terrain=settle_steepness(rows, rays.terrain))
    return _fix_position(on_ground, localizer, rows)


def fix_again(rays: AnyRays, rough: Fix, localizer: Localizer, rows: Evidence) -> tuple[AnyRays, Fix]:
    """The `rays` under the sky of the time that `rows` show, and the fix by these, from the points of a `rough` one on.

    A method without a posterior keeps the `rough` fix. Raises NotLocated as the `localizer` does.
    """
    if rough.is_approximate:
        return rays, rough
    support = None if rough.ambiguous else rough.support
    return _fix_position(rays, localizer, replace(rows, support=support))


def _fix_position(rays: AnyRays, localizer: Localizer, rows: Evidence) -> tuple[AnyRays, Fix]:
    """The `rays` under the sky of the time that `rows` show, and the fix by these, which are of the same image.

    In a round crater, where the vertical part of a clock's turn moves the position alone, the sky stays that of the
    stated time.
    """
    fix = localizer(rows, rays.terrain)
    if fix.clock is None or rays.terrain.axisymmetric:
        return rays, fix
    later_s = fix.clock.offset_s - rays.clock.offset_s
    if later_s and is_noticeable(rays.clock, max(abs(later_s), rays.clock.sigma_s), rays.terrain):
        rays = rays.later(later_s, SURE_SIGMAS * fix.clock.sigma_s)
    return rays, fix
