"""One image of a batch: located wherever a worker is, unless its result is there already."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from startrack import __version__
from startrack.exposure.facts import sidecars
from startrack.types import BadInput

INTERNAL_ERROR = "internal_error"
JOB = "job_sha256"  # what a result was made from: content of all its files, flags, version
OUTPUTS = (".stars.ecsv", ".annotated.png", ".wcs", ".corr")


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
    key = job_key(task)
    before = None if task.renew else stored(task.result)
    if before is not None and before.get(JOB) == key:
        return before, True
    result = Path(task.result)
    result.parent.mkdir(parents=True, exist_ok=True)
    for suffix in OUTPUTS:
        result.with_name(result.name.removesuffix(".fix.json") + suffix).unlink(missing_ok=True)
    try:
        record = _located(task, result)
    except BadInput as cause:
        record = _refused(task, cause.reason, str(cause))
    except MemoryError:
        raise
    except Exception as cause:  # noqa: BLE001 - one image's fault is its own; it is counted and told as such
        record = _refused(task, INTERNAL_ERROR, f"internal error: {type(cause).__name__}: {cause}")
    from startrack.report import write_json

    record = {**record, "image": task.name, JOB: key}
    write_json(task.result, record)
    return record, False


def stored(result: str) -> dict[str, Any] | None:
    """A result's record, or None where there is none that can be read."""
    try:
        record = json.loads(Path(result).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) else None


def job_key(task: Task) -> str:
    """SHA-256 of what decides the result: image, sidecar, camera and terrain files, flags and version."""
    digest = hashlib.sha256(json.dumps([__version__, task.facts, task.plots, task.compiled], default=str).encode())
    sidecar = next((path for path in sidecars(Path(task.path)) if path.is_file()), None)
    for path in (Path(task.path), sidecar):
        digest.update(_digest(path))
    for kind in ("camera", "terrain"):
        reference = task.facts.get(kind) or _named_in(sidecar, kind)
        digest.update(_digest(Path(reference)) if reference and Path(reference).is_file() else b"-")
    return digest.hexdigest()


def _located(task: Task, result: Path) -> dict[str, Any]:
    from startrack.exposure import read_exposure
    from startrack.localize import ExactPosterior
    from startrack.pipeline import Settings, locate_exposure
    from startrack.report import write_results

    exposure = read_exposure(task.path, **task.facts)
    found = locate_exposure(exposure, Settings(localizer=ExactPosterior(compiled=task.compiled)))
    return write_results(found, result, plots=task.plots, write_record=False)


def _refused(task: Task, reason: str, message: str) -> dict[str, Any]:
    from startrack.report import refused_dict

    return refused_dict(task.name, reason, message)


def _digest(path: Path | None) -> bytes:
    if path is None:
        return b"-"
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").digest()
    except OSError:
        return b"?"  # said by whoever reads it


def _named_in(sidecar: Path | None, kind: str) -> str | None:
    """A camera's or terrain's file as the sidecar names it; a shipped one's name is as good as its content."""
    if sidecar is None:
        return None
    value = _sidecar(str(sidecar), sidecar.stat().st_mtime_ns).get(kind)
    return str(sidecar.parent / value) if isinstance(value, str) else None


@lru_cache(maxsize=16)
def _sidecar(path: str, _changed_ns: int) -> dict[str, Any]:
    return stored(path) or {}
