"""Compile the C sources of this folder: `python -m startrack.kernels.build`, as the installation does.

The libraries lie in the folder `compiled` beside the sources. Their names hold the hash of the sources, so that a
library of other sources is never loaded. This file uses the standard library only, and nothing of startrack: the build
hook loads it before anything is installed.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

FOLDER = Path(__file__).parent
COMPILED = FOLDER / "compiled"
ZIGLANG = "ziglang>=0.13,<0.18"  # a C compiler as a Python package, for machines that have none
X86_64 = ("x86_64", "amd64")
# No fast arithmetic and no contraction: all compilers and both levels give the same bytes. The kernels read neither
# `errno` nor the flags of floating-point exceptions.
FLAGS = ("-std=c99", "-O3", "-fno-fast-math", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")
V3 = ("-mavx", "-mavx2", "-mbmi", "-mbmi2", "-mf16c", "-mfma", "-mlzcnt", "-mmovbe")  # of x86-64-v3, for old compilers
SANITIZED = ("-O1", "-g", "-fno-omit-frame-pointer", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")
PROBE = "#include <math.h>\n#if defined(_WIN32)\n__declspec(dllexport)\n#endif\ndouble probe(double x) {return exp(x);}"
CURE = (
    "Install a C compiler (Debian, Ubuntu: apt-get install gcc; Fedora: dnf install gcc; macOS: xcode-select --install)"
    f", or the package that holds one: pip install '{ZIGLANG}'. The variable CC names another compiler."
)


class BuildFailed(Exception):
    """No compiler works, or the sources do not compile. The message says what was tried and what helps."""


@dataclass(frozen=True)
class Compiler:
    """A compiler that builds libraries which this Python loads: its command, and flags for each level."""

    words: tuple[str, ...]
    is_zig: bool = False

    def flags(self, level: str) -> tuple[str, ...]:
        """Flags of the processors of a `level`, and of the target system."""
        processor: tuple[str, ...] = ()
        if self.is_zig:  # whose own choice is this machine's processor
            name = {"baseline": "baseline", "v3": "x86_64_v3"}[level]
            processor = ("-target", _zig_target(), f"-mcpu={name}")
        elif level == "sanitized":
            processor = SANITIZED
        elif is_x86_64():
            processor = ("-march=x86-64", "-mtune=generic", *(V3 if level == "v3" else ()))
        return (*processor, "-shared", *(() if os.name == "nt" else ("-fPIC",)))

    def build(self, sources: Sequence[Path], level: str, library: Path) -> None:
        """Compile `sources` into a `library` for the processors of a `level`. Raises BuildFailed."""
        own = dict.fromkeys(("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR"), _zig_cache().name) if self.is_zig else {}
        flags = [*shlex.split(os.environ.get("CFLAGS", "")), *FLAGS, *self.flags(level)]
        command = [
            *self.words, *flags, f"-DFLAGS={json.dumps(shlex.join(flags))}", "-o", str(library), *map(str, sources),
            *shlex.split(os.environ.get("LDFLAGS", "")), "-lm",
        ]  # fmt: skip
        try:
            run = subprocess.run(command, capture_output=True, text=True, errors="replace", env={**os.environ, **own})
        except OSError as cause:
            raise BuildFailed(f"{' '.join(self.words)}: {cause.strerror}") from cause
        if run.returncode or not library.is_file():
            lines = [line for line in run.stderr.splitlines() if "error" in line] or run.stderr.splitlines() or ["?"]
            raise BuildFailed(f"{' '.join(self.words)} ({level}): {lines[0].strip()}")


def is_x86_64() -> bool:
    """Whether this machine has the two levels of processors."""
    return platform.machine().lower() in X86_64


def levels() -> tuple[str, ...]:
    """The levels of processors that a wheel for this machine has libraries for."""
    return ("baseline", "v3") if is_x86_64() else ("baseline",)


@cache
def source_key() -> str:
    """The hash of all that decides over the libraries: the C sources, the header and this file."""
    key = hashlib.sha256()
    for path in sorted([*FOLDER.glob("*.[ch]"), Path(__file__)], key=lambda path: path.name):
        key.update(path.name.encode() + b"\0" + path.read_bytes())
    return key.hexdigest()[:16]


def library_name(level: str) -> str:
    """File name of the library of the present sources for the processors of a `level`."""
    suffix = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
    return f"kernels-{source_key()}-{level}{suffix}"


def how_to_build(level: str) -> str:
    """What to type for the library of a `level`."""
    words = f"{sys.executable} -m startrack.kernels.build{' sanitized' if level == 'sanitized' else ''}"
    return f"type `{words}` in {FOLDER.parents[1]}, or install startrack anew"


def find_compiler(with_zig: bool = True) -> Compiler:
    """The first compiler that works: $CC, cc, gcc, clang, and `with_zig` that of the package ziglang.

    Raises BuildFailed with what was tried.
    """
    tried = []
    for compiler in _candidates(with_zig):
        try:
            _check(compiler)
        except BuildFailed as cause:
            tried.append(str(cause))
        else:
            return compiler
    if with_zig and importlib.util.find_spec("ziglang") is None:
        tried.append("ziglang: not installed")
    raise BuildFailed(f"No C compiler works. Tried: {'; '.join(tried) or 'none'}. {CURE}")


def build(folder: Path = COMPILED, chosen: Sequence[str] = ()) -> list[Path]:
    """Compile the `chosen` levels, else those of this machine, into a `folder`; the libraries. Raises BuildFailed.

    Libraries of other sources in the folder are removed.
    """
    compiler, sources = find_compiler(with_zig="sanitized" not in chosen), sorted(FOLDER.glob("*.c"))
    made = []
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        for level in chosen or levels():
            library = folder / library_name(level)
            new = Path(scratch, library.name)
            try:
                compiler.build(sources, level, new)
            except BuildFailed as cause:
                raise BuildFailed(f"The kernels do not compile. {cause}. {CURE}") from cause
            os.replace(new, library)
            made.append(library)
    for other in folder.glob("kernels-*"):
        if source_key() not in other.name:
            with suppress(OSError):  # Windows keeps a library that a process has loaded
                other.unlink()
    return made


def _candidates(with_zig: bool) -> Iterator[Compiler]:
    own = shlex.split(os.environ.get("CC", ""))
    if own:
        yield Compiler(tuple(own))
    if os.name != "nt":
        for name in ("cc", "gcc", "clang"):
            yield Compiler((name,))
    if with_zig and importlib.util.find_spec("ziglang") is not None:
        yield Compiler((sys.executable, "-m", "ziglang", "cc"), is_zig=True)


def _check(compiler: Compiler) -> None:
    """Raise BuildFailed unless the compiler builds a library for each level, and Python can call it."""
    # Beside the sources: some systems run nothing from their folder for temporary files.
    place = FOLDER if os.access(FOLDER, os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="probe-", dir=place, ignore_cleanup_errors=True) as folder:
        source = Path(folder, "probe.c")
        source.write_text(PROBE)
        for level in reversed(levels()):
            compiler.build([source], level, library := Path(folder, f"probe-{level}.so"))
        try:
            probe = ctypes.CDLL(str(library)).probe
        except (OSError, AttributeError) as cause:
            raise BuildFailed(f"{' '.join(compiler.words)}: {cause}") from cause
        probe.argtypes, probe.restype = [ctypes.c_double], ctypes.c_double
        if probe(0.0) != 1.0:
            raise BuildFailed(f"{' '.join(compiler.words)}: a test program computes wrongly")


@cache
def _zig_cache() -> tempfile.TemporaryDirectory[str]:
    """A folder for what zig keeps from one call to the next, removed at the end of the process."""
    return tempfile.TemporaryDirectory(prefix="startrack-zig-", ignore_cleanup_errors=True)


def _zig_target() -> str:
    """This machine and system in zig's words; on Linux a C library that systems since 2014 have."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    if sys.platform == "win32":
        return f"{machine}-windows-gnu"
    if sys.platform == "darwin":
        return f"{machine}-macos"
    is_gnu = platform.libc_ver()[0] == "glibc"
    oldest = {"x86_64": ".2.17", "aarch64": ".2.17"}.get(machine, "")
    return f"{machine}-linux-gnu{oldest}" if is_gnu else f"{machine}-linux-musl"


def main() -> int:
    """Compile the levels named on the command line, else those of this machine; 0, or 1 with a message."""
    try:
        for path in build(chosen=sys.argv[1:]):
            print(path)
    except (BuildFailed, OSError) as cause:
        print(cause, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
