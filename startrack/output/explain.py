"""What an image would need for a position, or for a smaller circle: read off what was reached."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from startrack.chain import Detected, Identified, Located, Measured, Outcome, Refused, last_value
from startrack.core.errors import Reason, length_text
from startrack.core.types import Array, Blocked
from startrack.evidence import DECIDABLE_SNR
from startrack.frames import rays_from_azel
from startrack.localization import duration
from startrack.output.values import DOMINANT

WIDE_PART = 1e-3  # of the search radius: an answer with a smaller 95 % circle needs nothing
LONGER = 4.0  # times the exposure; stars of half the signal-to-noise ratio are in the star table
NEAR_SKYLINE_RAD = np.radians(2.0)  # stars this near it show where it stands
STAR_GROWTH = 0.6  # the number of stars grows with this power of the exposure: tenfold for 2 mag, SNR with its root
ENOUGH_STARS = 30  # point sources with which nearly every image is identified
GAINS_PART = 0.8  # a fact is named where the circle with it stated is smaller by this factor
LEAST_HIDDEN_RAD = np.radians(15.0)  # of the skyline out of view
AZIMUTHS_RAD = np.radians(np.arange(0.75, 360.0, 1.5))


def explain(outcome: Outcome) -> list[str]:
    """What the image of an `outcome` would need, one statement an entry; empty where a position has a small circle.

    The gain of a longer exposure is an estimate: with stars alone the circle falls as the number of stars near the
    skyline grows whose own light decides whether they are visible, with the sky's light as its noise does.
    """
    if isinstance(outcome, Refused):
        return [*_for_refusal(outcome)]
    return [*_for_circle(outcome)] if isinstance(outcome, Located) and _is_wide(outcome) else []


def _is_wide(located: Located) -> bool:
    fix = located.fix
    by_a_fact = any(DOMINANT * one.radius999_m_if_exact < fix.radius999_m for one in fix.unstated)
    return fix.ambiguous or by_a_fact or not fix.radius95_m < WIDE_PART * located.terrain.search_radius_m


def _for_circle(located: Located) -> Iterator[str]:
    """What several positions, or a position with a wide circle, would need."""
    if located.fix.ambiguous:
        first, second = (np.array([mode.east_m, mode.north_m]) for mode in located.fix.modes[:2])
        apart_m = float(np.linalg.norm(first - second))
        yield (
            f"another position: the two likeliest are {length_text(apart_m)} apart; --near with a sigma of "
            f"{length_text(apart_m / 5)} or less, or a second image from elsewhere, decides"
        )
    yield from _facts(located)
    yield _longer_exposure(located)
    yield from _more_skyline(located)


def _for_refusal(refused: Refused) -> Iterator[str]:
    """What a refused image would need, by the last value reached."""
    reached, reason = last_value(refused), refused.reason
    if reason is Reason.INCONSISTENT_EVIDENCE and isinstance(reached, Measured):
        yield from _doubtful(reached)
    elif isinstance(reached, Measured):
        yield _longer_exposure(reached)
        yield from _more_skyline(reached)
        yield from _silent(reached)
    elif isinstance(reached, Detected) and reason is Reason.NOT_IDENTIFIED:
        yield from _more_sources(reached)
    else:
        yield reason.advice


def _facts(located: Located) -> Iterator[str]:
    """The facts that would narrow the circle if they were stated."""
    radius_m = located.fix.radius999_m
    for one in located.fix.unstated:
        if one.radius999_m_if_exact < GAINS_PART * radius_m:
            yield (
                f"a fact: with {one.fact} stated and exact the 99.9 % circle would be "
                f"{one.radius999_m_if_exact:.1f} m, not {radius_m:.1f} m ({_where(one.fact)})"
            )


def _silent(measured: Measured) -> Iterator[str]:
    """The facts that nobody states, where no position shows what each would gain."""
    clock = ["time_sigma_s"] if measured.clock.gross_probability > 0.0 else []
    shape = [error.fact for error in measured.terrain.shape_errors if not error.is_stated]
    silent = list(dict.fromkeys([*shape, *clock]))
    if silent:
        yield f"facts: {', '.join(silent)} are not stated and count as uncertain ({_where(silent[0])})"


def _where(fact: str) -> str:
    if fact == "time_sigma_s":
        return "--time-sigma, or time_sigma_s in the sidecar"
    return "startrack terrain state FILE writes it"


def _longer_exposure(measured: Measured) -> str:
    """How much a longer exposure would gain, by the stars near the skyline."""
    now, then = _deciding_stars(measured, 1.0), _deciding_stars(measured, LONGER)
    seconds = measured.exposure.exposure_s
    longer = f"{LONGER:g} times the exposure" + ("" if seconds is None else f" ({LONGER * seconds:.3g} s)")
    seen_from = "" if isinstance(measured, Located) else " of the search area's middle"
    text = f"{longer}: {then} stars near the skyline{seen_from}, in place of {now}, would show whether they are visible"
    if not isinstance(measured, Located) or measured.fix.ambiguous or not np.isfinite(measured.fix.radius95_m):
        return text
    gain = LONGER**0.5 if measured.sky_light is not None else max(then, 1) / max(now, 1)
    stated = " if all facts were stated" if measured.fix.unstated else ""
    return f"{text}, a 95 % circle of about {measured.fix.radius95_m / gain:.1f} m{stated}"


def _deciding_stars(measured: Measured, longer: float) -> int:
    """Usable stars near the skyline that an exposure longer by a factor shows, by the noise of the background."""
    light, skyline_rad = measured.light, _skyline(measured)
    above = light.elevation_rad - np.interp(light.azimuth_rad, AZIMUTHS_RAD, skyline_rad, period=2 * np.pi)
    decides = light.expected_e * np.sqrt(longer) > DECIDABLE_SNR * light.sigma_e
    return int(np.count_nonzero(light.usable & decides & (np.abs(above) < NEAR_SKYLINE_RAD)))


def _more_skyline(measured: Measured) -> Iterator[str]:
    """Azimuths in which the skyline is not in view, or blocked."""
    rays_cam = rays_from_azel(AZIMUTHS_RAD, _skyline(measured)) @ measured.R_cam_enu.T
    xy_px, inside = measured.camera.project(rays_cam)
    known = inside & (measured.camera.angle_rad(xy_px) <= measured.camera.calibrated_angle_rad)
    hidden = Blocked(np.where(known, 0.0, 1.0))
    if 2 * np.pi * np.mean(hidden.whole) > LEAST_HIDDEN_RAD:
        yield f"more of the skyline: azimuths {hidden.text} are not in view; look up more steeply, or take a wider lens"
    if isinstance(measured, Located) and measured.blocked is not None:
        yield f"a free view: something on no map stands at azimuths {measured.blocked.text}; drive on some metres"


def _skyline(measured: Measured) -> Array:
    """Elevation (n,) of the map's skyline at the position, or in the middle of the search area without one."""
    position_m = measured.position_at_time_m if isinstance(measured, Located) else np.zeros(2)
    return np.asarray(measured.terrain.horizon_rad(position_m[None], AZIMUTHS_RAD)).ravel()


