"""Observed frames as files: a track that was stopped goes on without locating its images again."""

from __future__ import annotations

import io
import json
from dataclasses import asdict, fields
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np

from startrack.applications.tracking.observed_frame import ImageFix, ObservedFrame
from startrack.core.files import write_atomically
from startrack.core.types import Array, Clock, Evidence, ImageErrors, ShownError
from startrack.estimation.observations import FrameEstimate

FORMAT = "startrack.observed-frame/3"
T = TypeVar("T")
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
    arrays: dict[str, Array] = {} if frame.R_body_enu is None else {"R_body_enu": frame.R_body_enu}
    parts: dict[str, Any] = {f"mode{number}": mode for number, mode in enumerate(frame.modes)}
    parts |= {f"fix{number}": fix for number, fix in enumerate(frame.fixes)}
    if frame.evidence is not None:
        arrays |= {f"evidence.{name}": np.asarray(getattr(frame.evidence, name)) for name in ROWS}
        parts |= {"clock": frame.evidence.clock, "errors": frame.evidence.image_errors}
    for prefix, part in parts.items():
        if part is not None:  # a dataclass of numbers and arrays
            arrays |= {f"{prefix}.{f.name}": np.asarray(getattr(part, f.name)) for f in fields(part)}
    head = {
        "format": FORMAT, "name": frame.name, "time_utc": frame.time_utc.isoformat(), "modes": len(frame.modes),
        "fixes": len(frame.fixes), "shown": [asdict(one) for one in frame.shown], "reason": frame.reason,
        "message": frame.message,
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
    rows = None
    if "evidence.llr" in arrays:
        clock = _value(Clock, "clock", arrays) if "clock.turn_rad_s" in arrays else None
        errors = _value(ImageErrors, "errors", arrays) if "errors.covariance" in arrays else None
        rows = Evidence(clock=clock, image_errors=errors, **{name: arrays[f"evidence.{name}"] for name in ROWS})
    return ObservedFrame(
        head["name"], datetime.fromisoformat(head["time_utc"]), arrays.get("R_body_enu"),
        tuple(_value(FrameEstimate, f"mode{number}", arrays) for number in range(head["modes"])), rows,
        tuple(_value(ImageFix, f"fix{number}", arrays) for number in range(head["fixes"])),
        tuple(ShownError(**one) for one in head["shown"]), head["reason"], head["message"],
    )  # fmt: skip


def _value(kind: type[T], prefix: str, arrays: dict[str, Any]) -> T:
    """The dataclass that `encode_frame` took apart."""
    values = {f.name: arrays[f"{prefix}.{f.name}"] for f in fields(kind)}  # type: ignore[arg-type]
    return kind(**{name: one if one.ndim else float(one) for name, one in values.items()})
