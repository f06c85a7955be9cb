"""Where the shipped catalogues, cameras and terrains lie, in a wheel as in a checkout."""

from __future__ import annotations

import os
from pathlib import Path

from startrack.errors import BadInput

PACKAGE = Path(__file__).resolve().parent


def data_dir(kind: str) -> Path:
    """Folder of the shipped `kind` ("catalogs", "calib" or "terrain").

    A wheel carries them inside the package; a checkout has them at the top level.
    """
    inside = PACKAGE / "data" / kind
    return inside if inside.is_dir() else PACKAGE.parent / kind


def is_path(name_or_path: str | Path) -> bool:
    """Whether a user's word means a path (it ends in .toml or contains a separator) rather than a shipped name."""
    text = str(name_or_path)
    return text.endswith(".toml") or "/" in text or os.sep in text


def resolve_named(name_or_path: str | Path, kind: str, reason: str) -> Path:
    """Path of a user's file or of a shipped one. Raises BadInput `reason` where there is none."""
    if is_path(name_or_path):
        path = Path(name_or_path)
        if not path.is_file():
            raise BadInput(reason, f"{path}: no such file")
        return path
    path = data_dir(kind) / f"{name_or_path}.toml"
    if not path.is_file():
        shipped = ", ".join(sorted(p.stem for p in data_dir(kind).glob("*.toml")))
        raise BadInput(reason, f"no shipped file is called {name_or_path!r}; shipped: {shipped}; a path ends in .toml")
    return path
