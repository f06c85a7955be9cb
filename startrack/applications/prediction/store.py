"""Draws kept on disk, so that a stopped prediction is resumed."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from startrack import __version__
from startrack.applications.prediction.draws import Task, draw_task
from startrack.core.chunk_store import ChunkStore, Progress, source_digest
from startrack.core.runner import TASK_LIMIT_S

FOLDER = ".predict"
SOURCES = (  # their content is part of a chunk's key
    "localization/*.py", "simulation/*.py", "evidence/*.py", "rendering/*.py", "terrain/*.py", "star_fix.py",
    "blocked_view.py", "prediction/draws.py",
)  # fmt: skip


def draw_store(out: Path, *, draws: int, jobs: int, progress: Progress, cluster: str | None = None) -> ChunkStore[Task]:
    """The store of draws under the folder `out`, of which each place has `draws`.

    They are made in `jobs` processes or on a `cluster`, and reported to `progress`.
    """
    limit_s = draws * TASK_LIMIT_S  # a draw takes as long as an image
    return ChunkStore(out / FOLDER, draw_task, _key, jobs=jobs, progress=progress, cluster=cluster, limit_s=limit_s)


def _key(task: Task) -> str:
    """Hash of all that decides a task's draws: the content of the files, not their paths."""
    settings = asdict(task)
    for name in ("camera", "terrain"):
        settings["conditions"][name] = Path(settings["conditions"][name]).name
    whole = json.dumps([__version__, source_digest(SOURCES), settings], sort_keys=True, default=str)
    return hashlib.sha256(whole.encode()).hexdigest()[:24]
