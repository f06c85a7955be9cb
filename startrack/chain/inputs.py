"""Arguments of the library's functions (image, time, camera, terrain, angle) as the values used inside."""

from __future__ import annotations

import math
import os
from collections.abc import Generator
from datetime import UTC, datetime
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from startrack.camera import Camera, load_camera
from startrack.chain.stages import Settings
from startrack.core import MAX_EXPOSURE_S
from startrack.core.types import BadInput, Exposure
from startrack.exposure import check_time_sigma_s, exposure_of, read_exposure, with_facts
from startrack.frames import parse_utc
from startrack.terrain import Terrain, load_terrain, require_terrain

Image: TypeAlias = str | os.PathLike[str] | ArrayLike | Exposure
Time: TypeAlias = Any  # text, datetime, datetime64, astropy Time (not imported for a type alone), or None
MAX_LIST_COLUMNS = 4  # x, y, flux and error: an array (n, 4) is no image


def exposure_input(image: Image, time: Time, time_sigma: Any = None, duration: Any = None) -> Exposure:
    """The exposure of an `image`: a file, an array (H, W) or (H, W, 3), or the exposure itself.

    `time`, `time_sigma` (see `time_sigma_input`) and `duration` (see `duration_s`) replace its own where they are
    given. Pixels that a masked array hides do not count. Raises BadInput (bad_image, no_time), ValueError.
    """
    given: dict[str, Any] = {"time_utc": time_input(time), "time_sigma_s": time_sigma_input(time_sigma)}
    given["exposure_s"] = duration_s(duration)
    if isinstance(image, Exposure):
        return with_facts(image, **given)
    if isinstance(image, str | os.PathLike):
        return read_exposure(image, **given)
    try:
        pixels = np.asanyarray(image)  # a plain array would have lost its mask
        if pixels.dtype == object and pixels.ndim == 0:
            raise TypeError("one object that is no sequence")
    except (TypeError, ValueError) as cause:
        raise BadInput("bad_image", f"{type(image).__name__} is neither a file nor an array of pixels") from cause
    masked = getattr(pixels, "mask", None)  # of numpy's masked arrays and astropy's
    if masked is not None:
        masked = np.broadcast_to(masked, pixels.shape)
        pixels = getattr(pixels, "unmasked", np.ma.getdata(pixels))
    return with_facts(exposure_of(np.asarray(pixels), masked=masked), **given)


def is_list_of_centroids(image: Any) -> bool:
    """Whether an argument `image` is meant as a list of centroids, which need not be a valid one.

    That is any list or iterator of pairs, and an array that is empty, or narrower or lower than any image.
    """
    if isinstance(image, list | tuple | zip | map | Generator):
        return True
    shape = image.shape if isinstance(image, np.ndarray) else None
    return shape is not None and (0 in shape or (len(shape) == 2 and 2 <= min(shape) <= MAX_LIST_COLUMNS))


def time_input(time: Time) -> datetime | None:
    """A `time` as UTC: text, datetime, numpy datetime64 (which has no zone: UTC) or astropy Time (any scale).

    None stays None. Raises BadInput (no_time) for anything else.
    """
    if time is None:
        return None
    if isinstance(time, str):
        return parse_utc(time)
    if isinstance(time, datetime):
        if time.tzinfo is None:
            raise BadInput("no_time", f"{time} has no time zone: give UTC")
        return time.astimezone(UTC)
    if isinstance(time, np.datetime64):
        return parse_utc(str(time))
    moment = _iso_text(time)
    if not isinstance(moment, str):
        raise BadInput("no_time", f"{time!r} is no time: give text, a datetime, a datetime64 or one astropy Time")
    return parse_utc(moment)


def time_sigma_input(time_sigma: Any) -> float | None:
    """Standard deviation of the clock's error [s]: an astropy duration, or seconds; None stays None.

    Raises BadInput (no_time) for anything else, and for a number that is negative or larger than ten days.
    """
    if time_sigma is None:
        return None
    try:
        seconds = time_sigma.to_value("s") if hasattr(time_sigma, "to_value") else time_sigma
        return check_time_sigma_s(seconds, "time_sigma=")
    except (TypeError, ValueError) as cause:
        raise BadInput("no_time", f"{cause}: give seconds or an astropy duration") from cause


