"""Many mutated files in a process with limits of time and memory; the process that dies or hangs is replaced.

The process writes the number of the file in progress to a shared file and each failure as a line; the parent watches.
"""

from __future__ import annotations

import json
import mmap
import os
import resource
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from . import commands, targets

HANG_S = 10.0  # one file through a reader
COMMAND_HANG_S = 60.0  # one file through a whole command
MEMORY_BYTES = 2**31  # address space of one file beyond what the process has after its start: the end of it
BOUND_CPU_S, BOUND_BYTES = 2.0, 500e6  # of one file, beyond what a sound one takes
POLL_S = 0.05
COMMAND, SELF_TEST = "command", "self-test"  # the latter: files that fail in every way, to test the counting
KINDS = (*targets.READERS, COMMAND)
STATE = struct.Struct("<qqqd")  # number of the file, answers, refusals, and when it began


@dataclass
class Outcome:
    """What came out of the files of one kind."""

    kind: str
    tried: int = 0
    answers: int = 0
    refusals: int = 0
    slowest_s: float = 0.0
    crashes: list[dict[str, object]] = field(default_factory=list)
    hangs: list[int] = field(default_factory=list)
    above_cap: list[int] = field(default_factory=list)
    above_bounds: list[dict[str, object]] = field(default_factory=list)  # of processor time or memory

    @property
    def failures(self) -> int:
        """Crashes, hangs, and files above the cap or the bounds."""
        return len(self.crashes) + len(self.hangs) + len(self.above_cap) + len(self.above_bounds)


def run_campaign(kind: str, runs: int, seed: int, hang_s: float | None = None) -> Outcome:
    """Try `runs` mutated files of one kind, each for at most `hang_s` (default: HANG_S, of commands COMMAND_HANG_S)."""
    outcome, first = Outcome(kind), 0
    hang_s = hang_s or (COMMAND_HANG_S if kind == COMMAND else HANG_S)
    with tempfile.TemporaryDirectory(prefix="startrack-fuzz-") as name:
        while first < runs:
            first = _run_process(kind, first, runs, seed, Path(name), hang_s, outcome)
    outcome.tried = runs
    return outcome


def _run_process(kind: str, first: int, runs: int, seed: int, folder: Path, hang_s: float, outcome: Outcome) -> int:
    """One process from the file number `first`; the number of the file to go on with."""
    state_file, lines = folder / "state", folder / "failures.jsonl"
    state_file.write_bytes(STATE.pack(-1, 0, 0, time.monotonic()))
    lines.write_text("")
    words = [sys.executable, "-m", f"{__package__}.campaign", kind, str(first), str(runs), str(seed), str(folder)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "XDG_CACHE_HOME": str(folder / "cache")}
    environment["PYTHONPATH"] = os.pathsep.join([path or os.getcwd() for path in sys.path])
    errors = folder / "errors.txt"
    with state_file.open("r+b") as file, mmap.mmap(file.fileno(), STATE.size) as state, errors.open("w") as stderr:
        process = subprocess.Popen(words, env=environment, stderr=stderr, stdout=subprocess.DEVNULL)
        hung = False
        while process.poll() is None:
            number, _, _, began = STATE.unpack(state[:])
            if number >= 0 and time.monotonic() - began > hang_s:
                process.kill()
                hung = True
            time.sleep(POLL_S)
        number, answers, refusals, _ = STATE.unpack(state[:])
    error = errors.read_text(errors="replace")
    outcome.answers += answers
    outcome.refusals += refusals
    for line in lines.read_text().splitlines():
        failure = json.loads(line)
        if "slowest_s" in failure:
            outcome.slowest_s = max(outcome.slowest_s, failure["slowest_s"])
        elif "bound" in failure:
            outcome.above_bounds.append(failure)
        elif failure.pop("memory"):
            outcome.above_cap.append(failure["index"])
        else:
            outcome.crashes.append(failure)
    if number < 0:
        raise RuntimeError(f"the process for {kind} did not start: {error[-2000:]}")
    if hung:
        outcome.hangs.append(number)
    elif process.returncode:
        outcome.crashes.append(
            {"index": number, "cause": f"the process ended with {process.returncode}: {error}"[-800:]}
        )
    return number + 1 if hung or process.returncode else runs


