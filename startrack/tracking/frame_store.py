"""Observed frames as files: a track that was stopped goes on without locating its images again."""

from __future__ import annotations

import io
import json
from dataclasses import fields
from datetime import datetime
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from startrack.files import write_atomically
from startrack.tracking.frame_estimate import FrameEstimate
from startrack.tracking.observe import ObservedFrame
from startrack.tracking.shared import ImageErrors
from startrack.types import Array, Clock, Evidence

FORMAT = "startrack.observed-frame/2"
ROWS = ("azimuth_rad", "elevation_rad", "llr", "edge_sigma_rad", "extended_nats")


class FrameStore:
    """The frames in a folder, by the hash of all that decides them."""

    def __init__(self, folder: Path) -> None:
        """`folder` need not exist yet."""
        self.folder = folder

    def read(self, key: str) -> ObservedFrame | None:
        """The frame stored under `key`; None if there is none, or its file is damaged."""
        try:
            return decode_frame(self._path(key).read_bytes())
        except (OSError, ValueError, KeyError, BadZipFile):
            return None

    def write(self, key: str, frame: ObservedFrame) -> None:
        """Store the `frame` under `key`, complete or not at all. Raises BadInput if that is impossible."""
        write_atomically(self._path(key), encode_frame(frame), overwrite=True)

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.npz"


def encode_frame(frame: ObservedFrame) -> bytes:
    """The `frame` as a NumPy archive, without pickled objects."""
    arrays: dict[str, Array] = {}
    if frame.R_body_enu is not None:
        arrays["R_body_enu"] = frame.R_body_enu
    for number, mode in enumerate(frame.modes):
        arrays |= {f"mode{number}.{f.name}": np.asarray(getattr(mode, f.name)) for f in fields(mode)}
    if frame.evidence is not None:
        arrays |= {f"evidence.{name}": np.asarray(getattr(frame.evidence, name)) for name in ROWS}
        if frame.evidence.clock is not None:
            arrays |= {f"clock.{f.name}": np.asarray(getattr(frame.evidence.clock, f.name)) for f in fields(Clock)}
    if frame.image_errors is not None:
        arrays |= {f"errors.{f.name}": getattr(frame.image_errors, f.name) for f in fields(ImageErrors)}
    head = {
        "format": FORMAT, "name": frame.name, "time_utc": frame.time_utc.isoformat(), "modes": len(frame.modes),
        "reason": frame.reason, "message": frame.message, "steeper": frame.steeper,
    }  # fmt: skip
    file = io.BytesIO()
    np.savez(file, head=np.array(json.dumps(head)), **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def decode_frame(data: bytes) -> ObservedFrame:
    """The frame in the archive `data`. Raises ValueError, KeyError or BadZipFile for another file."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        arrays: dict[str, Any] = dict(archive)
    head = json.loads(str(arrays["head"]))
    if head["format"] != FORMAT:
        raise ValueError(f"format {head['format']}, expected {FORMAT}")
    errors = None
    if "errors.covariance" in arrays:
        errors = ImageErrors(**{f.name: arrays[f"errors.{f.name}"] for f in fields(ImageErrors)})
    return ObservedFrame(
        head["name"], datetime.fromisoformat(head["time_utc"]), arrays.get("R_body_enu"),
        tuple(_mode(arrays, number) for number in range(head["modes"])), _evidence(arrays), errors, head["reason"],
        head["message"], head["steeper"],
    )  # fmt: skip


def _mode(arrays: dict[str, Any], number: int) -> FrameEstimate:
    values = {f.name: arrays[f"mode{number}.{f.name}"] for f in fields(FrameEstimate)}
    return FrameEstimate(**{**values, "weight": float(values["weight"])})


def _evidence(arrays: dict[str, Any]) -> Evidence | None:
    if "evidence.llr" not in arrays:
        return None
    clock = None
    if "clock.turn_rad_s" in arrays:
        of_clock: dict[str, Any] = {f.name: arrays[f"clock.{f.name}"] for f in fields(Clock)}
        numbers = {name: float(one) for name, one in of_clock.items() if not one.ndim}
        clock = Clock(turn_rad_s=of_clock["turn_rad_s"], **numbers)
    return Evidence(clock=clock, **{name: arrays[f"evidence.{name}"] for name in ROWS})
