"""What startrack keeps between runs: where it lies, also for users without a home or a folder to write to."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from startrack.core import cache, compilation

ROOT = Path(__file__).parent.parent
# Python as for a user of whom the system knows nothing, and after it a machine that takes no file.
UNKNOWN_USER = """
import os, pwd, sys, tempfile

def unknown(uid):
    raise KeyError(uid)

pwd.getpwuid = unknown
os.environ.pop("HOME", None)
os.environ.pop("XDG_CACHE_HOME", None)
os.environ.pop("NUMBA_CACHE_DIR", None)
"""
READ_ONLY = """
def none():
    raise FileNotFoundError("No usable temporary directory found")

tempfile.gettempdir = none
allowed = os.access
os.access = lambda path, mode, **more: mode != os.W_OK and allowed(path, mode, **more)
"""
COMMAND = "from startrack.cli.main import main\nsys.exit(main(sys.argv[1:]))"

needs_users = pytest.mark.skipif(not hasattr(os, "getuid"), reason="Windows knows each user's home")


@pytest.fixture
def without_home(monkeypatch, tmp_path):
    """A user whom the system does not know, with a temporary folder."""

    def unknown(uid):
        raise KeyError(uid)

    for name in ("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", unknown)
    monkeypatch.setattr(cache.tempfile, "gettempdir", lambda: str(tmp_path))
    return tmp_path / f"startrack-{os.getuid()}"


@needs_users
def test_without_a_home_the_cache_lies_in_a_temporary_folder_of_the_user_alone(without_home):
    assert cache.cache_folder("horizons") == without_home / "horizons"
    assert without_home.stat().st_mode & 0o777 == 0o700
    assert cache.cache_folder("numba") == without_home / "numba"  # the same folder again


@needs_users
@pytest.mark.parametrize("fault", ["others may write", "link"])
def test_a_temporary_folder_that_others_may_have_filled_is_not_used(without_home, fault):
    if fault == "link":
        (without_home.parent / "theirs").mkdir()
        without_home.symlink_to(without_home.parent / "theirs")
    else:
        without_home.mkdir()
        without_home.chmod(0o777)
    with pytest.raises(OSError, match="Not a directory"):
        cache.cache_folder("horizons").mkdir(parents=True)


def run_unknown(tmp_path: Path, more: str, *words: object) -> subprocess.CompletedProcess[str]:
    """A run of the command as by an unknown user."""
    script = tmp_path / "script.py"
    script.write_text(UNKNOWN_USER + more + COMMAND)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    command = [sys.executable, str(script), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)


@needs_users
def test_a_user_without_a_home_builds_a_table(tmp_path):
    done = run_unknown(tmp_path, "", "terrain", "show", "shackleton-thesis", "--no-plots")
    assert (done.returncode, done.stderr) == (0, "")


@needs_users
@pytest.mark.slow
def test_where_no_folder_takes_a_file_commands_run_or_end_in_words(tmp_path):
    """Kernels are then compiled and not kept."""
    image = ROOT / "sample_images/near-centre.png"
    done = run_unknown(tmp_path, READ_ONLY, "detect", image, "-D", "out", "-q")
    assert (done.returncode, done.stderr) == (0, "")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["out", "script.py"]


def test_kernels_are_not_kept_where_no_folder_takes_a_file(monkeypatch):
    def none(**_):
        raise FileNotFoundError

    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull)
    monkeypatch.setattr(compilation.os, "access", lambda path, mode: False)
    monkeypatch.setattr(compilation.tempfile, "mkdtemp", none)
    assert compilation.choose_cache_folder() is False
    assert "NUMBA_CACHE_DIR" not in os.environ
