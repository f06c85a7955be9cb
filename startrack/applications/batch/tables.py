"""The tables of a batch: results, trajectories, timings and a manifest.

They are made from the images' records, sorted by name, so that they have the same bytes however the work was divided.
Only `timings.ecsv` differs from run to run.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from startrack.applications.batch import task as results
from startrack.applications.batch.find import Image, record_path, unique_names
from startrack.applications.batch.task import INPUTS, JOB, SOLVED, Record, Task, is_solved, stored_record, text_of_name
from startrack.chain import STAGES, content_sha256
from startrack.core import __version__
from startrack.core.files import write_atomically
from startrack.core.stored import read_json_object
from startrack.frames import R_from_quat_xyzw, tum_line
from startrack.output import Column, ecsv_text, file_schema, list_schema, object_schema, or_null, table_columns

FORMAT = "startrack.manifest/1"
MANIFEST_FILE = "manifest.json"
RESULT = "result"  # in the manifest: path of NAME.fix.json within the folder; null where that is an earlier solution
TRAJECTORY = "trajectory.tum"
PARQUET = "results.parquet"
NOT_IN_TABLES = ("modes", "message", "warnings", "format")
FILES = ("provenance.camera", "provenance.terrain")  # names or paths of files: the tables hold the stem, no path
COLUMNS = [*(Column(name, datatype="string", path=(name,)) for name in ("image", "status", "reason")), *table_columns()]
MANIFEST = file_schema(
    "Images of a batch",
    object_schema({
        "format": {"const": FORMAT},
        "version": "text",
        "settings": object_schema({}, "flags of the run"),
        "images": list_schema(object_schema({
            "image": "text",
            RESULT: or_null("text", "path of NAME.fix.json in the folder; null: that is of an earlier run"),
            "status": {"enum": [*SOLVED, "refused"]},
            "image_sha256": or_null("text", "of the image's file; null: not read"),
            JOB: or_null("text", "SHA-256 of all inputs; null: the next run repeats the image"),
        })),
    }),
)  # fmt: skip


class Rows(NamedTuple):
    """Rows of all images of a folder, and the numbers of results without a row and of former solutions kept."""

    rows: list[Record]
    omitted: int  # stored results of other settings or contents, or of an attempt that failed
    superseded: int  # images refused now because of an input, whose earlier solution is kept beside the tables


def table_values(record: Record) -> Record:
    """The part of a record that the tables need: the rest of 100,000 records need not stay in memory."""
    return {key: value for key, value in record.items() if key not in NOT_IN_TABLES}


def table_rows(tasks: Iterable[Task], now: Mapping[str, Record], out: str | os.PathLike[str]) -> Rows:
    """Rows of the whole folder's `tasks`; `now` has the records of this run by the images' names as text.

    `out` is the folder of the results."""
    rows, omitted, superseded = list[Record](), 0, 0
    for task in tasks:
        name = text_of_name(task.name)
        record = now.get(name) or results.valid_stored_record(task)
        if record is None:
            omitted += os.path.exists(task.result)
            continue
        is_superseded = name in now and not is_solved(record) and is_solved(stored_record(task.result))
        superseded += is_superseded
        result = text_of_name(Path(os.path.relpath(task.result, out)).as_posix())
        rows.append({**table_values(record), "image": name, RESULT: None if is_superseded else result})
    return Rows(rows, omitted, superseded)


def write_tables(out: Path, records: Sequence[Record], settings: dict[str, Any]) -> list[Path]:
    """Write results.ecsv, results.parquet (with the extra `parquet`), trajectories, timings.ecsv and manifest.json.

    Args:
        out: folder of the results.
        records: those of the images.
        settings: those of the run, for the manifest.

    Tables of an earlier run that this one does not make are removed. Returns the paths written; raises BadInput if
    one cannot be.
    """
    records = sorted(records, key=lambda record: str(record["image"]))
    columns = [replace(one, values=column_values(one, records), description="") for one in COLUMNS]
    made = {"results.ecsv": ecsv_text(columns).encode()} | ({PARQUET: _parquet(records)} if has_parquet() else {})
    made |= {name: "".join(lines).encode() for name, lines in _trajectories(records).items()}
    made |= {"timings.ecsv": _timings(records), MANIFEST_FILE: _manifest(records, settings)}
    for former in (out / PARQUET, out / TRAJECTORY, *out.glob("trajectory-*.tum")):
        if former.name not in made:
            with suppress(OSError):
                former.unlink()
    for name, data in made.items():
        write_atomically(out / name, data, overwrite=True)
    return [out / name for name in made]


def has_parquet() -> bool:
    """Whether the extra `parquet` is installed."""
    return find_spec("pyarrow") is not None


def reference_stem(reference: str) -> str:
    """Name of a camera or terrain: of a shipped one as it is, of a file its stem."""
    return PurePath(reference.replace("\\", "/")).name.removesuffix(".toml")


def column_values(column: Column, records: Sequence[Record]) -> list[Any]:
    """The values of a `column`, one a record, None if it has none."""
    values = [column.value(record) for record in records]
    is_file = ".".join(map(str, column.path)) in FILES
    return [value if value is None or not is_file else reference_stem(value) for value in values]


def _parquet(records: Sequence[Record]) -> bytes:
    """The results as Parquet, units in the columns' metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    types = {"string": pa.string(), "float64": pa.float64(), "int64": pa.int64()}
    fields = [
        pa.field(one.name, types[one.datatype], metadata={"unit": one.unit} if one.unit else None) for one in COLUMNS
    ]
    table = pa.table([column_values(one, records) for one in COLUMNS], schema=pa.schema(fields))
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return bytes(sink.getvalue().to_pybytes())


