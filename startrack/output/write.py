"""Results to files: each appears under its name only when it is whole."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from startrack.chain import Located, Measured, Oriented, Outcome, PlacedBySkyline, Positioned, last_value
from startrack.core.errors import BadInput
from startrack.core.files import check_regular, make_folder, printable, remove_file, write_atomically
from startrack.core.types import MeasuredSkyline
from startrack.output.geo import GEO_FORMATS, geo_text
from startrack.output.picture.annotate import annotated_png
from startrack.output.picture.canvas import png_bytes
from startrack.output.picture.panorama import located_picture
from startrack.output.record import result_dict
from startrack.output.tables import skyline_table_text, star_table_text
from startrack.output.values import off_map
from startrack.output.wcs import matches_bytes, wcs_bytes

ANNOTATED = ".annotated.png"
SKYLINE_TABLE, SKYLINE_PICTURE = SKYLINE_FILES = (".skyline.ecsv", ".skyline.png")  # where the image shows a skyline
PICTURES = (ANNOTATED, SKYLINE_PICTURE)
COMPANIONS = (ANNOTATED, ".stars.ecsv", *SKYLINE_FILES, ".wcs", ".corr")  # beside NAME.fix.json
STAR_FILES = tuple(one for one in COMPANIONS if one not in SKYLINE_FILES)  # beside NAME.identification.json
COMPANIONS_OF = {"fix": COMPANIONS, "identification": STAR_FILES, "detections": (ANNOTATED,)}  # most complete first
FilePath = str | os.PathLike[str]


def companion(record: Path, suffix: str) -> Path:
    """Path of the companion with a `suffix` (one of COMPANIONS) of a `record` NAME.KIND.json: NAME and the suffix.

    NAME.KIND and the suffix where a record of a more complete kind has the plain names: `detect` and `identify` leave
    the files of `locate` alone.
    """
    stem, kind = _stem_and_kind(record)
    kinds = list(COMPANIONS_OF)
    taken = any(record.with_name(f"{stem}.{other}.json").exists() for other in kinds[: kinds.index(kind)])
    return record.with_name(f"{stem}.{kind}{suffix}" if taken else f"{stem}{suffix}")


def remove_companions(record: Path) -> None:
    """Remove what an earlier run left beside a `record`: a refusal must not stand beside the picture of a success."""
    for suffix in COMPANIONS_OF[_stem_and_kind(record)[1]]:
        remove_file(companion(record, suffix))


def prepare_folder(path: Path, sha256: str, *, overwrite: bool, remedy: str) -> None:
    """Make the folder of a record at `path`, and remove the companions of an earlier one of this name.

    The record of the same image (`sha256` of its file) may be replaced; one of another image only with `overwrite`.
    Raises BadInput (bad_image, for lack of a better code) with the `remedy`, or where nothing can be written.
    """
    make_folder(path.parent)
    check_regular(path)  # a pipe would block
    try:
        before = json.loads(path.read_text(encoding="utf-8")) if path.exists() and not overwrite else None
    except OSError as cause:
        raise BadInput("bad_image", f"{printable(path)}: cannot be read, nor replaced: {cause.strerror}") from cause
    except (ValueError, RecursionError):  # no JSON: not ours
        before = {}
    provenance = before.get("provenance") if isinstance(before, dict) else None
    if before is not None and not (isinstance(provenance, dict) and provenance.get("image_sha256") == sha256):
        raise BadInput("bad_image", f"{printable(path)} is not a result of this image: {remedy}")
    remove_companions(path)


def _stem_and_kind(record: Path) -> tuple[str, str]:
    """NAME and KIND of NAME.KIND.json."""
    stem, kind = record.name.removesuffix(".json").rsplit(".", 1)
    return stem, kind


def write_results(
    outcome: Outcome,
    path: Path,
    *,
    plots: bool = True,
    write_record: bool = True,
    catalog_table: bool = False,
    more: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The record of an `outcome`, written to `path` (such as NAME.fix.json) after tables, WCS and pictures.

    `plots` and `write_record`: whether the pictures and the record are written; `catalog_table`: whether the star table
    without a terrain holds the stars that were not identified too; `more`: keys that are added to the record. Raises
    BadInput where a file cannot be written; none of them is then left.
    """
    record = result_dict(outcome, _stem_and_kind(path)[1]) | (more or {})
    try:
        _write_companions(outcome, path, plots=plots, catalog_table=catalog_table)
        if write_record:
            write_json(path, record)
    except BaseException:
        with suppress(BadInput):  # must not hide the cause
            remove_companions(path)
        raise
    return record


