"""What a folder of results holds already, and of which images it is."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from startrack.batch.find import Image
from startrack.batch.inputs import sha256_of

JOB = "job_sha256"  # what a result was made from: content of all its files, flags, version; null: to be done again
INPUTS = "inputs"  # camera and terrain files that the result was made with: path from the image to SHA-256
MANIFEST = "manifest.json"
RESULT = "result"  # in the manifest: path of NAME.fix.json within the folder


def stored(result: str | Path) -> dict[str, Any] | None:
    """A result's record, or None where there is none that can be read."""
    try:
        record = json.loads(Path(result).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) else None


def printable(name: str) -> str:
    """A file's name as text: bytes that are none become question marks."""
    return name.encode("utf-8", "replace").decode("utf-8")


def result_of(out: Path, image: Image) -> Path:
    """Where the image's result goes."""
    return out / f"{image.stem}.fix.json"


def is_of_other_images(out: Path, images: Iterable[Image]) -> bool:
    """Whether `out` is of a batch of other images: it has results, and not one is of what its image holds now.

    Told by content, so that the folder may have moved, grown, or changed in part.
    """
    listed = {one["image"]: one.get("image_sha256") for one in _listed(out) or ()}
    some = bool(listed)
    for image in images:
        known = listed.get(printable(image.name)) or _image_sha256(stored(result_of(out, image)))
        if known is not None and known == sha256_of(image.path):
            return False
        some = some or known is not None
    return some


def in_the_tables(out: Path) -> set[str] | None:
    """Paths within `out` of the results that its tables are of; None where there is no manifest."""
    images = _listed(out)
    return None if images is None else {str(one.get(RESULT)) for one in images}


def _listed(out: Path) -> list[dict[str, Any]] | None:
    images = (stored(out / MANIFEST) or {}).get("images")
    if not isinstance(images, list):
        return None
    return [one for one in images if isinstance(one, dict) and isinstance(one.get("image"), str)]


def _image_sha256(record: dict[str, Any] | None) -> str | None:
    """Of a batch's record: what `locate` left is no batch's."""
    provenance = record.get("provenance") if record is not None and JOB in record else None
    return provenance.get("image_sha256") if isinstance(provenance, dict) else None
