"""What a batch gives besides the images' own files: one table, a trajectory, timings and a manifest.

Made from the images' records in the order of their names, so that they are the same bytes however often the batch was
stopped and whoever did the work. Only `timings.ecsv` differs from run to run.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from startrack import __version__
from startrack.batch.store import JOB, MANIFEST, RESULT
from startrack.files import write_atomically
from startrack.frames import R_from_quat_xyzw, quat_xyzw_from_R
from startrack.output.ecsv import Column, ecsv_text, formatted
from startrack.output.views import columns
from startrack.stages import STAGES

Record = dict[str, Any]
FORMAT = "startrack.manifest/1"
UNITS = {
    "m": "m",
    "m^2": "m2",
    "deg": "deg",
    "arcsec": "arcsec",
    "px": "pix",
    "s": "s",
    "mag/arcsec^2": "mag / arcsec2",
}  # astropy's
KINDS = {"d": "int64", "s": "string"}  # by the last letter of the format, else float64
# name, datatype, unit, form, path within the record
COLUMNS: list[tuple[str, str, str | None, str, tuple[Any, ...]]] = [
    ("image", "string", None, "%s", ("image",)),
    ("status", "string", None, "%s", ("status",)),
    ("reason", "string", None, "%s", ("reason",)),
    *(
        (column.name, KINDS.get(column.form[-1], "float64"), UNITS.get(one.unit), column.form,
         (*one.path.split("."), *column.at))
        for one, column in columns()
    ),
]  # fmt: skip


def write_tables(out: Path, records: Sequence[Record], settings: dict[str, Any]) -> list[Path]:
    """results.ecsv, results.parquet, trajectory.tum, timings.ecsv and manifest.json in `out`; the paths written."""
    records = sorted(records, key=lambda record: str(record["image"]))
    written = []
    makers: tuple[tuple[str, Callable[[], bytes]], ...] = (
        ("results.ecsv", lambda: ecsv_text([_column(records, *of) for of in COLUMNS]).encode()),
        ("results.parquet", lambda: _parquet(records)),
        ("trajectory.tum", lambda: "".join(sorted(map(_pose, filter(_located, records)))).encode()),
        ("timings.ecsv", lambda: _timings(records).encode()),
        (MANIFEST, lambda: _manifest(records, settings)),
    )
    for name, make in makers:
        write_atomically(out / name, make(), overwrite=True)
        written.append(out / name)
    return written


def values_of(records: Sequence[Record], at: tuple[str | int, ...]) -> list[Any]:
    """One column of the records; None where a record has no such value."""

    def value(record: Any) -> Any:
        for key in at:
            if record is None or (isinstance(key, str) and key not in record):
                return None
            record = record[key]
        return record

    return [value(record) for record in records]


def _column(
    records: Sequence[Record], name: str, datatype: str, unit: str | None, form: str, at: tuple[str | int, ...]
) -> Column:
    return Column(name, formatted(form, values_of(records, at)), datatype, unit)


def _parquet(records: Sequence[Record]) -> bytes:
    """The same table as Parquet, units in the columns' metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {"string": pa.string(), "float64": pa.float64(), "int64": pa.int64()}
    fields = [
        pa.field(name, kinds[kind], metadata={"unit": unit} if unit else None) for name, kind, unit, _, _ in COLUMNS
    ]
    table = pa.table([values_of(records, of[4]) for of in COLUMNS], schema=pa.schema(fields))
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return bytes(sink.getvalue().to_pybytes())


def _located(record: Record) -> bool:
    return record["status"] == "ok" and record["provenance"]["time_utc"] is not None


def _pose(record: Record) -> str:
    """A line of TUM's format: seconds of UTC, place, and the rotation from the rover's body to enu."""
    place, attitude = record["position"], record["attitude"]
    seconds = datetime.fromisoformat(record["provenance"]["time_utc"]).timestamp()
    quat = quat_xyzw_from_R(R_from_quat_xyzw(np.array(attitude["quat_xyzw_body_enu"])).T)
    numbers = [place["east_m"], place["north_m"], place["up_m"], *quat.tolist()]
    return f"{seconds:017.6f} " + " ".join(f"{number:.9f}" for number in numbers) + "\n"


def _timings(records: Sequence[Record]) -> str:
    table = [Column("image", values_of(records, ("image",)), "string")]
    for stage in STAGES:
        times = formatted("%.3f", values_of(records, ("timing_ms", stage)))
        table.append(Column(f"{stage}_ms", times, "float64", "ms"))
    return ecsv_text(table)


def _manifest(records: Sequence[Record], settings: dict[str, Any]) -> bytes:
    images = [
        {
            "image": record["image"],
            RESULT: record.get(RESULT),
            "status": record["status"],
            "image_sha256": record.get("provenance", {}).get("image_sha256"),
            JOB: record.get(JOB),
        }
        for record in records
    ]
    whole = {"format": FORMAT, "version": __version__, "settings": settings, "images": images}
    return (json.dumps(whole, indent=1, ensure_ascii=False) + "\n").encode()