def _write_companions(outcome: Outcome, path: Path, *, plots: bool, catalog_table: bool) -> None:
    """Write tables, WCS and pictures beside each other: pictures are drawn and packed while tables are written."""
    value = last_value(outcome)
    with ThreadPoolExecutor() as pool:
        has_image = plots and value.exposure.pixels_adu.size > 1  # not of a skyline's file
        files = [pool.submit(write_annotated, companion(path, ANNOTATED), outcome)] if has_image else []
        if isinstance(value, Positioned) and value.skyline is not None:
            table = skyline_table_text(value.skyline, off_map(value).likely).encode("utf-8")
            write_atomically(companion(path, SKYLINE_TABLE), table, overwrite=True)
            if plots:
                files.append(pool.submit(_write_panorama, companion(path, SKYLINE_PICTURE), value, value.skyline))
        if isinstance(value, Measured) or (isinstance(value, Oriented) and value.terrain is None):
            write_star_table(companion(path, ".stars.ecsv"), value, catalog=catalog_table)
            write_wcs(companion(path, ".wcs"), companion(path, ".corr"), value)
    for file in files:
        file.result()


def _write_panorama(path: Path, value: Positioned, skyline: MeasuredSkyline) -> None:
    write_atomically(path, png_bytes(located_picture(value, skyline)), overwrite=True)


def write_geo(record: Path, outcome: Outcome, kinds: Sequence[str]) -> None:
    """Write an `outcome` with a position or modes beside its `record` NAME.fix.json, as NAME.geojson and NAME.kml.

    `kinds`: which of the two. A former file of another outcome is removed. Raises BadInput where one cannot be written.
    """
    for kind in GEO_FORMATS:
        path = record.with_name(f"{_stem_and_kind(record)[0]}.{kind}")
        if kind in kinds and isinstance(outcome, Located | PlacedBySkyline):
            write_atomically(path, geo_text(outcome, kind).encode("utf-8"), overwrite=True)
        else:
            remove_file(path)


def write_json(path: FilePath, record: dict[str, Any]) -> None:
    """Write a `record` to `path`, one top-level key a line. The same record gives the same bytes.

    Raises BadInput where the file cannot be written, and ValueError for NaN or an infinity, which JSON has not.
    """
    write_atomically(path, json_text(record).encode("utf-8", "replace"), overwrite=True)


def json_text(record: dict[str, Any]) -> str:
    """JSON of a `record` with one top-level key a line."""
    lines = (
        f" {json.dumps(key)}: {json.dumps(value, ensure_ascii=False, allow_nan=False)}" for key, value in record.items()
    )
    return "{\n" + ",\n".join(lines) + "\n}\n"


def write_star_table(path: FilePath, value: Oriented, *, catalog: bool = False) -> None:
    """Write `star_table_text` of a `value` and `catalog` to `path`. Raises BadInput where it cannot be written."""
    write_atomically(path, star_table_text(value, catalog=catalog).encode("utf-8"), overwrite=True)


def write_wcs(path: FilePath, corr_path: FilePath, value: Oriented) -> None:
    """Write the world coordinates of an identified `value` to `path` (FITS header), its matches to `corr_path`.

    No NAME.wcs is left if no FITS projection describes the lens. Raises BadInput where they cannot be written.
    """
    header = wcs_bytes(value)
    if header is None:
        remove_file(path)
    else:
        write_atomically(path, header, overwrite=True)
    write_atomically(corr_path, matches_bytes(value), overwrite=True)


def write_annotated(path: FilePath, outcome: Outcome, truth_enu_m: tuple[float, float] | None = None) -> None:
    """Write the annotated picture of an `outcome` to `path` (PNG). Raises BadInput where it cannot be written.

    `truth_enu_m` (east, north) [m] is drawn if it is given; no stage of the pipeline has it. The file also holds the
    picture without marks and the marks as coordinates, for the HTML page.
    """
    write_atomically(path, annotated_png(outcome, truth_enu_m), overwrite=True)
