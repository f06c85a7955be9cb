"""Facts about an image besides its pixels: from a flag, else from its sidecar, else from its header.

Any program may have written a header (FITS, PNG, TIFF, JPEG): an unusable value there gives a note and is not used.
Times of headers: FITS standard 4.0, section 9 (Rots et al. 2015, A&A 574, A36).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from startrack.core.declaration import SHOWN_CHARS, value_text
from startrack.core.files import MAX_CAUSE_CHARS
from startrack.core.types import TIME_SIGMA_S, BadInput, Exposure, Mask
from startrack.exposure.sidecar import BAYER_PATTERNS, NAMED_FILES, NUMBERS, SIDECAR, Sidecar, resolve_path
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
NO_TIME = (
    "the mid-exposure time is not known: give --time UTC, a sidecar NAME.json with time_utc, or a header with it; "
    "nothing is guessed"
)
HEADER_OF = {  # the sidecar's key of a fact and its name in a header: FITS keyword, PNG text chunk, TIFF description
    "time_utc": "DATE-AVG", "time_sigma_s": "STTSIG", "exposure_s": "EXPTIME", "camera": "STCAMERA",
    "terrain": "STTERRAI", "bayer_pattern": "BAYERPAT",
}  # fmt: skip
# The names of the sidecar's keys are valid in a header too, except in FITS, where a card called CAMERA is common and
# names the hardware.
SITE_NAMES = (("OBSLAT", "OBSLONG"), ("SITELAT", "SITELONG"), ("LAT-OBS", "LONG-OBS"), ("OBSGEO-B", "OBSGEO-L"))
ELSEWHERE = re.compile(r"^/|\\|^[A-Za-z]:|(^|/)\.\.(/|$)")  # of paths: absolute, of Windows, through a folder above
ROW_ORDERS = ("TOP-DOWN", "BOTTOM-UP")
_NAMES = (*TIME_NAMES, "ROWORDER", *HEADER_OF.values(), *(name for pair in SITE_NAMES for name in pair))
HEADER_KEYS = {name: name for name in _NAMES} | HEADER_OF


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
    """Text that tells how long `one` is after or before the `other`, such as "1:59:30 (h:mm:ss) before"."""
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
    """Triples for the `ways` that the `times` allow: the way, the middle by it, and whether that is known.

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


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Metadata of an exposure besides its pixels; None if not known.

    Raises ValueError for an unusable `time_sigma_s`.
    """

    time_utc: datetime | None = None  # mid-exposure, timezone-aware
    time_sigma_s: float | None = None  # standard deviation of the clock's error
    exposure_s: float | None = None
    camera: str | None = None  # path, or name of a shipped file
    terrain: str | None = None  # path, or name of a shipped file
    air: Mapping[str, Any] | None = None  # by key of `frames.AIR_KEYS`
    mask: str | None = None  # path
    obstacles: str | None = None  # path
    dark: str | None = None  # path of the dark frame
    flat: str | None = None  # path of the flat field
    site_rad: tuple[float, float] | None = None  # latitude and longitude in the header
    row_order: str = ""  # of ROW_ORDERS, in the header
    bayer_pattern: str | None = None  # RGGB and the like: the pixels are a mosaic of colours
    warnings: tuple[str, ...] = ()  # values that were ignored, and why

    def __post_init__(self) -> None:
        if self.time_sigma_s is not None:
            object.__setattr__(self, "time_sigma_s", check_time_sigma_s(self.time_sigma_s, "time_sigma_s"))


def check_time_sigma_s(value: Any, name: str) -> float:
    """The standard deviation `value` [s] of a clock's error. Raises ValueError with a line that names it `name`."""
    return float(NUMBERS["time_sigma_s"].check(value, name))


def with_facts(
    exposure: Exposure,
    *,
    time_utc: datetime | None = None,
    time_sigma_s: float | None = None,
    exposure_s: float | None = None,
    camera: str | None = None,
    terrain: str | None = None,
    mask: str | Mask | None = None,
) -> Exposure:
    """The exposure with the values given here in place of its own; `time_utc` is mid-exposure.

    `time_sigma_s` is the standard deviation of the clock's error; that of another time does not count. `camera` and
    `terrain` are names or paths of files, `mask` is a path or the mask itself.

    A mid-exposure time computed from DATE-OBS and a header's EXPTIME does not change with a new `exposure_s`; give it
    to `read_exposure` for that. Raises ValueError for a time without zone and an unusable `time_sigma_s`.
    """
    given: dict[str, Any] = {"exposure_s": exposure_s, "camera": camera, "terrain": terrain, "mask": mask}
    given["time_utc"] = None if time_utc is None else as_utc(time_utc)
    if time_sigma_s is None and time_utc is not None and is_other_time(time_utc, exposure.time_utc):
        given |= {"time_sigma_s": TIME_SIGMA_S, "time_sigma_is_stated": False}
    if time_sigma_s is not None:
        given |= {"time_sigma_s": check_time_sigma_s(time_sigma_s, "time_sigma_s"), "time_sigma_is_stated": True}
    return replace(exposure, **{key: value for key, value in given.items() if value is not None})


