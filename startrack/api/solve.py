"""Functions from images to solutions, and from many images to a track."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack import chain
from startrack.api.solution import Solution
from startrack.applications import tracking
from startrack.applications.tracking import Odometry, Track
from startrack.camera import Camera
from startrack.catalog import apparent_stars, load_catalog
from startrack.chain import Image, NearAttitude, Outcome, Refused, Settings, Time
from startrack.core import MAX_SPEED_M_S, ODOMETRY_FLOOR_M, ODOMETRY_SIGMA
from startrack.core.errors import BAD_INPUT_REASONS, BadInput
from startrack.core.types import Exposure, PositionPrior
from startrack.estimation.observations import OdometryErrors
from startrack.identification import Identifier, NearSky
from startrack.terrain import Terrain

if TYPE_CHECKING:
    from astropy.units import Quantity
    from numpy.typing import ArrayLike

    from startrack.api.centroids import IdentifiedCentroids


def locate(
    image: Image,
    *,
    camera: str | Camera | None = None,
    terrain: str | Terrain | None = None,
    time: Time = None,
    time_sigma: float | Quantity | None = None,
    exposure: float | Quantity | None = None,
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
        exposure: duration of the exposure, in which stars cross the skyline: an astropy duration, or seconds.
        settings: stages to use instead of the usual ones.

    Returns:
        The solution. It is false, with reason and message, where the image cannot be solved or fits several positions
        (exit code 3 of the commands).

    Raises:
        BadInput: something is missing (no_time, no_calibration, bad_terrain) or cannot be used (exit code 4).
        TypeError: `settings` of another type.
        ValueError: `exposure` is no duration above 0 s.
    """
    settings = chain.settings_input(settings)
    picture = chain.exposure_input(image, time, time_sigma, exposure)
    known = chain.camera_input(camera, picture), chain.terrain_input(terrain, picture)
    return _solution(chain.locate(picture, *known, load_catalog(), settings), "fix")


def locate_skyline(
    skyline: str | ArrayLike,
    *,
    terrain: str | Terrain,
    camera: str | Camera | None = None,
    attitude: str | Sequence[float] | None = None,
    heading_sigma: float | Quantity = 0.0,
    tilt_sigma: float | Quantity = 0.0,
    correlation: float | Quantity | None = None,
    near: ArrayLike | None = None,
    time: Time = None,
) -> Solution:
    """Position from a skyline that was measured elsewhere: traced on a photograph, or with a theodolite.

    Args:
        skyline: a file with the columns azimuth_deg, elevation_deg and sigma_deg (as NAME.skyline.ecsv of `locate`),
            or a polyline x_px, y_px[, sigma_px] on a picture; or rows (n, 3) of azimuth, elevation and sigma [deg].
        terrain: as for `locate`.
        camera: camera of a polyline, as for `locate`.
        attitude: of a polyline: a result file of startrack; or azimuth and elevation of the optical axis, and a
            clockwise turn of the camera about it [deg].
        heading_sigma: standard deviation of the attitude's error about the vertical: an angle or degrees; 180: it is
            not known at all.
        tilt_sigma: standard deviation of the attitude's error about each of two level axes.
        correlation: range of azimuth over which errors of heights are alike: an angle or degrees. None: 1 degree.
        near: east, north and sigma (3,) [m] of a prior of the position. None: anywhere in the search area.
        time: only for an `attitude` file without a time.

    Returns:
        The solution; its attitude is None. It is false, with reason and message, where the skyline gives no position.

    Raises:
        BadInput: something is missing or cannot be used (bad_image, no_calibration, bad_terrain, no_time).
        ValueError: sigmas that are no angles.
    """
    when, ground = chain.time_input(time), chain.terrain_input(terrain, None)
    errors = chain.SkylineErrors.of_inputs(
        heading_sigma=heading_sigma, tilt_sigma=tilt_sigma, correlation=correlation
    )  # fmt: skip
    stated = chain.StatedAttitude.of_input(attitude, ground.site, when)
    lens = None if camera is None else chain.load_camera_input(camera)
    prior = None if near is None else PositionPrior(*np.asarray(near, dtype=float).tolist())
    points = chain.skyline_points(skyline, errors, lens, stated, prior)
    name = os.fspath(terrain) if isinstance(terrain, str | os.PathLike) else None
    return _solution(chain.locate_skyline(chain.skyline_exposure(skyline, when, name), points, ground), "fix")


