"""One batch at a time writes to a folder."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest
from batch_helpers import frames

from startrack.applications.batch import LOCK, lock_results
from startrack.cli.main import main
from startrack.core.errors import BadInput

HOLD = """
import sys
from pathlib import Path
from startrack.applications.batch import lock_results
with lock_results(Path(sys.argv[1])): print(flush=True); input()
"""


def holder(out) -> subprocess.Popen[str]:
    """A process that holds the lock of the folder."""
    command = [sys.executable, "-c", HOLD, str(out)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    return process


def test_a_second_batch_is_refused_and_changes_nothing(tmp_path, capsys):
    frames(tmp_path / "images", 1)
    out = tmp_path / "out"
    out.mkdir()
    first = holder(out)
    assert main(["batch", str(tmp_path / "images"), "-D", str(out), "-j", "1"]) == 4
    assert f"another batch is writing to {out} (process {first.pid})" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == [LOCK]
    first.communicate("\n")
    assert list(out.iterdir()) == []
    assert main(["batch", str(tmp_path / "images"), "-D", str(out), "-j", "1", "-q"]) == 5


def test_a_lock_is_released_with_a_killed_process(tmp_path):
    first = holder(tmp_path)
    first.send_signal(signal.SIGKILL)
    first.communicate()
    assert (tmp_path / LOCK).exists()
    with lock_results(tmp_path):
        assert (tmp_path / LOCK).read_text() == str(os.getpid())
        with pytest.raises(BadInput, match=f"process {os.getpid()}"), lock_results(tmp_path):
            pass
    assert not (tmp_path / LOCK).exists()


@pytest.mark.parametrize("kind", ["folder", "symlink"])
def test_a_lock_file_of_another_kind_is_bad_input(tmp_path, kind):
    target = tmp_path / "target"
    target.write_text("not ours")
    if kind == "folder":
        (tmp_path / LOCK).mkdir()
    else:
        (tmp_path / LOCK).symlink_to(target)
    with pytest.raises(BadInput, match="cannot be used as lock file"), lock_results(tmp_path):
        pass
    assert target.read_text() == "not ours"
