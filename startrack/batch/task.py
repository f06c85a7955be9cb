"""One image of a batch: located wherever a worker is, unless its result is there already."""

from __future__ import annotations

import errno
from collections.abc import Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack import __version__
from startrack.batch.fingerprint import MISSING, hashes_of, key_of, sha256_of, unchanged, untouched_since
from startrack.batch.store import INPUTS, JOB, has_companions, image_sha256, is_solved, printable, stored
from startrack.errors import BAD_INPUT_REASONS, INTERNAL_ERROR, BadInput
from startrack.runner import Died, Runner, RunStopped

if TYPE_CHECKING:
    from startrack.stages import Outcome

Record = dict[str, Any]
ImageDone = tuple[Record, bool]  # the record, and whether it was there already
DISK_ERRORS = {errno.ENOSPC, errno.EROFS, errno.EDQUOT, errno.EFBIG, errno.EIO}


@dataclass(frozen=True)
class Task:
    """An image and all that decides its result; small, so that it travels to any worker."""

    name: str  # of the image, relative to the batch's folder
    path: str
    result: str  # path of NAME.fix.json
    facts: dict[str, Any] = field(default_factory=dict)  # from flags: time_utc, exposure_s, camera, terrain
    plots: bool = True
    renew: bool = False  # do it again even where the result is there
    localizer: str = "posterior"  # of startrack.localization.LOCALIZERS


def locate_images(runner: Runner[Task, ImageDone], tasks: Sequence[Task]) -> Generator[ImageDone, None, None]:
    """The outcomes in the order of completion. Raises BadInput (no_cluster), RunStopped."""
    with closing(runner.results(tasks)) as results:
        for task, outcome in results:
            yield (lost(task, f"internal error: {outcome.cause}"), False) if isinstance(outcome, Died) else outcome


def locate_image(task: Task) -> ImageDone:
    """The image's record, and whether it was there already. Never raises for an image's sake.

    NAME.fix.json is written last, so that a result that is there is whole. Raises RunStopped where the disk takes
    no more.
    """
    try:
        sha256 = sha256_of(task.path)
        key = _key(task, sha256)
        before = None if task.renew else _standing(task, key)
        return (before, True) if before is not None else (_fresh(task, sha256, key), False)
    except Exception as cause:  # noqa: BLE001 - one image's fault is its own; it is counted and told as such
        if isinstance(cause, BadInput):  # a refusal is a record: this is of the results, which cannot be written
            _stop_where_the_disk_is_full(cause)
            return lost(task, str(cause), cause.reason), False
        return lost(task, f"internal error: {type(cause).__name__}: {cause}"), False


def still_stored(task: Task) -> dict[str, Any] | None:
    """The stored record that the next run would keep, else None. An image that is older than its result is not read."""
    record = stored(task.result)
    if record is None:
        return None
    known = image_sha256(record) if untouched_since(task.path, task.result) else None
    return _standing(task, _key(task, known or sha256_of(task.path)))


def lost(task: Task, message: str, reason: str = INTERNAL_ERROR) -> dict[str, Any]:
    """The record of an image that has no result to keep: without a hash, so that the next run tries it again."""
    from startrack.output import refused_dict, write_json

    record = {**refused_dict(task.name, reason, message), **_unread(sha256_of(task.path))}
    record |= {"image": printable(task.name), JOB: None}
    with suppress(BadInput):  # where it cannot be written, there is nothing to keep either
        if not is_solved(stored(task.result)):
            _clear(Path(task.result))
            write_json(task.result, record)
    return record


def _standing(task: Task, key: str) -> dict[str, Any] | None:
    """The stored record where it is made from all that the image's result is made from now, and is whole."""
    record = stored(task.result)
    if record is None or record.get(JOB) != key or not unchanged(task.path, record.get(INPUTS, {})):
        return None
    return record if has_companions(record, Path(task.result), plots=task.plots) else None


def _key(task: Task, sha256: str) -> str:
    return key_of(task.path, sha256, task.facts, task.plots, task.localizer)


def _fresh(task: Task, sha256: str, key: str) -> dict[str, Any]:
    """The record made anew, and written unless it only says that an input is at fault where a solution stands already.

    The old files go first, when all is worked out, so that no half of a result is ever taken for a whole.
    """
    from startrack.output import result_dict, write_json, write_results

    result = Path(task.result)
    found, inputs = _located(task, sha256)
    reason = found["reason"] if isinstance(found, dict) else found.reason
    former_stays = reason in BAD_INPUT_REASONS and is_solved(stored(result))
    if not former_stays:
        _clear(result)
    if isinstance(found, dict):
        record = found
    elif former_stays:
        record = result_dict(found)
    else:
        record = write_results(found, result, plots=task.plots, write_record=False)
    record = {**record, "image": printable(task.name), JOB: key, INPUTS: inputs}
    if not former_stays:
        write_json(result, record)
    return record


def _clear(result: Path) -> None:
    """Make the folder, remove what an earlier run left. Raises BadInput where that cannot be."""
    from startrack.output import remove_companions

    try:
        result.parent.mkdir(parents=True, exist_ok=True)
        result.unlink(missing_ok=True)
        remove_companions(result)
    except OSError as cause:
        raise BadInput("bad_image", f"{result}: cannot be written ({cause.strerror})") from cause


def _located(task: Task, sha256: str) -> tuple[Outcome | dict[str, Any], dict[str, str]]:
    """A result that has companions, or else the record of a refusal; and the hashes of its other files."""
    from startrack.exposure import read_exposure
    from startrack.localization import LOCALIZERS
    from startrack.output import refused_dict, result_dict
    from startrack.pipeline import Settings, locate_exposure
    from startrack.stages import Inputs, Refused

    try:
        exposure = read_exposure(task.path, **task.facts)
    except BadInput as cause:
        return {**refused_dict(task.name, cause.reason, str(cause)), **_unread(sha256)}, {}
    inputs = hashes_of(task.path, [exposure.camera, exposure.terrain])  # before they are read: one that changes is seen
    try:
        return locate_exposure(exposure, Settings(localizer=LOCALIZERS[task.localizer]())), inputs
    except BadInput as cause:
        return result_dict(Refused(reason=cause.reason, message=str(cause), reached=Inputs(exposure=exposure))), inputs


def _unread(sha256: str) -> dict[str, Any]:
    """What is known of an image that could not be decoded, or whose sidecar could not be read: which file it was."""
    unknown = dict.fromkeys(("camera", "terrain", "catalog", "time_utc", "exposure_s"))
    return {} if sha256 == MISSING else {"provenance": {"version": __version__, "image_sha256": sha256, **unknown}}


def _stop_where_the_disk_is_full(cause: BadInput) -> None:
    if isinstance(cause.__cause__, OSError) and cause.__cause__.errno in DISK_ERRORS:
        raise RunStopped(str(cause)) from cause
