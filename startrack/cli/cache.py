"""`startrack cache`: what lies in the cache, and its removal."""

from __future__ import annotations

import argparse
import json
from contextlib import suppress
from pathlib import Path

from startrack.core.files import Locked, hold_lock, printable, remove_file
from startrack.core.stored import cache_folder, limit_bytes

TABLES, KIND = "tables of horizons", "horizons"


def show(args: argparse.Namespace) -> int:
    """Print the folder of the cache with the number and size of its files, and the limit."""
    files = _files()
    if args.json:
        print(json.dumps({"limit_bytes": limit_bytes(), "folders": [_as_json(files)]}))
        return 0
    size, limit = _megabytes(_size(files)), _megabytes(limit_bytes())
    print(f"{TABLES}  {size:>9} in {len(files)} files, at most {limit}  {printable(cache_folder(KIND))}")
    return 0


def clear(args: argparse.Namespace) -> int:
    """Remove the files of the cache. Raises BadOutput for one that has to stay."""
    files = _files()
    size, removed = _size(files), _as_json(files)
    for path in cache_folder(KIND).glob("*.lock"):
        with suppress(Locked, OSError), hold_lock(path, wait=False):  # of a killed process: it goes with the block
            pass
    for path in files:
        remove_file(path)
    if args.json:
        print(json.dumps({"removed_bytes": size, "folders": [removed]}))
    elif not args.quiet:
        print(f"removed {len(files)} files, {_megabytes(size)}")
    return 0


def _files() -> list[Path]:
    """All that is kept, but the locks of tables that are being made."""
    return sorted(path for path in cache_folder(KIND).glob("*") if path.is_file() and path.suffix != ".lock")


def _as_json(files: list[Path]) -> dict[str, object]:
    return {"kind": TABLES, "folder": str(cache_folder(KIND)), "files": len(files), "bytes": _size(files)}


def _size(files: list[Path]) -> int:
    """Bytes of the files that are still there."""
    size = 0
    for path in files:
        with suppress(OSError):
            size += path.stat().st_size
    return size


def _megabytes(size: float) -> str:
    return f"{size / 1e6:.1f} MB"
