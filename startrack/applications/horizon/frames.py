"""The frames of a fixed camera: identified stars, one lens for all of them, and an attitude for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera, cap_grid
from startrack.catalog import (
    LOWEST_STAR_RAD,
    Sky,
    StarCatalog,
    apparent_bodies,
    is_below_horizon,
    sky_at,
)
from startrack.chain import NearAttitude, Oriented, Refused, Settings, identify, identify_blind
from startrack.core.errors import BadInput, Reason
from startrack.core.limits import TimeLimitReached
from startrack.core.runner import map_in_threads
from startrack.core.types import Array, Body, Detections, Exposure, Ints
from startrack.detection import Damage, find_damage
from startrack.estimation.false_alarm import log_p_value_poisson
from startrack.estimation.fixed_camera import find_disagreeing
from startrack.estimation.frame_matching import JointFit, fit_frames, frame_of, require_body, require_time
from startrack.frames import R_enu_icrs, Site
from startrack.identification import WIDE_FIELD_RAD

Progress = Callable[[str], None]

# Of the names in a picture, anywhere in its field: none of 3,664 names in 17 pictures of one camera was wrong.
WRONG_NAMES_1 = 1e-3
MAX_FALSE_REFUSAL = 1e-5  # probability that wrong names alone are below the horizon of a right site


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """A photograph without identified stars, or with an attitude unlike that of the others, and why."""

    name: str
    reason: Reason
    message: str


@dataclass(frozen=True, kw_only=True, eq=False)
class SkyFrame:
    """Photograph with its attitude above the horizon, and the catalogue in apparent directions."""

    name: str
    detections: Detections
    camera: Camera
    R_cam_icrs: Array  # (3, 3) of apparent directions, refraction included
    R_enu_icrs: Array  # (3, 3)
    attitude_sigma_rad: float  # largest of the three axes
    damage: Damage | None  # what processing did to the pixels; None: nothing shows
    extra_sigma_px: float  # error of predicted pixels per axis
    sky: Sky  # from LOWEST_STAR_RAD up
    bodies: tuple[Body, ...]  # apparent directions, refraction included
    matched_detection: Ints  # (n,)
    matched_star: Ints  # (n,) indices into `sky.stars`

    @property
    def R_cam_enu(self) -> Array:
        """Rotation (3, 3) from enu to the camera."""
        return np.asarray(self.R_cam_icrs @ self.R_enu_icrs.T)


def orient_frames(
    exposures: Sequence[Exposure],
    catalog: StarCatalog,
    site: Site,
    *,
    camera: Camera | None,
    fov_rad: float | None,
    progress: Progress = lambda text: None,
) -> tuple[tuple[SkyFrame, ...], tuple[LeftOut, ...]]:
    """Frames of `exposures` at the `site` by stars of the `catalog`, and those left out: no stars, or another attitude.

    The lens is that of `camera`, or found from `fov_rad`, and then fitted to the stars of all frames in their apparent
    directions. `progress` is called with a text at each step. Raises BadInput (no_time, no_calibration, size_mismatch,
    bad_terrain of another body, inconsistent_evidence where stars below the horizon are seen, or where no majority of
    the exposures shows one attitude).
    """
    if camera is None and fov_rad is None:
        raise BadInput("no_calibration", "no camera is known: give a camera file (-c) or the field of view (--fov)")
    identified: list[Oriented] = []
    left_out: list[LeftOut] = []

    def orient(exposure: Exposure) -> Oriented | Refused:
        require_time(exposure)
        require_body(exposure, site)
        if identified:
            first = identified[0]
            near = NearAttitude.of(first.attitude_fit.attitude.R_cam_icrs, first.exposure.time_utc)
            return identify(exposure, first.camera, catalog, Settings(near_attitude=near))
        if camera is None:
            return identify_blind(exposure, fov_rad or 0.0, catalog)
        return identify(exposure, camera, catalog)

    def take(exposure: Exposure, outcome: Oriented | Refused) -> None:
        if outcome.reason is Reason.TIME_LIMIT:
            raise TimeLimitReached(f"{exposure.name}: {outcome.message}")
        progress(f"identified the stars of {exposure.name}")
        if isinstance(outcome, Oriented):
            _require_above_horizon(outcome, site)
            identified.append(outcome)
        elif outcome.reason.exit_code == Reason.BAD_IMAGE.exit_code:
            raise BadInput(outcome.reason, f"{exposure.name}: {outcome.message}")
        else:
            left_out.append(LeftOut(name=exposure.name, reason=outcome.reason, message=outcome.message))

    others = list(exposures)
    while others and not identified:  # lens and attitude of the first one identified serve for all others
        exposure = others.pop(0)
        take(exposure, orient(exposure))
    for exposure, outcome in zip(others, map_in_threads(orient, others), strict=True):
        take(exposure, outcome)
    if not identified:
        return (), tuple(left_out)
    wrong = find_disagreeing([one.exposure for one in identified], _attitudes(identified), site)
    for k, message in wrong.items():
        name = identified[k].exposure.name
        left_out.append(LeftOut(name=name, reason=Reason.INCONSISTENT_EVIDENCE, message=message))
    identified = [one for k, one in enumerate(identified) if k not in wrong]
    frames = tuple(frame_of(one.exposure, one.detections, catalog, site) for one in identified)
    progress("fitting the lens")
    lead = max(identified, key=lambda one: len(one.identification))
    joint = fit_frames(frames, lead.camera, _attitudes(identified))
    fitted = joint.fit.camera
    edge = fitted.max_angle_rad if camera is None else camera.max_angle_rad
    if camera is None and fov_rad is not None and fov_rad >= WIDE_FIELD_RAD:
        edge = 0.5 * fov_rad
    camera = replace(fitted, max_angle_rad=float(min(edge, fitted.lens.max_invertible_rad)))
    found = (_sky_frame(k, one, joint, camera, catalog, site) for k, one in enumerate(identified))
    return tuple(found), tuple(left_out)


def _attitudes(identified: Sequence[Oriented]) -> Array:
    """Attitudes R_cam_icrs (n, 3, 3) of n exposures."""
    return np.stack([one.attitude_fit.attitude.R_cam_icrs for one in identified])


def _require_above_horizon(one: Oriented, site: Site) -> None:
    """Raise BadInput (inconsistent_evidence) where more identified stars than wrong names are below the horizon."""
    rays, time_utc = one.stars.rays_icrs[one.identification.star], require_time(one.exposure)
    below = int(np.count_nonzero(is_below_horizon(rays, site, time_utc)))
    field = cap_grid(one.camera.max_angle_rad) @ one.attitude_fit.attitude.R_cam_icrs
    seen = is_below_horizon(field, site, time_utc)
    wrong = WRONG_NAMES_1 * len(rays) * (np.count_nonzero(seen) + 1) / (len(seen) + 1)
    if below and log_p_value_poisson(below, wrong) < np.log(MAX_FALSE_REFUSAL):
        raise BadInput(
            "inconsistent_evidence",
            f"{one.exposure.name}: {below} of {len(rays)} identified stars are below the horizon of this site at this "
            "time: check --site (signs) and --time (is it UTC?)",
        )


def _sky_frame(k: int, one: Oriented, joint: JointFit, camera: Camera, catalog: StarCatalog, site: Site) -> SkyFrame:
    time_utc, site = require_time(one.exposure), site.with_air(one.exposure.air)
    sky = sky_at(catalog, time_utc, site, LOWEST_STAR_RAD)
    hip_of_match = joint.frames[k].sky.stars.hip[joint.matches[k].star]
    order = np.argsort(sky.stars.hip)
    return SkyFrame(
        name=one.exposure.name,
        detections=one.detections,
        camera=camera,
        R_cam_icrs=joint.fit.R_cam_icrs[k],
        R_enu_icrs=R_enu_icrs(site, time_utc),
        attitude_sigma_rad=float(np.sqrt(np.max(np.diag(joint.fit.pose_covariance_rad2[k])))),
        damage=find_damage(one.exposure, camera),
        extra_sigma_px=joint.fit.extra_sigma_px,
        sky=sky,
        bodies=apparent_bodies(site, time_utc),
        matched_detection=joint.matches[k].detection,
        matched_star=order[np.searchsorted(sky.stars.hip[order], hip_of_match)],
    )
