"""Stars and attitude of an exposure: the stages of the pipeline that need no terrain."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from datetime import datetime

import numpy as np

from startrack.camera import REFRACTION_CONTAINED, Camera
from startrack.catalog import StarCatalog, apparent_bodies, apparent_stars, is_below_horizon
from startrack.chain.bright_stars import name_bright_sources
from startrack.chain.second_field import check_single_field
from startrack.chain.sky_state import stating_sky
from startrack.chain.stages import Detected, Identified, Inputs, Oriented, Settings, identified_names
from startrack.core import FIELD_TOLERANCE_1
from startrack.core.types import (
    BadInput,
    Body,
    Detections,
    Exposure,
    Identification,
    Stars,
)  # fmt: skip
from startrack.detection import Detector, image_circle
from startrack.estimation.lens_correction import correct_lens, solve_with_misfit
from startrack.exposure import NO_TIME, are_fractions
from startrack.frames import Site
from startrack.identification import WIDE_FIELD_RAD, NearSky
from startrack.terrain import Terrain, site_of_terrain


def check_inputs(inputs: Inputs) -> None:
    """Raise BadInput (no_time, bad_terrain, bad_calibration, size_mismatch) for `inputs` that do not go together."""
    exposure, camera = inputs.exposure, inputs.camera
    if inputs.terrain is not None:
        require_time_and_site(exposure, inputs.terrain)
    has_air = inputs.terrain is not None and inputs.terrain.air is not None
    if camera is not None and camera.refraction == REFRACTION_CONTAINED and has_air:
        raise BadInput(
            "bad_calibration",
            f"camera {camera.name} was calibrated without a site: its lens contains the refraction of the air, which "
            "would count twice: calibrate with --site LAT,LON[,M]",
        )
    if camera is not None and exposure.size_px != camera.size_px:
        raise BadInput(
            "size_mismatch",
            f"the image is {exposure.size_px[0]} x {exposure.size_px[1]} px, the camera file gives "
            f"{camera.size_px[0]} x {camera.size_px[1]}",
        )


def require_time_and_site(exposure: Exposure, terrain: Terrain) -> tuple[datetime, Site]:
    """Time of an `exposure` and site of a `terrain`. Raises BadInput no_time or bad_terrain without one."""
    if exposure.time_utc is None:
        raise BadInput("no_time", "; ".join([NO_TIME, *exposure.warnings]))
    if terrain.site is None:
        raise BadInput(
            "bad_terrain",
            f"terrain {terrain.name} has no site: an image can be located only on ground whose position on a body is "
            "known",
        )
    return exposure.time_utc, terrain.site


def site_on_earth(exposure: Exposure) -> Site | None:
    """The site of the terrain that the `exposure` names, if it is on the Earth; None where nothing shows that.

    Identification does not need it: a terrain that cannot be read is not its concern.
    """
    if exposure.terrain is None:
        return None
    with suppress(BadInput):
        site = site_of_terrain(exposure.terrain)
        return site if site.body == "earth" else None
    return None


def detect_sources(inputs: Inputs, detector: Detector) -> Detected:
    """Point sources of an exposure. Raises BadInput bad_image for fractions where the camera's levels are in counts.

    `detector` finds them in the exposure of `inputs`; the levels of its camera, if known, convert counts to electrons.
    """
    camera = inputs.camera
    stated = camera is not None and camera.sensor is not None
    if stated and inputs.exposure.saturation_adu is None and are_fractions(inputs.exposure.recorded_adu):
        raise BadInput(
            "bad_image",
            "the pixels are fractions from 0 to 1, and the camera file's gain and levels are for the sensor's counts: "
            "give those (8- or 16-bit integers, or floating point in ADU)",
        )
    with stating_sky(inputs.exposure, on_moon=_on_moon(inputs)):
        detections = detector(inputs.exposure, camera)
    if not isinstance(detections, Detections):
        raise TypeError(
            f"the detector returned {type(detections).__name__}, not Detections: put a function that returns (xy_px, "
            "flux_adu) into startrack.detection.PositionDetector(...)"
        )
    return Detected(**vars(inputs), detections=detections)


def _on_moon(inputs: Inputs) -> bool:
    """Whether the ground is known, and has no air."""
    return inputs.terrain is not None and inputs.terrain.air is None


def identify_stars(
    detected: Detected, camera: Camera, catalog: StarCatalog, settings: Settings, site: Site | None
) -> Identified:
    """Stars of the `catalog` that the point sources `detected` are.

    The identifier of the `settings` finds them, first near their rough attitude. `site` (None: not known) is where
    the `camera` stands. Raises NotIdentified, TooFewStars.
    """
    when, rough = detected.exposure.time_utc, settings.near_attitude
    stars = apparent_stars(catalog, when, site)
    rough_R_cam_icrs = None if rough is None else rough.R_cam_icrs_at(when, site)
    with stating_sky(detected.exposure, detected.detections, camera, stars.v_mag, on_moon=_on_moon(detected)):
        found = settings.identifier(detected.detections, camera, stars, rough_R_cam_icrs)
    bodies = apparent_bodies(site, when) if site is not None and when is not None else ()
    return _identified(detected, camera, stars, bodies, site, found)


def _identified(
    detected: Detected, camera: Camera, stars: Stars, bodies: tuple[Body, ...], site: Site | None,
    found: Identification,
) -> Identified:  # fmt: skip
    """Value after `detected`, with the stars that were `found` and the names of their sources."""
    return Identified(
        **vars(detected) | {"camera": camera}, stars=stars, site=site, identification=found,
        names=identified_names(detected.detections, found, bodies),
    )  # fmt: skip


def identify_unknown_lens(
    detected: Detected, fov_rad: float | tuple[float, float], catalog: StarCatalog, near_sky: NearSky | None,
    site: Site | None,
) -> Identified:  # fmt: skip
    """Stars that the point sources `detected` are, and the camera, from an approximate field of view.

    `detected` has the point sources, `catalog` the stars. `fov_rad` is one field of view, or the smallest and the
    largest. `near_sky` (None: not known) is where the optical axis points, `site` (None: not known) where the camera
    stands: with the time it leaves out the sky below the horizon. Raises NotIdentified, TooFewStars.
    """
    from startrack.identification import identify_unknown_lens as solve

    sources, when = detected.detections, detected.exposure.time_utc
    place = site if when is not None else None
    stars = apparent_stars(catalog, when, place)
    above = np.arange(len(stars))
    if place is not None and when is not None:
        above = np.flatnonzero(~is_below_horizon(stars.rays_icrs, place, when))
    narrowest_rad = float(np.min(fov_rad))
    more = "" if place is None else "; check the site (signs) and the time, as the sky below the horizon is left out"
    is_wide = np.max(fov_rad) * (1 + FIELD_TOLERANCE_1) >= WIDE_FIELD_RAD
    circle = image_circle(sources.background_e) if is_wide else None
    with stating_sky(detected.exposure, sources, v_mag=stars.v_mag, fov_rad=narrowest_rad, more=more):
        found = solve(sources, detected.exposure.size_px, fov_rad, stars.take(above), circle=circle, near_sky=near_sky)
    bodies = apparent_bodies(place, when) if place is not None and when is not None else ()
    identification = replace(found.identification, star=above[found.identification.star])
    return _identified(detected, found.camera, stars, bodies, place, identification)


def solve_orientation(identified: Identified, has_file: bool = True) -> Oriented:
    """Attitude that fits the `identified` stars, with the names of the brightest sources. Raises NotIdentified."""
    oriented = fit_orientation(identified, has_file)
    names = name_bright_sources(
        oriented.detections, oriented.camera, oriented.stars, oriented.identification,
        oriented.attitude_fit.attitude.R_cam_icrs, oriented.bodies, oriented.exposure.time_utc,
    )  # fmt: skip
    return replace(oriented, names=names)


def fit_orientation(identified: Identified, has_file: bool = True) -> Oriented:
    """The attitude that fits the `identified` stars. Raises NotIdentified.

    Where the stars show that the lens differs from its file the value's camera is the corrected one. Without `has_file`
    the identification found the camera by these very stars.
    """
    found, detections = identified.identification, identified.detections
    matches = (
        identified.camera, detections.xy_px[found.detection], detections.covariance_px2[found.detection],
        identified.stars.rays_icrs[found.star], found.R_cam_icrs,
    )  # fmt: skip
    camera, fit, change_px = correct_lens(*matches) if has_file else (*solve_with_misfit(*matches), 0.0)
    corrected = vars(identified) | {"camera": camera}
    return Oriented(**corrected, attitude_fit=fit, lens_change_px=change_px)


def check_one_attitude(oriented: Oriented) -> None:
    """Raise NotLocated (inconsistent_evidence) where the sources of `oriented` show a second attitude, too."""
    refined = replace(oriented.identification, R_cam_icrs=oriented.attitude_fit.attitude.R_cam_icrs)
    check_single_field(oriented.detections, oriented.camera, oriented.stars, refined)
