"""Flags of the commands: how they are declared, the types of their values, and those that several commands have."""

from __future__ import annotations

import argparse
import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from startrack.core import MAX_COUNT, MAX_EXPOSURE_S, MAX_SPEED_M_S, ODOMETRY_FLOOR_M, ODOMETRY_SIGMA
from startrack.core.declaration import LARGEST, SHOWN_CHARS
from startrack.core.errors import how_to_install
from startrack.core.file_kinds import FORMATS, KINDS_TEXT, PROGRAMS_TEXT

if TYPE_CHECKING:
    from startrack.core.declaration import Key
    from startrack.identification import NearSky

DEFAULT_LOCALIZER = "posterior"
T = TypeVar("T")
SCHEMES = ("", "tcp", "tls", "ucx", "ws", "wss")  # of Dask's addresses
MAX_MAGNITUDE = 100.0


class Flag(NamedTuple):
    """One argument of a command, as `argparse` takes it."""

    names: Sequence[str]
    options: dict[str, Any]


class Either(NamedTuple):
    """Flags that exclude each other."""

    flags: Sequence[Flag]
    required: bool = False


Group = Sequence[Flag | Either]


def flag(words: str, text: str, convert: Callable[[str], Any] | None = None, **options: Any) -> Flag:
    """A flag or argument. Its `words` are its names and, where it takes a value, what help texts call the value.

    A flag without a value is true where it is given. The help `text` ends with the default value.
    """
    names = [word for word in words.split() if word.startswith("-")] or words.split()[:1]
    values = words.split()[len(names) :]
    if values:
        options["metavar"] = values[0] if len(values) == 1 else tuple(values)
    elif not {"choices", "action"} & set(options):
        options["action"] = "store_true"
    if isinstance(options.get("default"), str | float | int) and "action" not in options:
        text += " (%(default)s)"
    return Flag(names, {"type": convert, **options, "help": text} if convert else {**options, "help": text})


@dataclass(frozen=True)
class Command:
    """One command: its name, the function that runs it, its texts, and its flags by the titles of their groups.

    `summary` stands in the list of commands, which lacks the command without one. `example` is the end of its help.
    `start` is printed in place of an error where nothing follows the command's name. `memory_later`: whether it needs
    the memory for kernels is known in its work (of each image, or never), so that this is checked there.
    """

    name: str
    run: Callable[[argparse.Namespace], int] | None
    summary: str | None
    description: str | None
    groups: dict[str, Group] = field(default_factory=dict)
    example: str = ""
    start: str = ""
    memory_later: bool = False
    actions: Sequence[Command] = ()

    def add_to(self, subparsers: Any) -> None:
        """Add the parser of the command to those of the `startrack` command."""
        parser: argparse.ArgumentParser = subparsers.add_parser(
            self.name,
            **({} if self.summary is None else {"help": self.summary}),
            usage=None if self.actions else self._usage(),
            description="\n\n".join(filter(None, (self.description, self.example and f"example:\n  {self.example}"))),
            epilog=self.start.partition("\n\n")[2],
            formatter_class=_Formatter,
        )
        for title, flags in self.groups.items():
            _add_flags(parser.add_argument_group(title), flags)
        if self.actions:
            nested = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
            for action in self.actions:
                action.add_to(nested)
        else:
            parser.set_defaults(run=self.run, usage_error=parser.error, memory_later=self.memory_later)

    def _usage(self) -> str:
        """What must be given, in a line: flags that are required, and arguments; the rest are options."""
        words = ["%(prog)s", "[options]"]
        for one in (one for flags in self.groups.values() for one in flags if isinstance(one, Flag)):
            is_flag, value = one.names[0].startswith("-"), one.options.get("metavar", "")
            more = {"+": "...", "*": "..."}.get(one.options.get("nargs", ""), "")
            text = f"{one.names[0]} {value}" if is_flag else f"{value or one.names[0]}{more}"
            if is_flag and one.options.get("required"):
                words.append(text)
            elif not is_flag:
                words.append(f"[{text}]" if one.options.get("nargs") in ("*", "?") else text)
        return " ".join(words)


