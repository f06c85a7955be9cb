"""The reasons of failures with their exit codes and advice, the exceptions that have them, and lengths in messages.

Separate from the values so that the commands start without numpy. Exit codes, JSON schema, the page's advice and the
table in docs/formats.md are made from `Reason`; a new reason is one entry here.
"""

from __future__ import annotations

import copyreg
import re
from decimal import Decimal
from enum import StrEnum
from typing import Any

from startrack.core.file_kinds import KINDS_TEXT

EXIT_OK, EXIT_INTERNAL_ERROR, EXIT_REFUSED, EXIT_BAD_INPUT, EXIT_STOPPED = 0, 1, 3, 4, 5


class Reason(StrEnum):
    """Reason why an image has no position, spelt as in the result format; each value is also that text.

    `exit_code` is the command's, `meaning` a heading, `advice` a text for the user.
    """

    exit_code: int
    meaning: str
    advice: str

    def __new__(cls, code: str, exit_code: int = 0, meaning: str = "", advice: str = "") -> Reason:
        one = str.__new__(cls, code)
        one._value_ = code
        one.exit_code, one.meaning, one.advice = exit_code, meaning, advice
        return one

    BAD_IMAGE = (
        "bad_image", EXIT_BAD_INPUT, "The image, or its sidecar, cannot be used",
        "Correct what the message names. startrack reads one whole picture of one channel or three, with a number in "
        f"every pixel, as {KINDS_TEXT}; a sidecar must be valid JSON.",
    )  # fmt: skip
    SIZE_MISMATCH = (
        "size_mismatch", EXIT_BAD_INPUT, "The image's size is not the camera's",
        "Give the right camera file with -c, and the picture as it left the camera, neither cropped nor scaled; mask, "
        "dark frame and flat field have its size.",
    )  # fmt: skip
    NO_TIME = (
        "no_time", EXIT_BAD_INPUT, "The time is not known, or is not UTC",
        "Give the middle of the exposure in UTC: --time, time_utc in NAME.json, or DATE-AVG in a FITS header.",
    )  # fmt: skip
    NO_CALIBRATION = (
        "no_calibration", EXIT_BAD_INPUT, "No camera file is known",
        "Give one with -c or in NAME.json; startrack calibrate makes one from pictures of the open sky.",
    )  # fmt: skip
    BAD_CALIBRATION = (
        "bad_calibration", EXIT_BAD_INPUT, "The camera file cannot be used",
        "Correct what the message names; docs/formats.md lists every key with its unit.",
    )  # fmt: skip
    BAD_TERRAIN = (
        "bad_terrain", EXIT_BAD_INPUT, "No terrain file is known, or it cannot be used",
        "Correct what the message names; a terrain file is given with -t or in NAME.json, and startrack terrain import "
        "makes one of a map.",
    )  # fmt: skip
    BAD_ODOMETRY = (
        "bad_odometry", EXIT_BAD_INPUT, "The odometry, or the path of a drive, cannot be used",
        "Correct what the message names; docs/track.md describes the files of odometry and the path of a drive.",
    )  # fmt: skip
    DISK_FULL = (
        "disk_full", EXIT_BAD_INPUT, "The disk is full, or takes no file of this size",
        "Free space there, or write the results to another disk with -D; then run the same command again.",
    )  # fmt: skip
    OUT_OF_MEMORY = (
        "out_of_memory", EXIT_BAD_INPUT, "Memory is short",
        "Raise the limit of memory (ulimit -v, or that of the container), close other programs, use fewer processes "
        "(-j), or take smaller pictures; then run the same command again.",
    )  # fmt: skip
    NO_CLUSTER = (
        "no_cluster", EXIT_BAD_INPUT, "The cluster of --cluster cannot be reached",
        "Start a Dask scheduler and give its address, such as tcp://host:8786.",
    )  # fmt: skip
    NO_STARS = (
        "no_stars", EXIT_REFUSED, "No stars stand out of the noise",
        "Try a longer exposure. Of a dark picture: was the lens cap on? Of a bright one: keep stray light out. Of "
        "blurred stars: focus.",
    )  # fmt: skip
    NOT_IDENTIFIED = (
        "not_identified", EXIT_REFUSED, "No attitude explains the point sources better than chance (one in 10^9)",
        "Try what fits the picture: startrack identify --fov where the camera file may be another lens's, another "
        "--fov where the field may be another, --mask where ground or lamps are in view, a longer exposure where "
        "stars are few.",
    )  # fmt: skip
    MIRRORED = (
        "mirrored", EXIT_REFUSED, "The image is a mirror image, compared with the camera file",
        "Read the sensor the other way round, or set mirrored in the camera file.",
    )  # fmt: skip
    INSUFFICIENT_GEOMETRY = (
        "insufficient_geometry", EXIT_REFUSED, "The stars leave the position open",
        "More of the skyline must be in view, with stars on both sides of it: look up more steeply, use a wider lens, "
        "or expose longer.",
    )  # fmt: skip
    OUTSIDE_SEARCH_AREA = (
        "outside_search_area", EXIT_REFUSED, "The stars point to a position outside the search area",
        "Check time and terrain; enlarge [search] radius_m in the terrain file if the rover may be farther out.",
    )  # fmt: skip
    INCONSISTENT_EVIDENCE = (
        "inconsistent_evidence", EXIT_REFUSED, "The horizon in the image is not the one that the map predicts",
        "Check terrain, time and camera height; something that is not on the map (a boulder, the lander) may stand in "
        "view.",
    )  # fmt: skip
    DAMAGED_IMAGE = (
        "damaged_image", EXIT_REFUSED, "Processing took the noise or the faint stars from the image",
        "Give the frame as the sensor recorded it: before dark subtraction, filters, thresholds and lossy compression.",
    )  # fmt: skip
    AMBIGUOUS = (
        "ambiguous", EXIT_REFUSED, "More than one position fits",
        "To choose between the positions, give locate or batch a rough one: --near EAST,NORTH,SIGMA in metres. Or "
        "take another picture some way off, expose longer, or narrow [search] in the terrain file to where the rover "
        "can be.",
    )  # fmt: skip
    TIME_LIMIT = (
        "time_limit", EXIT_REFUSED, "The time limit came before an answer",
        "Give more time with --time-limit, or facts that narrow the search: a camera file, a narrower --fov, "
        "--near-sky, or of a position --near.",
    )  # fmt: skip
    INTERNAL_ERROR = (
        "internal_error", EXIT_INTERNAL_ERROR, "The program has an error",
        "Please report it with the image; startrack locate IMAGE -v shows where it happened.",
    )  # fmt: skip


