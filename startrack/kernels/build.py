"""Compile the C sources of this folder: `python -m startrack.kernels.build`, as the installation does.

`python -m startrack.kernels.build wheels FOLDER` makes the wheels of a checkout for all systems of TARGETS.

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
ZIG = (sys.executable, "-m", "ziglang", "cc")
ZIG_CACHES = "ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR"  # variables
ZIGLANG = "ziglang>=0.13,<0.18"  # a C compiler as a Python package, for machines that have none
X86_64 = ("x86_64", "amd64")
SUFFIXES = {"win32": ".dll", "darwin": ".dylib"}  # of libraries, by sys.platform; ".so" elsewhere
VARIABLE = "STARTRACK_PLATFORM"  # of the environment: a key of TARGETS, a system to make a wheel for by ziglang
# No fast arithmetic and no contraction: all compilers and both levels give the same bytes. The kernels read neither
# `errno` nor the flags of floating-point exceptions.
FLAGS = ("-std=c99", "-O3", "-fno-fast-math", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")
# Of x86-64-v3, for old compilers; without FMA: gcc 12 fuses neighbouring a b + c and a b - c despite -ffp-contract=off.
V3 = ("-mavx", "-mavx2", "-mbmi", "-mbmi2", "-mf16c", "-mlzcnt", "-mmovbe")
SANITIZED = ("-O1", "-g", "-fno-omit-frame-pointer", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")
PROBE = "#include <math.h>\n#if defined(_WIN32)\n__declspec(dllexport)\n#endif\ndouble probe(double x) {return exp(x);}"
CURE = (
    "Install a C compiler (Debian, Ubuntu: apt-get install gcc; Fedora: dnf install gcc; macOS: xcode-select --install)"
    f", or the package that holds one: pip install '{ZIGLANG}'. The variable CC names another compiler."
)


class BuildFailed(Exception):
    """No compiler works, or the sources do not compile. The message says what was tried and what helps."""


@dataclass(frozen=True)
class Target:
    """A system: its name as in sys.platform, its processor as in platform.machine, and both in zig's words."""

    system: str
    machine: str
    zig: str

    @property
    def levels(self) -> tuple[str, ...]:
        """The levels of processors that a wheel for it has libraries for."""
        return ("baseline", "v3") if self.machine.lower() in X86_64 else ("baseline",)

    def library_name(self, level: str) -> str:
        """File name of the library of the present sources for the processors of a `level`."""
        return f"kernels-{source_key()}-{level}{SUFFIXES.get(self.system, '.so')}"


TARGETS = {  # by the tag of their wheels
    "manylinux_2_17_x86_64": Target("linux", "x86_64", "x86_64-linux-gnu.2.17"),
    "manylinux_2_17_aarch64": Target("linux", "aarch64", "aarch64-linux-gnu.2.17"),
    "macosx_13_0_x86_64": Target("darwin", "x86_64", "x86_64-macos.13.0"),
    "macosx_13_0_arm64": Target("darwin", "arm64", "aarch64-macos.13.0"),
    "win_amd64": Target("win32", "AMD64", "x86_64-windows-gnu"),
    "win_arm64": Target("win32", "ARM64", "aarch64-windows-gnu"),
}


@dataclass(frozen=True)
class Compiler:
    """A compiler that builds libraries for a target: its command, and flags for each level."""

    words: tuple[str, ...]
    target: Target
    is_zig: bool = False

    def flags(self, level: str) -> tuple[str, ...]:
        """Flags of the processors of a `level`, and of the target system."""
        processor: tuple[str, ...] = ()
        if self.is_zig:  # whose own choice is this machine's processor
            name = {"baseline": "baseline", "v3": "x86_64_v3"}[level]
            processor = ("-target", self.target.zig, f"-mcpu={name}")
        elif level == "sanitized":
            processor = SANITIZED
        elif "v3" in self.target.levels:
            processor = ("-march=x86-64", "-mtune=generic", *(V3 if level == "v3" else ()))
        return (*processor, "-shared", *(() if self.target.system == "win32" else ("-fPIC",)))

    def build(self, sources: Sequence[Path], level: str, library: Path) -> None:
        """Compile `sources` into a `library` for the processors of a `level`. Raises BuildFailed."""
        own = {name: os.environ.get(name) or _zig_cache().name for name in ZIG_CACHES} if self.is_zig else {}
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


@cache
def source_key() -> str:
    """The hash of all that decides over the libraries: the C sources, the header and this file."""
    key = hashlib.sha256()
    for path in sorted([*FOLDER.glob("*.[ch]"), Path(__file__)], key=lambda path: path.name):
        key.update(path.name.encode() + b"\0" + path.read_bytes())
    return key.hexdigest()[:16]


@cache
def this_target() -> Target:
    """This machine's system; on Linux with a C library that systems since 2014 have."""
    machine = platform.machine()
    name = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine.lower(), machine.lower())
    if sys.platform == "win32":
        system = "windows-gnu"
    elif sys.platform == "darwin":
        system = "macos"
    elif platform.libc_ver()[0] == "glibc":
        system = "linux-gnu" + {"x86_64": ".2.17", "aarch64": ".2.17"}.get(name, "")
    else:
        system = "linux-musl"
    return Target(sys.platform, machine, f"{name}-{system}")


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


def build(folder: Path = COMPILED, chosen: Sequence[str] = (), target: Target | None = None) -> list[Path]:
    """Compile the `chosen` levels, else all of a `target` (None: this machine), into a `folder`; the libraries.

    Libraries of other sources in the folder are removed. For a given target ziglang must be installed. Raises
    BuildFailed.
    """
    compiler = Compiler(ZIG, target, is_zig=True) if target else find_compiler(with_zig="sanitized" not in chosen)
    sources, made = sorted(FOLDER.glob("*.c")), []
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        for level in chosen or compiler.target.levels:
            library = folder / compiler.target.library_name(level)
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


def build_wheels(folder: str) -> None:
    """Make the wheels of this checkout for all TARGETS in a `folder`. Raises BuildFailed."""
    words = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, str(FOLDER.parents[1])]
    for tag in TARGETS:
        if subprocess.run(words, env={**os.environ, VARIABLE: tag}).returncode:
            raise BuildFailed(f"There is no wheel for {tag}: see the message above")


def _candidates(with_zig: bool) -> Iterator[Compiler]:
    target = this_target()
    own = shlex.split(os.environ.get("CC", ""))
    if own:
        yield Compiler(tuple(own), target)
    if os.name != "nt":
        for name in ("cc", "gcc", "clang"):
            yield Compiler((name,), target)
    if with_zig and importlib.util.find_spec("ziglang") is not None:
        yield Compiler(ZIG, target, is_zig=True)


def _check(compiler: Compiler) -> None:
    """Raise BuildFailed unless the compiler builds a library for each level, and Python can call it."""
    # Beside the sources: some systems run nothing from their folder for temporary files.
    place = FOLDER if os.access(FOLDER, os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="probe-", dir=place, ignore_cleanup_errors=True) as folder:
        source = Path(folder, "probe.c")
        source.write_text(PROBE)
        for level in reversed(compiler.target.levels):
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


def main() -> int:
    """Compile the levels named on the command line, else those of this machine; 0, or 1 with a message.

    `wheels FOLDER` makes the wheels for all TARGETS instead.
    """
    try:
        if sys.argv[1:2] == ["wheels"]:
            build_wheels(sys.argv[2])
            return 0
        for path in build(chosen=sys.argv[1:]):
            print(path)
    except (BuildFailed, OSError) as cause:
        print(cause, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
