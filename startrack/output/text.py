"""Results as text: rows of names and texts, lines for a terminal, and what an image would need."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from startrack.chain import STAGES, Detected, Identified, Located, Measured, Outcome, Positioned, Refused, last_value
from startrack.core.errors import Reason, length_text
from startrack.core.files import printable
from startrack.core.types import MIDDLES_RAD, Array, Sectors
from startrack.evidence import DECIDABLE_SNR
from startrack.frames import rays_from_azel
from startrack.localization import duration
from startrack.output.quantities import QUANTITIES
from startrack.output.record import image_name, stage_values
from startrack.output.values import DOMINANT, Angle, At, off_map

if TYPE_CHECKING:
    from startrack.camera import Camera

WIDE_PART = 1e-3  # of the search radius: an answer with a smaller 95 % circle needs nothing
LONGER = 4.0  # times the exposure; stars of half the signal-to-noise ratio are in the star table
NEAR_SKYLINE_RAD = np.radians(2.0)  # stars this near it show where it stands
STAR_GROWTH = 0.6  # the number of stars grows with this power of the exposure: tenfold for 2 mag, SNR with its root
ENOUGH_STARS = 30  # point sources with which nearly every image is identified
GAINS_PART = 0.8  # a fact is named where the circle with it stated is smaller by this factor
LEAST_HIDDEN_RAD = np.radians(15.0)  # of the skyline out of view
Rows = list[tuple[str, str]]


def rows(place: str, at: At, sections: Collection[str] | None = None) -> Rows:
    """The rows of a `place` (summary, text, panel, notebook or page): each a name and a text.

    `at` gives the values, `sections` restricts the quantities to these parts of the record.
    """
    found: dict[str, str] = {}
    for one in QUANTITIES:
        if sections is not None and one.section not in sections:
            continue
        for show in one.shown:
            if place not in show.place.split() or any(at(path) is not None for path in show.unless.split()):
                continue
            value = at(one.path)
            if value is None:
                continue
            value = Angle(value) if one.schema == "turn" else value
            text = show.form(value) if callable(show.form) else show.form.format(value)
            row = show.row[0].upper() + show.row[1:] if place == "page" else show.row
            found[row] = found[row] + text if row in found else text.lstrip(" ,;")
    return [(row, text) for row, text in found.items() if text]


def summary_line(result: Outcome, seconds: float | None = None) -> str:
    """One line about a `result`. It ends with the sum of the times of the stages.

    `seconds`: the time that the result and the writing of its files took, which is then stated instead.
    """
    if isinstance(result, Refused):
        return refusal_line(image_name(result.exposure), result.reason, result.message)
    took = f"{sum(result.timing_ms.values()) / 1e3:.1f} s" if seconds is None else f"{seconds:.1f} s"
    parts = [text for _, text in rows("summary", stage_values(result))]
    return "  ".join([printable(image_name(result.exposure)), result.status, *parts, took])


def refusal_line(image: str, reason: str, message: str) -> str:
    """One line about an `image` that was refused at whatever stage: `reason` and `message`, its own path left out."""
    name, cause = printable(Path(image).name), " ".join(message.split())
    before, named, after = cause.partition(f"{name}: ")
    if named and (not before or (before.endswith("/") and ": " not in before)):
        cause = after
    return f"{name}  refused  {reason}: {cause}"


def lens_text(camera: Camera) -> str:
    """The lens of a `camera` that an identification without a camera file found: model, focal length, centre."""
    x, y = camera.centre_px
    fx, fy = camera.focal_px
    focal = f"focal length {fx:.1f} px" if fx == fy else f"focal lengths {fx:.1f} and {fy:.1f} px ({fx / fy:.5f})"
    return (
        f"lens found: {camera.lens.model}, {focal}, centre ({x:.1f}, {y:.1f}) px"
        f"{_centre_error_text(camera)}, "
        f"{'mirrored' if camera.mirrored else 'not mirrored'}, known to {np.degrees(camera.calibrated_angle_rad):.0f} "
        "degrees off the axis"
    )


def _centre_error_text(camera: Camera) -> str:
    """The error of the centre, along which RA and Dec of the axis err too; empty where it is not fitted."""
    if camera.covariance is None or not {"cx", "cy"} <= set(camera.covariance_order):
        return ""
    at = [camera.covariance_order.index(name) for name in ("cx", "cy")]
    sigma_px = float(np.sqrt(np.diag(camera.covariance)[at].max()))
    return f" ± {sigma_px:.2g} px (RA and Dec of the axis err with it)" if sigma_px > 0.0 else ""


def verbose_text(result: Outcome) -> str:
    """Indented lines about a `result`: position, attitude, stars and times, as far as they are known."""
    at = stage_values(last_value(result))
    lines = rows("text", at)
    when = at("provenance.time_utc")
    lines += [("time", f"{when if when is not None else 'not known'} (middle of the exposure)")]
    spent = [f"{stage} {result.timing_ms[stage]:.0f}" for stage in STAGES if stage in result.timing_ms]
    lines += [("ms", f"{', '.join(spent)}; all stages {sum(result.timing_ms.values()):.0f}")] if spent else []
    lines += [("warning", warning) for warning in result.warnings]
    width = 1 + max(len(show.row) for one in QUANTITIES for show in one.shown if show.place == "text")
    return "\n".join(f"  {name:<{width}}{text}" for name, text in lines)


def explain(outcome: Outcome) -> list[str]:
    """What the image of an `outcome` would need, one statement an entry; empty where a position has a small circle.

    The gain of a longer exposure is an estimate: with stars alone the circle falls as the number of stars near the
    skyline grows whose own light decides whether they are visible, with the sky's light as its noise does.
    """
    return [*_needs_of(outcome)]


def _needs_of(outcome: Outcome) -> Iterator[str]:
    value, reason = last_value(outcome), outcome.reason
    if isinstance(outcome, Positioned):
        yield from _wider_map(outcome)
    if isinstance(outcome, Located):
        yield from _needs_of_located(outcome)
    elif reason is Reason.INCONSISTENT_EVIDENCE and isinstance(value, Measured):
        yield from _doubtful_facts(value)
    elif isinstance(value, Measured) and isinstance(outcome, Refused):
        yield from _longer_exposure(value)
        yield from _more_skyline(value)
        clock = ["time_sigma_s"] if value.clock.gross_probability > 0.0 else []
        shape = [error.fact for error in value.terrain.errors.shape if not error.is_stated]
        silent = list(dict.fromkeys([*shape, *clock]))
        if silent:  # no position shows what each would gain
            yield f"facts: {', '.join(silent)} are not stated and count as uncertain ({_statement_of(silent[0])})"
    elif isinstance(value, Detected) and reason is Reason.NOT_IDENTIFIED:
        count = len(value.detections)
        if isinstance(value, Identified) or count >= ENOUGH_STARS:
            file = "but they fit no attitude; --fov needs no file"
            yield f"the right camera file: {count} point sources are enough, {file}"
        else:
            longer = (ENOUGH_STARS / max(count, 1)) ** (1.0 / STAR_GROWTH)
            yield f"{longer:.1g} times the exposure: it has {count} point sources, and {ENOUGH_STARS} are enough"
    elif isinstance(outcome, Refused):
        yield outcome.reason.advice


def _needs_of_located(located: Located) -> Iterator[str]:
    fix, radius_m = located.fix, located.fix.radius999_m
    by_a_fact = any(DOMINANT * one.radius999_m_if_exact < radius_m for one in fix.unstated)
    by_map = [*_finer_map(located)]
    yield from by_map
    if not (fix.ambiguous or by_a_fact or not fix.radius95_m < WIDE_PART * located.terrain.search_radius_m):
        return
    if fix.ambiguous:
        first, second = (np.array([mode.east_m, mode.north_m]) for mode in fix.modes[:2])
        apart_m = float(np.linalg.norm(first - second))
        yield (
            f"another position: the two likeliest are {length_text(apart_m)} apart; --near with a sigma of "
            f"{length_text(apart_m / 5)} or less, or a second image from elsewhere, decides"
        )
    for one in fix.unstated:
        if one.radius999_m_if_exact < GAINS_PART * radius_m:
            yield (
                f"a fact: with {one.fact} stated and exact the 99.9 % circle would be "
                f"{one.radius999_m_if_exact:.1f} m, not {radius_m:.1f} m ({_statement_of(one.fact)})"
            )
    if not by_map:
        yield from _longer_exposure(located)
    yield from _more_skyline(located)


def _wider_map(positioned: Positioned) -> Iterator[str]:
    """The azimuths in which the maps end before the skyline may."""
    if sectors := off_map(positioned):
        yield (
            f"a wider map: at azimuths {sectors.text} the maps end, and ground beyond could stand above their skyline; "
            "where that is lower, state it (dem.highest_beyond_m)"
        )


def _finer_map(located: Located) -> Iterator[str]:
    """How much a map without smooth errors would gain, and which of its crests decide: those along the ellipse."""
    fix, exact_m = located.fix, located.fix.exact_map_radius999_m
    if exact_m is None or not DOMINANT * exact_m < fix.radius999_m:
        return
    east, north = np.linalg.eigh(fix.covariance_m2)[1][:, -1]
    along = np.degrees(np.arctan2(east, north)) % 180.0
    yield (
        f"a finer map: the smooth errors of this one make the 99.9 % circle {fix.radius999_m:.1f} m, not "
        f"{exact_m:.1f} m, and neither light nor more exposures help; crests "
        f"at azimuths {along:.0f} and {along + 180.0:.0f}, about "
        f"{length_text(located.terrain.errors.crest_distance_m)} away, count most"
    )


def _statement_of(fact: str) -> str:
    if fact == "time_sigma_s":
        return "--time-sigma, or time_sigma_s in the sidecar"
    return "startrack terrain state FILE writes it"


def _longer_exposure(measured: Measured) -> Iterator[str]:
    """How much a longer exposure would gain, by the stars near the skyline, if any are there."""
    now, then = _deciding_stars(measured, 1.0), _deciding_stars(measured, LONGER)
    if not then:
        return
    seconds = measured.exposure.exposure_s
    longer = f"{LONGER:g} times the exposure" + ("" if seconds is None else f" ({LONGER * seconds:.3g} s)")
    seen_from = "" if isinstance(measured, Located) else " of the search area's middle"
    text = f"{longer}: {then} stars near the skyline{seen_from}, in place of {now}, would show whether they are visible"
    if isinstance(measured, Located) and not measured.fix.ambiguous and np.isfinite(measured.fix.radius95_m):
        gain = LONGER**0.5 if measured.sky_at_skyline is not None else max(then, 1) / max(now, 1)
        stated = " if all facts were stated" if measured.fix.unstated else ""
        text += f", a 95 % circle of about {measured.fix.radius95_m / gain:.1f} m{stated}"
    yield text


def _deciding_stars(measured: Measured, longer: float) -> int:
    """Usable stars near the skyline that an exposure longer by a factor shows, by the noise of the background."""
    light, skyline_rad = measured.photometry, _skyline(measured)
    above = light.elevation_rad - np.interp(light.azimuth_rad, MIDDLES_RAD, skyline_rad, period=2 * np.pi)
    decides = light.expected_e * np.sqrt(longer) > DECIDABLE_SNR * light.sigma_e
    return int(np.count_nonzero(light.usable & decides & (np.abs(above) < NEAR_SKYLINE_RAD)))


def _more_skyline(measured: Measured) -> Iterator[str]:
    """Azimuths in which the skyline is not in view, or not the map's."""
    rays_cam = rays_from_azel(MIDDLES_RAD, _skyline(measured)) @ measured.R_cam_enu.T
    xy_px, inside = measured.camera.project(rays_cam)
    known = inside & (measured.camera.angle_rad(xy_px) <= measured.camera.calibrated_angle_rad)
    hidden = Sectors(np.where(known, 0.0, 1.0))
    if 2 * np.pi * np.mean(hidden.likely) > LEAST_HIDDEN_RAD:
        yield f"more of the skyline: azimuths {hidden.text} are not in view; look up more steeply, or take a wider lens"
    if isinstance(measured, Located) and measured.fix.blocked is not None:
        yield f"a free view: the skyline is not the map's at azimuths {measured.fix.blocked.text}; drive on some metres"


