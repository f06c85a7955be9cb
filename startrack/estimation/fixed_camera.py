"""Agreement of the pictures of a fixed camera: in the local frame it has one attitude, if times and site are right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from startrack.core.errors import BadInput
from startrack.core.types import Array, Bools, Exposure
from startrack.estimation.frame_matching import require_time
from startrack.frames import R_enu_icrs, Site

# Of a fixed camera between pictures, on each axis; a real one moved by 0.02 degrees in five weeks.
MOVED_SIGMA_RAD = np.radians(0.05)
WRONG_PICTURE_PROBABILITY = 1e-3  # of a wrong time or place; any attitude is then as probable
ALL_ROTATIONS_RAD3 = 8.0 * np.pi**2  # volume of the rotations
ALL_DIRECTIONS_SR = 4.0 * np.pi


def turns_rad(R: Array) -> Array:
    """Angles (n, n) [rad] between rotations (n, 3, 3)."""
    sine = np.sqrt(np.square(R[:, None] - R).sum(axis=(2, 3)) / 8.0)  # of half the angle
    return np.asarray(2.0 * np.arcsin(np.minimum(sine, 1.0)))


def log_odds_fixed(turn_rad: Array) -> Array:
    """Logarithm of the odds that two pictures, turned by (...) [rad], are right, against that one of them is wrong."""
    variance = 2.0 * MOVED_SIGMA_RAD**2
    prior = np.log1p(-WRONG_PICTURE_PROBABILITY) - np.log(WRONG_PICTURE_PROBABILITY) + np.log(ALL_ROTATIONS_RAD3)
    return np.asarray(prior - 1.5 * np.log(2.0 * np.pi * variance) - 0.5 * np.square(turn_rad) / variance)


def log_odds_kept(apart_rad: Array) -> Array:
    """Logarithm of the odds that a direction, (...) [rad] apart among the pixels of two pictures, is the same one.

    The alternative is a camera that was moved, to any attitude.
    """
    variance = 2.0 * MOVED_SIGMA_RAD**2
    prior = np.log(WRONG_PICTURE_PROBABILITY) + np.log(ALL_DIRECTIONS_SR)
    return np.asarray(prior - np.log(2.0 * np.pi * variance) - 0.5 * np.square(apart_rad) / variance)


def are_shifted_in_time(R_cam_icrs: Array, R_cam_enu: Array, site: Site) -> Bools:
    """Whether pairs (n, n) of pictures are turned about the celestial pole, as a wrong time turns them.

    `R_cam_icrs` and `R_cam_enu` (n, 3, 3) are rotations to the camera; the latter by the stated times at the `site`. A
    camera that follows the stars, and one that is turned about the vertical near a pole, turn so by themselves.
    """
    pole_enu = np.array([0.0, np.cos(site.latitude_rad), np.sin(site.latitude_rad)])

    def kept(rays: Array) -> Bools:
        half_chord = 0.5 * np.linalg.norm(rays[:, None] - rays, axis=2)
        return np.asarray(log_odds_kept(2.0 * np.arcsin(np.minimum(half_chord, 1.0))) > 0.0)

    turned = log_odds_fixed(turns_rad(R_cam_enu)) <= 0.0
    follows = log_odds_fixed(turns_rad(R_cam_icrs)) > 0.0
    return turned & kept(R_cam_enu @ pole_enu) & ~kept(R_cam_enu[:, :, 2]) & ~follows


def find_disagreeing(
    exposures: Sequence[Exposure], R_cam_icrs: Array, site: Site, *, may_move: bool = False
) -> dict[int, str]:
    """Indices of the `exposures` that disagree with most others by their times at the `site`, each with the reason.

    `R_cam_icrs` (n, 3, 3) are their attitudes. Where the camera `may_move` between pictures, only those disagree that a
    wrong time turns against others. Raises BadInput (no_time; inconsistent_evidence where no more than half agree).
    """
    R_enu = np.array([R_enu_icrs(site, require_time(one)) for one in exposures])
    R_cam_enu = R_cam_icrs @ np.swapaxes(R_enu, 1, 2)
    turn = turns_rad(R_cam_enu)
    odds = log_odds_fixed(turn)
    fits = odds > 0.0
    rivals = are_shifted_in_time(R_cam_icrs, R_cam_enu, site) if may_move else ~fits
    about = " about the celestial pole" if may_move else ""
    left, out = np.ones(len(exposures), np.bool_), dict[int, str]()
    while left.any():  # each stand of the camera
        middle = int(np.argmax(np.where(left, np.maximum(odds, 0.0) @ left, -1.0)))
        same, wrong = left & fits[middle], left & rivals[middle]
        by = {int(k): f"turned by {np.degrees(turn[middle, k]):.1f} degrees{about}" for k in np.flatnonzero(wrong)}
        if np.count_nonzero(same) <= len(by):
            raise BadInput(
                "inconsistent_evidence",
                f"{exposures[middle].name}: no majority of the {np.count_nonzero(same) + len(by)} pictures shows its "
                f"attitude; {', '.join(f'{exposures[k].name} is {text}' for k, text in by.items())}: check the times "
                "and the site; use pictures one by one if the camera was turned",
            )
        why = f" against most pictures: its time or site is wrong, or the camera was turned{about}"
        out |= {k: text + why for k, text in by.items()}
        left &= ~same & ~wrong
    return out
