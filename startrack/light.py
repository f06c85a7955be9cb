"""The light of one image's stars: the catalogue deep enough, a first look, and a second beside the skyline found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.detection import electrons
from startrack.evidence import Skyline, StarLight, flux_scale, known_well, levelled, near_skyline
from startrack.frames import Site, observer_velocity_m_s
from startrack.psf import noise_area_px
from startrack.result import Result, Settings
from startrack.terrain.masks import why_silent
from startrack.types import Array, Detections, Fix, Ints

RELIT_PX, NEIGHBOURS_PX = 12.0, 10.0  # stars this near the skyline are measured again, beside their neighbours
UNDECIDED_PX, CERTAIN = 2.0, 0.99  # farther from the skyline than that the fix decides which stars shine
COMPLETE_V_MAG = 6.5  # 5 sigma: from here on stars that Hipparcos lacks would say much


def deepen(result: Result, site: Site) -> None:
    """Put the deeper list in the catalogue's place if it is installed and the frame is deep enough to need it."""
    from startrack.catalog.gaia import deep_installed, hipparcos_in_deep, load_deep_catalog

    found, when = result.identification, result.exposure.time_utc
    assert result.camera is not None and result.detections is not None and result.stars is not None
    assert found is not None and when is not None
    scale = flux_scale(result.detections, result.camera, result.stars, found)
    noise_e = float(np.median(result.detections.noise_e)) * np.sqrt(noise_area_px(result.detections.psf_sigma_px))
    if scale.zero_mag - 2.5 * np.log10(5.0 * noise_e) < COMPLETE_V_MAG or not deep_installed():
        return
    deep = load_deep_catalog()
    result.stars, result.catalog_name = deep.at(when, observer_velocity_m_s(site, when)), deep.name
    result.identification = replace(found, star=hipparcos_in_deep()[found.star])


def second_look(result: Result, settings: Settings, fix: Fix) -> StarLight | None:
    """The light of the stars beside the skyline once more, now that the step of the sky's own light can be told.

    None where the sky is too dark to show a step.
    """
    assert result.camera is not None and result.detections is not None and result.terrain is not None
    assert result.light is not None and result.attitude_fit is not None and result.R_enu_icrs is not None
    camera, place = result.camera, fix.position_enu_m[:2]
    horizon = Skyline.seen_from(place, result.terrain)
    image, dead = electrons(result.exposure, camera)
    R_cam_enu = result.attitude_fit.attitude.R_cam_icrs @ result.R_enu_icrs.T
    detections = levelled(image, dead, result.detections, camera, R_cam_enu, horizon)
    if detections is result.detections:
        return None
    axes = np.linalg.cholesky(fix.covariance_m2).T
    known = known_well(horizon, [Skyline.seen_from(place + axis, result.terrain) for axis in axes], camera)
    light = result.light
    wanted = near_skyline(light.azimuth_rad, light.elevation_rad, camera, horizon, RELIT_PX) & known(light.azimuth_rad)
    around = near_skyline(light.azimuth_rad, light.elevation_rad, camera, horizon, RELIT_PX + NEIGHBOURS_PX)
    # The fix tells which neighbours shine, better than their own faint light does; beside the skyline only that.
    above = light.elevation_rad - horizon(light.azimuth_rad)
    beside = near_skyline(light.azimuth_rad, light.elevation_rad, camera, horizon, UNDECIDED_PX)
    beside |= ~known(light.azimuth_rad)
    visible = np.where(beside, 1.0 / (1.0 + np.exp(-light.llr)), np.where(above > 0, CERTAIN, 1.0 - CERTAIN))
    newer = first_look(result, settings, detections, light.star[around], visible[around])
    return light.renewed(newer, light.star[wanted])


def first_look(
    result: Result,
    settings: Settings,
    detections: Detections | None = None,
    only: Ints | None = None,
    visible: Array | None = None,
) -> StarLight:
    assert result.camera is not None and result.detections is not None and result.stars is not None
    assert result.identification is not None and result.attitude_fit is not None and result.R_enu_icrs is not None
    image, dead = electrons(result.exposure, result.camera)
    stars = result.stars if only is None else result.stars.take(only)
    light = settings.evidence(
        image,
        dead,
        detections or result.detections,
        result.camera,
        stars,
        result.bodies,
        result.attitude_fit.attitude.R_cam_icrs,
        result.R_enu_icrs,
        flux_scale(result.detections, result.camera, result.stars, result.identification),
        result.attitude_fit.extra_sigma_px,
        visible,
    )
    light = light if only is None else replace(light, star=only[light.star])
    assert result.terrain is not None
    why = why_silent(result.terrain, light.azimuth_rad, light.elevation_rad)
    cause = np.where(light.cause == "", why, light.cause)
    return replace(light, cause=cause, llr=np.where(cause == "", light.llr, 0.0))
