"""Files that a later run reads again: data with their hash, and JSON. Damaged ones count as missing."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from startrack.core.declaration import LARGEST
from startrack.core.files import FilePath, write_atomically

SEAL_BYTES = hashlib.sha256().digest_size


def write_sealed(path: FilePath, data: bytes) -> None:
    """Write `data` and behind them their SHA-256 in the place of a file at `path`. Raises as `write_atomically`.

    An archive or a pickle with that hash opens as without.
    """
    write_atomically(path, data + hashlib.sha256(data).digest(), overwrite=True)


def read_sealed(path: FilePath) -> bytearray | None:
    """The data that `write_sealed` wrote to `path`; None where there is no such file, or any byte of it has changed."""
    try:
        if not os.path.isfile(path):  # reading a pipe would block
            return None
        with open(path, "rb") as file:
            data = bytearray(os.fstat(file.fileno()).st_size)  # read in place: tables of horizons have 130 MB
            file.readinto(data)
    except OSError:
        return None
    seal = bytes(data[-SEAL_BYTES:])
    del data[-SEAL_BYTES:]
    return data if hashlib.sha256(data).digest() == seal else None


def read_json_object(path: FilePath) -> dict[str, Any] | None:
    """The JSON object in the file at `path`; None if it cannot be read, or is nested too deep."""
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8")) if os.path.isfile(path) else None
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def finite_json(text: str | bytes) -> Any:
    """What a JSON `text` holds; None for NaN and infinity, which JSON has not, and for numbers larger than any of ours.

    Raises ValueError or RecursionError for what is no JSON.
    """

    def usual(digits: str) -> float | int | None:
        value = float(digits)
        return None if abs(value) > LARGEST else value if {*digits} & {*".eE"} else int(digits)

    return json.loads(text, parse_constant=lambda _: None, parse_float=usual, parse_int=usual)
