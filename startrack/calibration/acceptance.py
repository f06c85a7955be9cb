"""What must be true of a calibration before it is handed out, and what to do where it is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.calibration.initial_camera import attitudes, opposite
from startrack.calibration.matching import match_frame
from startrack.calibration.observations import Observations
from startrack.calibration.region_growing import Joint
from startrack.camera import Camera
from startrack.camera.uncertainty import cap_grid
from startrack.frames import R_from_rotvec
from startrack.types import Array, Ints

FEWEST_MATCHES = 40
FRACTION = 0.6
HELD_OUT_RMS_PX = 1.0
MAP_SIGMA_PX = 0.5
CHANCE = 1e-9
MOST_CERTAIN = -690.0  # natural logarithm
RINGS = 4
SECTORS = 8
STARS_PER_RING = 3
STARS_PER_SECTOR = 2
SECTORS_WANTED = 5
TURNED_RAD = tuple(np.radians((-31.0, -17.0, 13.0, 29.0)))  # skies that cannot match but by chance


@dataclass(frozen=True)
class Gate:
    """One condition."""

    name: str
    value: float
    limit: str  # in words, such as ">= 40"
    passed: bool
    reason: str  # of the refusal
    advice: str  # what pictures to take, or what to look after


class Gated:
    """Whatever was asked for by gates."""

    gates: tuple[Gate, ...]

    @property
    def failed(self) -> tuple[Gate, ...]:
        """The gates that the calibration did not pass."""
        return tuple(gate for gate in self.gates if not gate.passed)

    @property
    def accepted(self) -> bool:
        """Whether the camera may be used."""
        return not self.failed


@dataclass(frozen=True)
class Coverage:
    """Stars by ring and sector of the calibrated cap."""

    ring_edges_rad: Array  # (rings + 1,)
    stars: Array  # (rings, sectors) counts


def coverage(joint: Joint) -> Coverage:
    """Counts of the used stars of all frames: rings of equal width in angle, sectors from image right, clockwise."""
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
    turn = np.arctan2(offset[:, 1], offset[:, 0]) % (2 * np.pi)
    return angle, ring, np.minimum((SECTORS * turn / (2 * np.pi)).astype(int), SECTORS - 1)


def log_chance(joint: Joint) -> float:
    """ln P(as many matches as were found, by chance).

    Measured, not modelled: the same matching at attitudes that are surely wrong.
    """
    from scipy.special import gammainc

    camera, within = joint.fit.camera, joint.fit.camera.calibrated_angle_rad
    found = sum(map(len, joint.matches))
    wrong = [
        sum(
            len(match_frame(frame, camera, R_from_rotvec(np.array([0.0, 0.3 * turn, turn])) @ R, within, joint.gate_px))
            for frame, R in zip(joint.frames, joint.fit.R_cam_icrs, strict=True)
        )
        for turn in TURNED_RAD
    ]
    tail = float(gammainc(max(found, 1), max(float(np.mean(wrong)), 0.5)))  # of a Poisson distribution
    return max(float(np.log(max(tail, 1e-300))), MOST_CERTAIN)


def opposite_rms_px(joint: Joint) -> float:
    """Median distance [px] at which the mirror image's camera puts the same stars."""
    mirrored, points = opposite(joint.fit.camera), joint.points.take(joint.fit.used)
    R = attitudes(mirrored, points)
    rays = np.einsum("nij,nj->ni", R[points.image], points.rays_icrs)
    return float(np.median(np.linalg.norm(mirrored.project(rays)[0] - points.xy_px, axis=1)))


def gates(joint: Joint) -> tuple[Gate, ...]:
    """All conditions, in the order in which a reader should look at them."""
    fit, matches = joint.fit, joint.matches
    stars = int(fit.used.sum())
    fraction = float(np.average([m.fraction for m in matches], weights=[max(len(m), 1) for m in matches]))
    chance = log_chance(joint)
    cover = coverage(joint)
    rings = int(np.sum(cover.stars.sum(axis=1) >= STARS_PER_RING))
    sectors = int(np.sum(cover.stars.sum(axis=0) >= STARS_PER_SECTOR))
    sigma = float(np.max(fit.camera.projection_sigma_px(seen_rays(fit.camera))))
    held = fit.held_out_rms_px
    handed = opposite_rms_px(joint)
    return (
        Gate("matched stars", stars, f">= {FEWEST_MATCHES}", stars >= FEWEST_MATCHES, "not_identified",
             "expose longer or open the lens, or add more pictures of the clear night sky"),
        Gate("matched fraction", fraction, f">= {FRACTION}", fraction >= FRACTION, "inconsistent_evidence",
             "the map leaves bright stars or bright sources without partner: use a clear sky without cloud, "
             "and check the time and the site"),
        Gate("log10 chance of as many matches", chance / np.log(10), "<= -9", chance <= np.log(CHANCE),
             "not_identified", "more stars are needed: expose longer, focus better"),
        Gate("held-out RMS [px]", held, f"<= {HELD_OUT_RMS_PX}", held <= HELD_OUT_RMS_PX,
             "inconsistent_evidence", "sharp stars are needed: focus, expose shorter, keep the camera still"),
        Gate("rings with stars", rings, f"= {RINGS}", rings == RINGS, "insufficient_geometry",
             "take pictures where stars fill the image from its middle to its edge: open sky, no walls"),
        Gate("sectors with stars", sectors, f">= {SECTORS_WANTED} of {SECTORS}", sectors >= SECTORS_WANTED,
             "insufficient_geometry", "add pictures with the camera turned about its axis, so that stars fall on the "
             "empty side of the image too"),
        Gate("map sigma [px]", sigma, f"<= {MAP_SIGMA_PX}", sigma <= MAP_SIGMA_PX, "insufficient_geometry",
             "more stars near the edge of the image are needed: add pictures at other attitudes of the camera"),
        Gate("opposite handedness [px]", handed, f">= {5 * HELD_OUT_RMS_PX:g}", handed >= 5 * HELD_OUT_RMS_PX,
             "inconsistent_evidence", "stars on one line cannot tell an image from its mirror image: add pictures"),
    )  # fmt: skip


def seen_rays(camera: Camera) -> Array:
    """Rays of the calibrated cap that fall into the frame."""
    grid = cap_grid(camera.calibrated_angle_rad)
    inside = camera.project(grid)[1]
    return grid[inside] if inside.any() else grid
