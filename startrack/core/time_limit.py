"""A limit of the processor time of a block of work, for which its long loops ask.

Processor time of the process, all threads, is counted; what is made once and kept (tables of horizons) is
not. No wall clock, thread or signal takes part: the same work ends at nearly the same place on a machine
that does other work too.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from threading import Lock

from startrack.core.errors import NoSolution, Reason


class TimeLimitReached(NoSolution):
    """The limit of the processor time came before an answer."""

    reason = Reason.TIME_LIMIT


@dataclass
class _Clock:
    """Processor time [s] without that of blocks that are not counted, which may overlap in several threads."""

    left_out_s: float = 0.0
    depth: int = 0
    begun_s: float = 0.0
    lock: Lock = field(default_factory=Lock)

    def now_s(self) -> float:
        with self.lock:
            return (self.begun_s if self.depth else time.process_time()) - self.left_out_s

    def pause(self) -> None:
        with self.lock:
            if not self.depth:
                self.begun_s = time.process_time()
            self.depth += 1

    def resume(self) -> None:
        with self.lock:
            self.depth -= 1
            if not self.depth:
                self.left_out_s += time.process_time() - self.begun_s


@dataclass(frozen=True)
class _Limit:
    seconds: float
    end_s: float  # of CLOCK


CLOCK = _Clock()
_LIMIT: ContextVar[_Limit | None] = ContextVar("time limit", default=None)


@contextmanager
def limited_time(seconds: float | None) -> Iterator[None]:
    """In the block `check_time` raises once so much processor time [s] was used; None: as outside of the block.

    Raises ValueError for a limit that is not above 0.
    """
    if seconds is not None and not seconds > 0:
        raise ValueError(f"the time limit is {seconds} s: give seconds of processor time, above 0")
    if seconds is None:
        yield
        return
    token = _LIMIT.set(_Limit(seconds, CLOCK.now_s() + seconds))
    try:
        yield
    finally:
        _LIMIT.reset(token)


@contextmanager
def uncounted_time() -> Iterator[None]:
    """In the block no processor time counts: what it makes is kept, and a second run does not need it."""
    CLOCK.pause()
    try:
        yield
    finally:
        CLOCK.resume()


def check_time() -> None:
    """Raises TimeLimitReached where the limit of the block has come."""
    limit = _LIMIT.get()
    if limit is not None and CLOCK.now_s() > limit.end_s:
        raise TimeLimitReached(f"the limit of {limit.seconds:g} s of processor time came before an answer")


@contextmanager
def stating_work(text: Callable[[], str]) -> Iterator[None]:
    """In the block TimeLimitReached becomes another one, which also states the `text`: what was done by then."""
    try:
        yield
    except TimeLimitReached as cause:
        raise TimeLimitReached(f"{cause}; {text()}") from cause
