"""Stars below the horizon of the stated site: an image that shows them has another site or time."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

import numpy as np

from startrack.applications.calibration.acceptance import (
    MAX_FALSE_ALARM,
    MIN_CHANCE_MATCHES,
    WRONG_ROTATIONS_RAD,
    Check,
    rotated_matches,
)
from startrack.applications.calibration.frame import Frame, sky_at
from startrack.applications.calibration.region_growing import JointFit
from startrack.catalog import StarCatalog
from startrack.core.types import Array, Bools
from startrack.estimation.false_alarm import log_p_value_poisson
from startrack.frames import R_enu_icrs, Site, azel_from_rays

LOWEST_STAR_RAD = np.radians(-3.0)  # true elevation; refraction lifts a star at -0.5 degrees to the horizon
MOST_BELOW_PART = 0.01  # of the identified stars; right sites: 0; a wrong sign of latitude or longitude: 0.3 to 0.5


def is_below_horizon(rays_icrs: Array, site: Site, time_utc: datetime) -> Bools:
    """Whether stars in the directions `rays_icrs` (n, 3) are below the horizon of a `site` at `time_utc`."""
    return np.asarray(azel_from_rays(rays_icrs @ R_enu_icrs(site, time_utc).T)[1] < LOWEST_STAR_RAD)


def horizon_checks(joint: JointFit, catalog: StarCatalog, site: Site | None) -> tuple[Check, ...]:
    """The check that the frames do not show stars below the horizon of their site; none without a site on the Earth.

    The fit has no stars below it: the frames are matched again with the whole `catalog`, and at attitudes at which only
    chance matches. Refraction is left out: stars seen below the stated horizon are high in the true sky.
    """
    if site is None or site.body != "earth":
        return ()
    whole = tuple(replace(f, sky=sky_at(catalog, f.time_utc, None)) for f in joint.frames)
    below, matched = _count_below(joint, whole, site, 0.0)
    chance = np.mean([_count_below(joint, whole, site, angle)[0] for angle in WRONG_ROTATIONS_RAD])
    by_chance = bool(log_p_value_poisson(below, max(float(chance), MIN_CHANCE_MATCHES)) > np.log(MAX_FALSE_ALARM))
    part = below / max(matched, 1)
    return (
        Check("part of stars below the horizon", part, f"<= {MOST_BELOW_PART}", by_chance or part <= MOST_BELOW_PART,
              "inconsistent_evidence", f"{below} of {matched} stars are below the horizon of this site at this time: "
              "check --site (signs) and the time"),
    )  # fmt: skip


def _count_below(joint: JointFit, frames: tuple[Frame, ...], site: Site, rotation_rad: float) -> tuple[int, int]:
    """Matches below the horizon of the `site`, and all, of `frames` whose sky is whole, at attitudes rotated so far."""
    below = matched = 0
    for frame, found in zip(frames, rotated_matches(joint, frames, rotation_rad), strict=True):
        rays = frame.sky.stars.rays_icrs[found.star]
        below += int(np.count_nonzero(is_below_horizon(rays, site, frame.time_utc)))
        matched += len(found)
    return below, matched
