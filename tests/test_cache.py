"""What startrack keeps between runs: where it lies, also for users without a home or a folder to write to."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from startrack.cli.main import main
from startrack.core import stored
from startrack.core.files import hold_lock
from startrack.core.types import BadInput

ROOT = Path(__file__).parent.parent
# Python as for a user of whom the system knows nothing, and after it a machine that takes no file.
UNKNOWN_USER = """
import os, pwd, sys, tempfile

def unknown(uid):
    raise KeyError(uid)

pwd.getpwuid = unknown
os.environ.pop("HOME", None)
os.environ.pop("XDG_CACHE_HOME", None)
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

    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", unknown)
    monkeypatch.setattr(stored.tempfile, "gettempdir", lambda: str(tmp_path))
    return tmp_path / f"startrack-{os.getuid()}"


@needs_users
def test_without_a_home_the_cache_lies_in_a_temporary_folder_of_the_user_alone(without_home):
    assert stored.cache_folder("horizons") == without_home / "horizons"
    assert without_home.stat().st_mode & 0o777 == 0o700
    assert stored.cache_folder("draws") == without_home / "draws"  # the same folder again


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
        stored.cache_folder("horizons").mkdir(parents=True)


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
    image = ROOT / "sample_images/near-centre.png"
    done = run_unknown(tmp_path, READ_ONLY, "detect", image, "-D", "out", "-q")
    assert (done.returncode, done.stderr) == (0, "")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["out", "script.py"]


@pytest.fixture
def full_cache(monkeypatch, tmp_path):
    """A cache of three tables, and the locks of a process that lives and a killed one.

    The first table was used last.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    tables = tmp_path / "startrack" / "horizons"
    tables.mkdir(parents=True)
    for age_s, name in ((10, "a"), (30, "b"), (20, "c")):
        (tables / f"{name}.table").write_bytes(bytes(1000))
        os.utime(tables / f"{name}.table", (1e9 - age_s, 1e9 - age_s))
    (tables / "killed.lock").write_text("1")
    with hold_lock(tables / "a.lock"):
        yield tables


def test_cache_shows_what_it_keeps(full_cache, capsys):
    assert main(["cache", "show", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["limit_bytes"] == 2e9
    assert [(one["kind"], one["files"], one["bytes"]) for one in record["folders"]] == [
        ("tables of horizons", 3, 3000),
    ]
    assert main(["cache", "show"]) == 0
    assert str(full_cache) in capsys.readouterr().out


def test_cache_clear_removes_all_but_the_lock_in_use(full_cache, capsys):
    assert main(["cache", "clear"]) == 0
    assert capsys.readouterr().out == "removed 3 files, 0.0 MB\n"
    left = [path.name for path in full_cache.parent.rglob("*") if path.is_file()]
    assert left == ["a.lock"]
    assert main(["cache", "clear", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["removed_bytes"] == 0


def test_the_tables_that_were_not_used_for_longest_leave_above_the_limit(full_cache, monkeypatch):
    for size_gb, left in (("3e-6", "abc"), ("2.5e-6", "ac"), ("1e-6", "a"), ("0", "a")):
        monkeypatch.setenv("STARTRACK_CACHE_GB", size_gb)
        stored.remove_oldest(full_cache, "*.table", full_cache / "a.table")
        assert sorted(path.stem for path in full_cache.glob("*.table")) == [*left], size_gb


@pytest.mark.parametrize("text", ["much", "-1", "nan"])
def test_a_limit_that_is_no_size_is_refused(monkeypatch, text):
    monkeypatch.setenv("STARTRACK_CACHE_GB", text)
    with pytest.raises(BadInput, match=f"STARTRACK_CACHE_GB={text}: is no size in GB"):
        stored.limit_bytes()
