"""From one image to the position: detect, identify, orient, measure, localize. Each stage returns a complete value."""

from __future__ import annotations

import time as clock
from datetime import datetime
from typing import TYPE_CHECKING

from startrack.attitude import solve_attitude
from startrack.camera import Camera
from startrack.catalog.bodies import bodies
from startrack.compilation import announce_compilation
from startrack.detection import Detector
from startrack.exposure import are_fractions
from startrack.frames import Site, observer_velocity_m_s
from startrack.identification import Identifier
from startrack.localization import check_consistency
from startrack.measurement import measure_evidence, remeasure_near_skyline, sky_step_at
from startrack.stages import (
    Detected,
    Identified,
    Inputs,
    Located,
    Oriented,
    Refused,
    Run,
    Settings,
    extend,
    with_timing,
)  # fmt: skip
from startrack.terrain import Terrain
from startrack.types import BadInput, Exposure, NoSolution, Stars

if TYPE_CHECKING:
    from startrack.catalog import StarCatalog

__all__ = ["NO_TIME", "Settings", "detect", "identify", "identify_blind", "locate", "locate_exposure"]

NO_TIME = (
    "the mid-exposure time is not known: give --time UTC, a sidecar NAME.json with time_utc, or a header with it; "
    "nothing is guessed"
)
NO_SITE = "terrain {} has no site: an image can be located only on ground whose place on a body is known"
ANYWHERE = Site("moon", 0.0, 0.0)  # stands in for an unknown site: 0.7 arcsec of aberration at most


def locate(
    exposure: Exposure, camera: Camera, terrain: Terrain, catalog: StarCatalog, settings: Settings | None = None
) -> Located | Refused:
    """Position and attitude of the camera, or the reason why there is none.

    `exposure` must have a time and the image size of the `camera`, `terrain` a site; `catalog` is the list of stars.
    `settings` exchanges stages. Bad input of an image makes a refusal too: nothing is raised for an image's sake.
    """
    settings = settings or Settings()
    run = Run(Inputs(exposure=exposure, camera=camera, terrain=terrain, catalog_name=catalog.name))
    try:
        check_inputs(run.reached)
        detected = run.step("detect", detect_sources, run.reached, camera, settings.detector)
        identified = run.step("identify", identify_stars, detected, camera, catalog, settings.identifier, terrain.site)
        oriented = run.step("attitude", solve_orientation, identified)
        measured = run.step("evidence", measure_evidence, oriented, terrain, settings)
        fix = run.time("locate", settings.localizer, measured.evidence(), terrain)
        step = None if fix.ambiguous else run.time("evidence", sky_step_at, measured, fix)
        if step is not None and step.exceeds_noise:
            measured = run.step("evidence", remeasure_near_skyline, measured, fix, step, settings.evidence)
            fix = run.time("locate", settings.localizer, measured.evidence(), terrain)
        if getattr(settings.localizer, "explains_evidence", True):
            run.time("locate", check_consistency, measured.evidence(), fix, terrain)
        sky_mag = step and step.brightness_mag_arcsec2(camera, exposure.exposure_s)
        return run.finish(extend(measured, Located, fix=fix, sky_brightness_mag_arcsec2=sky_mag))
    except (BadInput, NoSolution) as refusal:
        return run.refuse(refusal)


