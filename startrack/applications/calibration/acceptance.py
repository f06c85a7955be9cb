"""Acceptance checks of a calibration, and what to do where one fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from startrack.applications.calibration.frame import Frame
from startrack.applications.calibration.initial_camera import fit_attitudes, mirror_camera
from startrack.applications.calibration.matching import FrameMatches, match_frame
from startrack.applications.calibration.region_growing import JointFit
from startrack.camera import Camera, cap_grid
from startrack.core.types import Array, Ints
from startrack.estimation.false_alarm import log_p_value_poisson
from startrack.estimation.normal_equations import Observations
from startrack.frames import R_from_rotvec

MIN_MATCHES = 40
SMALLEST_FRACTION = 0.6
LARGEST_HELD_OUT_RMS_PX = 1.0
LARGEST_MAP_SIGMA_PX = 0.5
MAX_FALSE_ALARM = 1e-9
RINGS = 4
SECTORS = 8
STARS_PER_RING = 3
STARS_PER_SECTOR = 2
MIN_SECTORS = 5
WRONG_ROTATIONS_RAD = tuple(np.radians((-31.0, -17.0, 13.0, 29.0)))  # attitudes at which only chance matches
MIN_CHANCE_MATCHES = 0.5


@dataclass(frozen=True)
class Check:
    """One condition of acceptance."""

    name: str
    value: float
    limit: str  # in words, such as ">= 40"
    passed: bool
    reason: str  # of the refusal
    advice: str  # which pictures to take


class Checked:
    """A calibration with its acceptance checks."""

    checks: tuple[Check, ...]

    @property
    def failed_checks(self) -> tuple[Check, ...]:
        """The checks that the calibration did not pass."""
        return tuple(check for check in self.checks if not check.passed)

    @property
    def accepted(self) -> bool:
        """Whether the camera may be used."""
        return not self.failed_checks


@dataclass(frozen=True)
class Coverage:
    """Stars by ring and sector of the calibrated cap."""

    ring_edges_rad: Array  # (rings + 1,)
    stars: Array  # (rings, sectors) counts


def star_coverage(joint: JointFit) -> Coverage:
    """Counts of the used stars of all frames by ring (equal widths) and sector (clockwise from image right)."""
    camera, points = joint.fit.camera, joint.points.take(joint.fit.used)
    angle, ring, sector = rings_and_sectors(camera, points)
    edges = np.linspace(0.0, camera.calibrated_angle_rad, RINGS + 1)
    inside = angle <= camera.calibrated_angle_rad
    stars = np.zeros((RINGS, SECTORS))
    np.add.at(stars, (ring[inside], sector[inside]), 1)
    return Coverage(edges, stars)


def rings_and_sectors(camera: Camera, points: Observations) -> tuple[Array, Ints, Ints]:
    """Angle off the axis, ring and sector, each (n,), of observations."""
    angle = camera.angle_rad(points.xy_px)
    ring = np.clip((RINGS * angle / camera.calibrated_angle_rad).astype(int), 0, RINGS - 1)
    offset = points.xy_px - np.asarray(camera.centre_px)
    around = np.arctan2(offset[:, 1], offset[:, 0]) % (2 * np.pi)
    return angle, ring, np.minimum((SECTORS * around / (2 * np.pi)).astype(int), SECTORS - 1)


def joint_log_p_value(joint: JointFit) -> float:
    """Log-probability (natural) of as many matches by chance.

    The number expected by chance is measured by the same matching at certainly wrong attitudes.
    """
    found = sum(map(len, joint.matches))
    wrong = [sum(map(len, rotated_matches(joint, joint.frames, angle))) for angle in WRONG_ROTATIONS_RAD]
    return log_p_value_poisson(found, max(float(np.mean(wrong)), MIN_CHANCE_MATCHES))


def rotated_matches(joint: JointFit, frames: Sequence[Frame], rotation_rad: float) -> list[FrameMatches]:
    """The matches of `frames` with the lens and the attitudes of a `joint` fit, these rotated by an angle."""
    camera, rotation = joint.fit.camera, R_from_rotvec(np.array([0.0, 0.3 * rotation_rad, rotation_rad]))
    return [
        match_frame(frame, camera, rotation @ R, camera.calibrated_angle_rad, joint.gate_px)
        for frame, R in zip(frames, joint.fit.R_cam_icrs, strict=True)
    ]


def mirrored_residual_px(joint: JointFit) -> float:
    """Median residual [px] of the same stars with the mirror-image camera."""
    mirrored, points = mirror_camera(joint.fit.camera), joint.points.take(joint.fit.used)
    R = fit_attitudes(mirrored, points)
    rays = np.einsum("nij,nj->ni", R[points.image], points.rays_icrs)
    return float(np.median(np.linalg.norm(mirrored.project(rays)[0] - points.xy_px, axis=1)))


def check_acceptance(joint: JointFit) -> tuple[Check, ...]:
    """All checks, the most informative first."""
    fit, matches = joint.fit, joint.matches
    stars = int(fit.used.sum())
    fraction = float(np.average([m.fraction for m in matches], weights=[max(len(m), 1) for m in matches]))
    log_p = joint_log_p_value(joint)
    cover = star_coverage(joint)
    rings = int(np.sum(cover.stars.sum(axis=1) >= STARS_PER_RING))
    sectors = int(np.sum(cover.stars.sum(axis=0) >= STARS_PER_SECTOR))
    sigma = float(np.max(fit.camera.projection_sigma_px(calibrated_rays(fit.camera))))
    held = fit.held_out_rms_px
    mirrored = mirrored_residual_px(joint)
    return (
        Check("matched stars", stars, f">= {MIN_MATCHES}", stars >= MIN_MATCHES, "not_identified",
             "expose longer or open the lens, or add more pictures of the clear night sky"),
        Check("matched fraction", fraction, f">= {SMALLEST_FRACTION}", fraction >= SMALLEST_FRACTION,
             "inconsistent_evidence",
             "bright stars lack a source, or bright sources a star: use a clear sky without cloud, "
             "and check the time and the site"),
        Check("log10 chance of as many matches", log_p / np.log(10), "<= -9", log_p <= np.log(MAX_FALSE_ALARM),
             "not_identified", "more stars are needed: expose longer, focus better"),
        Check("held-out RMS [px]", held, f"<= {LARGEST_HELD_OUT_RMS_PX}", held <= LARGEST_HELD_OUT_RMS_PX,
             "inconsistent_evidence", "sharp stars are needed: focus, expose shorter, keep the camera still"),
        Check("rings with stars", rings, f"= {RINGS}", rings == RINGS, "insufficient_geometry",
             "take pictures where stars fill the image from its middle to its edge: open sky, no walls"),
        Check("sectors with stars", sectors, f">= {MIN_SECTORS} of {SECTORS}", sectors >= MIN_SECTORS,
             "insufficient_geometry", "add pictures with the camera turned about its axis, so that stars fall on the "
             "empty side of the image too"),
        Check("map sigma [px]", sigma, f"<= {LARGEST_MAP_SIGMA_PX}", sigma <= LARGEST_MAP_SIGMA_PX,
             "insufficient_geometry",
             "more stars near the edge of the image are needed: add pictures at other attitudes of the camera"),
        Check("opposite handedness [px]", mirrored, f">= {5 * LARGEST_HELD_OUT_RMS_PX:g}",
             mirrored >= 5 * LARGEST_HELD_OUT_RMS_PX,
             "inconsistent_evidence", "stars on one line do not determine the handedness: add pictures"),
    )  # fmt: skip


def calibrated_rays(camera: Camera) -> Array:
    """Rays (n, 3) of the calibrated cap that fall into the frame."""
    grid = cap_grid(camera.calibrated_angle_rad)
    inside = camera.project(grid)[1]
    return grid[inside] if inside.any() else grid