def _trajectories(records: Sequence[Record]) -> dict[str, list[str]]:
    """File name to TUM lines (Unix seconds; m; body to enu) of the solved images with a time, in its order.

    One file a terrain, whose origin is that of enu.
    """
    poses: dict[tuple[str, ...], list[str]] = {}
    for record in records:
        if record["status"] == "ok" and record["provenance"]["time_utc"] is not None:
            position, attitude = record["position"], record["attitude"]
            seconds = datetime.fromisoformat(record["provenance"]["time_utc"]).timestamp()
            position_m = np.array([position["east_m"], position["north_m"], position["up_m"]])
            line = tum_line(seconds, position_m, R_from_quat_xyzw(attitude["quat_xyzw_body_enu"]).T)
            poses.setdefault(_terrain_key(record), []).append(line)
    if len(poses) <= 1:
        return {TRAJECTORY: sorted(next(iter(poses.values()), []))}
    keys = sorted(poses)
    names = unique_names([key[0] for key in keys])
    return {f"trajectory-{name}.tum": sorted(poses[key]) for name, key in zip(names, keys, strict=True)}


def _terrain_key(record: Record) -> tuple[str, ...]:
    """Name of the terrain's file, and the hashes of the files of that name: equal for equal terrains only."""
    stem = reference_stem(str(record["provenance"].get("terrain") or record["position"].get("terrain")))
    inputs = record.get(INPUTS, {})
    return stem, *sorted(sha256 for path, sha256 in inputs.items() if PurePath(path).name == f"{stem}.toml")


def _timings(records: Sequence[Record]) -> bytes:
    table = [Column("image", [record["image"] for record in records], "string")]
    for stage in STAGES:
        times = [(record.get("timing_ms") or {}).get(stage) for record in records]
        table.append(Column(f"{stage}_ms", times, unit="ms", form="%.3f"))
    return ecsv_text(table).encode()


def _manifest(records: Sequence[Record], settings: dict[str, Any]) -> bytes:
    images = [
        {
            **{key: record.get(key) for key in ("image", RESULT, "status")},
            "image_sha256": record.get("provenance", {}).get("image_sha256"),
            JOB: record.get(JOB),
        }
        for record in records
    ]
    whole = {"format": FORMAT, "version": __version__, "settings": settings, "images": images}
    return (json.dumps(whole, indent=1, ensure_ascii=False) + "\n").encode()


def belongs_to_other_images(out: Path, images: Iterable[Image]) -> bool:
    """Whether `out` has results, none of which matches the current content of its image.

    Compared by content: the folder may have moved or grown, or some images may have changed.
    """
    listed = {one["image"]: one.get("image_sha256") for one in _manifest_images(out) or ()}
    some = bool(listed)
    for image in images:
        record = stored_record(record_path(out, image))
        known = listed.get(text_of_name(image.name)) or (record and results.image_sha256(record))
        if known is not None and known == content_sha256(image.path, image.bag_image):
            return False
        some = some or known is not None
    return some


def tabled_results(out: Path) -> set[str] | None:
    """Paths within `out` of the results in its tables; None if there is no manifest."""
    images = _manifest_images(out)
    return None if images is None else {str(one.get(RESULT)) for one in images}


def _manifest_images(out: Path) -> list[dict[str, Any]] | None:
    """Images in the manifest of the folder `out`, without damaged entries; None if there is no manifest."""
    images = (read_json_object(out / MANIFEST_FILE) or {}).get("images")
    if not isinstance(images, list):
        return None
    return [one for one in images if isinstance(one, dict) and isinstance(one.get("image"), str)]
