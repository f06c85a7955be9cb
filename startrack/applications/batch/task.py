"""Task of one image of a batch: located in any process, unless a valid result is there already."""

from __future__ import annotations

import errno
import os
from collections.abc import Generator, Sequence
from contextlib import closing, suppress
from dataclasses import astuple, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from startrack import chain, output
from startrack.chain import Outcome, content_sha256
from startrack.core.errors import BAD_INPUT_REASONS, INTERNAL_ERROR, BadInput, Reason, one_line
from startrack.core.files import FULL_DISK, printable, remove_file
from startrack.core.limits import refusing_shortage
from startrack.core.runner import Died, Runner, RunStopped
from startrack.core.stored import read_json_object
from startrack.core.types import Exposure
from startrack.exposure import BagImage, read_bag_image, read_exposure
from startrack.frames import R_from_quat_xyzw
from startrack.localization import localizer_name

JOB = "job_sha256"  # hash of a result's inputs (content of its files, flags, version); null: the next run repeats it
INPUTS = "inputs"  # camera and terrain files that the result was made with: path from the image to SHA-256
SOLVED = ("ok", "ambiguous")
NEEDED = {  # by the tables, of a record that is ok
    "position": ("east_m", "north_m", "up_m", "covariance_m2"),
    "attitude": ("quat_xyzw_body_enu", "quat_xyzw_cam_icrs", "sigma_arcsec"),
    "provenance": ("time_utc", "image_sha256"),
}
TYPES: dict[str, Any] = {"string": str, "int64": int, "float64": (int, float)}  # in JSON, of the tables' columns
LARGEST_INTEGER = 2**63
Record = dict[str, Any]
ImageDone = tuple[Record, bool]  # the record, and whether it was there already
DISK_ERRORS = FULL_DISK | {errno.EROFS}


@dataclass(frozen=True)
class Task:
    """An image and all settings that decide its result; small, so that it is cheap to send to a worker."""

    name: str  # of the image, relative to the batch's folder
    path: str
    result: str  # path of NAME.fix.json
    facts: dict[str, Any] = field(default_factory=dict)  # from flags, by the parameters of `read_exposure`
    plots: bool = True
    overwrite: bool = False  # locate it again even if a valid result is there
    settings: chain.Settings = field(default_factory=chain.Settings)
    bag_image: BagImage | None = None  # where `path` is BAG#NUMBER


def locate_images(runner: Runner[Task, ImageDone], tasks: Sequence[Task]) -> Generator[ImageDone, None, None]:
    """The outcomes of `tasks` on a `runner` in the order of completion. Raises BadInput (no_cluster), RunStopped."""
    with closing(runner.results(tasks)) as results:
        for task, outcome in results:
            if isinstance(outcome, Died):
                yield write_failure(task, f"internal error: {outcome.cause}"), False
            else:
                yield outcome


def locate_image(task: Task) -> ImageDone:
    """The record of a `task`'s image, and whether it existed already. Bad images and internal errors have records too.

    NAME.fix.json is written last, so that a record that exists is complete. Raises RunStopped if the disk is full.
    """
    try:
        sha256 = content_sha256(task.path, task.bag_image)
        key = _key(task, sha256)
        before = None if task.overwrite else _valid_record(task, key)
        with refusing_shortage():
            return (before, True) if before is not None else (_locate_and_write(task, sha256, key), False)
    except Exception as cause:
        if isinstance(cause, BadInput):  # not of the image, which would be a record: the results cannot be written
            if isinstance(cause.__cause__, OSError) and cause.__cause__.errno in DISK_ERRORS:
                raise RunStopped(str(cause)) from cause
            return write_failure(task, str(cause), cause.reason), False
        return write_failure(task, f"internal error: {type(cause).__name__}: {cause}"), False


def valid_stored_record(task: Task) -> dict[str, Any] | None:
    """The stored record that the next run would keep, else None. An image older than its record is not read."""
    record = stored_record(task.result)
    if record is None:
        return None
    known = image_sha256(record) if is_older_than(task.path, task.result) else None
    return _valid_record(task, _key(task, known or content_sha256(task.path, task.bag_image)))


