"""Limits of memory and of processor time, as refusals."""

from __future__ import annotations

import errno
import mmap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from threading import Lock

from startrack.core.errors import BadInput, NoSolution, Reason
from startrack.core.files import MAX_CAUSE_CHARS

# Address space of a command and of each pixel of its picture (VmPeak of `detect` on two cores: 0.90 GB at 0.26 Mpx).
# With less, some libraries are not loaded, and OpenBLAS may block or end the process.
COMMAND_BYTES = 0.9e9
START_BYTES = 0.4e9  # of a command that loads no library for images (VmPeak of `schema`, and of `terrain show`)
PIXEL_BYTES = 24
LIBRARY_BYTES = 2**27  # a library that cannot be loaded, or a thread not started, lacks less (OpenCV has 0.1 GB)
OPENCV_NO_MEMORY = -4  # cv2.error.code, StsNoMem


def check_memory(pixels: int = 0, base_bytes: float = COMMAND_BYTES) -> None:
    """Raise BadInput (out_of_memory) where the limit of address space is below `base_bytes` and a picture's pixels."""
    limit_bytes, needed_bytes = _limit_bytes(), base_bytes + PIXEL_BYTES * pixels
    if limit_bytes is not None and limit_bytes < needed_bytes:
        picture = f" with a picture of {pixels / 1e6:.1f} Mpx" if pixels else ""
        raise BadInput(
            Reason.OUT_OF_MEMORY,
            f"the limit of address space (ulimit -v) is {limit_bytes / 1e9:.2f} GB, and a command takes "
            f"{needed_bytes / 1e9:.2f} GB{picture}",
        )


@contextmanager
def refusing_shortage() -> Iterator[None]:
    """Context in which exceptions that come from a lack of memory become BadInput (out_of_memory)."""
    try:
        yield
    except (BadInput, NoSolution):
        raise
    except Exception as cause:
        if (refusal := memory_refusal(cause)) is None:
            raise
        raise refusal from cause


def memory_refusal(cause: BaseException) -> BadInput | None:
    """The refusal (out_of_memory) for a `cause` that comes from a lack of memory; None for others."""
    chain: list[BaseException] = []
    one: BaseException | None = cause
    while one is not None and one not in chain:
        chain.append(one)
        one = one.__cause__ or one.__context__
    lacking = next((one for one in chain if _states_shortage(one)), None)
    if lacking is None and has_room():
        return None
    lacking = lacking or cause
    limit_bytes = _limit_bytes()
    limit = "" if limit_bytes is None else f" within the limit of {limit_bytes / 1e9:.2f} GB (ulimit -v)"
    text = " ".join(f"{type(lacking).__name__}: {lacking}".split()).rstrip(":")[:MAX_CAUSE_CHARS]
    return BadInput(Reason.OUT_OF_MEMORY, f"memory is short{limit} ({text})")


def _states_shortage(cause: BaseException) -> bool:
    """Whether an exception means a lack of memory by itself. SPICE's classes are MemoryErrors of its own tables too."""
    if isinstance(cause, MemoryError):
        return not type(cause).__module__.startswith("spiceypy") or "MALLOC" in type(cause).__name__
    return (isinstance(cause, OSError) and cause.errno == errno.ENOMEM) or (
        type(cause).__module__ == "cv2" and getattr(cause, "code", None) == OPENCV_NO_MEMORY
    )


def has_room() -> bool:
    """Whether a library could still be loaded: libraries and threads fail with exceptions of any class without it."""
    with suppress(OSError, ValueError):
        mmap.mmap(-1, LIBRARY_BYTES).close()
        return True
    return False


def _limit_bytes() -> int | None:
    """The limit of this process's address space; None without one."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    soft = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if soft == resource.RLIM_INFINITY else soft


class TimeLimitReached(NoSolution):
    """Refusal of a run whose limit of processor time came before an answer."""

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
    """Context in which `check_time` raises once `seconds` of processor time were used; None: the outer limit holds.

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
    """Context whose processor time does not count: what is made in it is kept, and a second run does not need it."""
    CLOCK.pause()
    try:
        yield
    finally:
        CLOCK.resume()


def check_time() -> None:
    """Raise TimeLimitReached where the processor time of the enclosing `limited_time` is used up."""
    limit = _LIMIT.get()
    if limit is not None and CLOCK.now_s() > limit.end_s:
        raise TimeLimitReached(f"the limit of {limit.seconds:g} s of processor time came before an answer")


@contextmanager
def stating_work(text: Callable[[], str]) -> Iterator[None]:
    """Context in which TimeLimitReached becomes another one that also states the `text`: what was done by then."""
    try:
        yield
    except TimeLimitReached as cause:
        raise TimeLimitReached(f"{cause}; {text()}") from cause
