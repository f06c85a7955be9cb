"""Time as text: ISO 8601, always UTC."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

from startrack.core.types import BadInput

# The suffix only: the date and the time of day before it are left to the standard library.
_PARTS = re.compile(r"(?P<stamp>\d[\d-]*[Tt ]\d[\d:.,]*)\s?(?P<suffix>[Zz]|[+-][\d:]+)?", re.ASCII)
_DATE = re.compile(r"\d{4}(-?\d{2}-?\d{2}|-?W\d{2}-?\d|-\d{3})[Zz]?", re.ASCII)
_UTC_SUFFIXES = {None, "Z", "z", "+00:00", "+0000", "+00"}


def parse_utc(text: str) -> datetime:
    """The time that `text` names, as an aware UTC datetime.

    ISO 8601 with a date and a time of day. No suffix, Z and +00:00 mean UTC. Digits beyond the microsecond are
    dropped (the sky turns 15 microarcseconds in one).

    Raises:
        BadInput: "no_time" for any other offset and for anything that is not such a time; nothing is guessed.
    """
    parts = _PARTS.fullmatch(text.strip()) if isinstance(text, str) else None
    if parts is None and isinstance(text, str) and _DATE.fullmatch(text.strip()):
        raise BadInput(
            "no_time", f"{text!r} is a date without a time of day: give one such as {text.strip()}T12:00:00Z"
        )
    if parts is None:
        raise BadInput("no_time", f"{text!r} is not an ISO 8601 date and time such as 2026-03-01T12:00:00Z")
    if parts["suffix"] not in _UTC_SUFFIXES:
        utc = _utc_text(parts["stamp"] + parts["suffix"])
        raise BadInput("no_time", f"{text!r} is a local time (offset {parts['suffix']}): give it in UTC{utc}")
    try:
        return datetime.fromisoformat(parts["stamp"]).replace(tzinfo=UTC)
    except ValueError as error:
        raise BadInput("no_time", f"{text!r} is not a valid date and time: {error}") from error


def _utc_text(local: str) -> str:
    """The instant of a `local` time with an offset, for a message; empty where there is no such time."""
    try:
        utc = datetime.fromisoformat(local).astimezone(UTC)
    except (ValueError, OverflowError):
        return ""
    return f"; that is {utc.replace(tzinfo=None).isoformat()}Z"


def format_utc(time: datetime) -> str:
    """Text of `time` in ISO 8601 with microseconds and Z: parse_utc(format_utc(time)) == time.

    Raises:
        ValueError: the datetime carries no time zone.
    """
    return as_utc(time).replace(tzinfo=None).isoformat(timespec="microseconds") + "Z"


def as_utc(time: datetime) -> datetime:
    """Instant of `time` with time zone UTC.

    Raises:
        ValueError: the datetime carries no time zone, so that it names no instant.
    """
    if time.utcoffset() is None:
        raise ValueError(f"{time!r} carries no time zone")
    return time.astimezone(UTC)


def seconds_since_2000(time: datetime) -> float:
    """UTC seconds of a `time` since 2000-01-01T12:00:00Z, leap seconds not counted [s]."""
    return (as_utc(time) - datetime(2000, 1, 1, 12, tzinfo=UTC)) / timedelta(seconds=1)
