"""The functions of the library: images to solutions or to a camera, a pose to an image; with astropy's types."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack import pipeline
from startrack.calibration import Calibration
from startrack.calibration import calibrate as calibrate_exposures
from startrack.camera import Camera
from startrack.catalog import load_catalog
from startrack.errors import BAD_INPUT_REASONS, BadInput
from startrack.files import file_stem
from startrack.frames import Site
from startrack.horizon import measure_skyline
from startrack.inputs import (
    Image,
    Time,
    angle_rad,
    camera_input,
    duration_s,
    exposure_input,
    field_of_view_rad,
    is_list_of_centroids,
    load_camera_input,
    settings_input,
    terrain_input,
    time_input,
)  # fmt: skip
from startrack.orientation import stars_at
from startrack.rendering import Series, Truth, load_sky_catalog
from startrack.rendering import render as render_scene
from startrack.solution import Solution
from startrack.stages import Outcome, Refused, Settings
from startrack.terrain import Terrain
from startrack.tracking import Odometry, Track, TrackSession, read_odometry
from startrack.tracking.track import ODOMETRY_FLOOR_M, ODOMETRY_SIGMA
from startrack.types import Exposure, MeasuredSkyline

if TYPE_CHECKING:
    from astropy.units import Quantity
    from numpy.typing import ArrayLike

    from startrack.identification import IdentifiedCentroids
    from startrack.prediction import Prediction

__all__ = ["calibrate", "detect", "identify", "locate", "measure_horizon", "predict", "render", "track"]

TIME_FLAG, TIME_ARGUMENT = "--time UTC", "time="  # messages of the stages name the flags of the commands


def locate(
    image: Image,
    *,
    camera: str | Camera | None = None,
    terrain: str | Terrain | None = None,
    time: Time = None,
    time_sigma: float | Quantity | None = None,
    settings: Settings | None = None,
) -> Solution:
    """Position and attitude from one image of the stars.

    What is not given comes from the image's sidecar or header.

    Args:
        image: a file, an array (H, W) of raw counts, colours (H, W, 3), or an Exposure.
        camera: a camera file, the name of a shipped one, or the object.
        terrain: a terrain file, the name of a shipped one, or the object.
        time: middle of the exposure: text, aware datetime, numpy datetime64 (UTC) or astropy Time (any scale).
        time_sigma: standard deviation of the clock's error: an astropy duration, or seconds.
        settings: stages to use instead of the usual ones.

    Returns:
        The solution. It is false, with reason and message, where the image cannot be solved or fits several positions
        (exit code 3 of the commands).

    Raises:
        BadInput: something is missing (no_time, no_calibration, bad_terrain) or cannot be used (exit code 4).
        TypeError: `settings` of another type.
    """
    settings = settings_input(settings)
    exposure = exposure_input(image, time, time_sigma)
    known = camera_input(camera, exposure), terrain_input(terrain, exposure)
    return _solution(pipeline.locate(exposure, *known, load_catalog(), settings), "fix")


def track(
    images: Iterable[Image],
    *,
    camera: str | Camera | None = None,
    terrain: str | Terrain | None = None,
    odometry: str | Odometry | None = None,
    odometry_sigma: float = ODOMETRY_SIGMA,
    odometry_floor_m: float = ODOMETRY_FLOOR_M,
    at_rest: bool = False,
    settings: Settings | None = None,
) -> Track:
    """The trajectory of a camera from many images, with the errors that they share.

    Args:
        images: as for `locate`, in any order; they are read one by one.
        camera: as for `locate`.
        terrain: as for `locate`; one for all images.
        odometry: a file (TUM text or a ROS bag), or the object. None: the moves between the images are not known.
        odometry_sigma: standard deviation of a move on each horizontal axis, relative to its length.
        odometry_floor_m: the same, beside that.
        at_rest: the camera did not move.
        settings: stages to use instead of the usual ones.

    Returns:
        The track: `frames`, and the trajectories `smoothed` (by all images) and `filtered` (by those up to each).

    Raises:
        BadInput: as `locate`; bad_odometry; bad_image without images and for one that is given twice; bad_calibration
            for another camera and bad_terrain for another terrain than those of the first image; the reason of the
            first refused image where none has a single position.
    """
    session = TrackSession(
        settings=settings_input(settings) or Settings(), stated_camera=camera, stated_terrain=terrain
    )  # fmt: skip
    for image in images:
        session.add_exposure(exposure_input(image, None))
    moves = odometry if odometry is None or isinstance(odometry, Odometry) else read_odometry(odometry)
    return session.estimate(
        moves, odometry_sigma=odometry_sigma, odometry_floor_m=odometry_floor_m, at_rest=at_rest
    )  # fmt: skip


def identify(
    image: Image,
    *,
    camera: str | Camera | None = None,
    time: Time = None,
    fov: float | Quantity | None = None,
    size_px: tuple[int, int] | None = None,
    flux: ArrayLike | None = None,
    sigma_px: ArrayLike | None = None,
) -> Solution | IdentifiedCentroids:
    """Stars and attitude of an image, or of a list of centroids. Neither terrain nor time is needed.

    Args:
        image: an image, as for `locate`; or centroids, an array (n, 2) or a list of pairs, x and y in px from the
            centre of the top-left pixel.
        camera: the camera, as for `locate`. Of an image it may come from sidecar or header.
        time: middle of the exposure, as for `locate`. None: the catalogue is taken at J2000.0 without aberration.
        fov: instead of a camera, the field of view to 10 %: an angle or degrees; across the frame's width below 100
            degrees, else across the image circle. The lens is then found with the stars.
        size_px: of centroids: width and height of the frame; needed with `fov`, and given with nothing else.
        flux: of centroids: (n,) in any linear unit. None: they are sorted, brightest first.
        sigma_px: of centroids: error per axis, one number or (n,). None: 0.3 px.

    Returns:
        Of an image a Solution, whose `result.camera` is the camera used or found. Of centroids `IdentifiedCentroids`:
        `detection` and `star` (indices), `hip`, `attitude`, `camera`.

    Raises:
        ValueError: both `camera` and `fov` are given, or of centroids neither; arrays of a wrong shape or type; of an
            image `size_px`, `flux` or `sigma_px`; `size_px` with `camera`.
        BadInput: as `locate`.
        NotIdentified: the centroids are not identified.
    """
    if fov is not None and camera is not None:
        raise ValueError("camera= and fov= exclude each other: with fov= the lens is found, with camera= it is known")
    of_list = {"size_px": size_px, "flux": flux, "sigma_px": sigma_px}
    given = [f"{name}=" for name, value in of_list.items() if value is not None]
    if given and isinstance(image, str | os.PathLike | Exposure):
        raise ValueError(f"{' and '.join(given)}: for lists of centroids only, and this is an image")
    if given or is_list_of_centroids(image):
        return _identify_list(image, camera, time, fov, size_px, flux, sigma_px)
    exposure = exposure_input(image, time)
    if fov is not None:
        return _solution(pipeline.identify_blind(exposure, field_of_view_rad(fov), load_catalog()), "identification")
    return _solution(pipeline.identify(exposure, camera_input(camera, exposure), load_catalog()), "identification")


def detect(image: Image, *, camera: str | Camera | None = None) -> Solution:
    """Point sources only.

    Args:
        image: as for `locate`.
        camera: as for `locate`; with one the fluxes are in electrons, else in ADU.

    Raises:
        BadInput: as `locate`.
    """
    exposure = exposure_input(image, None)
    is_known = camera is not None or exposure.camera is not None
    return _solution(pipeline.detect(exposure, camera_input(camera, exposure) if is_known else None), "detections")


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
        seed: of sky, sensor and noise.
        number: of the exposure within the series of this seed.
        settings: further fields of `startrack.rendering.Series`, such as `exposure_s` or `sky_v_mag_arcsec2`.

    Raises:
        BadInput: bad_calibration without a sensor, bad_terrain where no camera can stand there.
        ValueError: `heading` is no angle.
    """
    lens = load_camera_input(camera)
    ground = terrain_input(terrain, None)
    catalog = load_sky_catalog("auto").brighter_than(settings.get("faint_v_mag", Series.faint_v_mag) or np.inf)
    east_m, north_m = position_m if position_m is not None else (None, None)
    series = Series(
        camera=lens,
        terrain=ground,
        seed=seed,
        time_utc=time_input(time),
        east_m=east_m,
        north_m=north_m,
        heading_rad=None if heading is None else angle_rad(heading, "heading") % (2 * np.pi),
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
    sky_v_mag_arcsec2: float = 22.0,
    draws: int = 10,
    seed: int = 0,
    localizer: str = "posterior",
) -> Prediction:
    """Expected accuracy of positions over the search area of a terrain, or at given positions.

    Evidence of the stars is drawn at every place and located as `locate` does with the stars alone.

    Args:
        camera: as for `locate`; it needs a `[sensor]`.
        terrain: as for `locate`.
        time: middle of the exposures, as for `locate`; of a pair the draws are evenly spaced between both.
        positions_m: (k, 2) east and north from the terrain's origin [m]. None: cells of the search area.
        spacing_m: of the cells [m]. None: a tenth of the search area, or a little less.
        exposure: an astropy duration, or seconds. None: a V 6 star on the axis reaches 5 sigma.
        sky_v_mag_arcsec2: diffuse light of the sky.
        draws: at each place.
        seed: of the draws.
        localizer: as `--localizer`.

    Returns:
        The prediction: `positions_m` (k, 2), `cells` (arrays (k,) by name, as the columns of predict.ecsv), `summary`.

    Raises:
        BadInput: as `locate`; bad_calibration without a sensor.
        ValueError: positions of another shape, or where no camera can stand.
    """
    from startrack.prediction import predict_positions

    first, last = time if isinstance(time, tuple) else (time, time)
    start, end = time_input(first), time_input(last)
    if start is None or end is None:
        raise BadInput("no_time", "give time=: the sky depends on it")
    return predict_positions(
        load_camera_input(camera), terrain_input(terrain, None), (start, end), positions_m=positions_m,
        spacing_m=spacing_m, exposure_s=duration_s(exposure), sky_v_mag_arcsec2=sky_v_mag_arcsec2, draws=draws,
        seed=seed, localizer=localizer,
    )  # fmt: skip


def _identify_list(
    xy_px: Any,
    camera: str | Camera | None,
    time: Time,
    fov: float | Quantity | None,
    size_px: tuple[int, int] | None,
    flux: ArrayLike | None,
    sigma_px: ArrayLike | None,
) -> IdentifiedCentroids:
    from startrack.identification import identify_centroids

    if camera is None and (fov is None or size_px is None):
        raise ValueError("centroids: give a camera, or fov= with size_px=")
    return identify_centroids(
        xy_px,
        camera=None if camera is None else load_camera_input(camera),
        fov_rad=None if fov is None else field_of_view_rad(fov),
        size_px=size_px,
        flux=flux,
        sigma_px=sigma_px,
        stars=stars_at(load_catalog(), time_input(time), None),
    )


def _solution(outcome: Outcome, kind: str) -> Solution:
    """Raises BadInput where the input was at fault, whichever stage found that."""
    if isinstance(outcome, Refused) and outcome.reason in BAD_INPUT_REASONS:
        raise BadInput(outcome.reason, outcome.message.replace(TIME_FLAG, TIME_ARGUMENT))
    return Solution(outcome, kind)
