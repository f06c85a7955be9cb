"""Which pictures of a fixed camera agree: in the local frame it has one attitude, if times and site are right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from startrack.chain import Oriented
from startrack.core.errors import BadInput, Reason
from startrack.core.types import Array
from startrack.estimation.frame_matching import require_time
from startrack.frames import R_enu_icrs, Site

# Of a fixed camera between pictures, on each axis; a real one moved by 0.02 degrees in five weeks.
MOVED_SIGMA_RAD = np.radians(0.05)
WRONG_PICTURE_PROBABILITY = 1e-3  # of a wrong time or place; any attitude is then as probable
ALL_ROTATIONS_RAD3 = 8.0 * np.pi**2  # volume of the rotations


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """A photograph without identified stars, or with an attitude unlike that of the others, and why."""

    name: str
    reason: Reason
    message: str


def turns_rad(R: Array) -> Array:
    """(n, n) angles between rotations (n, 3, 3)."""
    sine = np.sqrt(np.square(R[:, None] - R).sum(axis=(2, 3)) / 8.0)  # of half the angle
    return np.asarray(2.0 * np.arcsin(np.minimum(sine, 1.0)))


def log_odds_fixed(turn_rad: Array) -> Array:
    """Logarithm of the odds that two pictures, turned by (...) [rad], are right, against that one of them is wrong."""
    variance = 2.0 * MOVED_SIGMA_RAD**2
    prior = np.log1p(-WRONG_PICTURE_PROBABILITY) - np.log(WRONG_PICTURE_PROBABILITY) + np.log(ALL_ROTATIONS_RAD3)
    return np.asarray(prior - 1.5 * np.log(2.0 * np.pi * variance) - 0.5 * np.square(turn_rad) / variance)


def split_fixed(pictures: Sequence[Oriented], site: Site) -> tuple[list[Oriented], list[LeftOut]]:
    """The `pictures` that agree with most others, and those that do not, by their times at the `site`.

    Raises BadInput (inconsistent_evidence) where no more than half agree.
    """
    R = np.array([p.attitude_fit.attitude.R_cam_icrs @ R_enu_icrs(site, require_time(p.exposure)).T for p in pictures])
    turn = turns_rad(R)
    odds = log_odds_fixed(turn)
    middle = int(np.argmax(np.maximum(odds, 0.0).sum(axis=1)))
    fits = odds[middle] > 0.0
    angles_deg = np.degrees(turn[middle]).tolist()
    if 2 * np.count_nonzero(fits) <= len(pictures):
        raise BadInput(
            "inconsistent_evidence",
            f"{pictures[middle].exposure.name}: no majority of the {len(pictures)} pictures shows its attitude; "
            + ", ".join(f"{p.exposure.name} is turned by {a:.1f} degrees"
                        for p, a, fit in zip(pictures, angles_deg, fits, strict=True) if not fit)
            + ": check the times and the site; measure pictures one by one if the camera was turned",
        )  # fmt: skip
    why = "turned by {:.1f} degrees against most pictures: its time or site is wrong, or the camera was turned"
    out = [
        LeftOut(name=p.exposure.name, reason=Reason.INCONSISTENT_EVIDENCE, message=why.format(angle))
        for p, angle, fit in zip(pictures, angles_deg, fits, strict=True) if not fit
    ]  # fmt: skip
    return [p for p, fit in zip(pictures, fits, strict=True) if fit], out
