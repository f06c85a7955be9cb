"""The sidecar NAME.json beside NAME.png: its keys, its path, and its checked values."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from startrack.core.declaration import SHOWN_CHARS, Choice, Number, Table, Text, value_text
from startrack.core.files import is_path, printable
from startrack.core.types import BadInput
from startrack.frames import parse_utc

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
        "dark": Text(description="dark frame of the frame's size, subtracted"),
        "flat": Text(description="flat field of the frame's size, divided by"),
        "bayer_pattern": Choice(values=BAYER_PATTERNS, description="colours of the first 2 x 2 pixels of a mosaic"),
    },
)
IMAGE_KEYS = ("mask", "dark", "flat")  # always paths: no such image is shipped, and no header names one
RAW_SUFFIXES = {".dng", ".cr2", ".cr3", ".crw", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"}
PICTURE_SUFFIXES = {".png", ".tif", ".tiff", ".jpg", ".jpeg", ".fits", ".fit", ".fts"} | RAW_SUFFIXES
PACKING_SUFFIXES = {".gz", ".bz2", ".fz"}
MAX_SIDECAR_BYTES = 2**20
MAX_UNKNOWN_KEY_WARNINGS = 5


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


def read_sidecar(image: Path) -> tuple[Path, dict[str, Any]]:
    """The sidecar's path and its keys with their values; the image's path and none without a sidecar."""
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


def unknown_key_warnings(sidecar: Path, values: Mapping[str, Any]) -> list[str]:
    """A warning for each unknown key, which may be a misspelt one."""
    unknown = [key for key in values if key not in SIDECAR.keys]
    return [
        f"sidecar {printable(sidecar.name)}: key {key[:SHOWN_CHARS]!r} is none of {', '.join(SIDECAR.keys)}; not used"
        for key in unknown[:MAX_UNKNOWN_KEY_WARNINGS]
    ]


def _bad_sidecar(sidecar: Path, cause: str, reason: str = "bad_image") -> BadInput:
    return BadInput(reason, " ".join(f"sidecar {printable(sidecar)}: {cause}".split()))


def sidecar_value(sidecar: Path, values: Mapping[str, Any], key: str) -> Any:
    """The checked value of a sidecar's key; None if the key is missing or null."""
    value = values.get(key)
    if value is None:
        return None
    try:
        return SIDECAR.keys[key].check(
            value.strip().upper() if key == "bayer_pattern" and is_pattern(value) else value, key
        )
    except ValueError as error:
        raise _bad_sidecar(sidecar, str(error)) from error


def sidecar_time(sidecar: Path, value: object) -> datetime | None:
    """Mid-exposure of the key `time_utc`. Raises BadInput (no_time)."""
    if value is None:
        return None
    try:
        return parse_utc(value if isinstance(value, str) else value_text(value))
    except BadInput as error:
        raise _bad_sidecar(sidecar, f"time_utc: {str(error)[:200]}", error.reason) from error


def sidecar_reference(sidecar: Path, values: Mapping[str, Any], key: str) -> str | None:
    """The path or name of a file under a key of the sidecar."""
    value = sidecar_value(sidecar, values, key)
    if key in IMAGE_KEYS and value is not None:
        return os.path.join(sidecar.parent, value)
    return None if value is None else resolve_path(sidecar, value)


def is_pattern(value: object) -> bool:
    """Whether a value is a pattern of colours, in any case of letters."""
    return isinstance(value, str) and value.strip().upper() in BAYER_PATTERNS


def resolve_path(file: Path, reference: str) -> str:
    """A path in `file` is relative to the folder of `file`; a name stays a name."""
    return os.path.join(file.parent, reference) if is_path(reference) else reference