INTERNAL_ERROR = Reason.INTERNAL_ERROR
ADVICE_IN_MESSAGE = re.compile(  # the imperatives of our messages, a flag, or a question
    r"\?|(^|\s)--[a-z]"
    r"|\b(give|choose|correct|enlarge|expose|find|flip|install|make|replace|run|set|state|try|use|widen) "
)
ADVICE_BY_MESSAGE = {  # part of a message: what to do
    "or a sidecar with terrain": "A picture from the Earth needs no terrain for its stars (startrack identify) and its "
    "skyline (startrack horizon).",
    "no such folder of results": "Give the folder OUT of startrack locate or batch, or one NAME.fix.json.",
    "images there": "Give the folder that holds the pictures.",
}
MISSING = "No such file"
MISSING_ADVICE = "Check the name and the folder of the file."
BAD_INPUT_REASONS = frozenset(one for one in Reason if one.exit_code == EXIT_BAD_INPUT)  # BadInput in the library


def fitting_advice(message: str) -> str | None:
    """Advice after a refusal with this `message`; None where the advice of its reason fits."""
    return next((advice for part, advice in ADVICE_BY_MESSAGE.items() if part in message), None)


def next_step(reason: str, message: str) -> str:
    """The advice of a `reason` for a terminal; empty where the `message` itself contains what to do, or a question."""
    if ADVICE_IN_MESSAGE.search(message):
        return ""
    if message.endswith((MISSING, "no such folder", "is a file, not a folder")):
        return MISSING_ADVICE
    return Reason(reason).advice


def exit_code_of(reason: str | None) -> int:
    """Exit code of an image's `reason`; 0 for None, which means a solution."""
    return EXIT_OK if reason is None else Reason(reason).exit_code


def length_text(metres: float, digits: int = 2) -> str:
    """A length with so many significant digits and without an exponent, such as "180 m"."""
    return f"{Decimal(f'{metres:.{digits}g}'):f} m"


def one_line(text: str) -> str:
    """A `text` for one line of a terminal: control characters, which names of files may hold, are escaped."""
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)


class BadInput(Exception):
    """Input that cannot be used (exit code 4). `reason` is one of the codes of `Reason`, `message` the cause."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(one_line(message))
        self.reason = Reason(reason)

    def __reduce__(self) -> tuple[Any, ...]:
        """Parts from which another process makes the exception anew; by default they are the message alone."""
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


def how_to_install(extra: str) -> str:
    """The command that installs an `extra` of pyproject.toml."""
    return f"pip install '.[{extra}]' in a clone of startrack"


class BadOutput(BadInput):
    """Path at which results cannot be written; as the value of a flag it is wrong usage (exit code 2).

    `command_message` is the cause with flags of the command instead of arguments of the library.
    """

    def __init__(self, reason: str, message: str, command_message: str = "") -> None:
        super().__init__(reason, message)
        self.command_message = one_line(command_message or message)


class NoSolution(Exception):
    """Refusal of a stage without a reliable answer (exit code 3). Its message: a `fact`, then `advice` if given."""

    reason: Reason = Reason.INCONSISTENT_EVIDENCE

    def __init__(self, fact: str, reason: str | None = None, *, advice: str = "", **evidence: Any) -> None:
        super().__init__(one_line(f"{fact}: {advice}" if advice else fact))
        self.fact, self.advice = one_line(fact), one_line(advice)
        if reason is not None:
            self.reason = Reason(reason)
        self.evidence = evidence


class TooFewStars(NoSolution):
    """Refusal of a picture with too few point sources for an identification."""

    reason = Reason.NO_STARS


class NotIdentified(NoSolution):
    """Refusal of a picture whose point sources no attitude explains."""

    reason = Reason.NOT_IDENTIFIED


class NotLocated(NoSolution):
    """Refusal of evidence that does not determine a position."""

    reason = Reason.INSUFFICIENT_GEOMETRY
