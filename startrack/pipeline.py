"""The whole story of one image: detect, identify, attitude, evidence, position."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from startrack.camera import Camera
from startrack.catalog.bodies import bodies
from startrack.exposure import are_fractions
from startrack.frames import R_enu_icrs, Site, observer_velocity_m_s
from startrack.light import deepen, first_look, second_look
from startrack.localization import check_consistency
from startrack.orient import solve_attitude
from startrack.result import Result, Settings
from startrack.terrain import Terrain
from startrack.types import BadInput, Exposure, NoSolution

if TYPE_CHECKING:
    from startrack.catalog import StarCatalog

__all__ = ["NO_TIME", "Result", "Settings", "detect", "identify", "identify_blind", "locate", "locate_exposure"]

NO_TIME = (
    "the mid-exposure time is not known: give --time UTC, a sidecar NAME.json with time_utc, or a header with it; "
    "nothing is guessed"
)


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
                deepen(result, terrain.site)
            result.light = first_look(result, settings)
        with _timed(result, "locate"):
            evidence = result.light.evidence()
            fix = settings.localizer(evidence, terrain)
        with _timed(result, "evidence"):
            relit = None if fix.ambiguous else second_look(result, settings, fix)
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
    from startrack.identification.unknown_lens import identify_blind as solve

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
        _check_counts(exposure, camera)
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
        _check_counts(exposure, camera)
        result.detections = settings.detector(exposure, camera)
    with _timed(result, "identify"):
        _take_stars(result, catalog, site)
        assert result.stars is not None
        result.identification = settings.identifier(result.detections, camera, result.stars)
    _solve_attitude(result)


def _check_counts(exposure: Exposure, camera: Camera | None) -> None:
    """A camera file's levels are in counts: taken for those, fractions from 0 to 1 would all lie below the bias."""
    stated = camera is not None and camera.sensor is not None
    if stated and exposure.saturation_adu is None and are_fractions(exposure.pixels_adu):
        raise BadInput(
            "bad_image",
            "the pixels are fractions from 0 to 1, and the camera file's gain and levels are for the sensor's counts: "
            "give those (8- or 16-bit integers, or floating point in ADU)",
        )


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
