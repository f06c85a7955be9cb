"""One image of a batch: located wherever a worker is, unless its result is there already."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from startrack import __version__
from startrack.errors import INTERNAL_ERROR, BadInput
from startrack.exposure.facts import sidecars

JOB = "job_sha256"  # what a result was made from: content of all its files, flags, version
INPUTS = "inputs"  # files that the result was made with: path to SHA-256


@dataclass(frozen=True)
class Task:
    """An image and all that decides its result; small, so that it travels to any worker."""

    name: str  # of the image, relative to the batch's folder
    path: str
    result: str  # path of NAME.fix.json
    facts: dict[str, Any] = field(default_factory=dict)  # from flags: time_utc, exposure_s, camera, terrain
    plots: bool = True
    renew: bool = False  # do it again even where the result is there
    compiled: bool = False  # the localizer's compiled engine


def locate_image(task: Task) -> tuple[dict[str, Any], bool]:
    """The image's record, and whether it was there already. Never raises for an image's sake.

    NAME.fix.json is written last, so that a result that is there is whole.
    """
    try:
        key = job_key(task)
        before = None if task.renew else stored(task.result)
        if before is not None and before.get(JOB) == key and _unchanged(before.get(INPUTS, {})):
            return before, True
        return _fresh(task, key), False
    except BadInput as cause:  # results cannot be written there
        return lost(task, str(cause), cause.reason), False
    except MemoryError:
        raise
    except Exception as cause:  # noqa: BLE001 - one image's fault is its own; it is counted and told as such
        return lost(task, f"internal error: {type(cause).__name__}: {cause}"), False


def lost(task: Task, message: str, reason: str = INTERNAL_ERROR) -> dict[str, Any]:
    """The record of an image that could not even be begun, or that took its worker with it."""
    from startrack.report import refused_dict

    return {**refused_dict(task.name, reason, message), "image": printable(task.name)}


def printable(name: str) -> str:
    """A file's name as text: bytes that are none become question marks."""
    return name.encode("utf-8", "replace").decode("utf-8")


def _fresh(task: Task, key: str) -> dict[str, Any]:
    """The record made anew. The old one goes first, so that no half of a result is ever taken for a whole."""
    from startrack.report import refused_dict, remove_companions, write_json

    result = Path(task.result)
    result.parent.mkdir(parents=True, exist_ok=True)
    result.unlink(missing_ok=True)
    remove_companions(result.parent, result.name.removesuffix(".fix.json"))
    inputs: dict[str, str] = {}
    try:
        record, inputs = _located(task, result)
    except BadInput as cause:
        record = refused_dict(task.name, cause.reason, str(cause))
    except MemoryError:
        raise
    except Exception as cause:  # noqa: BLE001 - one image's fault is its own; it is counted and told as such
        record = refused_dict(task.name, INTERNAL_ERROR, f"internal error: {type(cause).__name__}: {cause}")
    record = {**record, "image": printable(task.name), JOB: key, INPUTS: inputs}
    write_json(task.result, record)
    return record


def stored(result: str) -> dict[str, Any] | None:
    """A result's record, or None where there is none that can be read."""
    try:
        record = json.loads(Path(result).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) else None


def job_key(task: Task) -> str:
    """SHA-256 of what decides the result: image, sidecar, flags and version; camera and terrain files are INPUTS."""
    digest = hashlib.sha256(json.dumps([__version__, task.facts, task.plots, task.compiled], default=str).encode())
    sidecar = next((path for path in sidecars(Path(task.path)) if path.is_file()), None)
    for path in (Path(task.path), sidecar):
        digest.update(_digest(path))
    return digest.hexdigest()


def _inputs(references: list[str | None]) -> dict[str, str]:
    """Path to SHA-256 of the camera's and terrain's files, height maps included; a shipped one's name needs none."""
    import tomllib

    files = [Path(reference) for reference in references if reference and Path(reference).is_file()]
    for path in tuple(files):
        maps = tomllib.loads(path.read_text(encoding="utf-8")).get("dem", {}).get("file", [])
        files += [path.parent / name for name in ([maps] if isinstance(maps, str) else maps)]
    return {str(path): _digest(path).hex() for path in files}


def _unchanged(inputs: dict[str, str]) -> bool:
    return all(_digest(Path(path)).hex() == digest for path, digest in inputs.items())


def _located(task: Task, result: Path) -> tuple[dict[str, Any], dict[str, str]]:
    from startrack.exposure import read_exposure
    from startrack.localize import ExactPosterior
    from startrack.pipeline import Settings, locate_exposure
    from startrack.report import write_results

    exposure = read_exposure(task.path, **task.facts)
    found = locate_exposure(exposure, Settings(localizer=ExactPosterior(compiled=task.compiled)))
    record = write_results(found, result, plots=task.plots, write_record=False)
    return record, _inputs([exposure.camera, exposure.terrain])


def _digest(path: Path | None) -> bytes:
    if path is None:
        return b"-"
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").digest()
    except OSError:
        return b"?"  # said by whoever reads it
