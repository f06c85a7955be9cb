"""Time and its sigma, exposure seconds, camera, terrain of an image: from a flag, else its sidecar, else its header."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from startrack.declaration import SHOWN_CHARS, Choice, Number, Table, Text, value_text
from startrack.files import is_path, printable
from startrack.frames.time import as_utc, parse_utc
from startrack.types import BadInput, Exposure, Mask

BAYER_PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
MAX_EXPOSURE_S = 1e6
# Ten days rotate the Moon's sky by a third of a turn: such a clock states no time. A larger number has another unit.
MAX_TIME_SIGMA_S = 864_000.0
NUMBERS = {
    "time_sigma_s": Number(low=0, high=MAX_TIME_SIGMA_S, description="standard deviation of the clock's error"),
    "exposure_s": Number(low=0, high=MAX_EXPOSURE_S, above=True),
}
SIDECAR = Table(
    description="NAME.json beside NAME.png. Paths are relative to the sidecar.",
    keys={
        "time_utc": Text(max_chars=100, description="middle of the exposure, ISO 8601, UTC"),
        **NUMBERS,
        "camera": Text(description="a camera file, or the name of a shipped one"),
        "terrain": Text(description="a terrain file, or the name of a shipped one"),
        "mask": Text(description="8-bit image of the frame's size: pixels below 128 do not count"),
        "bayer_pattern": Choice(values=BAYER_PATTERNS, description="colours of the first 2 x 2 pixels of a mosaic"),
    },
)
# Names in a header (FITS keywords, PNG text chunks, TIFF description) and the fact that each one gives. The names of
# the sidecar's keys are valid there too, except in FITS, where a card called CAMERA is common and names the hardware.
_HEADER_KEYS = ("DATE-AVG", "STTSIG", "EXPTIME", "STCAMERA", "STTERRAI", "BAYERPAT")
HEADER_KEYS = {key: key for key in ("DATE-OBS", "TIMESYS", *_HEADER_KEYS)}
HEADER_KEYS |= dict(zip((key for key in SIDECAR.keys if key != "mask"), _HEADER_KEYS, strict=True))
RAW_SUFFIXES = {".dng", ".cr2", ".cr3", ".crw", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"}
PICTURE_SUFFIXES = {".png", ".tif", ".tiff", ".jpg", ".jpeg", ".fits", ".fit", ".fts"} | RAW_SUFFIXES
PACKING_SUFFIXES = {".gz", ".bz2", ".fz"}
MAX_SIDECAR_BYTES = 2**20
MAX_UNKNOWN_KEY_WARNINGS = 5


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
    mask: str | None = None  # path
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

    `time_sigma_s` is the standard deviation of the clock's error. `camera` and `terrain` are names or paths of files,
    `mask` is a path or the mask itself.

    A mid-exposure time computed from DATE-OBS and a header's EXPTIME does not change with a new `exposure_s`; give it
    to `read_exposure` for that. Raises ValueError for a time without zone and an unusable `time_sigma_s`.
    """
    given: dict[str, Any] = {"exposure_s": exposure_s, "camera": camera, "terrain": terrain, "mask": mask}
    given["time_utc"] = None if time_utc is None else as_utc(time_utc)
    given["time_sigma_s"] = None if time_sigma_s is None else check_time_sigma_s(time_sigma_s, "time_sigma_s")
    return replace(exposure, **{key: value for key, value in given.items() if value is not None})


def resolve_facts(image: Path, header: Mapping[str, Any], given: Facts) -> Facts:
    """The metadata of `image` from, in this order: `given` (flags), its sidecar, its header.

    A source is read only for values that the sources before it do not have. An unusable value in a sidecar raises
    BadInput (bad_image, or no_time); in a header, which any program may have written, it gives a warning.
    """
    sidecar, values = _read_sidecar(image)
    notes: list[str] = [*given.warnings, *_unknown_keys(sidecar, values)]

    def first_number(key: str, flag: float | None) -> float | None:
        stated = _sidecar_value(sidecar, values, key) if flag is None else flag
        return _header_number(header, key, notes) if stated is None else stated

    exposure_s = first_number("exposure_s", given.exposure_s)
    time_utc = given.time_utc
    if time_utc is None:
        time_utc = _sidecar_time(sidecar, values.get("time_utc"))
    if time_utc is None:
        time_utc = _header_time(header, exposure_s, notes)
    return Facts(
        time_utc=None if time_utc is None else as_utc(time_utc),
        time_sigma_s=first_number("time_sigma_s", given.time_sigma_s),
        exposure_s=exposure_s,
        camera=given.camera
        or _sidecar_reference(sidecar, values, "camera")
        or _header_reference(image, header, "STCAMERA", notes),
        terrain=given.terrain
        or _sidecar_reference(sidecar, values, "terrain")
        or _header_reference(image, header, "STTERRAI", notes),
        mask=given.mask or _sidecar_reference(sidecar, values, "mask"),
        bayer_pattern=_sidecar_value(sidecar, values, "bayer_pattern") or _header_pattern(header, notes),
        warnings=tuple(notes),
    )


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


