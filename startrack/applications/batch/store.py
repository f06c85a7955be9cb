"""A folder of results: its lock, the records in it, and the images it belongs to."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from startrack.applications.batch.find import Image
from startrack.chain import content_sha256
from startrack.core.errors import BadInput
from startrack.core.files import Locked, hold_lock
from startrack.output import COMPANIONS, PICTURES, SKYLINE_FILES

JOB = "job_sha256"  # hash of a result's inputs (content of its files, flags, version); null: the next run repeats it
INPUTS = "inputs"  # camera and terrain files that the result was made with: path from the image to SHA-256
MANIFEST = "manifest.json"
LOCK = ".startrack-batch.lock"
RESULT = "result"  # in the manifest: path of NAME.fix.json within the folder; null where that is an earlier solution
SOLVED = ("ok", "ambiguous")
NEEDED = {  # by the tables, of a record that is ok
    "position": ("east_m", "north_m", "up_m", "covariance_m2"),
    "attitude": ("quat_xyzw_body_enu", "quat_xyzw_cam_icrs", "sigma_arcsec"),
    "provenance": ("time_utc", "image_sha256"),
}


@contextmanager
def lock_results(out: Path) -> Iterator[None]:
    """Lock the folder `out` of results against other batches.

    Raises BadInput (bad_image) if another batch writes to it, or if the lock file cannot be used.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(hold_lock(out / LOCK, wait=False))
        except Locked as cause:
            raise BadInput(
                "bad_image",
                f"another batch is writing to {out} (process {cause.owner}): wait for it, or choose another -D",
            ) from cause
        except OSError as cause:
            raise BadInput("bad_image", f"{out / LOCK}: cannot be used as lock file ({cause.strerror})") from cause
        yield


def stored_record(result: str | Path) -> dict[str, Any] | None:
    """A result's record; None if there is none, or it cannot be read or is incomplete."""
    record = _read_object(Path(result))
    return record if record is not None and _is_record(record) else None


def is_solved(record: dict[str, Any] | None) -> bool:
    """Whether a record has a position, or several that fit."""
    return record is not None and record["status"] in SOLVED


def has_companions(record: dict[str, Any], result: Path, *, plots: bool) -> bool:
    """Whether tables, WCS and pictures are beside a solved record; other records need none."""
    stem = result.name.removesuffix(".fix.json")
    needed = {*COMPANIONS} if is_solved(record) else set()
    if not plots:
        needed -= {*PICTURES}
    if record["status"] != "ok" or record["position"].get("search") == "approximate":
        needed -= {*SKYLINE_FILES}
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
    """A file's name as text: undecodable bytes become question marks."""
    return name.encode("utf-8", "replace").decode("utf-8")


def record_path(out: Path, image: Image) -> Path:
    """Path of the record of an `image` in the folder `out`."""
    return out / f"{image.stem}.fix.json"


def belongs_to_other_images(out: Path, images: Iterable[Image]) -> bool:
    """Whether `out` has results, none of which matches the current content of its image.

    Compared by content: the folder may have moved or grown, or some images may have changed.
    """
    listed = {one["image"]: one.get("image_sha256") for one in _manifest_images(out) or ()}
    some = bool(listed)
    for image in images:
        record = stored_record(record_path(out, image))
        known = listed.get(text_of_name(image.name)) or (record and image_sha256(record))
        if known is not None and known == content_sha256(image.path, image.bag_image):
            return False
        some = some or known is not None
    return some


def tabled_results(out: Path) -> set[str] | None:
    """Paths within `out` of the results in its tables; None if there is no manifest."""
    images = _manifest_images(out)
    return None if images is None else {str(one.get(RESULT)) for one in images}


def _manifest_images(out: Path) -> list[dict[str, Any]] | None:
    images = (_read_object(out / MANIFEST) or {}).get("images")
    if not isinstance(images, list):
        return None
    return [one for one in images if isinstance(one, dict) and isinstance(one.get("image"), str)]


def _read_object(file: Path) -> dict[str, Any] | None:
    """The JSON object in a file; None if it cannot be read, or is nested too deep."""
    try:
        if not stat.S_ISREG(file.stat().st_mode):  # reading a pipe would block
            return None
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _is_record(found: dict[str, Any]) -> bool:
    """Whether a JSON object has the keys that resuming and the tables need."""
    status, provenance = found.get("status"), found.get("provenance", {})
    named = isinstance(found.get("image"), str) and "reason" in found and isinstance(provenance, dict)
    if not named or status not in (*SOLVED, "refused") or not isinstance(found.get(INPUTS, {}), dict):
        return False
    parts = NEEDED if status == "ok" else {}
    return all(isinstance(found.get(part), dict) and found[part].keys() >= set(keys) for part, keys in parts.items())
