"""Images as they are written into a folder: each once, when its file is complete."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from startrack.applications.batch.find import Image, images_under
from startrack.core.errors import BadInput

POLL_S = 0.05
STILL_S = 0.1  # since the last change of a file, after which it is complete
PATIENCE_S = 5.0  # for a file that cannot be read, or whose sidecar is missing


def follow_images(
    folder: str | os.PathLike[str],
    excluded: str | os.PathLike[str],
    take: Callable[[Image], None],
    refuse: Callable[[Image, BadInput], None],
    *,
    until_idle_s: float | None,
) -> Iterator[Image | None]:
    """Give each image of a `folder` to `take`, and yield it after that; None where no image waits.

    Ends when no image came for `until_idle_s` (None: never). An image that `take` refuses with BadInput is tried again
    for some seconds, since its sidecar may be missing; then `refuse` gets it. The folder `excluded` is left out.
    """
    taken: set[str] = set()
    refused: set[tuple[str, int]] = set()  # with the time of its last change: a file that grows on is tried anew
    first_try: dict[str, float] = {}
    idle_since = time.monotonic()
    while until_idle_s is None or time.monotonic() - idle_since < until_idle_s:
        waiting = False
        for image in images_under(folder, excluded):
            changed_ns = _changed_ns(image.path)
            if image.path in taken or (image.path, changed_ns) in refused or not _is_still(changed_ns):
                continue
            idle_since = time.monotonic()
            try:
                take(image)
            except BadInput as cause:
                if time.monotonic() - first_try.setdefault(image.path, time.monotonic()) < PATIENCE_S:
                    continue
                refuse(image, cause)
                refused.add((image.path, changed_ns))
                continue
            taken.add(image.path)
            waiting = True
            yield image
            idle_since = time.monotonic()
        if not waiting:
            yield None
            time.sleep(POLL_S)


def _changed_ns(path: str) -> int:
    try:
        return Path(path).stat().st_mtime_ns
    except OSError:  # removed since it was listed
        return time.time_ns()


def _is_still(changed_ns: int) -> bool:
    return time.time_ns() - changed_ns > STILL_S * 1e9