def stem(image: Path) -> str:
    """Name without the suffixes of picture and packing: "night 1.2" for "night 1.2.fits.bz2"."""
    return _stems(image)[-1]


def sidecars(image: Path) -> list[Path]:
    """Possible paths of a sidecar, most specific first; it is written to the last one, NAME.json."""
    return [image.with_name(name + ".json") for name in _stems(image)]


def sidecar_of(image: Path) -> Path | None:
    """The sidecar of the image if there is one. Cameras that write NAME.PNG write NAME.JSON."""
    candidates = (candidate for path in sidecars(image) for candidate in (path, path.with_suffix(".JSON")))
    return next((candidate for candidate in candidates if os.path.isfile(candidate)), None)


def _stems(image: Path) -> list[str]:
    """["a.fits.bz2", "a.fits", "a"]."""
    names = [image.name]
    while Path(names[-1]).suffix.lower() in PACKING_SUFFIXES:
        names.append(Path(names[-1]).stem)
    last = Path(names[-1])
    if last.suffix.lower() in PICTURE_SUFFIXES or len(names) == 1:
        names.append(last.stem)
    return names


def _read_sidecar(image: Path) -> tuple[Path, dict[str, Any]]:
    found = sidecar_of(image)
    if found is None:
        return image, {}
    try:
        with found.open("rb") as file:
            raw = file.read(MAX_SIDECAR_BYTES + 1)
        if len(raw) > MAX_SIDECAR_BYTES:
            raise ValueError("more than 1 MiB")
        values = json.loads(raw.decode("utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise _bad_sidecar(found, f"cannot be read as JSON ({str(error)[:200]})") from error
    if not isinstance(values, dict):
        raise _bad_sidecar(found, 'holds no JSON object such as {"time_utc": "2031-03-26T20:58:11Z"}')
    return found, values


def _unknown_keys(sidecar: Path, values: Mapping[str, Any]) -> list[str]:
    """A warning for each unknown key, which may be a misspelt one."""
    unknown = [key for key in values if key not in SIDECAR.keys]
    return [
        f"sidecar {printable(sidecar.name)}: key {key[:SHOWN_CHARS]!r} is none of {', '.join(SIDECAR.keys)}; not used"
        for key in unknown[:MAX_UNKNOWN_KEY_WARNINGS]
    ]


def _bad_sidecar(sidecar: Path, cause: str, reason: str = "bad_image") -> BadInput:
    return BadInput(reason, " ".join(f"sidecar {printable(sidecar)}: {cause}".split()))


def _sidecar_value(sidecar: Path, values: Mapping[str, Any], key: str) -> Any:
    """The checked value of a sidecar's key; None if the key is missing or null."""
    value = values.get(key)
    if value is None:
        return None
    try:
        return SIDECAR.keys[key].check(
            value.strip().upper() if key == "bayer_pattern" and _is_pattern(value) else value, key
        )
    except ValueError as error:
        raise _bad_sidecar(sidecar, str(error)) from error


def _sidecar_time(sidecar: Path, value: object) -> datetime | None:
    if value is None:
        return None
    try:
        return parse_utc(value if isinstance(value, str) else value_text(value))
    except BadInput as error:
        raise _bad_sidecar(sidecar, f"time_utc: {str(error)[:200]}", error.reason) from error


def _sidecar_reference(sidecar: Path, values: Mapping[str, Any], key: str) -> str | None:
    value = _sidecar_value(sidecar, values, key)
    if key == "mask" and value is not None:  # always a path: no mask is shipped
        return os.path.join(sidecar.parent, value)
    return None if value is None else _resolve_path(sidecar, value)


def _header_reference(image: Path, header: Mapping[str, Any], key: str, notes: list[str]) -> str | None:
    value = str(header.get(key) or "").strip()
    if not value.isprintable():
        notes.append(f"{key} is no name of a file; not used")
        return None
    return _resolve_path(image, value) if value else None


def _header_pattern(header: Mapping[str, Any], notes: list[str]) -> str | None:
    value = str(header.get("BAYERPAT") or "").strip().upper()
    if not value or _is_pattern(value):
        return value or None
    notes.append(f"BAYERPAT {value[:SHOWN_CHARS]!r} is none of {', '.join(BAYER_PATTERNS)}; not used")
    return None


def _is_pattern(value: object) -> bool:
    return isinstance(value, str) and value.strip().upper() in BAYER_PATTERNS


def _resolve_path(file: Path, reference: str) -> str:
    """A path in `file` is relative to the folder of `file`; a name stays a name."""
    return os.path.join(file.parent, reference) if is_path(reference) else reference


def _header_number(header: Mapping[str, Any], key: str, notes: list[str]) -> float | None:
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


def _header_time(header: Mapping[str, Any], exposure_s: float | None, notes: list[str]) -> datetime | None:
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
