"""Shipped files by name, TOML files, folders for results, atomic writes and file locks."""

from __future__ import annotations

import errno
import os
import re
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any
from uuid import uuid4

from startrack.core.declaration import similar_name
from startrack.core.errors import MISSING, BadInput, BadOutput, Reason, one_line

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

PACKAGE = Path(__file__).resolve().parents[1]
MAX_TEXT_BYTES = 2**20  # camera and terrain files have a few kilobytes
MAX_CAUSE_CHARS = 200  # of a library's message
MAX_STEM_BYTES = 200  # file systems take names of 255, and a suffix follows
FULL_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}  # errors of writing that are not the path's
MAX_KEY_PARTS = 16  # of a TOML key such as origin.latitude_deg
_KEY_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
KINDS = {  # of TOML files, by the reason of a faulty one: the flag that takes it, and keys that it has
    "bad_calibration": ("-c (a camera file)", {"size_px", "focal_px"}),
    "bad_terrain": ("-t (a terrain file)", {"body", "origin"}),
}
LONG_KEY = re.compile(rf"(?<![\w.-])(?:{_KEY_PART}[ \t]*+\.[ \t]*+){{{MAX_KEY_PARTS}}}")
FOREIGN_CAMERA_SUFFIXES = ".yaml", ".yml", ".xml", ".txt", ".cal"  # of other programs' camera files
FilePath = str | os.PathLike[str]
PART = re.compile(r"\.[0-9a-f]{32}\.part")  # name of a file that is being written
PART_LIVES_S = 86_400.0  # since the last byte: longer than any writing, on file systems whose locks hold on one host


class Locked(Exception):
    """Another process holds a lock file. `owner` is its process number as text, "unknown" if it cannot be read."""

    owner = "unknown"

    def __init__(self, lock_file: Path) -> None:
        with suppress(OSError, ValueError):
            text = lock_file.read_text(encoding="ascii").strip()
            self.owner = text if text.isdecimal() else self.owner
        super().__init__(f"process {self.owner} holds the lock")


def data_dir(kind: str) -> Path:
    """Folder of the shipped `kind` ("catalogs", "calib" or "terrain").

    A wheel carries them inside the package; a checkout has them at the top level.
    """
    inside = PACKAGE / "data" / kind
    return inside if inside.is_dir() else PACKAGE.parent / kind


def is_path(reference: FilePath) -> bool:
    """Whether a camera's or terrain's `reference` is a path; otherwise it is the name of a shipped file.

    A path ends in .toml, or as other programs' camera files do, or contains a separator: "/", or "\\" as on Windows.
    """
    text = split_camera(reference)[0]
    return text.endswith((".toml", *FOREIGN_CAMERA_SUFFIXES)) or "/" in text or "\\" in text


def split_camera(reference: FilePath) -> tuple[str, str | None]:
    """File and camera's name of a `reference` FILE#NAME; the name is None for a file alone.

    Only other programs' camera files hold several cameras. An existing file whose own name has a # is taken whole.
    """
    text = os.fspath(reference)
    file, mark, name = text.rpartition("#")
    if mark and file.endswith(FOREIGN_CAMERA_SUFFIXES) and not os.path.isfile(text):
        return file, name
    return text, None


def require_reference(given: object, reason: str) -> None:
    """Raise BadInput `reason` where what is `given` for a file is neither a text nor a path."""
    if not isinstance(given, str | os.PathLike):
        what = type(given).__name__
        raise BadInput(reason, f"{what} is neither a name nor a path: give the name of a shipped file, or a path")


def relative_path(file: FilePath, folder: FilePath) -> str:
    """The path of a `file` as seen from `folder`, with forward slashes.

    Real paths: `..` of a linked folder is not the folder above the link.
    """
    real = os.path.realpath(file)
    try:
        return Path(os.path.relpath(real, os.path.realpath(folder))).as_posix()
    except ValueError:  # another drive of Windows
        return Path(real).as_posix()


def resolve_named(name_or_path: str | Path, kind: str, reason: str) -> Path:
    """Path of a user's file or of a shipped one. Raises BadInput `reason` if there is none, or if it is no name."""
    require_reference(name_or_path, reason)
    if is_path(name_or_path):
        path = Path(name_or_path)
        if not os.path.isfile(path):  # False also for names too long for the file system
            raise BadInput(reason, f"{path}: {missing_text(path)}")
        return path
    path = data_dir(kind) / f"{name_or_path}.toml"
    if not os.path.isfile(path):
        shipped = ", ".join(sorted(p.stem for p in data_dir(kind).glob("*.toml")))
        raise BadInput(
            reason,
            f"no shipped file is called {name_or_path!r}; shipped: {shipped}; a path ends in .toml or contains a "
            f"separator{f': ./{name_or_path}' if os.path.isfile(name_or_path) else ''}",
        )
    return path


