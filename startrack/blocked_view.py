"""Evidence without the azimuths that something on no map blocks: a mast, dust, a ridge, a dead part of the sensor."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from startrack.localization import ExactPosterior, Localizer
from startrack.localization.blocked import find_blocked
from startrack.localization.summary import ground_of_fix
from startrack.stages import StarRays
from startrack.types import Fix, NotLocated

ROUNDS = 4  # of finding and leaving out; two are usual
MOST_BLOCKED_RAD = np.radians(150.0)  # of the skyline: the rest must show by itself that map, time and camera are right
BLOCKED = "blocked"  # the cause in the star table
S = TypeVar("S", bound=StarRays)


def leave_out_blocked(measured: S, fix: Fix, localizer: Localizer) -> S:
    """`measured` without the blocked parts of the view; `measured` itself where nothing is blocked.

    Patches of missing stars above the map's skyline are left out, and ranges where the skyline rises above the map's,
    with everything at their azimuths. `fix` is the position at the time of `measured`; the `localizer` finds it anew.
    Where too much of the skyline would be left out, or what is left gives no position, nothing is: the fix must then
    explain all of the evidence. With the posterior, raises NotLocated (inconsistent_evidence) where the skyline rises
    in too much of it.
    """
    if fix.search == "approximate":  # its skyline is not that of the image
        return measured
    rows, blocked = replace(measured.evidence(), clock=None), None
    for _ in range(ROUNDS):
        newer = find_blocked(rows, fix, ground_of_fix(fix, measured.terrain))
        if newer is None and (blocked is None or blocked.risen):  # the better position meets a low ridge's flanks
            break
        if newer is not None and newer.same_as(blocked):
            break
        blocked = newer
        if blocked is not None and blocked.width_rad > MOST_BLOCKED_RAD:
            if blocked.risen and isinstance(localizer, ExactPosterior):  # others need not find the best of all rows
                raise NotLocated(
                    f"the skyline is higher than the map's at azimuths {blocked.text}, too much to leave out: "
                    "wrong terrain, time or camera file, or a ridge on no map?",
                    reason="inconsistent_evidence",
                )
            return measured
        kept = rows if blocked is None else rows.take(~blocked.hides(rows.azimuth_rad, rows.elevation_rad))
        try:
            fix = localizer(kept, measured.terrain)
        except NotLocated:
            return measured
    if blocked is None:
        return measured
    hidden = blocked.hides(measured.light.azimuth_rad, measured.light.elevation_rad)
    light = measured.light.masked(np.where(hidden, BLOCKED, ""))
    return replace(measured, light=light, blocked=blocked)
