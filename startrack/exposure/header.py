"""Facts in the header of an image (FITS, PNG, TIFF, JPEG). An unusable value gives a note and is not used."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from startrack.core.declaration import SHOWN_CHARS, value_text
from startrack.core.types import BadInput
from startrack.exposure.sidecar import BAYER_PATTERNS, IMAGE_KEYS, NUMBERS, SIDECAR, is_pattern, resolve_path
from startrack.frames import parse_utc

# Names in a header (FITS keywords, PNG text chunks, TIFF description) and the fact that each one gives. The names of
# the sidecar's keys are valid there too, except in FITS, where a card called CAMERA is common and names the hardware.
_HEADER_KEYS = ("DATE-AVG", "STTSIG", "EXPTIME", "STCAMERA", "STTERRAI", "BAYERPAT")
HEADER_KEYS = {key: key for key in ("DATE-OBS", "TIMESYS", *_HEADER_KEYS)}
HEADER_KEYS |= dict(zip((key for key in SIDECAR.keys if key not in IMAGE_KEYS), _HEADER_KEYS, strict=True))


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


def header_number(header: Mapping[str, Any], key: str, notes: list[str]) -> float | None:
    """The header's number of seconds for a key of the sidecar, within the limits of that key."""
    declared, name = NUMBERS[key], HEADER_KEYS[key]
    value = header.get(name)
    if value is None or value == "":
        return None
    try:
        return float(declared.check(math.nan if isinstance(value, bool) else float(value), name))
    except (TypeError, ValueError, OverflowError):
        notes.append(f"{name} {value_text(value)} is not a number of seconds {declared.limits}; not used")
        return None


def header_time(header: Mapping[str, Any], exposure_s: float | None, notes: list[str]) -> datetime | None:
    """Mid-exposure from DATE-AVG, or from DATE-OBS and half the exposure; the notes have the cause if there is none."""
    given = [key for key in ("DATE-AVG", "DATE-OBS") if str(header.get(key) or "").strip()]
    if not given:
        return None
    scale = str(header.get("TIMESYS") or "UTC").strip().upper()
    if scale != "UTC" and not scale.startswith("UTC("):  # FITS allows UTC(NIST) and the like
        notes.append(f"{given[0]} not used: it is in the time scale {scale[:20]}, not UTC")
        return None
    for key in given:
        try:
            time = parse_utc(str(header[key]))
        except BadInput as error:
            notes.append(f"{key} not used: {str(error)[:200]}")
            continue
        if key == "DATE-AVG":
            return time
        if exposure_s is not None:
            return _time_after(time, exposure_s / 2, notes)
        notes.append(
            "DATE-OBS is when the exposure starts, and without EXPTIME its middle is not known: "
            "give the time of the middle (time_utc in a sidecar), or exposure_s"
        )
    return None


def _time_after(start: datetime, seconds: float, notes: list[str]) -> datetime | None:
    try:
        return start + timedelta(seconds=seconds)
    except OverflowError:
        notes.append(f"DATE-OBS not used: {start} plus half the exposure is beyond the calendar")
        return None


def header_reference(image: Path, header: Mapping[str, Any], key: str, notes: list[str]) -> str | None:
    """The path or name of a file that the header names under `key`; None if it names none."""
    value = str(header.get(key) or "").strip()
    if not value.isprintable():
        notes.append(f"{key} is no name of a file; not used")
        return None
    return resolve_path(image, value) if value else None


def header_pattern(header: Mapping[str, Any], notes: list[str]) -> str | None:
    """The header's pattern of colours; None if it has none."""
    value = str(header.get("BAYERPAT") or "").strip().upper()
    if not value or is_pattern(value):
        return value or None
    notes.append(f"BAYERPAT {value[:SHOWN_CHARS]!r} is none of {', '.join(BAYER_PATTERNS)}; not used")
    return None
