"""Terrain files that leave errors out: which ones, what counts for them, and the file with them written in."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from startrack.core.files import parse_toml
from startrack.core.types import BadInput
from startrack.terrain.io import read_keys
from startrack.terrain.shape import (
    BIAS,
    CAMERA_ERROR,
    CYLINDER_FACTS,
    DEPTH,
    DIAMETER,
    OFFSETS,
    REFRACTION,
    STRETCH,
    WAVE_PER_POST,
    WAVES,
    Fact,
    vertical_fact,
)

HEIGHT_KEY = "height_sigma_m"


@dataclass(frozen=True)
class StateableError:
    """A key of a terrain file that states an error."""

    table: str  # of the file
    key: str
    meaning: str
    default: str  # what counts where the key is absent
    is_missing: bool  # and matters


def stateable_errors(text: str) -> list[StateableError]:
    """The errors that a terrain file with this `text` states or could state. Raises BadInput bad_terrain."""
    keys = read_keys(text)
    vertical = vertical_fact(keys["body"])
    dem, rover, cylinder = keys.get("dem", {}), keys.get("rover", {}), keys.get("cylinder")
    if cylinder is not None:
        sizes_m = {DEPTH.key: cylinder["depth_m"], DIAMETER.key: cylinder["diameter_m"]}
        inexact = not cylinder.get("exact", False)
        rows = [
            ("cylinder", fact, _default_text(fact, sizes_m.get(fact.key)), inexact and fact.key not in cylinder)
            for fact in CYLINDER_FACTS
        ]
        rows.append(("rover", CAMERA_ERROR, "0", False))
    else:
        rows = [
            ("dem", BIAS, f"three times what {HEIGHT_KEY} makes of the horizon", BIAS.key not in dem),
            *(("dem", fact, _default_text(fact), fact.key not in dem) for fact in (STRETCH, vertical)),
            ("dem", WAVES, _waves_text(), WAVES.key not in dem),
            ("dem", OFFSETS, _default_text(OFFSETS), OFFSETS.key not in dem and not isinstance(dem["file"], str)),
            ("rover", CAMERA_ERROR, _default_text(CAMERA_ERROR), CAMERA_ERROR.key not in rover),
        ]
        if keys["body"] == "earth":
            rows.append(("air", REFRACTION, _default_text(REFRACTION), REFRACTION.key not in keys.get("air", {})))
    found = [
        StateableError(table=table, key=fact.key, meaning=fact.meaning, default=default, is_missing=missing)
        for table, fact, default, missing in rows
    ]
    if cylinder is not None:
        return found
    meaning, default = "error of single heights of the map [m]", "0, with a warning"
    return [StateableError("dem", HEIGHT_KEY, meaning, default, is_missing=HEIGHT_KEY not in dem), *found]


def _waves_text() -> str:
    """What counts where a file leaves the waves out."""
    gross = f"with probability {100 * WAVES.gross_probability:g} % a seam of {np.degrees(WAVES.gross_sigma):.4g}"
    return f"{WAVE_PER_POST:g} of what {HEIGHT_KEY} makes of the horizon, and {gross}"


def _default_text(fact: Fact, size_m: float | None = None) -> str:
    """The prior of a fact that a file leaves out, in the unit of its key; `size_m` is what a relative error is of."""
    unit = 180.0 / np.pi if fact.key.endswith("_deg") else size_m or 1.0
    text = f"{fact.sigma * unit:.4g}"
    if fact.gross_probability:
        text += f", and with probability {100 * fact.gross_probability:g} % {fact.gross_sigma * unit:.4g}"
    return text


def state_errors(text: str, values: Mapping[tuple[str, str], float | bool]) -> str:
    """The `text` of a terrain file with `values` by table and key written in; all else is as before.

    Raises BadInput bad_terrain where a key is there already, or the file's notation leaves no place for it.
    """
    for (table, key), value in values.items():
        before = parse_toml(text, "bad_terrain")
        if key in before.get(table, {}):
            raise BadInput("bad_terrain", f"it states {table}.{key} already")
        wanted = {**before, table: {**before.get(table, {}), key: value}}
        line = f"{key} = {str(value).lower() if isinstance(value, bool) else repr(float(value))}"
        fits = (changed for changed in _places(text, table, line) if _keys_of(changed) == wanted)
        found = next(fits, None)
        if found is None:
            raise BadInput("bad_terrain", f"startrack finds no place for it: write `{line}` into [{table}] by hand")
        text = found
    return text


def _keys_of(text: str) -> dict[str, Any] | None:
    """The keys of a TOML text; None if it is none."""
    try:
        return parse_toml(text, "bad_terrain")
    except BadInput:
        return None


def _places(text: str, table: str, line: str) -> Iterator[str]:
    """Texts with the line after the last key of the table, after its header, or in a table of its own at the end."""
    end = "\r\n" if "\r\n" in text else "\n"
    lines = text.splitlines(keepends=True)
    for at, one in enumerate(lines):
        if re.match(rf"\s*\[\s*{table}\s*\]", one):
            rest = at + 1
            while rest < len(lines) and not re.match(r"\s*\[", lines[rest]):
                rest += 1
            while rest > at + 1 and re.match(r"\s*(#|$)", lines[rest - 1]):
                rest -= 1
            for place in (rest, at + 1):
                head = "".join(lines[:place])
                yield head + ("" if head.endswith("\n") else end) + line + end + "".join(lines[place:])
    yield text + ("" if text.endswith("\n") else end) + f"{end}[{table}]{end}{line}{end}"
