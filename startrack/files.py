"""Where the shipped catalogues, cameras and terrains lie, in a wheel as in a checkout; and folders for results."""

from __future__ import annotations

import os
import tempfile
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


def made_folder(folder: str | Path, reason: str = "bad_image") -> Path:
    """A folder for results, made and found to take files before anything is computed.

    Raises BadInput (bad_image, for lack of a better code) where nothing can be written there.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as cause:
        raise BadInput(
            reason, f"{path}: results cannot be written to this folder ({cause.strerror}): choose another"
        ) from cause
    return path
