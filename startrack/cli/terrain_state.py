"""`startrack terrain state`: write into a terrain file the errors that it leaves out."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from startrack.cli.flag_types import amount
from startrack.cli.flags import JSON, MORE, Command, flag
from startrack.core.errors import BadInput
from startrack.core.files import parse_toml, printable, read_text, resolve_named, write_atomically

if TYPE_CHECKING:
    from startrack.terrain import StateableError

FLAGS = {  # keys of the file, and the unit of each
    "depth_sigma_m": "M", "diameter_sigma_m": "M", "ellipse_sigma_1": "X", "rim_tilt_sigma_deg": "DEG",
    "height_sigma_m": "M", "horizon_sigma_deg": "DEG", "stretch_sigma_1": "X", "vertical_sigma_deg": "DEG",
    "camera_height_sigma_m": "M",
}  # fmt: skip
Values = dict[tuple[str, str], float | bool]  # by table and key


def _flag(key: str) -> str:
    return "--" + key.rpartition("_")[0].replace("_", "-")


def state_terrain(args: argparse.Namespace) -> int:
    """Write the errors; 0, or 2 where there is nothing to write and nobody to ask. Raises BadInput, BadOutput."""
    from startrack.terrain import stateable_errors

    path = resolve_named(args.file, "terrain", "bad_terrain")
    text = read_text(path, "bad_terrain")
    try:
        known = stateable_errors(text)
        missing = [error for error in known if error.is_missing]
        values = _values_of_flags(args, known, text)
        if not values and missing and sys.stdin.isatty():
            values = _ask(missing)
        changed = _changed_text(path, text, values) if values else text
    except BadInput as cause:
        raise BadInput(cause.reason, f"{printable(path)}: {cause}") from cause
    if values:
        write_atomically(path, changed.encode("utf-8"), overwrite=True, reason="bad_terrain")
    _show(args, path, missing, values)
    return 2 if missing and not values and not sys.stdin.isatty() else 0


def _values_of_flags(args: argparse.Namespace, known: list[StateableError], text: str) -> Values:
    """What the flags state. Wrong usage: keys of another kind of terrain, and keys that the file states."""
    given = {key: getattr(args, key) for key in FLAGS if getattr(args, key) is not None}
    tables = {error.key: error.table for error in known}
    for key in given:
        if key not in tables:
            args.usage_error(f"{_flag(key)}: {args.file} has no {key}: it describes another kind of ground")
    if not args.exact:
        return {(tables[key], key): value for key, value in given.items()}
    if "depth_sigma_m" not in tables:
        zeros = {error.key: 0.0 for error in known if error.is_missing}
        return {(tables[key], key): value for key, value in {**zeros, **given}.items()}
    values: Values = {(tables[key], key): value for key, value in given.items()}
    if "exact" not in parse_toml(text, "bad_terrain")["cylinder"]:
        values["cylinder", "exact"] = True
    return values


def _ask(missing: list[StateableError]) -> Values:
    """Answers on the terminal; an empty one leaves an error unstated."""
    print("One standard deviation of each; 0 if it is exact; Enter leaves it out.")
    values: Values = {}
    for error in missing:
        while (answer := _answer(error)) is not None:
            try:
                values[error.table, error.key] = amount(answer)
                break
            except (argparse.ArgumentTypeError, ValueError) as cause:
                print(f"  {cause}")
    return values


def _answer(error: StateableError) -> str | None:
    try:
        return input(f"{error.key}, {error.meaning} (left out: {error.default}): ").strip() or None
    except EOFError:
        return None


def _changed_text(path: Path, text: str, values: Values) -> str:
    """The text of the file with the values. Raises BadInput where it would be no terrain."""
    from startrack.terrain import state_errors, terrain_from_dict

    changed = state_errors(text, values)
    terrain_from_dict(parse_toml(changed, "bad_terrain"), default_name=path.stem, folder=path.parent)
    return changed


def _show(args: argparse.Namespace, path: Path, missing: list[StateableError], values: Values) -> None:
    """Print what was written and what is left out."""
    written = {key: value for (_, key), value in values.items()}
    left = [error for error in missing if error.key not in written and "exact" not in written]
    if args.json:
        unstated = [{"fact": error.key, "default": error.default} for error in left]
        print(json.dumps({"format": "startrack.terrain/1", "file": str(path), "stated": written, "unstated": unstated}))
    elif not args.quiet:
        lines = [f"  written   {key} = {str(value).lower()}" for key, value in written.items()]
        lines += [f"  left out  {error.key}, {error.meaning}: {error.default}" for error in left]
        print("\n".join([str(path), *(lines or ["  states every error"])]))
    if left and not written and not sys.stdin.isatty():
        flags = " ".join(f"{_flag(error.key)} {FLAGS[error.key]}" for error in left)
        print(f"startrack terrain state {path}: give {flags}, or --exact", file=sys.stderr)


COMMAND = Command(
    "state", state_terrain, "write into a terrain file the errors that it leaves out",
    "An error that the file states is trusted; for one that it leaves out a default counts, and that it may be grossly "
    "wrong. Without flags the missing ones are asked for, or listed where there is no terminal.",
    {
        "input": (
            flag("file FILE", "the terrain file; its comments stay"),
            *(flag(f"{_flag(key)} {unit}", "one standard deviation", amount, dest=key) for key, unit in FLAGS.items()),
            flag("--exact", "the terrain is a model: errors that it leaves out are 0"),
        ),
        "more": (JSON, *MORE),
    },
    "startrack terrain state own.toml --depth-sigma 30",
)  # fmt: skip
