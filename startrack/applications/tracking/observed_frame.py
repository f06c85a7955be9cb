"""From the result of one image to what a track needs of it: a few numbers and rows, without the image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from startrack.applications.tracking.frame_estimate import estimate_frame
from startrack.applications.tracking.track_errors import TrackErrors
from startrack.chain import Located, Measured, Outcome, Refused, last_value
from startrack.core.types import Array, Evidence, Fix, ShownError
from startrack.estimation.observations import FrameEstimate
from startrack.estimation.smoother import SIGMAS_95
from startrack.evidence.sky_levels import SECTORS
from startrack.localization.posterior import MIN_ROW_NATS
from startrack.localization.skyline_profiles import HIGH_RAD, LOW_RAD
from startrack.localization.summary import camera_at
from startrack.terrain import Terrain

MODE_SIGMA_M = 10.0  # of a mode whose circle is not known


@dataclass(frozen=True, eq=False)
class ImageFix:
    """One position by an image alone, as `locate` states it."""

    position_enu_m: Array  # (3,)
    covariance_m2: Array  # (2, 2)
    radius95_m: float
    radius999_m: float
    at_time_m: Array  # (2,) if the stated time is right
    weight: float = 1.0  # probability of the position


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """One image of a track."""

    name: str
    time_utc: datetime
    R_body_enu: Array | None  # (3, 3) from enu; None: no attitude
    modes: tuple[FrameEstimate, ...]  # of the position; empty: refused
    evidence: Evidence | None  # rows about the skyline; None: refused
    fixes: tuple[ImageFix, ...] = ()  # by the image alone, of each mode
    shown: tuple[ShownError, ...] = ()  # errors beyond the defaults of facts that no file states
    reason: str = ""  # of a refusal
    message: str = ""

    @property
    def facts(self) -> frozenset[str]:
        """Facts whose gross error the image shows."""
        return frozenset(one.fact for one in self.shown)


def observe_frame(outcome: Outcome, errors: TrackErrors | None = None, terrain: Terrain | None = None) -> ObservedFrame:
    """The `outcome` of one image as an observation of its position and of the shared `errors`.

    `errors` and `terrain` are those of the track; None: those of the image. Raises ValueError for an image without a
    time, for a fix that states no error (another localizer), and for one that shows a gross error of a fact that is not
    among those of `errors` (see `TrackErrors.with_gross`).
    """
    value, name, when = last_value(outcome), outcome.exposure.name, outcome.exposure.time_utc
    if when is None:
        raise ValueError(f"{name}: an image of a track needs its time")
    R = value.camera.R_body_cam @ value.R_cam_enu if isinstance(value, Measured) else None
    if isinstance(outcome, Refused):
        return ObservedFrame(name, when, R, (), None, reason=str(outcome.reason), message=outcome.message)
    if not isinstance(value, Located):
        return ObservedFrame(name, when, R, (), None)
    if value.fix.search == "approximate":
        raise ValueError(f"{name}: a track needs the localizer posterior")
    terrain = terrain or value.terrain
    if errors is None:
        errors = TrackErrors.of(terrain, value.clock, value.sky_light is not None)
        errors = errors.with_gross(facts_of(value, errors))
    missing = facts_of(value, errors) - errors.gross
    if missing:
        raise ValueError(f"{name}: it shows a gross error of {', '.join(missing)}: it must be shared")
    fixes = _image_fixes(value.fix, terrain)
    rows = _informative_rows(_located_evidence(value), terrain, fixes[0].at_time_m)
    return observe_again(ObservedFrame(name, when, R, (), rows, fixes, value.fix.shown), errors, terrain)


def facts_of(outcome: Outcome, errors: TrackErrors) -> frozenset[str]:
    """Facts among those of `errors` whose gross error an `outcome` shows."""
    shown = outcome.fix.shown if isinstance(outcome, Located) else ()
    return frozenset(one.fact for one in shown) & frozenset(errors.listed.facts)


def observe_again(frame: ObservedFrame, errors: TrackErrors, terrain: Terrain) -> ObservedFrame:
    """The `frame` by its evidence, with these shared `errors`."""
    if frame.evidence is None:
        return frame
    modes = [
        replace(estimate_frame(frame.evidence, terrain, errors, fix.at_time_m, fix.covariance_m2), weight=fix.weight)
        for fix in frame.fixes
    ]
    return replace(frame, modes=tuple(modes))


def _image_fixes(fix: Fix, terrain: Terrain) -> tuple[ImageFix, ...]:
    """The position of a `fix` by one image, or each of several."""
    if not fix.ambiguous:
        position, at = np.asarray(fix.position_enu_m), np.asarray(fix.at_time_m)
        return (ImageFix(position, np.asarray(fix.covariance_m2), fix.radius95_m, fix.radius999_m, at),)
    found = []
    for mode in fix.modes:
        at = np.array([mode.east_m, mode.north_m])
        sigma = mode.radius95_m / SIGMAS_95 if np.isfinite(mode.radius95_m) else MODE_SIGMA_M
        position = np.asarray(camera_at(at, terrain))
        found.append(ImageFix(position, sigma**2 * np.eye(2), mode.radius95_m, mode.radius999_m, at, mode.weight))
    return tuple(found)


def _located_evidence(located: Located) -> Evidence:
    """Rows of the stars and of the sky's light that a position is from, with the errors of the image."""
    stars = replace(located.evidence(), near=None)
    if located.sky_light is None or located.sky_used is None:
        return stars
    light = located.sky_light.evidence(located.sky_used, np.zeros(SECTORS))
    rows = Evidence.concatenate(stars, light) if located.by_stars else light
    return replace(rows, clock=stars.clock, image_errors=located.image_errors)


def _informative_rows(rows: Evidence, terrain: Terrain, position_m: Array) -> Evidence:
    """The rows about the skyline seen from a position (2,) that say something about it."""
    azimuth = np.linspace(0.0, 2 * np.pi, 721)
    above = rows.elevation_rad - np.interp(rows.azimuth_rad, azimuth, terrain.horizon_rad(position_m[None], azimuth))
    kept = (np.abs(rows.llr) > MIN_ROW_NATS) | (rows.extended_nats > MIN_ROW_NATS)
    kept &= np.asarray(terrain.is_informative(rows.azimuth_rad, rows.elevation_rad))
    return rows.take(kept & (above > LOW_RAD) & (above < HIGH_RAD))
