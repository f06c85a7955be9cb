"""Base of all values with a position: what they state of it, whatever it is from."""

from __future__ import annotations

from startrack.core.errors import Reason
from startrack.core.types import Exposure, Fix, MeasuredSkyline, PositionPrior
from startrack.frames import Site
from startrack.terrain import Terrain


class Positioned:
    """The position of a camera above a terrain: a base of the values that have one."""

    exposure: Exposure
    fix: Fix
    site: Site
    terrain: Terrain
    skyline: MeasuredSkyline | None
    near: PositionPrior | None

    @property
    def status(self) -> str:
        """Status: ok, or ambiguous where several positions fit."""
        return "ambiguous" if self.fix.ambiguous else "ok"

    @property
    def reason(self) -> Reason | None:
        """Reason `ambiguous` where several positions fit, else None."""
        return Reason.AMBIGUOUS if self.fix.ambiguous else None

    @property
    def message(self) -> str:
        """Number of positions that fit, if there are several."""
        return f"{len(self.fix.modes)} positions fit" if self.fix.ambiguous else ""

    @property
    def position_warnings(self) -> list[str]:
        """Warnings of what blocks the view, and of errors beyond the defaults of facts that no file states."""
        blocked = [f"not the map's skyline, and left out: {self.fix.blocked.text}"] if self.fix.blocked else []
        shown = [f"the image shows {one.text}, which no file states: it is estimated" for one in self.fix.shown]
        return [*blocked, *shown, *self.fix.cautions]
