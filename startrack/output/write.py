"""Results to files: each appears under its name only when it is whole."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.errors import BadInput
from startrack.files import make_folder, write_atomically

if TYPE_CHECKING:
    from startrack.stages import Oriented, Outcome

COMPANIONS = (".stars.ecsv", ".annotated.png", ".wcs", ".corr")  # beside NAME.fix.json and the other records
FilePath = str | os.PathLike[str]


def remove_companions(folder: Path, stem: str) -> None:
    """Remove what an earlier run left beside its record: a refusal must not stand beside the picture of a success."""
    for suffix in COMPANIONS:
        (folder / f"{stem}{suffix}").unlink(missing_ok=True)


def make_way(path: Path, sha256: str, *, overwrite: bool, remedy: str) -> None:
    """Make the folder of a record to come, and remove what an earlier one of this name left beside it.

    The record of the same image is there to be renewed; one of another image is kept unless `overwrite`. Raises
    BadInput (bad_image, for lack of a better code) with the `remedy`, or where nothing can be written.
    """
    make_folder(path.parent)
    try:
        before = json.loads(path.read_text(encoding="utf-8")) if path.exists() and not overwrite else None
    except OSError as cause:
        raise BadInput("bad_image", f"{path}: cannot be read, nor replaced: {cause.strerror}") from cause
    except ValueError:  # no JSON: not ours
        before = {}
    if before is not None and not _is_of(before, sha256):
        raise BadInput("bad_image", f"{path} is not a result of this image: {remedy}")
    remove_companions(path.parent, _stem_and_kind(path)[0])


def _is_of(record: Any, sha256: str) -> bool:
    provenance = record.get("provenance", {}) if isinstance(record, dict) else {}
    return isinstance(provenance, dict) and provenance.get("image_sha256") == sha256


def _stem_and_kind(record: Path) -> tuple[str, str]:
    """NAME and KIND of NAME.KIND.json."""
    stem, kind = record.name.removesuffix(".json").rsplit(".", 1)
    return stem, kind


def write_results(outcome: Outcome, path: Path, *, plots: bool = True, write_record: bool = True) -> dict[str, Any]:
    """The record of an image, written to `path` (NAME.fix.json, say) after its companions: star table, WCS, picture.

    Raises BadInput where they cannot be written.
    """
    from startrack.output.record import record_of
    from startrack.stages import Measured, Oriented, reached

    stem, kind = _stem_and_kind(path)
    record, value = record_of(outcome, kind), reached(outcome)
    if isinstance(value, Measured) or (isinstance(value, Oriented) and value.terrain is None):
        write_star_table(path.with_name(f"{stem}.stars.ecsv"), value)
        write_wcs(path.with_name(f"{stem}.wcs"), path.with_name(f"{stem}.corr"), value)
    if plots:
        write_annotated(path.with_name(f"{stem}.annotated.png"), outcome)
    if write_record:
        write_json(path, record)
    return record


def write_json(path: FilePath, record: dict[str, Any]) -> None:
    """Write a result's dictionary, one top-level key a line. The same dictionary gives the same bytes.

    Raises BadInput where the file cannot be written, and ValueError for NaN or an infinity, which JSON has not.
    """
    write_atomically(path, json_text(record).encode("utf-8"), overwrite=True)


def json_text(record: dict[str, Any]) -> str:
    """JSON of a dictionary with one top-level key a line."""
    lines = (f" {json.dumps(key)}: {_json(value)}" for key, value in record.items())
    return "{\n" + ",\n".join(lines) + "\n}\n"


def write_star_table(path: FilePath, value: Oriented) -> None:
    """Write NAME.stars.ecsv: every catalogue star in view. Raises BadInput where it cannot be written."""
    from startrack.output.star_table import star_table_text

    write_atomically(path, star_table_text(value).encode("utf-8"), overwrite=True)


def write_wcs(path: FilePath, corr_path: FilePath, value: Oriented) -> None:
    """Write NAME.wcs, the FITS header of the image's world coordinates, and NAME.corr, its matches as a FITS table.

    No NAME.wcs is left if no FITS projection describes the lens. Raises BadInput where they cannot be written.
    """
    from startrack.output.wcs import matches_bytes, wcs_bytes

    header = wcs_bytes(value)
    if header is None:
        Path(path).unlink(missing_ok=True)
    else:
        write_atomically(path, header, overwrite=True)
    write_atomically(corr_path, matches_bytes(value), overwrite=True)


def write_annotated(path: FilePath, outcome: Outcome, truth_enu_m: tuple[float, float] | None = None) -> None:
    """Write NAME.annotated.png. Raises BadInput where it cannot be written.

    `truth_enu_m` (east, north) is drawn where a caller knows it; no stage of the pipeline does.
    """
    import cv2

    from startrack.output.picture.annotate import annotate

    picture = annotate(outcome, truth_enu_m)
    run_lengths = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]  # smaller and quicker for flat colours
    ok, data = cv2.imencode(".png", picture[:, :, ::-1], run_lengths)
    if not ok:
        raise RuntimeError("OpenCV could not encode the picture as PNG")
    write_atomically(path, data.tobytes(), overwrite=True)


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
