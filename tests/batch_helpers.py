"""Quick frames for the tests of batches."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from startrack.applications.batch import Task

SIZE = 256
CAMERA = f"""
name = "small"
size_px = [{SIZE}, {SIZE}]
focal_px = [80.0, 80.0]
centre_px = [127.5, 127.5]
max_angle_deg = 92.5
"""
FACTS = {"time_utc": "2030-01-01T00:00:00Z", "exposure_s": 1.0, "camera": "small.toml", "terrain": "shackleton-thesis"}


def frames(folder: Path, count: int, level: int = 100) -> list[Path]:
    """Frames of the lens cap, each with other noise: refused for lack of stars within milliseconds."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "small.toml").write_text(CAMERA)
    paths = [folder / f"{number:02d}.png" for number in range(count)]
    for number, path in enumerate(paths):
        pixels = np.random.default_rng(number).normal(level, 3, (SIZE, SIZE)).round().astype(np.uint16)
        path.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
        path.with_suffix(".json").write_text(json.dumps(FACTS))
    return paths


def stdin_of(*names: str, end: str = "\n") -> io.TextIOWrapper:
    """Standard input with the images' names."""
    return io.TextIOWrapper(io.BytesIO("".join(name + end for name in names).encode()))


def task_of(image: Path, out: Path, plots: bool = False, **facts: Any) -> Task:
    """The batch's task for one image."""
    return Task(name=image.name, path=str(image), result=str(out / f"{image.stem}.fix.json"), facts=facts, plots=plots)