class _Formatter(argparse.HelpFormatter):
    """Fills each paragraph of a text, and keeps the lines of one that has several."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = text.split("\n\n")
        fill = super()._fill_text
        return "\n\n".join(one if "\n" in one else fill(one, width, indent) for one in paragraphs)


def function_at(path: str) -> Callable[[argparse.Namespace], int]:
    """The function at `path` in startrack.cli, as "folder.module.function"; its module is loaded when it is called.

    So the help, which needs no result, is printed without numpy.
    """
    module, _, name = path.rpartition(".")
    return lambda args: int(getattr(importlib.import_module(f"startrack.cli.{module}"), name)(args))


def _add_flags(parser: Any, flags: Group) -> None:
    for one in flags:
        if isinstance(one, Either):
            _add_flags(parser.add_mutually_exclusive_group(required=one.required), one.flags)
        else:
            parser.add_argument(*one.names, **one.options)


def checked_flag(args: argparse.Namespace, key: Key, value: Any, flag: str) -> Any:
    """The value of a `flag` as the `key` of a file would have it; else a usage error."""
    try:
        return key.check(value, flag)
    except ValueError as cause:
        args.usage_error(str(cause))


def check_localizer(args: argparse.Namespace) -> None:
    """A usage error for an unknown name after --localizer, and for one that takes no --near."""
    from startrack.localization import LOCALIZERS

    if getattr(args, "near", None) is not None and args.localizer != DEFAULT_LOCALIZER:
        args.usage_error(f"--near: only --localizer {DEFAULT_LOCALIZER} takes a prior of the position")
    if args.localizer not in LOCALIZERS:
        args.usage_error(f"--localizer {args.localizer}: known are {', '.join(LOCALIZERS)}")


def check_extra(args: argparse.Namespace, module: str, extra: str, user: str, hint: str = "") -> None:
    """A usage error where the `module` of an `extra` is missing that the `user` needs; `hint`: what else helps."""
    if find_spec(module) is None:
        args.usage_error(f"{user} {module}: {how_to_install(extra)}{hint}")


def check_cluster(args: argparse.Namespace) -> None:
    """A usage error for --cluster where Dask is missing."""
    if args.cluster is not None:
        check_extra(args, "distributed", "cluster", "--cluster needs")


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


IMAGES = flag("images IMAGE", f"{', '.join(FORMATS)}, camera raw, ROS bag, or BAG#NUMBER", nargs="+")
SOME_IMAGES = IMAGES._replace(options={**IMAGES.options, "nargs": "*"})
PHOTOGRAPHS = flag("images IMAGE", KINDS_TEXT, nargs="+")
TOPIC = flag("--image-topic TOPIC", "topic of the images in a ROS bag that has several")
CAMERA = flag("-c --camera FILE", f"camera file of startrack, {PROGRAMS_TEXT}, or the name of a shipped one")
TERRAIN = flag("-t --terrain FILE", "terrain file, or the name of a shipped one")
TIME = flag("--time UTC", "middle of the exposure, ISO 8601 (of one image)")
EXPOSURE = flag("--exposure S", "exposure time in seconds", seconds)
PIXELS = (
    flag("--mask FILE", "8-bit image of the frame's size: pixels below 128 do not count (a mast, a lamp)"),
    flag("--dark FILE", "dark frame of the frame's size: subtracted, its median kept"),
    flag("--flat FILE", "flat field of the frame's size, its own dark subtracted"),
)
TIME_SIGMA = flag(
    "--time-sigma SECONDS",
    "standard deviation of the clock's error (1; where it is not stated the clock may also be grossly wrong)",
    time_sigma_s,
)
TIME_LIMIT = flag(
    "--time-limit SECONDS",
    "limit of processor time, of all threads together; what is not found by then is refused as time_limit",
    positive_number,
)
FACTS = (CAMERA, TIME, TIME_SIGMA, EXPOSURE, *PIXELS)  # that images may lack
MAIN_FACTS, OTHER_FACTS = (CAMERA, TERRAIN, TIME), (TIME_SIGMA, EXPOSURE, *PIXELS)
SITE = flag("--site LAT,LON[,M]", "where the camera stands on the Earth, in degrees and metres (--site=-30.2,...)")
SKY = (PHOTOGRAPHS, CAMERA, TIME, EXPOSURE, *PIXELS, SITE, TERRAIN)  # of photographs of the night sky

LOCALIZER = flag(
    "--localizer NAME",
    "posterior, pseudo-gradient, hull, or another of startrack.localization.LOCALIZERS",
    default=DEFAULT_LOCALIZER,
)
EVIDENCE = flag(
    "--evidence",
    "evidence of the position: stars, the light of the sky that stops at the skyline, or both",
    choices=("both", "stars", "sky"),  # as startrack.chain.stages has them; written here so that help is quick
    default="both",
)
NEAR = flag(
    "--near EAST,NORTH,SIGMA",
    "prior of the position, a normal distribution [m]: the posterior contains it, and an image that contradicts it "
    "is refused",
    position_prior,
)
NEAR_ATTITUDE = flag(
    "--near-attitude FILE",
    "a result of startrack whose attitude is a rough one, some degrees off at most: the stars are sought there first, "
    "and everywhere if they are not there",
)
NEAR_SKY = flag(
    "--near-sky RA,DEC,RADIUS",
    "where the camera points, in degrees (ICRS): the stars are sought only with the optical axis within RADIUS of RA, "
    "DEC; fewer stars suffice (--near-sky=-10,...)",
    near_sky,
)
POINTING = Either((NEAR_ATTITUDE, NEAR_SKY))
METHOD = (LOCALIZER, EVIDENCE, NEAR, POINTING)

ODOMETRY = (
    flag("--odometry-sigma F", "error of a move on each horizontal axis, relative", amount, default=ODOMETRY_SIGMA),
    flag(
        "--odometry-floor M", "error of a move beside the relative one, added in quadrature", amount,
        default=ODOMETRY_FLOOR_M,
    ),
)  # fmt: skip
ODOMETRY_TIME = flag(
    "--odometry-time-sigma SECONDS",
    "offset of the odometry's clock from that of the images",
    amount,
    default=0.0,
)
MAX_SPEED = flag(
    "--max-speed M_PER_S",
    "largest speed of the rover; odometry with a faster move is refused",
    positive_number,
    default=MAX_SPEED_M_S,
)

DIR = flag("-D --dir OUT", "folder of the results", default="startrack-out")
FILE = flag("-o --output FILE", "what to write, instead of a file in OUT")
OVERWRITE = flag("-O --overwrite", "replace existing files, also results of another image of this name")
AGAIN = Either((flag("--resume", "keep the results that are there (default)"), OVERWRITE))
JSON = flag("--json", "print JSON objects instead of lines")
NO_PLOTS = flag("--no-plots", "no pictures")
OUTPUT = (DIR, OVERWRITE, JSON, NO_PLOTS)
JOBS = flag("-j --jobs N", "processes (default: all cores)", positive_count)
CLUSTER_TEXTS = "--cluster ADDRESS", "a Dask cluster to use instead (extra: cluster)"
CLUSTER = flag(*CLUSTER_TEXTS)
NO_SEED = flag("--seed N", "no effect: this command draws nothing at random", int, default=0)
VERBOSE = flag("-v --verbose", "more output; tracebacks of internal errors", action="count", default=0)
MORE = (VERBOSE, flag("-q --quiet", "print errors only"))
