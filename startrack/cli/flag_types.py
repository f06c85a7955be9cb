"""Types of the values on the command line, with messages in words."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from startrack.core import MAX_COUNT, MAX_EXPOSURE_S
from startrack.core.declaration import LARGEST, SHOWN_CHARS

if TYPE_CHECKING:
    from startrack.identification import NearSky

T = TypeVar("T")
SCHEMES = ("", "tcp", "tls", "ucx", "ws", "wss")  # of Dask's addresses
MAX_MAGNITUDE = 100.0


def number(text: str) -> float:
    """A number whose size is at most that in our files."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST:  # NaN fails too
        raise argparse.ArgumentTypeError(f"{text[:SHOWN_CHARS]!r} is not a number from -{LARGEST:g} to {LARGEST:g}")
    return value


def count(text: str) -> int:
    """A whole number from 0 up."""
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text[:SHOWN_CHARS]!r} is not a whole number") from None
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text[:SHOWN_CHARS]!r} is negative")
    return value


def limit_type(convert: Callable[[str], T], is_allowed: Callable[[T], bool], fault: str) -> Callable[[str], T]:
    """The type of the values that `is_allowed`; `fault` is the message about another one, "{}" in it the text."""

    def convert_allowed(text: str) -> T:
        value = convert(text)
        if not is_allowed(value):
            raise argparse.ArgumentTypeError(fault.format(text[:SHOWN_CHARS]))
        return value

    return convert_allowed


amount = limit_type(number, lambda value: value >= 0, "{!r} is negative")
positive_number = limit_type(number, lambda value: value > 0, "{!r} is not above 0")
magnitude = limit_type(
    number,
    lambda value: abs(value) <= MAX_MAGNITUDE,
    f"{{!r}} is no magnitude from -{MAX_MAGNITUDE:g} to {MAX_MAGNITUDE:g}",
)
seconds = limit_type(
    number, lambda value: 0 < value <= MAX_EXPOSURE_S, f"{{!r}} is not above 0 and up to {MAX_EXPOSURE_S:g} seconds"
)
positive_count = limit_type(count, lambda value: value > 0, "{!r} is not above 0")
limited_count = limit_type(count, lambda value: value <= MAX_COUNT, f"{{}} is more than {MAX_COUNT}")


half_turn = limit_type(number, lambda value: 0.0 <= value <= 180.0, "{!r} is not from 0 to 180 degrees")


def attitude(words: list[str]) -> tuple[float, float, float]:
    """Azimuth, pitch and roll [deg] of three `words`."""
    azimuth, pitch, roll = (number(word) for word in words)
    if abs(pitch) >= 90.0:
        raise argparse.ArgumentTypeError(f"the pitch {pitch:g} is not between -90 and 90 degrees")
    return azimuth, pitch, roll


def time_sigma_s(text: str) -> float:
    """A standard deviation of a clock's error [s]."""
    from startrack.exposure import check_time_sigma_s

    try:
        return check_time_sigma_s(number(text), "SECONDS")
    except ValueError as cause:
        raise argparse.ArgumentTypeError(str(cause)) from cause


def clock_offset_s(text: str) -> float:
    """An error of a clock [s], no larger than the largest sigma."""
    return math.copysign(time_sigma_s(str(abs(number(text)))), number(text))


def field_of_view_rad(text: str, narrowest_deg: float = 0.5, widest_deg: float = 360.0) -> float:
    """An angle given in degrees [rad]."""
    if ".." in text:
        raise argparse.ArgumentTypeError(f"{text[:SHOWN_CHARS]!r}: give one number; startrack identify takes MIN..MAX")
    if not narrowest_deg <= number(text) <= widest_deg:
        raise argparse.ArgumentTypeError(f"{text} is not between {narrowest_deg:g} and {widest_deg:g} degrees")
    return math.radians(number(text))


def field_or_range_rad(text: str, narrowest_deg: float, widest_deg: float) -> float | tuple[float, float]:
    """An angle, or the smallest and the largest that it may be, MIN..MAX, given in degrees [rad]."""
    first, between, last = text.partition("..")
    try:
        low = field_of_view_rad(first, narrowest_deg, widest_deg)
        high = field_of_view_rad(last, narrowest_deg, widest_deg) if between else low
    except argparse.ArgumentTypeError as cause:
        raise argparse.ArgumentTypeError(f"{cause}: give DEG or MIN..MAX") from cause
    if high < low:
        raise argparse.ArgumentTypeError(f"{text}: the first field of view is wider than the last")
    return (low, high) if between else low


def geo_formats(text: str) -> list[str]:
    """Names of formats with commas between them."""
    found = text.split(",")
    if not set(found) <= {"geojson", "kml"}:
        raise argparse.ArgumentTypeError(f"{text[:SHOWN_CHARS]!r} is not geojson, kml or geojson,kml")
    return found


def position_prior(text: str) -> tuple[float, float, float]:
    """East, north and standard deviation [m] of a position."""
    words = text.split(",")
    if len(words) != 3:
        raise argparse.ArgumentTypeError(f"{text[:SHOWN_CHARS]!r} is not EAST,NORTH,SIGMA in metres, as -3000,1500,200")
    return number(words[0]), number(words[1]), positive_number(words[2])


def near_sky(text: str) -> NearSky:
    """A part of the sky: right ascension, declination and radius [deg]."""
    from startrack.identification import NearSky

    try:
        return NearSky.from_degrees([number(word) for word in text.split(",")])
    except ValueError as cause:
        raise argparse.ArgumentTypeError(f"{text[:SHOWN_CHARS]!r}: {cause}") from cause


def exposure_times(text: str) -> list[float]:
    """Exposure times [s] with commas between them."""
    found = [seconds(word) for word in text.split(",")]
    if len(set(found)) != len(found):
        raise argparse.ArgumentTypeError(f"{text!r} names an exposure twice")
    return found


def cluster_address(text: str) -> str:
    """Address of a Dask scheduler."""
    scheme, _, address = text.rpartition("://")
    host, _, port = address.rpartition(":")
    if scheme not in SCHEMES or not host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise argparse.ArgumentTypeError(
            f"{text[:SHOWN_CHARS]!r} is not the address of a Dask scheduler such as tcp://host:8786"
        )
    return text
