"""Images as they are written into a folder: each once, when its file is complete."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from startrack.core.errors import BadInput

STILL_S = 0.1  # since the last change of a file, after which it is complete
PATIENCE_S = 5.0  # for a file that cannot be read, or whose sidecar is missing


def follow_images(
    list_images: Callable[[], Iterable[str]],
    take: Callable[[str], None],
    refuse: Callable[[str, BadInput], None],
    *,
    until_idle_s: float | None,
) -> Iterator[str | None]:
    """Give each path that `list_images` lists to `take`, and yield it after that; None where no image waits.

    Ends when no image came for `until_idle_s` (None: never). An image that `take` refuses with BadInput is tried again
    for some seconds, since its sidecar may be missing; then `refuse` gets it.
    """
    taken: set[str] = set()
    refused: set[tuple[str, int]] = set()  # with the time of its last change: a file that grows on is tried anew
    first_try: dict[str, float] = {}
    idle_since = time.monotonic()
    while until_idle_s is None or time.monotonic() - idle_since < until_idle_s:
        waiting = False
        for path in list_images():
            changed_ns = _changed_ns(path)
            is_still = time.time_ns() - changed_ns > STILL_S * 1e9
            if path in taken or (path, changed_ns) in refused or not is_still:
                continue
            idle_since = time.monotonic()
            try:
                take(path)
            except BadInput as cause:
                if time.monotonic() - first_try.setdefault(path, time.monotonic()) >= PATIENCE_S:
                    refuse(path, cause)
                    refused.add((path, changed_ns))
                continue
            taken.add(path)
            waiting = True
            yield path
            idle_since = time.monotonic()
        if not waiting:
            yield None
            time.sleep(0.5 * STILL_S)


def _changed_ns(path: str) -> int:
    try:
        return Path(path).stat().st_mtime_ns
    except OSError:  # removed since it was listed
        return time.time_ns()
