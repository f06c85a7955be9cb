"""The position by the stars alone, with its checks: the same for measured stars and for simulated ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from startrack.blocked_view import leave_out_blocked
from startrack.crater_depth import OtherDepth, check_depth_by_stars
from startrack.localization import ExactPosterior, Localizer, check_consistency, clock_matters
from startrack.localization.integrity import assess_integrity
from startrack.localization.nuisance import lower_evidence
from startrack.localization.position_prior import name_prior
from startrack.localization.summary import ground_of_fix
from startrack.stages import StarFix, StarRays, extend
from startrack.types import Fix, NotLocated

CLOCK_SIGMAS = 5.0  # of a fix, within which the true time is searched once the fix is known
F = TypeVar("F", bound=StarFix)
S = TypeVar("S", bound=StarRays)


def locate_rays(rays: StarRays, localizer: Localizer | None = None) -> StarFix:
    """The position that explains photometry of stars, and its integrity; `localizer` None: the posterior.

    Raises NotLocated (or another NoSolution of the `localizer`) where the pipeline refuses an image with these `rays`.
    """
    localizer = localizer or ExactPosterior()
    fixed = fix_unblocked(rays, StarFix, localizer)
    return with_integrity(with_shown_depth(fixed, check_by_stars, StarFix, localizer))


def fix_unblocked(rays: StarRays, to: type[F], localizer: Localizer) -> F:
    """As `fix_by_stars`, without the parts of the view that something on no map blocks.

    Raises NotLocated (inconsistent_evidence) where the skyline is too high in too much of it, also for a crater of
    another depth than its file states.
    """
    fixed = fix_by_stars(rays, to, localizer)
    try:
        return _without_blocked(fixed, to, localizer)
    except NotLocated:
        deeper = _with_depth_of_stars(fixed, to, localizer)
        if deeper is None:
            raise
        return _without_blocked(deeper, to, localizer)


def _without_blocked(fixed: F, to: type[F], localizer: Localizer) -> F:
    unblocked = leave_out_blocked(fixed, fixed.fix_at_time, localizer)
    return fixed if unblocked is fixed else fix_by_stars(unblocked, to, localizer)


def fix_by_stars(rays: StarRays, to: type[F], localizer: Localizer) -> F:
    """`rays` under the sky of the time that they show, with the position, as a value of the class `to`."""
    fix = localizer(rays.evidence(), rays.terrain)
    rays, fix_at_time = _at_time_of_fix(rays, fix), fix
    if fix.clock is not None and clock_matters(rays.clock, rays.terrain):
        fix_at_time = localizer(replace(rays.evidence(), clock=None), rays.terrain)
    return extend(rays, to, fix=fix, fix_at_time=fix_at_time)


def check_fix(fixed: StarFix) -> None:
    """Raises NotLocated (inconsistent_evidence) where the rays contradict the fix, the terrain or the time."""
    if fixed.fix.search == "approximate":
        return
    try:
        check_consistency(fixed.evidence(), fixed.fix_at_time, fixed.terrain)
    except NotLocated as refusal:
        raise name_prior(refusal, fixed.near) from refusal


def check_by_stars(fixed: F, depth_is_right: bool) -> F:
    """`fixed`, which the rays do not contradict.

    Raises NotLocated as `check_fix` does, and, unless `depth_is_right`, OtherDepth where the stars show another depth.
    """
    try:
        check_fix(fixed)
    finally:  # another depth explains a contradiction too
        if not depth_is_right:
            check_depth_by_stars(fixed)
    return fixed


def with_shown_depth(fixed: F, check: Callable[[F, bool], F], to: type[F], localizer: Localizer) -> F:
    """`check(fixed, False)`, or, where that raises OtherDepth and the stars agree, the fix with the depth estimated.

    `check` has `depth_is_right` as its second argument. Raises what `check` raises. The stars are asked because a
    second skyline shows another depth to the light of the sky alone.
    """
    try:
        return check(fixed, False)
    except OtherDepth as shown:
        return check(_with_depth(fixed, shown, to, localizer) or fixed, True)


def _with_depth_of_stars(fixed: F, to: type[F], localizer: Localizer) -> F | None:
    """As `_with_depth`, of the depth that the stars show; None where they show none."""
    try:
        check_depth_by_stars(fixed)
    except OtherDepth as shown:
        return _with_depth(fixed, shown, to, localizer)
    return None


def _with_depth(fixed: F, shown: OtherDepth, to: type[F], localizer: Localizer) -> F | None:
    """The fix with the depth estimated; None where the stars contradict a crater of the depth that is shown."""
    known = replace(fixed, terrain=fixed.terrain.reshaped(np.array([shown.steeper, 0.0])))
    try:
        check_fix(fix_by_stars(known, to, localizer))
    except NotLocated:
        return None
    return fix_by_stars(replace(fixed, terrain=shown.terrain, steeper=shown.steeper), to, localizer)


def with_integrity(fixed: F) -> F:
    """`fixed` with its integrity, if it is one position with a posterior.

    Raises NotLocated (inconsistent_evidence) where its directions contradict each other.
    """
    fix, terrain = fixed.fix_at_time, fixed.terrain
    if fixed.fix.search == "approximate" or fixed.fix.ambiguous:
        return fixed
    rows = lower_evidence(fixed.evidence(), fix.horizon_error_rad)
    found = assess_integrity(rows, fix.position_enu_m[:2], fix.covariance_m2, fixed.fix, ground_of_fix(fix, terrain))
    return replace(fixed, integrity=found)


def _at_time_of_fix(rays: S, fix: Fix) -> S:
    """`rays` under the sky of the time that the evidence of a `fix` shows."""
    if fix.clock is None:
        return rays
    later_s = fix.clock.offset_s - rays.clock.offset_s
    return rays.later(later_s, CLOCK_SIGMAS * fix.clock.sigma_s) if later_s else rays