def _skyline(measured: Measured) -> Array:
    """Elevation (n,) of the map's skyline at the position, or in the middle of the search area without one."""
    position_m = measured.fix.compared_at_m if isinstance(measured, Located) else np.zeros(2)
    return np.asarray(measured.terrain.horizon_rad(position_m[None], MIDDLES_RAD)).ravel()


def _doubtful_facts(measured: Measured) -> Iterator[str]:
    """A line of text for each fact that may be wrong where they contradict the image, with what would mend it."""
    sigma = f"stated to {duration(measured.clock.sigma_s)}"
    if measured.clock.gross_probability > 0.0:
        sigma = "nobody states its error"
    yield f"the right time: {measured.exposure.time_utc:%Y-%m-%dT%H:%M:%S} UTC, {sigma}; --time-sigma widens it"
    stated = dict.fromkeys(error.fact for error in measured.terrain.errors.shape if error.is_stated)
    trusted = f" and trusted in {', '.join(stated)}" if stated else ""
    yield f"the right terrain: {measured.terrain.name} is compared with the image{trusted}"
    lens = "startrack calibrate verify compares it with an image of the stars"
    if measured.camera.covariance is None:
        lens = "its lens counts as exact; startrack calibrate states a covariance"
    yield f"the right camera file: {measured.camera.name}, residuals of {measured.attitude_fit.rms_px:.2f} px; {lens}"
    yield "a free view: a mask (--mask) leaves out what stands in view and is on no map"
