"""Calibration and skyline by photographs of the sky; a synthetic image of a pose; the accuracy on a terrain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack import chain
from startrack.applications import calibration, horizon
from startrack.applications.calibration import Calibration
from startrack.camera import Camera
from startrack.catalog import load_catalog
from startrack.chain import Image, Time
from startrack.core import SKY_V_MAG_ARCSEC2
from startrack.core.errors import BadInput
from startrack.core.files import file_stem
from startrack.core.types import Exposure, MeasuredSkyline
from startrack.frames import Site
from startrack.rendering import Series, Truth, load_sky_catalog
from startrack.rendering import render as render_scene
from startrack.terrain import Terrain

if TYPE_CHECKING:
    from astropy.units import Quantity
    from numpy.typing import ArrayLike

    from startrack.applications.prediction import Prediction


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
        site: place on the Earth where the camera stood: refraction is then taken out of the lens.
        name: name of the camera.

    Returns:
        The calibration. Use its `camera` only where `accepted` is true; `checks` lists the conditions.

    Raises:
        BadInput: as `locate`.
        NotIdentified: no image's stars could be identified.
    """
    if camera is None and fov is None:
        raise BadInput("no_calibration", "give fov=, or an approximate camera=")
    start = None if camera is None else chain.load_camera_input(camera)
    exposures = [chain.exposure_input(image, None) for image in images]
    fov_rad = None if fov is None else chain.field_of_view_rad(fov)
    return calibration.calibrate(exposures, load_catalog(), camera=start, fov_rad=fov_rad, site=site, name=name)


def measure_horizon(
    images: Sequence[Image], *, site: Site, camera: str | Camera | None = None, fov: float | Quantity | None = None
) -> MeasuredSkyline:
    """The horizon (obstruction profile) of a fixed camera on the Earth, from photographs of the night sky.

    Args:
        images: as for `locate`, each with its time; those whose stars cannot be identified are left out.
        site: place on the Earth where the camera stands.
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
    exposures = [chain.exposure_input(image, None) for image in images]
    if not exposures:
        raise ValueError("no image is given")
    lens = chain.camera_input(camera, exposures[0]) if fov is None else None
    fov_rad = None if fov is None else chain.field_of_view_rad(fov)
    return horizon.measure_skyline(exposures, load_catalog(), site, camera=lens, fov_rad=fov_rad).skyline


def render(
    camera: str | Camera = "fisheye-2048",
    terrain: str | Terrain = "shackleton-thesis",
    *,
    time: Time = None,
    position_m: tuple[float, float] | None = None,
    heading: float | Quantity | None = None,
    seed: int = 0,
    number: int = 0,
    **settings: Any,
) -> tuple[Exposure, Truth]:
    """A synthetic exposure, and the truth about it. The same arguments give the same pixels.

    Args:
        camera: as for `locate`; it needs a `[sensor]`.
        terrain: as for `locate`.
        time: middle of the exposure, as for `locate`. None: drawn from the seed, like all that is not given.
        position_m: (east, north) from the terrain's origin [m].
        heading: azimuth of the rover's nose: an angle, or degrees.
        seed: seed of sky, sensor and noise.
        number: number of the exposure within the series of this seed.
        settings: further fields of `startrack.rendering.Series`, such as `exposure_s` or `sky_v_mag_arcsec2`.

    Raises:
        BadInput: bad_calibration without a sensor, bad_terrain where no camera can stand there.
        ValueError: `heading` is no angle.
    """
    lens = chain.load_camera_input(camera)
    ground = chain.terrain_input(terrain, None)
    catalog = load_sky_catalog("auto").brighter_than(settings.get("faint_v_mag", Series.faint_v_mag) or np.inf)
    east_m, north_m = position_m if position_m is not None else (None, None)
    series = Series(
        camera=lens,
        terrain=ground,
        seed=seed,
        time_utc=chain.time_input(time),
        east_m=east_m,
        north_m=north_m,
        heading_rad=None if heading is None else chain.angle_rad(heading, "heading") % (2 * np.pi),
        **{"catalog": catalog, **settings},
    )
    scene, rng = series.scene(number, f"{file_stem(ground.name)}-{seed}-{number:03d}")
    return render_scene(scene, rng=rng)


def predict(
    camera: str | Camera,
    terrain: str | Terrain,
    *,
    time: Time | tuple[Time, Time],
    positions_m: ArrayLike | None = None,
    spacing_m: float | None = None,
    exposure: float | Quantity | None = None,
    sky_v_mag_arcsec2: float = SKY_V_MAG_ARCSEC2,
    draws: int = 10,
    seed: int = 0,
    localizer: str = "posterior",
) -> Prediction:
    """Expected accuracy of positions over the search area of a terrain, or at given positions.

    The stars and the light of the sky at the skyline are drawn at every place and located as `locate` does.

    Args:
        camera: as for `locate`; it needs a `[sensor]`.
        terrain: as for `locate`.
        time: middle of the exposures, as for `locate`; of a pair the draws are evenly spaced between both.
        positions_m: (k, 2) east and north from the terrain's origin [m]. None: cells of the search area.
        spacing_m: distance of the cells [m]. None: a tenth of the search area, or a little less.
        exposure: an astropy duration, or seconds. None: a V 6 star on the axis reaches 5 sigma.
        sky_v_mag_arcsec2: diffuse light of the sky.
        draws: number of draws at each place.
        seed: seed of the draws.
        localizer: name of the method of localization, as for `--localizer`.

    Returns:
        The prediction: `positions_m` (k, 2), `cells` (arrays (k,) by name, as the columns of predict.ecsv), `summary`.

    Raises:
        BadInput: as `locate`; bad_calibration without a sensor.
        ValueError: positions of another shape, or where no camera can stand.
    """
    from startrack.applications.prediction import predict_positions

    first, last = time if isinstance(time, tuple) else (time, time)
    start, end = chain.time_input(first), chain.time_input(last)
    if start is None or end is None:
        raise BadInput("no_time", "give time=: the sky depends on it")
    return predict_positions(
        chain.load_camera_input(camera), chain.terrain_input(terrain, None), (start, end), positions_m=positions_m,
        spacing_m=spacing_m, exposure_s=chain.duration_s(exposure), sky_v_mag_arcsec2=sky_v_mag_arcsec2, draws=draws,
        seed=seed, localizer=localizer,
    )  # fmt: skip
