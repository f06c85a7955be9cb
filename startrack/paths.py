"""Where the shipped catalogues, cameras and terrains lie, in a wheel as in a checkout."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).resolve().parent


def data_dir(kind: str) -> Path:
    """Folder of the shipped `kind` ("catalogs", "calib" or "terrain").

    A wheel carries them inside the package; a checkout has them at the top level.
    """
    inside = PACKAGE / "data" / kind
    return inside if inside.is_dir() else PACKAGE.parent / kind