def locate_exposure(exposure: Exposure, settings: Settings | None = None) -> Located | Refused:
    """`locate` with the camera and the terrain that `exposure` names, and `settings`; stage `read` is reading them.

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
    return with_timing(locate(exposure, camera, terrain, load_catalog(), settings), read=read_ms)


def identify(
    exposure: Exposure, camera: Camera, catalog: StarCatalog, settings: Settings | None = None, site: Site | None = None
) -> Oriented | Refused:
    """Stars and attitude only. Without a time the `catalog` is taken at J2000.0, without aberration.

    `exposure` must have the image size of the `camera`; `settings` exchanges stages; `site` (None: not known) adds
    planets and the aberration of the body that it is on.
    """
    settings = settings or Settings()
    run = Run(Inputs(exposure=exposure, camera=camera, catalog_name=catalog.name))
    try:
        check_inputs(run.reached)
        detected = run.step("detect", detect_sources, run.reached, camera, settings.detector)
        identified = run.step("identify", identify_stars, detected, camera, catalog, settings.identifier, site)
        return run.finish(run.step("attitude", solve_orientation, identified))
    except (BadInput, NoSolution) as refusal:
        return run.refuse(refusal)


def identify_blind(
    exposure: Exposure, fov_rad: float, catalog: StarCatalog, settings: Settings | None = None
) -> Oriented | Refused:
    """Stars, attitude and lens of an `exposure` without a camera file, from an approximate field of view alone.

    `fov_rad` [rad] is the angle across the image's width below 100 degrees, from there up that of the whole image
    circle. `catalog` is the list of stars; `settings` has the detector. The lens found is the value's `camera`.
    """
    run = Run(Inputs(exposure=exposure, catalog_name=catalog.name))
    try:
        detected = run.step("detect", detect_sources, run.reached, None, (settings or Settings()).detector)
        identified = run.step("identify", identify_unknown_lens, detected, fov_rad, catalog)
        return run.finish(run.step("attitude", solve_orientation, identified))
    except (BadInput, NoSolution) as refusal:
        return run.refuse(refusal)


def detect(exposure: Exposure, camera: Camera | None, settings: Settings | None = None) -> Detected | Refused:
    """Point sources of an `exposure`; `camera` (None: not known) gives fluxes in electrons, `settings` the detector."""
    run = Run(Inputs(exposure=exposure, camera=camera))
    try:
        return run.finish(run.step("detect", detect_sources, run.reached, camera, (settings or Settings()).detector))
    except (BadInput, NoSolution) as refusal:
        return run.refuse(refusal)


def check_inputs(inputs: Inputs) -> None:
    """Raises BadInput no_time, bad_terrain or size_mismatch for `inputs` that cannot be solved together."""
    exposure, camera, terrain = inputs.exposure, inputs.camera, inputs.terrain
    if terrain is not None and exposure.time_utc is None:
        raise BadInput("no_time", "; ".join([NO_TIME, *exposure.warnings]))
    if terrain is not None and terrain.site is None:
        raise BadInput("bad_terrain", NO_SITE.format(terrain.name))
    if camera is not None and exposure.size_px != camera.size_px:
        raise BadInput(
            "size_mismatch",
            f"the image is {exposure.size_px[0]} x {exposure.size_px[1]} px, the camera file says "
            f"{camera.size_px[0]} x {camera.size_px[1]}",
        )


def detect_sources(inputs: Inputs, camera: Camera | None, detector: Detector) -> Detected:
    """The point sources. Raises BadInput bad_image for fractions where the camera's levels are in counts.

    `detector` finds them in the exposure of `inputs`; with a `camera` its levels turn counts into electrons.
    """
    announce_compilation()
    stated = camera is not None and camera.sensor is not None
    if stated and inputs.exposure.saturation_adu is None and are_fractions(inputs.exposure.pixels_adu):
        raise BadInput(
            "bad_image",
            "the pixels are fractions from 0 to 1, and the camera file's gain and levels are for the sensor's counts: "
            "give those (8- or 16-bit integers, or floating point in ADU)",
        )
    return extend(inputs, Detected, detections=detector(inputs.exposure, camera))


def identify_stars(
    detected: Detected, camera: Camera, catalog: StarCatalog, identifier: Identifier, site: Site | None
) -> Identified:
    """Which of the point sources `detected` is which star of the `catalog`, found by the `identifier`.

    `site` (None: not known) is where the `camera` stands. Raises NotIdentified, TooFewStars.
    """
    when = detected.exposure.time_utc
    stars = stars_at(catalog, when, site)
    return extend(
        detected,
        Identified,
        camera=camera,
        stars=stars,
        bodies=tuple(bodies(site, when)) if site is not None and when is not None else (),
        identification=identifier(detected.detections, camera, stars),
    )


def identify_unknown_lens(detected: Detected, fov_rad: float, catalog: StarCatalog) -> Identified:
    """As `identify_stars`, with the camera found from the approximate field of view `fov_rad` [rad].

    `detected` has the point sources, `catalog` the stars. Raises NotIdentified, TooFewStars.
    """
    from startrack.identification import identify_unknown_lens as solve

    stars = stars_at(catalog, detected.exposure.time_utc, None)
    sources, size_px = detected.detections, detected.exposure.size_px
    found = solve(sources, size_px, fov_rad, stars, background=sources.background_e)
    return extend(
        detected, Identified, camera=found.camera, stars=stars, bodies=(), identification=found.identification
    )


def solve_orientation(identified: Identified) -> Oriented:
    """The attitude that fits the `identified` stars. Raises NotIdentified."""
    found, detections = identified.identification, identified.detections
    fit = solve_attitude(
        identified.camera,
        detections.xy_px[found.detection],
        detections.covariance_px2[found.detection],
        identified.stars.rays_icrs[found.star],
        found.R_cam_icrs,
    )
    return extend(identified, Oriented, attitude_fit=fit)


def stars_at(catalog: StarCatalog, when: datetime | None, site: Site | None) -> Stars:
    """The `catalog` as seen at the time `when` from a `site`; at J2000.0 without aberration where the time is None."""
    return catalog.at(when, observer_velocity_m_s(site or ANYWHERE, when) if when is not None else None)
