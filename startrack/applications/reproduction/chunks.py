"""The chunks of fixes of the thesis's tables and figures."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from startrack import __version__
from startrack.applications.reproduction.methods import Task, compute_chunk
from startrack.core import chunk_store
from startrack.core.chunk_store import Progress, source_digest

FOLDER = ".chunks"
SOURCES = (  # their content is part of a chunk's key
    "localization/*.py", "terrain/cylinder.py", "reproduction/simulator.py", "reproduction/methods.py",
    "reproduction/bound.py",
)  # fmt: skip


class ChunkStore(chunk_store.ChunkStore[Task]):
    """Computes tasks of this room and keeps their chunks under `folder`."""

    def __init__(self, folder: Path, *, jobs: int, progress: Progress, cluster: str | None = None) -> None:
        super().__init__(folder / FOLDER, compute_chunk, _key, jobs=jobs, progress=progress, cluster=cluster)


def _key(task: Task) -> str:
    settings = json.dumps([__version__, source_digest(SOURCES), asdict(task)], sort_keys=True)
    return hashlib.sha256(settings.encode()).hexdigest()[:24]