def work(kind: str, first: int, runs: int, seed: int, folder: Path) -> None:
    """The process: files `first` to `runs` - 1, under the cap of memory."""
    if kind == COMMAND:
        commands.run_sound_commands(folder)  # compiles
    elif kind != SELF_TEST:
        targets.prepare(folder)
    sound_s = _sound_cpu_s(folder) if kind == COMMAND else {}
    cap = _bytes_of("VmSize") + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (cap, cap))
    answers = refusals = 0
    slowest_s = 0.0
    with (folder / "state").open("r+b") as file, mmap.mmap(file.fileno(), STATE.size) as state, \
            (folder / "failures.jsonl").open("a") as lines:  # fmt: skip
        for index in range(first, runs):
            began, cpu_s, before = time.monotonic(), time.process_time(), _reset_peak_bytes()
            state[:] = STATE.pack(index, answers, refusals, began)
            try:
                reason = _one(kind, seed, index, folder)
                answers, refusals = answers + (reason is None), refusals + (reason is not None)
            except BaseException as cause:  # noqa: BLE001 - any exception but a refusal is a finding
                record = {"index": index, "memory": isinstance(cause, MemoryError), "cause": _cause_text(cause)}
                print(json.dumps(record), file=lines, flush=True)
            slowest_s = max(slowest_s, time.monotonic() - began)
            used_s, grown = time.process_time() - cpu_s, _bytes_of("VmHWM") - before
            used_s -= sound_s[commands.words_of(seed, index)] if sound_s else 0.0
            if used_s > BOUND_CPU_S or grown > BOUND_BYTES:
                bound = f"{used_s:.1f} s of CPU and {grown / 1e6:.0f} MB beyond a sound file"
                print(json.dumps({"index": index, "bound": bound}), file=lines, flush=True)
        state[:] = STATE.pack(runs, answers, refusals, time.monotonic())
        print(json.dumps({"slowest_s": slowest_s}), file=lines, flush=True)


def _sound_cpu_s(folder: Path) -> dict[tuple[str, ...], float]:
    """Processor time of each command on sound files, with a small picture or a sample: the longer of both."""
    found = {}
    for words in commands.COMMANDS:
        times = []
        for small in (False, True):
            began = time.process_time()
            commands.run_sound(words, folder, small=small)
            times.append(time.process_time() - began)
        found[words] = max(times)
    return found


def _reset_peak_bytes() -> int:
    """Make the present memory the largest one so far (VmHWM), where the system lets a process do so."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _bytes_of("VmHWM")


def _bytes_of(key: str) -> int:
    """A size of memory in this process's status."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status[key].split()[0]) * 1024


def _one(kind: str, seed: int, index: int, folder: Path) -> str | None:
    if kind == COMMAND:
        return commands.run_command(seed, index, folder)
    if kind == SELF_TEST:
        return _fail(index)
    data, number = targets.mutated(kind, seed, index)
    return targets.read(kind, data, number, folder)


def _fail(index: int) -> str | None:
    """An answer, a refusal, an exception, an end of the process, a hang, no memory, and too much, by the number."""
    match index % 7:
        case 0 | 1:
            return None if index % 7 == 0 else "refused"
        case 2:
            raise ValueError("self-test")
        case 3:
            os._exit(9)
        case 4:
            time.sleep(3600)
        case 6:
            return None if b"x" * int(1.2 * BOUND_BYTES) else "refused"
    return str(len(bytearray(2 * MEMORY_BYTES)))


def _cause_text(cause: BaseException) -> str:
    """The exception and the last lines of the package in its traceback."""
    frames = [f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in traceback.extract_tb(cause.__traceback__)]
    return f"{type(cause).__name__}: {cause} | {' < '.join(reversed(frames[-5:]))}"[:900]


if __name__ == "__main__":
    work(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), Path(sys.argv[5]))
