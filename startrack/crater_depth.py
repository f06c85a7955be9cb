"""A crater's depth that an image shows to be another one than its file states: it is estimated then."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.stretch import shown_steepness
from startrack.terrain import Cylinder

if TYPE_CHECKING:
    from startrack.stages import StarFix


class OtherDepth(Exception):
    """An image shows a crater steeper than its `terrain` states, by the part `steeper`.

    Its `terrain` has that part as the error of its depth.
    """

    def __init__(self, terrain: Cylinder, steeper: float) -> None:
        super().__init__(f"{steeper:+.2%}")
        self.terrain, self.steeper = replace(terrain, depth_sigma_m=abs(steeper) * terrain.depth_m), steeper


def check_depth_by_stars(fixed: StarFix) -> None:
    """Raises OtherDepth where the stars show another depth of a crater whose file states none of its errors."""
    terrain, fix = fixed.terrain, fixed.fix_at_time
    if not isinstance(terrain, Cylinder) or any(terrain.shape_sigma) or fix.ambiguous or fix.search == "approximate":
        return
    likelihood = PositionLikelihood.from_evidence(fixed.evidence(), terrain)
    steeper = shown_steepness(likelihood, fix.position_enu_m[:2])
    if steeper:
        raise OtherDepth(terrain, steeper)