def write_failure(task: Task, message: str, reason: str = INTERNAL_ERROR) -> dict[str, Any]:
    """Write and return the record of an image that failed: without a job hash, so that the next run repeats it."""
    record = _unread_record(task, reason, message, content_sha256(task.path, task.bag_image))
    record |= {"image": text_of_name(task.name), JOB: None, INPUTS: {}}
    with suppress(BadInput):  # the record is returned all the same
        if not is_solved(stored_record(task.result)):
            _remove_former(Path(task.result))
            output.write_json(task.result, record)
    return record


def _valid_record(task: Task, key: str) -> dict[str, Any] | None:
    """The stored record, if it is complete and everything it was made from is unchanged; else None."""
    record = stored_record(task.result)
    if record is None or record.get(JOB) != key or not chain.are_unchanged(task.path, record.get(INPUTS, {})):
        return None
    return record if has_companions(record, Path(task.result), plots=task.plots) else None


def _key(task: Task, sha256: str) -> str:
    """Hash of all that decides the record, except the files that camera and terrain are read from."""
    settings, near_sky = task.settings, task.settings.identifier.near_sky
    near = () if settings.near is None else astuple(settings.near)
    pointing = (settings.near_attitude, None if near_sky is None else astuple(near_sky))
    return chain.job_sha256(
        task.path, sha256, task.facts, task.plots, localizer_name(settings.localizer), settings.evidence_sources,
        *near, *(one for one in pointing if one is not None),
    )  # fmt: skip


def _locate_and_write(task: Task, sha256: str, key: str) -> dict[str, Any]:
    """Locate the image and write its record and companions, unless an input is at fault and a solution exists already.

    Former files are removed before new ones are written, so that no result consists of both.
    """
    result = Path(task.result)
    found, inputs = _locate(task, sha256)
    reason = found["reason"] if isinstance(found, dict) else found.reason
    keeps_former = reason in BAD_INPUT_REASONS and is_solved(stored_record(result))
    if not keeps_former:
        _remove_former(result)
    if isinstance(found, dict):
        record = found
    elif keeps_former:
        record = output.result_dict(found)
    else:
        record = output.write_results(found, result, plots=task.plots, write_record=False)
    again = record["reason"] == Reason.OUT_OF_MEMORY  # by the next run
    record = {**record, "image": text_of_name(task.name), JOB: None if again else key, INPUTS: inputs}
    if not keeps_former:
        output.write_json(result, record)
    return record


def _remove_former(result: Path) -> None:
    """Make the folder and remove the files of an earlier run. Raises BadInput if that is impossible."""
    try:
        result.parent.mkdir(parents=True, exist_ok=True)
        remove_file(result)
        output.remove_companions(result)
    except OSError as cause:
        raise BadInput("bad_image", f"{printable(result)}: cannot be written ({cause.strerror})") from cause


def read_task(task: Task) -> Exposure:
    """The exposure of a task's image. Raises BadInput."""
    if task.bag_image is not None:
        return read_bag_image(task.bag_image, **task.facts)
    return read_exposure(task.path, **task.facts)


def _locate(task: Task, sha256: str) -> tuple[Outcome | dict[str, Any], dict[str, str]]:
    """Outcome of a task, or the record of one that has no companions; and the hashes of camera and terrain files."""
    try:
        exposure = read_task(task)
    except BadInput as cause:
        return _unread_record(task, cause.reason, str(cause), sha256), {}
    # Before the files are read, so that a change in between is noticed.
    inputs = chain.input_hashes(task.path, [exposure.camera], exposure.terrain, exposure.mask, exposure.obstacles)
    try:
        return chain.locate_exposure(exposure, task.settings), inputs
    except BadInput as cause:
        refused = chain.Refused(reason=cause.reason, message=str(cause), reached=chain.Inputs(exposure=exposure))
        return output.result_dict(refused), inputs


