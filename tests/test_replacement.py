"""Files that appear when they are complete: what a killed process leaves is removed by the next one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from startrack.core.files import PART_LIVES_S, _remove_parts, write_atomically

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no lock shows there that a process lives")
# Stops between write and rename, as a run that is killed there.
STOP = """
import os, sys, time
from startrack.core.files import write_atomically

def stand_still(*_):
    print("written", flush=True)
    time.sleep(60)

os.replace = stand_still
write_atomically(sys.argv[1], b"x" * 1000, overwrite=True)
"""


@pytest.fixture
def writer(tmp_path):
    """A process that has written a part and not renamed it."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    process = subprocess.Popen(
        [sys.executable, "-c", STOP, str(tmp_path / "a.json")], stdout=subprocess.PIPE, text=True, env=environment
    )
    assert process.stdout is not None and process.stdout.readline() == "written\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def parts(folder: Path) -> list[Path]:
    return list(folder.glob(".*.part"))


def test_the_next_run_removes_the_part_of_a_killed_one_and_none_in_use(writer, tmp_path):
    (part,) = parts(tmp_path)
    assert part.stat().st_size == 1000
    let_age(part, 2 * PART_LIVES_S)
    write_atomically(tmp_path / "b.json", b"1", overwrite=True)
    assert parts(tmp_path) == [part]
    writer.send_signal(signal.SIGKILL)
    writer.wait()
    assert parts(tmp_path) == [part]
    _remove_parts.cache_clear()  # as in another process
    write_atomically(tmp_path / "c.json", b"2", overwrite=True)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["b.json", "c.json"]


def let_age(path: Path, seconds: float) -> None:
    written = time.time() - seconds
    os.utime(path, (written, written))


def test_a_young_part_stays_though_its_lock_is_free(tmp_path):
    """A file system with locks within one host gives the lock of a part that another host is writing."""
    part = tmp_path / f".{'3' * 32}.part"
    part.write_bytes(b"x")
    for age_s, stays in ((0.9 * PART_LIVES_S, True), (1.1 * PART_LIVES_S, False)):
        let_age(part, age_s)
        _remove_parts.cache_clear()
        write_atomically(tmp_path / "a.json", b"1", overwrite=True)
        assert part.exists() == stays


def test_files_of_others_stay(tmp_path):
    mine = [tmp_path / name for name in ("x.part", ".x.part", f".{'0' * 31}g.part", f".{'1' * 32}.part.json")]
    for path in mine:
        path.write_text("mine")
    (tmp_path / f".{'2' * 32}.part").symlink_to(mine[0])
    for path in mine:
        let_age(path, 2 * PART_LIVES_S)
    write_atomically(tmp_path / "a.json", b"1", overwrite=True)
    assert len(list(tmp_path.iterdir())) == 6
