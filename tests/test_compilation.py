"""numba's cache: compiling is announced once, loading from the cache is not; a folder for read-only installations."""

from __future__ import annotations

import errno
import logging
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from startrack.core import compilation, kernels
from startrack.core.runner import Runner
from startrack.core.types import Evidence, NotLocated
from startrack.localization import posterior
from startrack.terrain import load_terrain

ROOT = Path(__file__).parent.parent
FIRST_USE = """
import sys

from startrack.core.compilation import announce_compilation

announce_compilation()
announce_compilation()
from numba import njit

__name__ = "startrack.probe"  # a kernel of the package, as far as numba can tell
sys.modules[__name__] = sys.modules["__main__"]

@njit(cache=True)
def kernel(x):
    return x + 1.0

kernel(1.0)
kernel(1)
"""


def run_script(script: Path, cache: Path) -> tuple[str, str]:
    """What it prints on stdout and on stderr."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


@pytest.mark.slow
def test_compiling_is_announced_once_and_loading_is_not(tmp_path):
    script = tmp_path / "first_use.py"
    script.write_text(FIRST_USE)
    out, log = run_script(script, tmp_path / "cache")
    assert out == ""
    assert log.splitlines() == ["compiling probe, once for this installation: for another kind of data"]
    assert run_script(script, tmp_path / "cache") == ("", "")


@pytest.mark.slow
@pytest.mark.parametrize("words", ["terrain show shackleton --no-plots --at 0 0", "render -t shackleton -o {out}"])
def test_the_first_use_of_a_command_without_images_is_announced(tmp_path, words):
    script = tmp_path / "command.py"
    arguments = words.format(out=tmp_path / "a.png").split()
    script.write_text(f"from startrack.cli.main import main\nassert main({arguments}) == 0\n")
    _, log = run_script(script, tmp_path / "cache")
    assert "compiling terrain, once for this installation: 0 of" in log


@pytest.mark.slow
def test_after_doctor_no_command_compiles(tmp_path):
    """Of those that are used first: a narrow field without a camera file, a skyline, a track, and a height map."""
    place = {"NUMBA_CACHE_DIR": str(tmp_path / "numba"), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    (tmp_path / "numba").mkdir()
    images = ROOT / "sample_images"
    drive = tmp_path / "drive"
    drive.mkdir()
    for name in ("near-centre.png", "near-centre.json", "near-wall.png", "near-wall.json"):
        (drive / name).write_bytes((images / name).read_bytes())
    lowell = images / "lowell-2018-08-06.fits.bz2"

    def lines_of(*words: object) -> list[str]:
        command = [sys.executable, "-m", "startrack", *map(str, words)]
        run = subprocess.run(command, env={**os.environ, **place}, capture_output=True, text=True, cwd=tmp_path)
        return [line for line in run.stderr.splitlines() if line.startswith("compiling ")]

    assert lines_of("doctor")
    for words in (
        ("identify", images / "near-centre.png", "--fov", "8..20", "-D", tmp_path / "out", "--no-plots"),
        ("horizon", lowell, "-c", "lowell-ldt", "--site=34.7443,-111.4223,2361", "-o", tmp_path / "a.hrz"),
        ("track", drive, "-D", tmp_path / "track"),
        ("terrain", "show", "shackleton", "--no-plots"),
    ):
        assert lines_of(*words) == [], words


def test_compiled_code_that_the_disk_does_not_take_is_used_all_the_same(monkeypatch, caplog):
    """A full disk, in the process that compiles."""

    def no_space(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    kernel = kernels.njit(cache=True)(add_two)
    monkeypatch.setattr(kernel._cache._cache_file, "save", no_space)
    monkeypatch.setattr(kernels, "WARNED", set())
    assert kernel(1.0) == 3.0
    assert "cannot be kept (No space left on device)" in caplog.text


def add_two(x):
    return x + 2.0


def test_python_calls_no_inner_kernel():
    with pytest.raises(TypeError, match="add_two is called by kernels only"):
        kernels.njit(inner=True)(add_two)(1.0)


def compile_beside_another(folder: str) -> int:
    """Signal the compilation of a kernel, as numba does, once two processes have begun."""
    from numba.core import event

    compilation.announce_compilation()
    (Path(folder) / str(os.getpid())).touch()
    while len(list(Path(folder).iterdir())) < 2:
        time.sleep(0.01)
    dispatcher = SimpleNamespace(py_func=SimpleNamespace(__module__="startrack.probe"))
    event.start_event("numba:compile", data={"dispatcher": dispatcher})
    return os.getpid()


@pytest.mark.slow
@pytest.mark.parametrize(("announced", "level", "lines"), [(False, 0, 1), (True, 0, 0), (False, logging.ERROR, 0)])
def test_two_processes_announce_once(tmp_path, capfd, monkeypatch, announced, level, lines):
    """And not at all where their parent has, or where it is quiet."""
    monkeypatch.setattr(compilation.ANNOUNCEMENT_TURN, "is_taken", announced)
    monkeypatch.setattr(logging.getLogger("startrack"), "level", level)
    with Runner(compile_beside_another, jobs=2) as runner:
        processes = {process for _, process in runner.results([str(tmp_path)] * 4)}
    assert len(processes) == 2
    assert capfd.readouterr().err.count("compiling probe, once for this installation") == lines


def test_a_localizer_called_without_the_pipeline_announces_too(monkeypatch):
    calls: list[str] = []
    monkeypatch.setattr(posterior, "announce_compilation", lambda: calls.append("announced"))
    none = Evidence(azimuth_rad=[], elevation_rad=[], llr=[])
    with pytest.raises(NotLocated):
        posterior.ExactPosterior()(none, load_terrain("shackleton-thesis"))
    assert calls == ["announced"]


@pytest.fixture
def read_only_package(monkeypatch, tmp_path):
    """An installation that cannot be written to, for a user with a home."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(compilation.os, "access", lambda path, mode: False)


