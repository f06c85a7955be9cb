"""The track by its likeliest explanation, without what another explanation may be right about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from startrack.applications.tracking.explanations import Explanation, Explanations
from startrack.core.types import Array, BadInput, Bools, Ints
from startrack.estimation.observations import FrameEstimate, Steps
from startrack.estimation.trajectory import Smoothed, mix_smoothed, smooth
from startrack.localization import AMBIGUOUS_MASS

CHI2_999 = float(-2.0 * np.log(0.001))  # within which a normal error in the plane is with 99.9 %
NAMED_FRAMES = 4  # of a group in a message


@dataclass(frozen=True, eq=False)
class RobustTrack:
    """The estimate without the moves and frames that contradict the others."""

    smoothed: Smoothed
    mode: Ints  # (n,) which mode of each frame is used; -1: none
    steps: Steps  # the moves as they are explained
    leg: Ints  # (n - 1,) number from 1 of the leg, or of the single move, that slipped; 0: none
    vouched: Bools  # (n,) whether explanations of another position are unlikely together
    attitude_fits: Bools  # (n,) whether the attitude of each frame turns the move after it
    fault: str = ""  # of the odometry as a whole, which is left out then

    @property
    def slipped(self) -> Bools:
        """(n - 1,) moves judged wheel slip."""
        return np.asarray(self.leg > 0)


def conclude(
    modes: Sequence[Sequence[FrameEstimate]], compared: Explanations, names: Sequence[str] = ()
) -> RobustTrack:
    """The estimate from frames with one mode each, several (ambiguous) or none (refused).

    Args:
        modes: of n frames, in the order of time.
        compared: their explanations, with the moves between all of them.
        names: of the frames, for messages; empty: their numbers from 1.

    Raises:
        ValueError: no frame has a mode.
        BadInput: inconsistent_evidence where two groups of frames contradict each other, and neither is clearly right.
    """
    if not any(modes):
        raise ValueError("no frame has a single position")
    best, *others = compared.ranked()
    found = _smooth(modes, best, best.mode)
    doubt, rival = _doubt(modes, best, found, others)
    vouched = doubt <= AMBIGUOUS_MASS
    mode = np.where(vouched, best.mode, -1)
    if found is None or (mode < 0).all():
        texts = [_group(one, names, has_odometry=compared.has_odometry) for one in (best, rival or best)]
        what = "contradict each other" if compared.may_slip else "do not agree on one position"
        why = "" if compared.may_slip else ": has the camera moved? Then leave --at-rest out"
        raise BadInput("inconsistent_evidence", f"{' and '.join(texts)} {what}, and neither is clearly right{why}")
    if (mode != best.mode).any():
        found = _smooth(modes, best, mode) or found
    turns = np.append(best.anchor == np.arange(1, len(mode)), True)
    return RobustTrack(found, mode, best.steps, best.leg, vouched, turns, best.moves.fault)


def disagrees(position_m: Array, covariance_m2: Array, other_m: Array, other_m2: Array) -> Bools:
    """Whether other positions (..., 2) are not within the ellipses that hold 99.9 %, or not known as well."""
    known = np.linalg.inv(covariance_m2)
    away = np.einsum("...i,...ij,...j->...", other_m - position_m, known, other_m - position_m)
    wider = np.linalg.eigvals(known @ other_m2).real.max(axis=-1)
    return np.asarray((away > CHI2_999) | (wider > CHI2_999))


def _doubt(
    modes: Sequence[Sequence[FrameEstimate]], best: Explanation, found: Smoothed | None,
    others: Sequence[Explanation],
) -> tuple[Array, Explanation | None]:  # fmt: skip
    """Probability (n,) of explanations of another position of each frame, and the likeliest of these explanations."""
    doubt, rival = np.zeros(len(best.mode)), None
    share = np.array([one.share for one in others])
    differs = np.array([(one.mode != best.mode) | (best.mode < 0) for one in others]).reshape(len(others), len(doubt))
    open_frames = share @ differs > AMBIGUOUS_MASS
    if found is None or not open_frames.any():
        return doubt, None
    for one in (one for one in others if one.share > AMBIGUOUS_MASS / len(others)):
        other = _smooth(modes, one, one.mode)
        away = np.ones(len(doubt), dtype=bool) if other is None else disagrees(
            found.position_m, found.covariance_m2, other.position_m, other.covariance_m2
        )  # fmt: skip
        doubt += one.share * (away & open_frames)
        rival = one if rival is None and (away & open_frames).any() else rival
    return doubt, rival


def _smooth(modes: Sequence[Sequence[FrameEstimate]], one: Explanation, mode: Ints) -> Smoothed | None:
    """The estimate by the modes (n,) with the moves of an explanation and its variants; None where no frame has one."""
    chosen = [of[k] if k >= 0 else None for of, k in zip(modes, mode, strict=True)]
    if all(estimate is None for estimate in chosen):
        return None
    parts, share = one.parts
    return mix_smoothed([smooth(chosen, each.steps) for each in parts], share)


def _group(one: Explanation, names: Sequence[str], *, has_odometry: bool) -> str:
    """The frames and the odometry that an explanation takes as right, in words."""
    used = [names[k] if names else f"image {k + 1}" for k in np.flatnonzero(one.mode >= 0).tolist()]
    more = [f"{len(used) - NAMED_FRAMES} more"] if len(used) > NAMED_FRAMES else []
    odometry = ["the odometry"] if has_odometry and not one.moves.fault else []
    return f"({', '.join([*used[:NAMED_FRAMES], *more, *odometry]) or 'no image'})"
