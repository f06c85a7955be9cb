"""From the result of one image to what a track needs of it: a few numbers, without the image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from startrack.evidence.star_offsets import OFFSET_TERMS
from startrack.stages import Located, Measured, Outcome, Refused, last_value
from startrack.terrain import Terrain
from startrack.tracking.frame_estimate import FrameEstimate, estimate_frame, first_guess
from startrack.tracking.shared import STEEPNESS, ImageErrors, SharedErrors
from startrack.types import Array, Bools, Evidence

NEAR_RAD = np.radians(1.5)  # rows within this of the skyline are kept for other exposures of the same position
MODE_SIGMA_M = 10.0  # of a mode of an ambiguous fix, of the first Gaussian
WIDER = 3.0  # standard deviations of a position by another shape of the terrain, of the first Gaussian


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """One image of a track."""

    name: str
    time_utc: datetime
    R_body_enu: Array | None  # (3, 3) from enu; None: no attitude
    modes: tuple[FrameEstimate, ...]  # of the position; empty: refused
    evidence: Evidence | None  # rows near the skyline, above the map's horizon; None: refused
    image_errors: ImageErrors | None = None  # of the rows of the sky's light
    reason: str = ""  # of a refusal
    message: str = ""
    steeper: float = 0.0  # relative, by which the image shows a crater deeper than its file states


def observe_frame(
    outcome: Outcome, shared: SharedErrors | None = None, terrain: Terrain | None = None
) -> ObservedFrame:
    """The `outcome` of one image as an observation of its position and of the errors `shared`.

    `shared` and `terrain` are those of the track; None: those of the image. Raises ValueError for an image without a
    time, for a fix that states no error (another localizer), and for one of another depth than the file's where
    `shared` has no error of the depth (see `TrackSession`).
    """
    value, when = last_value(outcome), outcome.exposure.time_utc
    if when is None:
        raise ValueError(f"{outcome.exposure.name}: an image of a track needs its time")
    R = None
    if isinstance(value, Measured):
        R = value.camera.R_body_cam @ value.R_cam_enu
    if isinstance(outcome, Refused) or not isinstance(value, Located):
        reason = str(outcome.reason) if isinstance(outcome, Refused) else ""
        message = outcome.message if isinstance(outcome, Refused) else ""
        return ObservedFrame(outcome.exposure.name, when, R, (), None, None, reason, message)
    if value.fix.search == "approximate":
        raise ValueError(f"{outcome.exposure.name}: a track needs the localizer posterior")
    terrain = terrain or value.terrain
    shared = shared or SharedErrors.of(terrain, value.clock)
    if value.steeper and STEEPNESS not in shared.names:
        raise ValueError(f"{outcome.exposure.name}: it shows a wrong depth of the crater, which must be shared")
    rows, errors = located_evidence(value)
    errors = errors and errors.without_edge(shared)
    estimates = tuple(_mode_estimates(value, rows, terrain, shared, errors))
    near = rows_near(rows, terrain, estimates)
    return ObservedFrame(outcome.exposure.name, when, R, estimates, near, errors, steeper=value.steeper)


def observe_again(frame: ObservedFrame, shared: SharedErrors, terrain: Terrain) -> ObservedFrame:
    """The `frame` by its evidence, with other shared errors and another error of the terrain's shape."""
    if frame.evidence is None:
        return frame
    modes = []
    for mode in frame.modes:
        spread = WIDER**2 * mode.covariance[:2, :2] + MODE_SIGMA_M**2 * np.eye(2)
        first = first_guess(shared, mode.mean[:2], spread)
        one = estimate_frame(frame.evidence, terrain, shared, *first, frame.image_errors)
        modes.append(replace(one, weight=mode.weight))
    return replace(frame, modes=tuple(modes))


def located_evidence(located: Located) -> tuple[Evidence, ImageErrors | None]:
    """Rows of the stars and of the sky's light above the map's horizon, and the errors of the image in the latter."""
    stars, sky, fit = located.evidence(), located.sky_light, located.skyline_fit
    if sky is None or fit is None:
        return stars, None
    image = ~fit.errors.of_terrain
    raised_px = fit.errors.raised_px[:, image] @ fit.errors.mean[image]
    light = sky.evidence(fit.used, raised_px, located.sky_variance_factor)
    raised_rad = np.where(fit.used[:, None], fit.errors.raised_px[:, image] / sky.px_per_rad[:, None], 0.0)
    errors = ImageErrors(raised_rad, fit.errors.covariance[:OFFSET_TERMS, :OFFSET_TERMS])
    if not located.by_stars:
        return replace(light, clock=stars.clock), errors
    return Evidence.concatenate(stars, light), errors


def _mode_estimates(
    located: Located, rows: Evidence, terrain: Terrain, shared: SharedErrors, errors: ImageErrors | None
) -> Iterator[FrameEstimate]:
    fix = located.fix
    if not fix.ambiguous:
        first = first_guess(shared, fix.position_enu_m[:2], fix.covariance_m2, fix.horizon_error_rad)
        yield estimate_frame(rows, terrain, shared, *first, errors)
        return
    for mode in fix.modes:
        at, spread = np.array([mode.east_m, mode.north_m]), MODE_SIGMA_M**2 * np.eye(2)
        first = first_guess(shared, at, spread, fix.horizon_error_rad)
        yield replace(estimate_frame(rows, terrain, shared, *first, errors), weight=mode.weight)


def rows_near(rows: Evidence, terrain: Terrain, estimates: tuple[FrameEstimate, ...]) -> Evidence:
    """The rows near the skyline seen from one of the modes."""
    return rows.take(np.any([_is_near(rows, terrain, e.mean[:2]) for e in estimates], axis=0))


def _is_near(rows: Evidence, terrain: Terrain, position_m: Array) -> Bools:
    azimuth = np.linspace(0.0, 2 * np.pi, 721)
    horizon = np.interp(rows.azimuth_rad, azimuth, terrain.horizon_rad(position_m[None], azimuth))
    return np.asarray(np.abs(rows.elevation_rad - horizon) < NEAR_RAD)
