"""The whole story of one image: detect, identify, attitude, evidence, position."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from startrack.bodies import bodies
from startrack.camera import Camera
from startrack.detect import Detector, electrons
from startrack.evidence import Skyline, StarEvidence, StarLight, flux_scale, known_well, levelled, near_skyline
from startrack.frames import R_enu_icrs, Site, observer_velocity_m_s
from startrack.identify import Identifier
from startrack.localize import ExactPosterior, Localizer, check_consistency
from startrack.orient import AttitudeFit, solve_attitude
from startrack.psf import noise_area_px
from startrack.terrain import Terrain
from startrack.types import (
    Array,
    Attitude,
    BadInput,
    Body,
    Detections,
    Exposure,
    Fix,
    Identification,
    Ints,
    NoSolution,
    Stars,
)

if TYPE_CHECKING:
    from startrack.catalog import StarCatalog

RELIT_PX, NEIGHBOURS_PX = 12.0, 10.0  # stars this near the skyline are measured again, beside their neighbours
UNDECIDED_PX, CERTAIN = 2.0, 0.99  # farther from the skyline than that the fix decides which stars shine
COMPLETE_V_MAG = 6.5  # 5 sigma: from here on stars that Hipparcos lacks would say much
UNKNOWN_TIME_SIGMA_RAD = np.radians(60 / 3600)  # aberration and proper motion left out
NO_TIME = (
    "the mid-exposure time is not known: give --time UTC, a sidecar NAME.json with time_utc, or a header with it; "
    "nothing is guessed"
)


@dataclass(frozen=True)
class Settings:
    """The stages and their settings; exchange any of them."""

    detector: Detector = field(default_factory=Detector)
    identifier: Identifier = field(default_factory=Identifier)
    evidence: StarEvidence = field(default_factory=StarEvidence)
    localizer: Localizer = field(default_factory=ExactPosterior)
    deep_stars: bool = True  # evidence of Gaia's stars too, where installed and the frame sees deeper than Hipparcos


@dataclass
class Result:
    """What became of one image. Parts that were not reached are None."""

    exposure: Exposure
    camera: Camera | None = None
    terrain: Terrain | None = None
    catalog_name: str = ""
    status: str = "refused"  # ok, ambiguous or refused
    reason: str | None = None
    message: str = ""
    detections: Detections | None = None
    stars: Stars | None = None
    bodies: list[Body] = field(default_factory=list)
    identification: Identification | None = None
    attitude_fit: AttitudeFit | None = None
    R_enu_icrs: Array | None = None
    light: StarLight | None = None
    fix: Fix | None = None
    timing_ms: dict[str, float] = field(default_factory=dict)

    @property
    def attitude(self) -> Attitude | None:
        """Attitude with the error of an unknown time included."""
        if self.attitude_fit is None:
            return None
        attitude = self.attitude_fit.attitude
        if self.exposure.time_utc is not None:
            return attitude
        widened = attitude.covariance_rad2 + UNKNOWN_TIME_SIGMA_RAD**2 * np.eye(3)
        return Attitude(R_cam_icrs=attitude.R_cam_icrs, covariance_rad2=widened)


def locate(
    exposure: Exposure, camera: Camera, terrain: Terrain, catalog: StarCatalog, settings: Settings | None = None
) -> Result:
    """Position and attitude of the camera; a Result with a reason where there is none to stand by."""
    settings = settings or Settings()
    result = Result(exposure=exposure, camera=camera, terrain=terrain, catalog_name=catalog.name)
    with _refusals(result):
        if exposure.time_utc is None:
            raise BadInput("no_time", "; ".join([NO_TIME, *exposure.warnings]))
        _identify(result, catalog, settings, terrain.site)
        result.R_enu_icrs = R_enu_icrs(terrain.site, exposure.time_utc)
        with _timed(result, "evidence"):
            if settings.deep_stars and catalog.name == "hipparcos":
                _deepen(result, terrain.site)
            result.light = _light(result, settings)
        with _timed(result, "locate"):
            evidence = result.light.evidence()
            fix = settings.localizer(evidence, terrain)
        with _timed(result, "evidence"):
            relit = None if fix.ambiguous else _relit(result, settings, fix)
        if relit is not None:
            result.light, evidence = relit, relit.evidence()
            with _timed(result, "locate"):
                fix = settings.localizer(evidence, terrain)
        with _timed(result, "locate"):
            check_consistency(evidence, fix, terrain, getattr(settings.localizer, "compiled", False))
        result.fix = fix
        result.status = "ambiguous" if fix.ambiguous else "ok"
        if fix.ambiguous:
            result.reason, result.message = "ambiguous", f"{len(fix.modes)} places fit the stars"
    return result


def locate_exposure(exposure: Exposure, settings: Settings | None = None) -> Result:
    """`locate` with the camera and the terrain that the exposure names, the time of reading them included.

    Raises BadInput (no_calibration, bad_calibration, bad_terrain) where one is not named or cannot be used.
    """
    from startrack.camera import load_camera
    from startrack.catalog import load_catalog
    from startrack.terrain import load_terrain

    start = clock.perf_counter()
    if exposure.camera is None:
        raise BadInput("no_calibration", "no camera file is known: give -c FILE or a sidecar with camera")
    if exposure.terrain is None:
        raise BadInput("bad_terrain", "no terrain file is known: give -t FILE or a sidecar with terrain")
    camera, terrain = load_camera(exposure.camera), load_terrain(exposure.terrain)
    read_ms = 1e3 * (clock.perf_counter() - start)
    result = locate(exposure, camera, terrain, load_catalog(), settings)
    result.timing_ms["read"] = read_ms
    return result


def identify(
    exposure: Exposure, camera: Camera, catalog: StarCatalog, settings: Settings | None = None, site: Site | None = None
) -> Result:
    """Stars and attitude only. Without a time the catalogue is taken at J2000.0, without aberration."""
    result = Result(exposure=exposure, camera=camera, catalog_name=catalog.name)
    with _refusals(result):
        _identify(result, catalog, settings or Settings(), site)
        result.status = "ok"
    return result


def identify_blind(
    exposure: Exposure, fov_rad: float, catalog: StarCatalog, settings: Settings | None = None
) -> Result:
    """Stars, attitude and lens without a camera file, from an approximate field of view [rad] alone.

    Below 100 degrees that is the angle across the image's width, from there up that of the whole image circle. The lens
    found is the result's camera ("unknown").
    """
    from startrack.identify.blind import identify_blind as solve

    settings = settings or Settings()
    result = Result(exposure=exposure, catalog_name=catalog.name)
    with _refusals(result):
        _take_stars(result, catalog, None)
        assert result.stars is not None
        with _timed(result, "detect"):
            result.detections = settings.detector(exposure, None)
        with _timed(result, "identify"):
            found = solve(result.detections, exposure.size_px, fov_rad, result.stars)
        result.camera, result.identification = found.camera, found.identification
        _solve_attitude(result)
        result.status = "ok"
    return result


def detect(exposure: Exposure, camera: Camera | None, settings: Settings | None = None) -> Result:
    """Centroids only."""
    result = Result(exposure=exposure, camera=camera)
    with _refusals(result), _timed(result, "detect"):
        result.detections = (settings or Settings()).detector(exposure, camera)
        result.status = "ok"
    return result


def _identify(result: Result, catalog: StarCatalog, settings: Settings, site: Site | None) -> None:
    exposure, camera = result.exposure, result.camera
    assert camera is not None
    if exposure.size_px != camera.size_px:
        raise BadInput(
            "size_mismatch",
            f"the image is {exposure.size_px[0]} x {exposure.size_px[1]} px, the camera file says "
            f"{camera.size_px[0]} x {camera.size_px[1]}",
        )
    with _timed(result, "detect"):
        result.detections = settings.detector(exposure, camera)
    with _timed(result, "identify"):
        _take_stars(result, catalog, site)
        assert result.stars is not None
        result.identification = settings.identifier(result.detections, camera, result.stars)
    _solve_attitude(result)


def _take_stars(result: Result, catalog: StarCatalog, site: Site | None) -> None:
    """The catalogue at the exposure's time.

    Without a site the Moon's centre stands in: the Earth's velocity differs by 0.7 arcsec of aberration.
    """
    where = site or Site("moon", 0.0, 0.0)
    when = result.exposure.time_utc
    result.stars = catalog.at(when, observer_velocity_m_s(where, when) if when is not None else None)
    result.bodies = bodies(site, when) if site is not None and when is not None else []


def _solve_attitude(result: Result) -> None:
    found, d = result.identification, result.detections
    assert found is not None and d is not None and result.camera is not None and result.stars is not None
    with _timed(result, "attitude"):
        result.attitude_fit = solve_attitude(
            result.camera,
            d.xy_px[found.detection],
            d.covariance_px2[found.detection],
            result.stars.rays_icrs[found.star],
            found.R_cam_icrs,
        )


def _deepen(result: Result, site: Site) -> None:
    """Put the deeper list in the catalogue's place if it is installed and the frame is deep enough to need it."""
    from startrack.deep_catalog import deep_installed, hipparcos_in_deep, load_deep_catalog

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


def _relit(result: Result, settings: Settings, fix: Fix) -> StarLight | None:
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
    newer = _light(result, settings, detections, light.star[around], visible[around])
    return light.renewed(newer, light.star[wanted])


def _light(
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
    return light if only is None else replace(light, star=only[light.star])


@contextmanager
def _refusals(result: Result) -> Iterator[None]:
    """A refusal of a stage becomes the result's reason and message."""
    try:
        yield
    except (BadInput, NoSolution) as refusal:
        result.status, result.reason, result.message = "refused", refusal.reason, str(refusal)


@contextmanager
def _timed(result: Result, stage: str) -> Iterator[None]:
    start = clock.perf_counter()
    try:
        yield
    finally:
        result.timing_ms[stage] = result.timing_ms.get(stage, 0.0) + 1e3 * (clock.perf_counter() - start)
