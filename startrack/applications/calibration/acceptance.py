"""Acceptance checks of a calibration, and what to do where one fails."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from startrack.applications.calibration.initial_states import fit_attitudes
from startrack.camera import Camera, cap_grid
from startrack.catalog import MOST_BELOW_PART, StarCatalog, is_below_horizon, sky_at
from startrack.core.types import Array, Bools, Ints
from startrack.estimation.adjust import Observations
from startrack.estimation.false_alarm import log_p_value_poisson
from startrack.estimation.frame_matching import Frame, FrameMatches, JointFit, match_frames
from startrack.frames import R_from_rotvec, Site
from startrack.identification import MAX_FALSE_ALARM

MIN_STARS_MATCHED = 40
SMALLEST_FRACTION = 0.6
LARGEST_HELD_OUT_RMS_PX = 1.0
LARGEST_MAP_SIGMA_PX = 0.5
IMAGE_RINGS, IMAGE_SECTORS = 4, 8
STARS_PER_RING = 3
STARS_PER_SECTOR = 2
MIN_IMAGE_SECTORS = IMAGE_SECTORS // 2 + 1
WRONG_ROTATIONS_RAD = tuple(np.radians((-31.0, -17.0, 13.0, 29.0)))  # attitudes at which only chance matches
MIN_CHANCE_MATCHES = 0.5


@dataclass(frozen=True)
class Check:
    """Condition of acceptance, and whether it is met."""

    name: str
    value: float
    limit: str  # in words, such as ">= 40"
    passed: bool
    reason: str  # of the refusal
    advice: str  # which pictures to take


@dataclass(frozen=True, kw_only=True)
class RefusedImage:
    """An image that the calibration does not use."""

    name: str
    reason: str
    message: str


@dataclass(frozen=True, kw_only=True)
class CheckedCamera:
    """A calibrated camera with its acceptance checks."""

    camera: Camera
    checks: tuple[Check, ...]
    refused: tuple[RefusedImage, ...]

    @property
    def failed_checks(self) -> tuple[Check, ...]:
        """The checks that the calibration did not pass."""
        return tuple(check for check in self.checks if not check.passed)

    @property
    def accepted(self) -> bool:
        """Whether the camera may be used."""
        return not self.failed_checks

    @property
    def message(self) -> str:
        """Failed checks and advice; empty where the calibration is accepted."""
        return "; ".join(f"{c.name} is {c.value:.3g}, required {c.limit}: {c.advice}" for c in self.failed_checks)


@dataclass(frozen=True)
class Coverage:
    """The used stars of all frames by ring (equal widths) and sector (clockwise from image right)."""

    ring_edges_rad: Array  # (rings + 1,) to the calibrated angle
    stars: Array  # (rings, sectors) counts
    ring_rms_px: Array  # (rings,) held-out RMS distance; NaN where there is no star
    rms_px: Array  # (rings, sectors) the same


def star_coverage(joint: JointFit) -> Coverage:
    """Counts and held-out residuals of the used stars of all frames within the calibrated angle."""
    camera, used = joint.fit.camera, joint.fit.used
    angle, ring, sector = rings_and_sectors(camera, joint.points.take(used))
    inside = angle <= camera.calibrated_angle_rad
    stars, squared = np.zeros((2, IMAGE_RINGS, IMAGE_SECTORS))
    np.add.at(stars, (ring[inside], sector[inside]), 1.0)
    np.add.at(squared, (ring[inside], sector[inside]), np.sum(joint.fit.held_out_px[used][inside] ** 2, axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return Coverage(
            ring_edges_rad=np.linspace(0.0, camera.calibrated_angle_rad, IMAGE_RINGS + 1),
            stars=stars,
            ring_rms_px=np.sqrt(squared.sum(axis=1) / stars.sum(axis=1)),
            rms_px=np.sqrt(squared / stars),
        )


def rings_and_sectors(camera: Camera, points: Observations) -> tuple[Array, Ints, Ints]:
    """Angle off the axis, ring and sector, each (n,), of observations."""
    angle = camera.angle_rad(points.xy_px)
    ring = np.clip((IMAGE_RINGS * angle / camera.calibrated_angle_rad).astype(int), 0, IMAGE_RINGS - 1)
    offset = points.xy_px - np.asarray(camera.centre_px)
    around = np.arctan2(offset[:, 1], offset[:, 0]) % (2 * np.pi)
    return angle, ring, np.minimum((IMAGE_SECTORS * around / (2 * np.pi)).astype(int), IMAGE_SECTORS - 1)


def joint_log_p_value(joint: JointFit) -> float:
    """Log-probability (natural) that chance gives as many matches as the `joint` fit has.

    The number expected by chance is measured by the same matching at certainly wrong attitudes.
    """
    wrong = (sum(map(len, _rotated_matches(joint, joint.frames, angle))) for angle in WRONG_ROTATIONS_RAD)
    return _log_p_value(sum(map(len, joint.matches)), wrong)


def _log_p_value(found: int, by_chance: Iterable[int]) -> float:
    """Log-probability (natural) that chance gives as many as `found`, by the numbers at certainly wrong attitudes."""
    return log_p_value_poisson(found, max(float(np.mean(list(by_chance))), MIN_CHANCE_MATCHES))


def _rotated_matches(joint: JointFit, frames: Sequence[Frame], rotation_rad: float) -> tuple[FrameMatches, ...]:
    """The matches of `frames` with the lens and the attitudes of a `joint` fit, these rotated by an angle."""
    camera, rotation = joint.fit.camera, R_from_rotvec(np.array([0.0, 0.3 * rotation_rad, rotation_rad]))
    return match_frames(frames, camera, rotation @ joint.fit.R_cam_icrs, camera.calibrated_angle_rad, joint.gate_px)


def _mirrored_residual_px(joint: JointFit) -> float:
    """Median residual [px] of the same stars with the mirror-image camera."""
    camera, points = joint.fit.camera, joint.points.take(joint.fit.used)
    mirrored = replace(camera, mirrored=not camera.mirrored)
    R = fit_attitudes(mirrored, points)
    rays = np.einsum("nij,nj->ni", R[points.image], points.rays_icrs)
    return float(np.median(np.linalg.norm(mirrored.project(rays)[0] - points.xy_px, axis=1)))


def check_acceptance(joint: JointFit) -> tuple[Check, ...]:
    """All checks, the most informative first."""
    fit, matches = joint.fit, joint.matches
    stars = int(fit.used.sum())
    fraction = float(np.average([m.fraction for m in matches], weights=[max(len(m), 1) for m in matches]))
    cover, log10_p = star_coverage(joint), joint_log_p_value(joint) / np.log(10)
    rings = int(np.sum(cover.stars.sum(axis=1) >= STARS_PER_RING))
    sectors = int(np.sum(cover.stars.sum(axis=0) >= STARS_PER_SECTOR))
    return (
        minimum_check("matched stars", stars, MIN_STARS_MATCHED, "not_identified",
                      "expose longer or open the lens, or add more pictures of the clear night sky"),
        minimum_check("matched fraction", fraction, SMALLEST_FRACTION, "inconsistent_evidence",
                      "bright stars lack a source, or bright sources a star: use a clear sky without cloud, "
                      "and check the time and the site"),
        maximum_check("log10 chance of as many matches", log10_p, round(np.log10(MAX_FALSE_ALARM)), "not_identified",
                      "more stars are needed: expose longer, focus better"),
        held_out_check(fit.held_out_rms_px, "sharp stars are needed: focus, expose shorter, keep the camera still"),
        ring_check("rings with stars", rings, "take pictures where stars fill the image from its middle to its edge: "
                   "open sky, no walls"),
        minimum_check("sectors with stars", sectors, MIN_IMAGE_SECTORS, "insufficient_geometry", "add pictures with "
                      "the camera turned about its axis, so that stars fall on the empty side of the image too",
                      f" of {IMAGE_SECTORS}"),
        map_check(fit.camera, "more stars near the edge of the image are needed: add pictures at other attitudes of "
                  "the camera"),
        minimum_check("opposite handedness [px]", _mirrored_residual_px(joint), round(5 * LARGEST_HELD_OUT_RMS_PX),
                      "inconsistent_evidence", "stars on one line do not determine the handedness: add pictures"),
    )  # fmt: skip


def minimum_check(name: str, value: float, least: float, reason: str, advice: str, of: str = "") -> Check:
    """The check that a value is large enough; `of` follows the limit in words."""
    return Check(name, value, f">= {least}{of}", value >= least, reason, advice)


def maximum_check(name: str, value: float, most: float, reason: str, advice: str) -> Check:
    """The check that a value is small enough."""
    return Check(name, value, f"<= {most}", value <= most, reason, advice)


def held_out_check(rms_px: float, advice: str) -> Check:
    """The check that fits predict observations that they do not contain."""
    return maximum_check("held-out RMS [px]", rms_px, LARGEST_HELD_OUT_RMS_PX, "inconsistent_evidence", advice)


def ring_check(name: str, rings: int, advice: str) -> Check:
    """The check that every ring of the image has observations."""
    return Check(name, rings, f"= {IMAGE_RINGS}", rings == IMAGE_RINGS, "insufficient_geometry", advice)


def map_check(camera: Camera, advice: str) -> Check:
    """The check that the projection is determined up to the calibrated angle, where this is inside the frame."""
    grid = cap_grid(camera.calibrated_angle_rad)
    inside = camera.project(grid)[1]
    sigma = float(np.max(camera.projection_sigma_px(grid[inside] if inside.any() else grid)))
    return maximum_check("map sigma [px]", sigma, LARGEST_MAP_SIGMA_PX, "insufficient_geometry", advice)


def horizon_checks(joint: JointFit, catalog: StarCatalog, site: Site | None) -> tuple[Check, ...]:
    """The check that the frames do not show stars below the horizon of their site; none without a site on the Earth.

    The fit has no stars below it: the frames are matched again with the whole `catalog`, and at attitudes at which only
    chance matches. Refraction is left out: stars seen below the stated horizon are high in the true sky.
    """
    if site is None or site.body != "earth":
        return ()
    whole = tuple(replace(f, sky=sky_at(catalog, f.time_utc, None)) for f in joint.frames)

    def seen_below(rotation_rad: float) -> Bools:
        """Whether the matched stars (n,) are below the horizon, at attitudes rotated by an angle."""
        matches = zip(whole, _rotated_matches(joint, whole, rotation_rad), strict=True)
        return np.concatenate([is_below_horizon(f.sky.stars.rays_icrs[m.star], site, f.time_utc) for f, m in matches])

    matched = seen_below(0.0)
    below, part = int(matched.sum()), float(matched.sum() / max(len(matched), 1))
    by_chance = _log_p_value(below, (int(seen_below(angle).sum()) for angle in WRONG_ROTATIONS_RAD))
    return (
        Check("part of stars below the horizon", part, f"<= {MOST_BELOW_PART}",
              by_chance > np.log(MAX_FALSE_ALARM) or part <= MOST_BELOW_PART, "inconsistent_evidence",
              f"{below} of {len(matched)} stars are "
              "below the horizon of this site at this time: check --site (signs) and the time (is it UTC?)"),
    )  # fmt: skip