def track(
    images: Iterable[Image],
    *,
    camera: str | Camera | None = None,
    terrain: str | Terrain | None = None,
    odometry: str | Odometry | None = None,
    odometry_sigma: float = ODOMETRY_SIGMA,
    odometry_floor_m: float = ODOMETRY_FLOOR_M,
    max_speed_m_s: float = MAX_SPEED_M_S,
    odometry_time_sigma_s: float = 0.0,
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
        odometry_floor_m: standard deviation [m] that is added to that, whatever the length of the move.
        max_speed_m_s: highest speed of the rover; odometry with a faster move is refused.
        odometry_time_sigma_s: standard deviation of the offset of the odometry's clock from that of the images.
        at_rest: the camera did not move.
        settings: stages to use instead of the usual ones.

    Returns:
        The track: `frames`, and the trajectories `smoothed` (by all images) and `filtered` (by those up to each).

    Raises:
        BadInput: as `locate`; bad_odometry; inconsistent_evidence where two groups of images contradict each other, and
            neither is clearly right; bad_image without images and for one that is given twice; bad_calibration
            for another camera and bad_terrain for another terrain than those of the first image; the reason of the
            first refused image where none has a single position.
    """
    settings = chain.settings_input(settings) or Settings()
    session = tracking.TrackSession(
        settings=settings, stated_camera=camera, stated_terrain=terrain,
        odometry_errors=OdometryErrors(odometry_sigma, odometry_floor_m, max_speed_m_s, odometry_time_sigma_s),
    )  # fmt: skip
    for image in images:
        session.add_exposure(chain.exposure_input(image, None))
    moves = (
        odometry
        if odometry is None or isinstance(odometry, Odometry)
        else tracking.read_odometry(odometry, floor_m=odometry_floor_m)
    )
    return session.estimate(moves, at_rest=at_rest)


def identify(
    image: Image,
    *,
    camera: str | Camera | None = None,
    time: Time = None,
    fov: float | Quantity | None = None,
    size_px: tuple[int, int] | None = None,
    flux: ArrayLike | None = None,
    sigma_px: ArrayLike | None = None,
    near_attitude: ArrayLike | None = None,
    near_sky: ArrayLike | None = None,
) -> Solution | IdentifiedCentroids:
    """Stars and attitude of an image, or of a list of centroids. Neither terrain nor time is needed.

    Args:
        image: an image, as for `locate`; or centroids, an array (n, 2) or a list of pairs, x and y in px from the
            centre of the top-left pixel.
        camera: the camera, as for `locate`. Of an image it may come from sidecar or header.
        time: middle of the exposure, as for `locate`. None: the catalogue is taken at J2000.0 without aberration,
            and 60 arcsec are added to the stated sigma.
        fov: instead of a camera, the field of view to 10 %: an angle or degrees; across the frame's width below 100
            degrees, else across the image circle. The lens is then found with the stars.
        size_px: of centroids: width and height of the frame; needed with `fov`, and given with nothing else.
        flux: of centroids: (n,) in any linear unit. None: they are sorted, brightest first.
        sigma_px: of centroids: error per axis, one number or (n,). None: 0.3 px.
        near_attitude: with a camera, a rough attitude R_cam_icrs (3, 3), some degrees off at most: the stars are sought
            there first, and everywhere if they are not there.
        near_sky: right ascension, declination and radius (3,) in degrees, ICRS: the stars are sought only with the
            optical axis in that part of the sky. With a camera fewer stars suffice.

    Returns:
        Of an image a Solution, whose `result.camera` is the camera used or found. Of centroids `IdentifiedCentroids`:
        `detection` and `star` (indices), `hip`, `attitude`, `camera`.

    Raises:
        ValueError: both `camera` and `fov` are given, or of centroids neither; arrays of a wrong shape or type; of an
            image `size_px`, `flux` or `sigma_px`; `size_px` with `camera`; `near_attitude` that is no rotation;
            `near_sky` that is no part of the sky.
        BadInput: as `locate`.
        NotIdentified: the centroids are not identified.
    """
    if fov is not None and camera is not None:
        raise ValueError("camera= and fov= exclude each other: with fov= the lens is found, with camera= it is known")
    if fov is not None and near_attitude is not None:
        raise ValueError("near_attitude= needs camera=: with fov= the lens is not known")
    near = None if near_attitude is None else NearAttitude.of(near_attitude)
    identifier = Identifier(near_sky=None if near_sky is None else NearSky.from_degrees(near_sky))
    of_list = {"size_px": size_px, "flux": flux, "sigma_px": sigma_px}
    given = [f"{name}=" for name, value in of_list.items() if value is not None]
    if given and isinstance(image, str | os.PathLike | Exposure):
        raise ValueError(f"{' and '.join(given)}: for lists of centroids only, and this is an image")
    if given or chain.is_list_of_centroids(image):
        from startrack.api.centroids import identify_centroids

        if camera is None and (fov is None or size_px is None):
            raise ValueError("centroids: give a camera, or fov= with size_px=")
        xy_px: Any = image
        when = chain.time_input(time)
        return identify_centroids(
            xy_px, camera=None if camera is None else chain.load_camera_input(camera),
            fov_rad=None if fov is None else chain.field_of_view_rad(fov), size_px=size_px, flux=flux,
            sigma_px=sigma_px, stars=None if when is None else apparent_stars(load_catalog(), when, None),
            identifier=identifier, near_R_cam_icrs=None if near is None else near.R_cam_icrs_at(None, None),
        )  # fmt: skip
    exposure = chain.exposure_input(image, time)
    settings = Settings(identifier=identifier, near_attitude=near)
    if fov is not None:
        outcome = chain.identify_blind(exposure, chain.field_of_view_rad(fov), load_catalog(), settings)
    else:
        outcome = chain.identify(exposure, chain.camera_input(camera, exposure), load_catalog(), settings)
    return _solution(outcome, "identification")


def detect(image: Image, *, camera: str | Camera | None = None) -> Solution:
    """Point sources of an image, without their names.

    Args:
        image: as for `locate`.
        camera: as for `locate`; with one the fluxes are in electrons, else in ADU.

    Raises:
        BadInput: as `locate`.
    """
    exposure = chain.exposure_input(image, None)
    is_known = camera is not None or exposure.camera is not None
    lens = chain.camera_input(camera, exposure) if is_known else None
    return _solution(chain.detect(exposure, lens), "detections")


def _solution(outcome: Outcome, kind: str) -> Solution:
    """Solution of an `outcome`. Raises BadInput where the input was at fault, whichever stage found that."""
    if isinstance(outcome, Refused) and outcome.reason in BAD_INPUT_REASONS:  # the stages name flags of the commands
        raise BadInput(outcome.reason, outcome.message.replace("--time UTC", "time="))
    return Solution(outcome, kind)