def duration_s(duration: Any) -> float | None:
    """The `duration` of an exposure [s]: an astropy duration, or seconds; None stays None.

    Raises ValueError for anything else, and unless it is above 0 s and at most MAX_EXPOSURE_S.
    """
    if duration is None:
        return None
    try:
        seconds = float(duration.to_value("s") if hasattr(duration, "to_value") else duration)
    except (TypeError, ValueError) as cause:
        raise ValueError(f"exposure={duration!r}: give seconds or an astropy duration") from cause
    if not 0 < seconds <= MAX_EXPOSURE_S:
        raise ValueError(f"exposure={duration!r} is not above 0 s and at most {MAX_EXPOSURE_S:g} s")
    return seconds


def _iso_text(time: Any) -> Any:
    """Text of an astropy Time in UTC to the microsecond: its own ends at the millisecond. None for anything else."""
    try:
        moment = getattr(time, "utc", None)
    except Exception as cause:  # astropy's own, such as of a local time or of UT1 beyond its tables
        raise BadInput("no_time", f"{time!r} cannot be turned into UTC: {cause}") from cause
    if moment is None or not hasattr(moment, "isot"):
        return None
    finer = moment.copy()
    finer.precision = 6
    return finer.isot


def camera_input(camera: str | os.PathLike[str] | Camera | None, exposure: Exposure) -> Camera:
    """The `camera`, the one of a file or a shipped name, or the one that the `exposure` names.

    Raises BadInput (no_calibration, bad_calibration).
    """
    reference = camera if camera is not None else exposure.camera
    if reference is None:
        raise BadInput("no_calibration", "no camera is known: give camera=")
    return load_camera_input(reference)


def load_camera_input(reference: str | os.PathLike[str] | Camera) -> Camera:
    """The camera that the `reference` is, or that of its file or shipped name. Raises BadInput as `camera_input`."""
    if isinstance(reference, Camera):
        return reference
    if not isinstance(reference, str | os.PathLike):
        raise BadInput("bad_calibration", f"{type(reference).__name__} is no camera: give a file, a name or a Camera")
    return load_camera(os.fspath(reference))


def terrain_input(terrain: str | os.PathLike[str] | Terrain | None, exposure: Exposure | None) -> Terrain:
    """The `terrain`, the one of a file or a shipped name, or the one that the `exposure` names.

    Raises BadInput (bad_terrain).
    """
    reference = terrain if terrain is not None or exposure is None else exposure.terrain
    if reference is None:
        raise BadInput("bad_terrain", "no terrain is known: give terrain=")
    if isinstance(reference, str | os.PathLike):
        return load_terrain(os.fspath(reference))
    return require_terrain(reference)


def settings_input(settings: Settings | None) -> Settings | None:
    """The `settings`, None for the usual ones. Raises TypeError for anything else."""
    if settings is None or isinstance(settings, Settings):
        return settings
    raise TypeError(
        f"settings= is of type {type(settings).__name__}: give startrack.chain.Settings(...), such as "
        "Settings(detector=Detector(threshold_snr=6.0))"
    )


def field_of_view_rad(fov: Any) -> float:
    """Field of view [rad] of the argument `fov`, an astropy angle or degrees. Raises BadInput (no_calibration)."""
    try:
        size = angle_rad(fov, "fov")
    except ValueError as cause:
        raise BadInput("no_calibration", f"no field of view: {cause}") from cause
    if not 0 < size <= 2 * math.pi:
        raise BadInput("no_calibration", f"fov= is {math.degrees(size):g} degrees: give more than 0, at most 360")
    return size


def angle_rad(angle: Any, argument: str) -> float:
    """Angle [rad] of an astropy `angle` or of degrees. Raises ValueError naming the `argument` where it is neither."""
    try:
        size = float(angle.to_value("rad")) if hasattr(angle, "to_value") else math.radians(angle)
    except (TypeError, ValueError) as cause:
        raise ValueError(f"{argument}={angle!r}: give degrees or an astropy angle") from cause
    if not math.isfinite(size):
        raise ValueError(f"{argument}= is not finite: give degrees or an astropy angle")
    return size
