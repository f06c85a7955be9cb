"""Sidecar NAME.json beside an image: its keys, its path, and its checked values; and the names of images' files."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from startrack.core import MAX_EXPOSURE_S
from startrack.core.declaration import SHOWN_CHARS, Choice, Number, Table, Text, value_text
from startrack.core.file_kinds import FORMATS, RAW_SUFFIXES
from startrack.core.files import MAX_CAUSE_CHARS, MAX_TEXT_BYTES, is_path, printable
from startrack.core.types import BadInput
from startrack.frames import AIR_TABLE, parse_utc

BAYER_PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
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
        "camera": Text(is_path=True, description="a camera file, or the name of a shipped one"),
        "terrain": Text(is_path=True, description="a terrain file, or the name of a shipped one"),
        "air": AIR_TABLE,
        "mask": Text(is_path=True, description="8-bit image of the frame's size: pixels below 128 do not count"),
        "obstacles": Text(
            is_path=True,
            description="CSV file of azimuth_deg and elevation_deg, below which something hides the ground's skyline",
        ),
        "dark": Text(is_path=True, description="dark frame of the frame's size, subtracted"),
        "flat": Text(is_path=True, description="flat field of the frame's size, divided by"),
        "bayer_pattern": Choice(values=BAYER_PATTERNS, description="colours of the first 2 x 2 pixels of a mosaic"),
    },
)
NAMED_FILES = ("camera", "terrain")  # paths, or names of shipped files
IMAGE_KEYS = ("mask", "obstacles", "dark", "flat")  # always paths: none is shipped, and no header names one
PICTURE_SUFFIXES = {suffix for one in FORMATS.values() for suffix in one.suffixes} | RAW_SUFFIXES
PACKING_SUFFIXES = {".gz", ".bz2", ".fz"}
MAX_UNKNOWN_KEY_WARNINGS = 5


def stem(image: Path) -> str:
    """Name of the file `image` without the suffixes of picture and packing: "night 1.2" for "night 1.2.fits.bz2"."""
    return _stems(image)[-1]


def sidecars(image: Path) -> list[Path]:
    """Possible paths of a sidecar, most specific first; it is written to the last one, NAME.json."""
    return [image.with_name(name + ".json") for name in _stems(image)]


def sidecar_of(image: Path) -> Path | None:
    """The sidecar of the image if there is one. Cameras that write NAME.PNG write NAME.JSON."""
    return next((candidate for candidate in _candidates(image) if os.path.isfile(candidate)), None)


def _candidates(image: Path) -> Iterator[Path]:
    return (candidate for path in sidecars(image) for candidate in (path, path.with_suffix(".JSON")))


def _stems(image: Path) -> list[str]:
    """Names of the file without its suffixes of packing and picture, longest first: ["a.fits.bz2", "a.fits", "a"]."""
    names = [image.name]
    while Path(names[-1]).suffix.lower() in PACKING_SUFFIXES:
        names.append(Path(names[-1]).stem)
    last = Path(names[-1])
    if last.suffix.lower() in PICTURE_SUFFIXES or len(names) == 1:
        names.append(last.stem)
    return names


@dataclass(frozen=True)
class Sidecar:
    """The keys of a sidecar as written; they are checked when they are used."""

    path: Path
    values: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, image: Path) -> Sidecar:
        """The sidecar of an image; without one, one without keys. Raises BadInput bad_image."""
        for candidate in _candidates(image):
            if os.path.lexists(candidate) and not os.path.isfile(candidate):  # a pipe would block
                raise cls(candidate)._fault("is no regular file")
        path = sidecar_of(image)
        if path is None:
            return cls(image)
        try:
            with path.open("rb") as file:
                raw = file.read(MAX_TEXT_BYTES + 1)
            if len(raw) > MAX_TEXT_BYTES:
                raise ValueError("more than 1 MiB")
            values = json.loads(raw.decode("utf-8-sig"))
        except (OSError, ValueError, RecursionError) as error:
            raise cls(path)._fault(f"cannot be read as JSON ({str(error)[:MAX_CAUSE_CHARS]})") from error
        if not isinstance(values, dict):
            raise cls(path)._fault('holds no JSON object such as {"time_utc": "2031-03-26T20:58:11Z"}')
        return cls(path, values)

    def value(self, key: str) -> Any:
        """The checked value of a key, a path resolved; None if the key is missing or null. Raises BadInput."""
        value = self.values.get(key)
        if value is None:
            return None
        if key == "bayer_pattern" and isinstance(value, str) and value.strip().upper() in BAYER_PATTERNS:
            value = value.strip().upper()
        try:
            if key == "time_utc":
                return parse_utc(value if isinstance(value, str) else value_text(value))
            value = SIDECAR.keys[key].check(value, key)
        except ValueError as error:
            raise self._fault(str(error)) from error
        except BadInput as error:  # of the time
            raise self._fault(f"{key}: {str(error)[:MAX_CAUSE_CHARS]}", error.reason) from error
        if key in IMAGE_KEYS:
            return os.path.join(self.path.parent, value)
        return resolve_path(self.path, value) if key in NAMED_FILES else value

    @property
    def warnings(self) -> list[str]:
        """A warning for each unknown key, which may be a misspelt one."""
        unknown = [key for key in self.values if key not in SIDECAR.keys][:MAX_UNKNOWN_KEY_WARNINGS]
        name, known = printable(self.path.name), ", ".join(SIDECAR.keys)
        return [f"sidecar {name}: key {key[:SHOWN_CHARS]!r} is none of {known}; not used" for key in unknown]

    def _fault(self, cause: str, reason: str = "bad_image") -> BadInput:
        return BadInput(reason, " ".join(f"sidecar {printable(self.path)}: {cause}".split()))


def resolve_path(file: Path, reference: str) -> str:
    """Path that `reference` is in `file`: relative to the folder of `file`; a name stays a name."""
    return os.path.join(file.parent, reference) if is_path(reference) else reference
