"""numba's cache: a folder for read-only installations, and damaged, stale and equal kernels."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from startrack.core import compilation, kernels
from startrack.detection.residual_kernel import fill_row

ROOT = Path(__file__).parent.parent
PEAKS = """
import errno
import hashlib
import numpy as np
from startrack.detection.peak_kernel import find_maxima

rng, single = np.random.default_rng(4), np.float32
image = rng.normal(100.0, 10.0, (256, 256)).astype(single)
background, noise = rng.uniform(90.0, 110.0, (4, 256)).astype(single), rng.uniform(9.0, 11.0, (4, 256)).astype(single)
none, taps = np.zeros((0, 256), single), np.exp(-0.25 * np.arange(9) ** 2).astype(single)
peaks = find_maxima(
    image, background, noise, 64, none, single(1.0), single(0.0), taps, 2, single(1.0), single(2.0),
    np.zeros((0, 256), bool), 8,
)
print(len(peaks), hashlib.sha256(peaks.tobytes()).hexdigest())
"""


def run_script(script: Path, cache: Path) -> tuple[str, str]:
    """What it prints on stdout and on stderr."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


@pytest.mark.slow
def test_a_kernel_gives_the_same_bytes_compiled_and_loaded(tmp_path):
    """Its sums of reordered terms are those of its own library's code, in the process that compiles its parts too."""
    script = tmp_path / "peaks.py"
    script.write_text(PEAKS)
    compiled, loaded = (run_script(script, tmp_path / "cache")[0] for _ in range(2))
    assert int(compiled.split()[0]) > 100
    assert compiled == loaded


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nbi", "nbc"])
@pytest.mark.parametrize("fault", ["cut short", "one bit"])
def test_damaged_compiled_code_is_made_anew(tmp_path, kind, fault):
    """With one line for all files and the same bytes; the run after it loads what it kept."""
    script, cache = tmp_path / "peaks.py", tmp_path / "cache"
    script.write_text(PEAKS)
    before, _ = run_script(script, cache)
    files = list(cache.rglob(f"*.{kind}"))
    assert files
    for file in files:
        data = bytearray(file.read_bytes())
        data[len(data) // 2] ^= fault == "one bit"
        file.write_bytes(data[:30] if fault == "cut short" else data)
    out, log = run_script(script, cache)
    assert out == before
    assert log.splitlines() == [f"a file of compiled code is damaged: compiled anew ({cache})"]
    assert run_script(script, cache) == (before, "")


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
    with pytest.raises(TypeError, match="fill_row is called by kernels only"):
        fill_row(1.0)


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
