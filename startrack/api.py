"""The library's front door: a picture to a solution that prints itself, with astropy's types at the edge."""

from __future__ import annotations

from typing import TYPE_CHECKING

from startrack import pipeline
from startrack.camera import Camera
from startrack.catalog import load_catalog
from startrack.errors import BAD_INPUT_REASONS, BadInput
from startrack.inputs import Picture, When, angle_rad, given_camera, given_exposure, given_settings, given_terrain
from startrack.solution import Solution
from startrack.stages import Outcome, Refused
from startrack.terrain import Terrain

if TYPE_CHECKING:
    from astropy.units import Quantity

__all__ = ["Solution", "detect", "identify", "locate"]

ARGUMENT_OF_FLAG = {"--time UTC": "time="}  # messages of the stages name what the commands take


def locate(
    image: Picture,
    *,
    camera: str | Camera | None = None,
    terrain: str | Terrain | None = None,
    time: When = None,
    settings: pipeline.Settings | None = None,
) -> Solution:
    """Position and attitude from a picture of the stars.

    `image` is a file, an array (H, W) of raw counts, or an Exposure; `camera` and `terrain` are files, names of shipped
    ones, or the objects; `time` is the middle of the exposure: text, datetime, numpy datetime64 or astropy Time (any
    scale). What is not given comes from the image's sidecar or header.

    Raises BadInput for every reason that ends the commands with exit code 4: something is missing (no_time,
    no_calibration, bad_terrain) or cannot be used. A picture that cannot be solved, or fits several places (exit code
    3), gives a Solution that is false and says why. Raises TypeError for other `settings`.
    """
    settings = given_settings(settings)
    exposure = given_exposure(image, time)
    known = given_camera(camera, exposure), given_terrain(terrain, exposure)
    return _solution(pipeline.locate(exposure, *known, load_catalog(), settings), "fix")


def identify(
    image: Picture, *, camera: str | Camera | None = None, time: When = None, fov: float | Quantity | None = None
) -> Solution:
    """Stars and attitude only: no terrain needed, nor a time.

    With `fov` no camera either: an angle, or a number of degrees, good to 10 %; across the image's width below 100
    degrees, else across the image circle. The lens found is then `solution.result.camera`. Raises ValueError where both
    are given, BadInput as `locate` does.
    """
    if fov is not None and camera is not None:
        raise ValueError("camera= and fov= exclude each other: with fov= the lens is found, with camera= it is known")
    exposure = given_exposure(image, time)
    if fov is not None:
        return _solution(pipeline.identify_blind(exposure, angle_rad(fov), load_catalog()), "identification")
    return _solution(pipeline.identify(exposure, given_camera(camera, exposure), load_catalog()), "identification")


def detect(image: Picture, *, camera: str | Camera | None = None) -> Solution:
    """Centroids only; with a camera their fluxes are in electrons. Raises BadInput as `locate` does."""
    exposure = given_exposure(image, None)
    known = camera is not None or exposure.camera is not None
    return _solution(pipeline.detect(exposure, given_camera(camera, exposure) if known else None), "detections")


def _solution(result: Outcome, kind: str) -> Solution:
    """Raises BadInput where the input was at fault, whichever stage found that."""
    if isinstance(result, Refused) and result.reason in BAD_INPUT_REASONS:
        message = result.message
        for flag, argument in ARGUMENT_OF_FLAG.items():
            message = message.replace(flag, argument)
        raise BadInput(result.reason, message)
    return Solution(result, kind)
