"""The position by the stars alone: the same for measured stars and for simulated ones."""

from __future__ import annotations

from typing import TypeVar

from startrack.chain.stages import StarFix, StarRays, extend
from startrack.core.types import Evidence, Fix
from startrack.localization import DEFAULT_LOCALIZER, Localizer, clock_matters, require_localizer

CLOCK_SIGMAS = 5.0  # of a fix, within which the true time is searched once the fix is known
F = TypeVar("F", bound=StarFix)


def locate_rays(rays: StarRays, localizer: Localizer | None = None) -> StarFix:
    """The position that explains photometry of stars; `localizer` None: the posterior.

    Raises NotLocated (or another NoSolution of the `localizer`) where the pipeline refuses an image with these `rays`.
    """
    return fix_position(rays, StarFix, localizer or require_localizer(DEFAULT_LOCALIZER))


def fix_position(rays: StarRays, to: type[F], localizer: Localizer, evidence: Evidence | None = None) -> F:
    """`rays` under the sky of the time that they show, with the position, as a value of the class `to`.

    `evidence` None: that of the stars.
    """
    fix = localizer(rays.evidence() if evidence is None else evidence, rays.terrain)
    return extend(_at_time_of(rays, fix), to, fix=fix)


def _at_time_of(rays: StarRays, fix: Fix) -> StarRays:
    """`rays` under the sky of the time that the evidence of a `fix` shows."""
    if fix.clock is None or rays.terrain.axisymmetric or not clock_matters(rays.clock, rays.terrain):
        return rays
    later_s = fix.clock.offset_s - rays.clock.offset_s
    return rays.later(later_s, CLOCK_SIGMAS * fix.clock.sigma_s) if later_s else rays