def test_kernels_of_a_read_only_installation_are_kept_in_the_users_cache(read_only_package, tmp_path):
    compilation.choose_cache_folder()
    assert os.environ.pop("NUMBA_CACHE_DIR") == str(tmp_path / "cache" / "startrack" / "numba")


def test_without_any_folder_the_kernels_are_kept_for_the_process(read_only_package, tmp_path):
    (tmp_path / "cache").write_text("no folder")
    compilation.choose_cache_folder()
    folder = Path(os.environ.pop("NUMBA_CACHE_DIR"))
    assert folder.is_dir()
    assert folder.stat().st_mode & 0o077 == 0  # numba unpickles the files in it
    folder.rmdir()


def test_a_folder_that_the_user_names_is_kept(monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "mine")
    monkeypatch.setattr(compilation.os, "access", lambda path, mode: False)
    compilation.choose_cache_folder()
    assert os.environ["NUMBA_CACHE_DIR"] == "mine"


@pytest.fixture
def cached_kernel(monkeypatch, tmp_path):
    """A package of one module with the index of a compiled kernel beside it."""
    package = tmp_path / "package"
    index = package / "__pycache__" / f"module.kernel-1.py{sys.version_info.major}{sys.version_info.minor}.nbi"
    index.parent.mkdir(parents=True)
    (package / "module.py").write_text("x = 1\n")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(compilation, "PACKAGE", package)
    compilation.discard_stale_kernels()
    index.write_bytes(b"compiled")
    return index


def test_kernels_stay_while_the_sources_do(cached_kernel):
    compilation.discard_stale_kernels()
    assert cached_kernel.exists()


@pytest.mark.parametrize("change", ["text", "file", "version"])
def test_kernels_of_other_sources_are_forgotten(cached_kernel, monkeypatch, change):
    package = cached_kernel.parent.parent
    if change == "text":
        (package / "module.py").write_text("x = 22\n")
    elif change == "file":
        (package / "other.py").write_text("y = 1\n")
    else:
        monkeypatch.setattr(compilation, "__version__", "another")
    compilation.discard_stale_kernels()
    assert not cached_kernel.exists()


def test_every_kernel_is_compiled_by_the_checked_cache():
    sources = (ROOT / "startrack").rglob("*.py")
    direct = [
        path.stem for path in sources if re.search(r"^(from|import) numba", path.read_text(encoding="utf-8"), re.M)
    ]
    assert direct == ["kernels"]


def test_no_kernel_is_in_a_package_whose_changes_keep_the_cache() -> None:
    package = Path(compilation.__file__).parents[1]
    assert all((package / name).is_dir() for name in compilation.ABOVE_KERNELS)
    sources = [path for name in compilation.ABOVE_KERNELS for path in (package / name).rglob("*.py")]
    assert [path for path in sources if "njit" in path.read_text(encoding="utf-8")] == []
