"""Photographs of the open sky to a camera, and to the skyline of a fixed camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from startrack.applications.calibration import Calibration
from startrack.applications.calibration import calibrate as calibrate_exposures
from startrack.applications.horizon import measure_skyline
from startrack.camera import Camera
from startrack.catalog import load_catalog
from startrack.chain import Image, camera_input, exposure_input, field_of_view_rad, load_camera_input
from startrack.core.errors import BadInput
from startrack.core.types import MeasuredSkyline
from startrack.frames import Site

if TYPE_CHECKING:
    from astropy.units import Quantity


def calibrate(
    images: Sequence[Image],
    *,
    camera: str | Camera | None = None,
    fov: float | Quantity | None = None,
    site: Site | None = None,
    name: str = "camera",
) -> Calibration:
    """A camera from images of the open sky.

    Args:
        images: as for `locate`, each with its time.
        camera: an approximate camera; or give `fov`.
        fov: field of view, as for `identify`.
        site: on the Earth, where the camera stood: refraction is then taken out of the lens.
        name: of the camera.

    Returns:
        The calibration. Use its `camera` only where `accepted` is true; `checks` lists the conditions.

    Raises:
        BadInput: as `locate`.
        NotIdentified: no image's stars could be identified.
    """
    if camera is None and fov is None:
        raise BadInput("no_calibration", "give fov=, or an approximate camera=")
    start = None if camera is None else load_camera_input(camera)
    exposures = [exposure_input(image, None) for image in images]
    fov_rad = None if fov is None else field_of_view_rad(fov)
    return calibrate_exposures(exposures, load_catalog(), camera=start, fov_rad=fov_rad, site=site, name=name)


def measure_horizon(
    images: Sequence[Image],
    *,
    site: Site,
    camera: str | Camera | None = None,
    fov: float | Quantity | None = None,
) -> MeasuredSkyline:
    """The horizon (obstruction profile) of a fixed camera on the Earth, from photographs of the night sky.

    Args:
        images: as for `locate`, each with its time; those whose stars cannot be identified are left out.
        site: on the Earth, where the camera stands.
        camera: as for `locate`; None: `fov`, or the camera that the first image names.
        fov: field of view, as for `identify`.

    Returns:
        Elevation with its sigma at every degree of azimuth; nan where the horizon is unknown.

    Raises:
        ValueError: both `camera` and `fov` are given, no image, or a site that is not on the Earth.
        BadInput: as `locate`.
        NoSolution: the stars of no image are identified.
    """
    if fov is not None and camera is not None:
        raise ValueError("camera= and fov= exclude each other: with fov= the lens is found, with camera= it is known")
    if site.body != "earth":
        raise ValueError(f"site= is on the {site.body}: the horizon is measured on the Earth")
    exposures = [exposure_input(image, None) for image in images]
    if not exposures:
        raise ValueError("no image is given")
    lens = camera_input(camera, exposures[0]) if fov is None else None
    fov_rad = None if fov is None else field_of_view_rad(fov)
    return measure_skyline(exposures, load_catalog(), site, camera=lens, fov_rad=fov_rad).skyline