def _doubtful(measured: Measured) -> Iterator[str]:
    """The facts of which one is wrong, where they contradict the image."""
    sigma = f"stated to {duration(measured.clock.sigma_s)}"
    if measured.clock.gross_probability > 0.0:
        sigma = "nobody states its error"
    yield f"the right time: {measured.exposure.time_utc:%Y-%m-%dT%H:%M:%S} UTC, {sigma}; --time-sigma widens it"
    stated = dict.fromkeys(error.fact for error in measured.terrain.shape_errors if error.is_stated)
    trusted = f" and trusted in {', '.join(stated)}" if stated else ""
    yield f"the right terrain: {measured.terrain.name} is compared with the image{trusted}"
    lens = "startrack calibrate verify compares it with an image of the stars"
    if measured.camera.covariance is None:
        lens = "its lens counts as exact; startrack calibrate states a covariance"
    yield f"the right camera file: {measured.camera.name}, residuals of {measured.attitude_fit.rms_px:.2f} px; {lens}"
    yield "a free view: a mask (--mask) leaves out what stands in view and is on no map"


def _more_sources(detected: Detected) -> Iterator[str]:
    """How much longer an exposure an image without identified stars needs."""
    count = len(detected.detections)
    if isinstance(detected, Identified) or count >= ENOUGH_STARS:
        yield f"the right camera file: {count} point sources are enough, but they fit no attitude; --fov needs no file"
        return
    longer = (ENOUGH_STARS / max(count, 1)) ** (1.0 / STAR_GROWTH)
    yield f"{longer:.1g} times the exposure: it has {count} point sources, and {ENOUGH_STARS} are enough"