def missing_text(path: FilePath) -> str:
    """Message for a `path` without a file; it names the file in that folder whose name is the most similar."""
    folder, name = os.path.split(path)
    there: set[str] = set()
    with suppress(OSError, ValueError):  # no such folder, or a NUL in its name
        there = set(os.listdir(folder or ".")) - {name}  # itself: a link to nowhere
    similar = similar_name(os.fspath(name), sorted(there))
    return f"{MISSING}: is {printable(similar)} meant?" if similar else MISSING


def read_text(path: FilePath, reason: str, *, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a user's file of at most `max_bytes`, UTF-8. Raises BadInput `reason` with one line of cause."""
    try:
        if not os.path.isfile(path):  # a folder; a device or a pipe, which might never end
            raise ValueError("no such file")
        with open(path, "rb") as file:
            raw = file.read(max_bytes + 1)
        if b"\0" in raw:
            raise ValueError("it is no text: is it a picture, or a map (see terrain import)?")
        if len(raw) > max_bytes:
            raise ValueError(f"it has more than {max_bytes // 2**20} MiB")
        return raw.decode("utf-8")
    except (OSError, ValueError) as cause:  # ValueError: not UTF-8 too
        text = (cause.strerror if isinstance(cause, OSError) else None) or str(cause)
        raise BadInput(reason, f"{printable(path)}: cannot be read ({text[:MAX_CAUSE_CHARS]})") from cause


def parse_toml(text: str, reason: str) -> dict[str, Any]:
    """The keys of a TOML text. Raises BadInput `reason` with one line of cause, also for a file of another kind."""
    if LONG_KEY.search(text):  # tomllib takes seconds for a key of thousands of parts
        raise BadInput(reason, f"not a TOML file: a key of more than {MAX_KEY_PARTS} parts")
    try:
        values = tomllib.loads(text)
    except (ValueError, RecursionError) as cause:  # TOMLDecodeError, huge integers, deeply nested lists
        raise BadInput(reason, " ".join(f"not a TOML file: {str(cause)[:MAX_CAUSE_CHARS]}".split())) from cause
    for kind, (flag, keys) in KINDS.items():
        if reason in KINDS and kind != reason and keys <= values.keys():
            raise BadInput(reason, f"it is a file of another kind: give it with {flag}, and the right one here")
    return values


def existing_folder(folder: FilePath, content: str = "") -> Path:
    """Path of a user's folder. Raises BadInput bad_image, naming the expected `content`, if it is a file or missing."""
    path = Path(folder)
    if not path.is_dir():
        of_content = f" of {content}" if content else ""
        cause = "is a file, not a folder" if path.exists() else "no such folder"
        raise BadInput("bad_image", f"{printable(path)}: {cause}{of_content}")
    return path


def make_folder(folder: FilePath, reason: str = "bad_image") -> Path:
    """Make a folder for results and check that files can be written there, before anything is computed.

    Raises BadOutput `reason` if they cannot; BadInput if the disk is full.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except (OSError, ValueError) as cause:  # ValueError: a name with a null character
        raise _write_error(
            cause, reason, path, "results cannot be written to this folder", ": choose another"
        ) from cause
    return path


def check_output(file: FilePath, *, overwrite: bool, reason: str = "bad_image") -> Path:
    """Path of an output file, before anything is computed; its folder is made.

    Raises BadOutput `reason` if the file exists and not `overwrite`, or is a folder, or if its folder takes no files.
    """
    path = Path(file)
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):  # `make_folder` reports what is no folder
        pass
    except (OSError, ValueError) as cause:  # a name too long, or with a null character
        text = getattr(cause, "strerror", None) or cause
        raise BadOutput(reason, f"{printable(path)}: cannot be written ({text})") from cause
    check_free(path, overwrite=overwrite, reason=reason)
    make_folder(path.parent, reason)
    return path


def printable(name: FilePath) -> str:
    """A file's name as one line of text for messages: undecodable bytes and control characters are escaped."""
    return one_line(os.fspath(name))


def file_stem(name: str) -> str:
    """The `name` of a camera or terrain as the stem of a file in one folder: without separators and leading dots."""
    stem = re.sub(r"[/\\\0]", "_", name).lstrip(".")
    return stem.encode("utf-8", "replace")[:MAX_STEM_BYTES].decode("utf-8", "ignore") or "unnamed"


def write_atomically(path: FilePath, data: bytes, *, overwrite: bool, reason: str = "bad_image") -> None:
    """Write a file that appears under its name only when it is complete; missing folders are made.

    Raises BadOutput `reason` if the file exists and not `overwrite`, or if the path takes no file; BadInput if the
    disk is full.
    """
    check_free(path, overwrite=overwrite, reason=reason)
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        replace_file(Path(path), data)
    except (OSError, ValueError) as cause:  # ValueError: a name with a null character
        raise _write_error(cause, reason, path, "cannot be written") from cause


def _write_error(cause: Exception, reason: str, path: FilePath, text: str, advice: str = "") -> BadInput:
    """BadInput (disk_full), or where the path is at fault BadOutput `reason`."""
    is_full = isinstance(cause, OSError) and cause.errno in FULL_DISK
    kind, reason = (BadInput, Reason.DISK_FULL) if is_full else (BadOutput, reason)
    return kind(reason, f"{printable(path)}: {text} ({getattr(cause, 'strerror', None) or cause}){advice}")


def check_free(path: FilePath, *, overwrite: bool, reason: str = "bad_image") -> None:
    """Raise BadOutput `reason` if `path` exists and may not be replaced (not `overwrite`), or is no regular file."""
    check_regular(path, reason)
    if not overwrite and os.path.lexists(path):
        text, ways = f"{printable(path)}: exists already: replace it with", ("overwrite=True", "-O")
        raise BadOutput(reason, *(f"{text} {way}, or write elsewhere" for way in ways))


def check_regular(path: FilePath, reason: str = "bad_image") -> None:
    """Raise BadOutput `reason` if `path` is a folder, a pipe, a device, a socket or a link that leads to no file."""
    if os.path.lexists(path) and not os.path.isfile(path):
        cause = "cannot be replaced: it is no regular file; remove it, or write elsewhere"
        raise BadOutput(reason, f"{printable(path)}: {cause}")


def remove_file(path: FilePath) -> None:
    """Remove a former result, if there is one. Raises BadOutput bad_image if it is no regular file or has to stay."""
    check_regular(path)
    try:
        Path(path).unlink(missing_ok=True)
    except OSError as cause:
        raise _write_error(cause, "bad_image", path, "cannot be written") from cause


@contextmanager
def hold_lock(path: FilePath, *, wait: bool = True, on_wait: Callable[[], None] | None = None) -> Iterator[None]:
    """Hold the lock file `path` for the length of the block; the system releases it if the process is killed.

    With `wait`, wait for another holder, after one call of `on_wait`; otherwise raise Locked. The lock works between
    processes of one machine, and on a shared file system as far as that supports locks. Raises OSError if the lock
    file cannot be made.
    """
    from filelock import FileLock, Timeout

    file = Path(path)
    lock = FileLock(file, thread_local=False)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        if not wait:
            raise Locked(file) from None
        if on_wait is not None:
            on_wait()
        lock.acquire()
    try:
        with suppress(OSError):
            file.write_text(str(os.getpid()), encoding="ascii")
        yield
    finally:
        with suppress(OSError):  # Windows keeps open files; a remaining file is not a lock
            file.unlink()
        lock.release()


def replace_file(target: Path, data: bytes) -> None:
    """Write the `data` to a part file that then takes the place of `target`; remove part files of killed processes.

    Raises OSError, and ValueError for a name with a null character.
    """
    _remove_parts(target.parent.absolute())
    # In the same folder, because a rename does not cross file systems; tempfile would make the file private.
    part = target.parent / f".{uuid4().hex}.part"
    try:
        with part.open("xb") as file:
            if fcntl is not None:
                with suppress(OSError):  # a file system without locks: there no process removes parts
                    fcntl.flock(file, fcntl.LOCK_EX)
            file.write(data)
            file.flush()
            if fcntl is None:
                file.close()  # Windows renames no open file
            os.replace(part, target)
    finally:
        with suppress(OSError):  # renamed already; and a failed clean-up must not hide the cause
            part.unlink()


@lru_cache(maxsize=4096)
def _remove_parts(folder: Path) -> None:
    """Remove the part files that killed processes left in a `folder`. A process lists each folder only once.

    A process holds the lock of its part up to the renaming, and writes once it has it: an empty part may be in use.
    Another host may not see the lock, so that a part also has to be old.
    On Windows, where no lock shows that a process lives, parts stay.
    """
    if fcntl is None:
        return
    with suppress(OSError):  # a folder that cannot be listed
        for path in folder.iterdir():
            if PART.fullmatch(path.name) and not path.is_symlink():
                with suppress(OSError), path.open("r+b") as file:  # in use, or another user's
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    status = os.fstat(file.fileno())
                    if status.st_size and time.time() - status.st_mtime > PART_LIVES_S:
                        path.unlink()