def resolve_facts(image: Path, header: Mapping[str, Any], given: Facts) -> Facts:
    """The metadata of `image` from, in this order: `given` (flags), its sidecar, its header.

    A source is read only for values that the sources before it do not have, and for a time that differs from the given
    one. An unusable value in a sidecar raises BadInput (bad_image, or no_time); in a header it gives a warning.
    """
    sidecar = Sidecar.read(image)
    notes = [*given.warnings, *sidecar.warnings]
    found: dict[str, Any] = {}
    for key in sorted(SIDECAR.keys, key=lambda key: key != "exposure_s"):  # the middle of the exposure depends on it
        value = getattr(given, key)
        if value is None or value == "":
            value = sidecar.value(key)
        if value is None and key in NUMBERS:
            value = header_number(header, key, notes)
        elif value is None and key == "time_utc":
            value = middle_of_exposure(header, found["exposure_s"], notes)
        elif value is None and key in HEADER_OF:
            value = _header_text(header, key, notes)
            if value is not None and key in NAMED_FILES:
                value = _file_beside(image, HEADER_OF[key], value, notes)
        found[key] = as_utc(value) if key == "time_utc" and value is not None else value
    if given.time_utc is not None:
        other = _other_time_notes(found["time_utc"], sidecar, header, found["exposure_s"])
        notes += other
        if other:  # what the file states of its clock is not about this time
            found["time_sigma_s"] = given.time_sigma_s
    row_order = str(header.get("ROWORDER", "")).strip().upper()
    found |= {"site_rad": _header_site_rad(header), "row_order": row_order if row_order in ROW_ORDERS else ""}
    return Facts(**found, warnings=tuple(notes))


def _other_time_notes(
    stated: datetime, sidecar: Sidecar, header: Mapping[str, Any], exposure_s: float | None
) -> list[str]:  # fmt: skip
    """Note of how the time in the sidecar, else in the header, differs from the `stated` one; none if not."""
    with suppress(BadInput):  # a time that cannot be read is none
        other = sidecar.value("time_utc") or middle_of_exposure(header, exposure_s, [])
        if other is not None and is_other_time(stated, other):
            return [f"the time used is {apart_text(stated, other)} that of the file, {format_utc(as_utc(other))}"]
    return []


def facts_in_text(text: str) -> dict[str, Any]:
    """Header entries in a free text (TIFF ImageDescription, JPEG comment): a JSON object, or lines `KEY = value`."""
    try:
        entries = json.loads(text)
    except (ValueError, RecursionError):  # no JSON, then: the other form, or a text about something else
        pairs = (line.partition("=") for line in text.splitlines())
        entries = {key.strip(): value.strip().strip("'\"") for key, _, value in pairs}
    if not isinstance(entries, dict):
        return {}
    return {HEADER_KEYS[key]: value for key, value in reversed(entries.items()) if key in HEADER_KEYS}


def _header_site_rad(header: Mapping[str, Any]) -> tuple[float, float] | None:
    """The first pair of latitude and longitude [rad] in a header, of numbers or texts such as 34 28 38.3."""
    for names in SITE_NAMES:
        with suppress(KeyError, ValueError):
            latitude, longitude = (math.radians(_degrees_of(header[name])) for name in names)
            if abs(latitude) <= math.pi / 2 and abs(longitude) <= 2 * math.pi:  # False for NaN too
                return latitude, longitude
    return None


def _degrees_of(value: Any) -> float:
    """Degrees of a number, or of degrees, minutes and seconds with blanks or colons. Raises ValueError."""
    text = str(value).strip()
    parts = [abs(float(part)) for part in text.replace(":", " ").split()]
    if not 1 <= len(parts) <= 3:
        raise ValueError(text)
    size = sum(part / 60.0**power for power, part in enumerate(parts))
    return -size if text.startswith("-") else size


def header_number(header: Mapping[str, Any], key: str, notes: list[str]) -> float | None:
    """The header's number of seconds for a key of the sidecar, within the limits of that key."""
    declared, name = NUMBERS[key], HEADER_OF[key]
    value = header.get(name)
    if value is None or value == "":
        return None
    try:
        return float(declared.check(math.nan if isinstance(value, bool) else float(value), name))
    except (TypeError, ValueError, OverflowError):
        notes.append(f"{name} {value_text(value)} is not a number of seconds {declared.limits}; not used")
        return None


def _file_beside(image: Path, name: str, value: str, notes: list[str]) -> str | None:
    """A header's name of a shipped file, or the path of one beside or below the `image`; None for a file elsewhere.

    A header comes from others: it may not tell them which files exist here, nor open a connection to a server.
    """
    if ELSEWHERE.search(value):
        notes.append(f"{name} {value[:SHOWN_CHARS]!r} names a file elsewhere: give it by a flag or a sidecar; not used")
        return None
    return resolve_path(image, value)


def _header_text(header: Mapping[str, Any], key: str, notes: list[str]) -> str | None:
    """The header's name of a file, or pattern of colours; None if it has none."""
    name = HEADER_OF[key]
    value = str(header.get(name) or "").strip()
    if key == "bayer_pattern":
        value = value.upper()
        if value and value not in BAYER_PATTERNS:
            notes.append(f"{name} {value[:SHOWN_CHARS]!r} is none of {', '.join(BAYER_PATTERNS)}; not used")
            return None
    elif not value.isprintable():
        notes.append(f"{name} is no name of a file; not used")
        return None
    return value or None