def _unread_record(task: Task, reason: str, message: str, sha256: str) -> dict[str, Any]:
    """The record of an image that could not be decoded, or its sidecar not be read: with the hash of its file."""
    known = None if sha256 == chain.MISSING else sha256
    return output.refused_dict(task.name, reason, message, image_sha256=known)


def stored_record(result: str | Path) -> dict[str, Any] | None:
    """A result's record; None if there is none, or it cannot be read or is incomplete."""
    record = read_json_object(result)
    return record if record is not None and _is_record(record) else None


def is_solved(record: dict[str, Any] | None) -> bool:
    """Whether a record has a position, or several that fit."""
    return record is not None and record["status"] in SOLVED


def has_companions(record: dict[str, Any], result: Path, *, plots: bool) -> bool:
    """Whether tables, WCS and pictures are beside a solved record; other records need none."""
    stem = result.name.removesuffix(".fix.json")
    needed = {*output.COMPANIONS} if is_solved(record) else set()
    if not plots:
        needed -= {*output.PICTURES}
    if record["status"] != "ok" or record["position"].get("search") == "approximate":
        needed -= {*output.SKYLINE_FILES}
    return all(result.with_name(f"{stem}{suffix}").is_file() for suffix in needed)


def image_sha256(record: dict[str, Any]) -> str | None:
    """SHA-256 of the image that a batch made the record from; None for records of `locate`."""
    sha256 = record.get("provenance", {}).get("image_sha256") if JOB in record else None
    return sha256 if isinstance(sha256, str) else None


def is_older_than(image: str | os.PathLike[str], result: str | os.PathLike[str]) -> bool:
    """Whether the image was neither written nor moved after its result was written; neither file is read."""
    try:
        of_image, of_result = os.stat(image), os.stat(result)
    except (OSError, ValueError):  # a NUL in the name
        return False
    return max(of_image.st_mtime_ns, of_image.st_ctime_ns) < of_result.st_mtime_ns


def text_of_name(name: str) -> str:
    """A file's name as text of one line: undecodable bytes become question marks, control characters are escaped."""
    return one_line(name.encode("utf-8", "replace").decode("utf-8"))


def _is_record(found: dict[str, Any]) -> bool:
    """Whether a JSON object has the keys that resuming and the tables need."""
    status, provenance = found.get("status"), found.get("provenance", {})
    named = isinstance(found.get("image"), str) and "reason" in found and isinstance(provenance, dict)
    if not named or status not in (*SOLVED, "refused") or not isinstance(found.get(INPUTS, {}), dict):
        return False
    parts = NEEDED if status == "ok" else {}
    whole = all(isinstance(found.get(part), dict) and found[part].keys() >= set(keys) for part, keys in parts.items())
    return whole and _has_types(found)


def _has_types(found: dict[str, Any]) -> bool:
    """Whether what is printed, and what the tables and the trajectory take, has the types of a record."""
    try:
        numbers = [(TYPES["float64"], one) for one in (found.get("timing_ms") or {}).values()]
        texts = [found["message"], *found.get("warnings", ()), (found.get("search") or {}).get("outcome", "")]
        columns = [(TYPES[one.datatype], one.value(found)) for one in output.table_columns()]
        time_utc = found.get("provenance", {}).get("time_utc")
        if time_utc is not None:
            datetime.fromisoformat(time_utc)
        if found["status"] == "ok":
            R_from_quat_xyzw(found["attitude"]["quat_xyzw_body_enu"])
    except (TypeError, ValueError, LookupError, AttributeError):
        return False
    typed = all(one is None or isinstance(one, kind) for kind, one in (*numbers, *columns))
    typed &= all(isinstance(one, str) for one in texts)
    fits = all(abs(one) < LARGEST_INTEGER for _, one in (*numbers, *columns) if isinstance(one, int))
    return typed and fits and found["reason"] in (None, *Reason)
