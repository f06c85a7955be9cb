"""The middle of the exposure by the times in a header: of FITS, or of the same names in PNG, TIFF and JPEG.

Format: FITS standard 4.0, section 9 (Rots et al. 2015, A&A 574, A36).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import Any

from startrack.core.declaration import value_text
from startrack.core.files import MAX_CAUSE_CHARS
from startrack.core.types import BadInput
from startrack.frames import EPHEMERIS_YEARS, as_utc, format_utc, parse_utc

SAME_TIME_S = 1.0  # between two statements of one time, below which they are the same
MJD_ZERO = datetime(1858, 11, 17, tzinfo=UTC)
JD_OF_MJD_ZERO = 2_400_000.5
TO_MIDDLE = {"AVG": 0.0, "BEG": 0.5, "OBS": 0.5, "END": -0.5}  # exposures, by the end of a name; OBS is the start
PAIRS = (("DATE-BEG", "DATE-END"), ("MJD-BEG", "MJD-END"))
OBS_PAIRS = (("DATE-OBS", "DATE-END"), ("MJD-OBS", "MJD-END"))  # without another start and without EXPTIME
WAYS = (  # to the middle, the most direct first; of equal ones text before a number of days
    ("DATE-AVG",), ("MJD-AVG",), *PAIRS, *OBS_PAIRS, ("DATE-BEG",), ("DATE-OBS",), ("MJD-BEG",), ("MJD-OBS",),
    ("DATE-END",), ("MJD-END",),
)  # fmt: skip
MOMENTS = tuple(way[0] for way in WAYS if len(way) == 1)
TIME_NAMES = (*MOMENTS, "TIME-OBS", "TIMESYS")


def middle_of_exposure(header: Mapping[str, Any], exposure_s: float | None, notes: list[str]) -> datetime | None:
    """The middle of the exposure by the first of WAYS for which the `header` has its times; None without one.

    From a start or an end it takes the duration `exposure_s`, or that between the two where both are there. The `notes`
    get why a time is not used, and which others disagree with the one that is.
    """
    given = [key for key in MOMENTS if _is_stated(key, header.get(key))]
    scale = str(header.get("TIMESYS") or "UTC").strip().upper()
    if given and scale != "UTC" and not scale.startswith("UTC("):  # FITS allows UTC(NIST) and the like
        notes.append(f"{given[0]} not used: it is in the time scale {scale[:20]}, not UTC")
        return None
    times, faults = dict[str, datetime](), dict[str, str]()
    for key in given:
        try:
            times[key] = _moment(header, key)
        except (BadInput, OverflowError, TypeError, ValueError) as error:
            faults[key] = f"{key} not used: {str(error)[:MAX_CAUSE_CHARS]}"
    obs_pairs = [pair for pair in OBS_PAIRS if exposure_s is None and pair[0].replace("OBS", "BEG") not in times]
    for start, end in (*PAIRS, *obs_pairs):
        if start in times and end in times and times[end] < times[start]:
            faults[start] = f"{start} and {end} not used: the end is before the start"
            del times[start], times[end]
    ways = [way for way in WAYS if way not in OBS_PAIRS or way in obs_pairs]
    found = [*_middles(times, ways, exposure_s)]
    used = next(((way, middle) for way, middle, known in found if known), None)
    notes += [text for key, text in faults.items() if used is None or MOMENTS.index(key) < MOMENTS.index(used[0][0])]
    if used is None:
        if found:
            (key,), _, _ = found[0]
            notes.append(
                f"{key} is when the exposure {'ends' if key.endswith('END') else 'starts'}, and without EXPTIME its "
                "middle is not known: give the time of the middle (time_utc in a sidecar), or exposure_s"
            )
        return None
    others = [
        f"by {' and '.join(way)}{'' if known else ' (without EXPTIME)'} it is {apart_text(other, used[1])}"
        for way, other, known in found
        if is_other_time(other, used[1])
    ]
    if others:
        chosen = f"that by {' and '.join(used[0])}, {format_utc(used[1])}"
        notes.append(f"times of the header disagree: the middle of the exposure is {chosen}; {', '.join(others)}")
    return used[1]


def is_other_time(one: datetime, other: datetime | None) -> bool:
    """Whether the two are different times; False without an `other`."""
    return other is not None and abs((as_utc(one) - as_utc(other)).total_seconds()) >= SAME_TIME_S


def apart_text(one: datetime, other: datetime) -> str:
    """How long `one` is after or before the `other`, such as "1:59:30 (h:mm:ss) before"."""
    late_s = (as_utc(one) - as_utc(other)).total_seconds()
    return f"{timedelta(seconds=round(abs(late_s)))} (h:mm:ss) {'after' if late_s > 0 else 'before'}"


def _is_stated(key: str, value: Any) -> bool:
    """Whether the `value` of a `key` states a time, right or wrong: null, an empty text and 0 days fill its place."""
    if key.startswith("MJD"):
        with suppress(OverflowError, TypeError, ValueError):
            return float(value) != 0.0
    return value is not None and bool(str(value).strip())


def _moment(header: Mapping[str, Any], key: str) -> datetime:
    """The time of a `key`. Raises BadInput (no_time), ValueError, TypeError or OverflowError if it cannot be used."""
    value = header[key]
    if key.startswith("MJD"):
        days = math.nan if isinstance(value, bool) else float(value)
        if not days > 0.0:  # also of NaN
            raise ValueError(f"{value_text(value)} is no modified Julian date")
        time = MJD_ZERO + timedelta(days=days)
    else:
        text, of_day = str(value).strip(), str(header.get("TIME-OBS") or "").strip()
        if key == "DATE-OBS" and of_day and "T" not in text:  # an older form, in which DATE-OBS is a date alone
            text += f"T{of_day}"
        time = parse_utc(text)
    first, last = EPHEMERIS_YEARS
    if not first <= time.year <= last:
        is_julian = key.startswith("MJD") and float(value) > JD_OF_MJD_ZERO
        question = f" ({value_text(value)}: a Julian date?)" if is_julian else ""
        raise ValueError(f"{time.year} is outside {first} to {last}, the ephemeris's years{question}")
    return time


def _middles(
    times: Mapping[str, datetime], ways: Sequence[tuple[str, ...]], exposure_s: float | None
) -> Iterator[tuple[tuple[str, ...], datetime, bool]]:
    """Each of the `ways` that the `times` allow, the middle by it, and whether that is known.

    Without a duration it is not known from a start or an end, which then stands in its place.
    """
    left = dict(times)
    for way in ways:
        if not left.keys() >= set(way):
            continue
        if len(way) == 2:
            start, end = (left.pop(key) for key in way)
            exposure_s = (end - start).total_seconds()
            yield way, start + (end - start) / 2, True
        else:
            part = TO_MIDDLE[way[0][-3:]]
            middle = left[way[0]] + part * timedelta(seconds=exposure_s or 0.0)
            yield way, middle, part == 0.0 or exposure_s is not None
