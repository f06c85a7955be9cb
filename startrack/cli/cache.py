"""`startrack cache`: what lies in the cache, and its removal."""

from __future__ import annotations

import argparse
import json
from contextlib import suppress
from pathlib import Path

from startrack.core.cache import cache_folder, limit_bytes
from startrack.core.compilation import choose_cache_folder, compiled_files
from startrack.core.files import Locked, hold_lock, printable, remove_file

TABLES, CODE = "tables of horizons", "compiled code"


def show(args: argparse.Namespace) -> int:
    """Print the folders of the cache with the number and size of their files, and the limit."""
    found = _found()
    if args.json:
        print(json.dumps({"limit_bytes": limit_bytes(), "folders": [_as_json(*one) for one in found]}))
        return 0
    for kind, folder, files in found:
        limit = f", at most {_megabytes(limit_bytes())}" if kind == TABLES else ""
        print(f"{kind:<18}  {_megabytes(_size(files)):>9} in {len(files)} files{limit}  {printable(folder)}")
    return 0


def clear(args: argparse.Namespace) -> int:
    """Remove the files of the cache. Raises BadOutput for one that has to stay."""
    found = _found()
    size = sum(_size(files) for *_, files in found)
    removed = [_as_json(*one) for one in found]
    for path in cache_folder("horizons").glob("*.lock"):
        with suppress(Locked, OSError), hold_lock(path, wait=False):  # of a killed process: it goes with the block
            pass
    for *_, files in found:
        for path in files:
            remove_file(path)
    if args.json:
        print(json.dumps({"removed_bytes": size, "folders": removed}))
    elif not args.quiet:
        print(f"removed {sum(len(files) for *_, files in found)} files, {_megabytes(size)}")
    return 0


def _found() -> list[tuple[str, Path, list[Path]]]:
    """Kind, folder and files of all that is kept, but the locks of tables that are being made."""
    choose_cache_folder()
    tables = cache_folder("horizons")
    kept = sorted(path for path in tables.glob("*") if path.is_file() and path.suffix != ".lock")
    return [(TABLES, tables, kept), *((CODE, folder, files) for folder, files in compiled_files().items())]


def _as_json(kind: str, folder: Path, files: list[Path]) -> dict[str, object]:
    return {"kind": kind, "folder": str(folder), "files": len(files), "bytes": _size(files)}


def _size(files: list[Path]) -> int:
    """Bytes of the files that are still there."""
    size = 0
    for path in files:
        with suppress(OSError):
            size += path.stat().st_size
    return size


def _megabytes(size: float) -> str:
    return f"{size / 1e6:.1f} MB"
