"""The images of a folder tree; the names of their results, and the lock of these."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path, PurePosixPath
from typing import Literal

from startrack.core.errors import BadInput
from startrack.core.files import Locked, existing_folder, hold_lock
from startrack.exposure import PACKING_SUFFIXES, PICTURE_SUFFIXES, BagImage, list_bag_images, stem
from startrack.output import PICTURES
from startrack.terrain import is_geotiff

LOCK = ".startrack-batch.lock"
COARSE_S = 2.0  # steps of a folder's time on the coarsest file systems (FAT): a later change within one does not show
RELIST_S = 10.0  # after which a folder is listed again whatever its time: some network file systems do not keep it


@dataclass(frozen=True, order=True)
class Image:
    """Image of a batch: a file, or a message of a bag."""

    name: str  # path relative to the folder, with / on every system
    stem: str  # of its results, relative to the folder of the results
    path: str
    bag_image: BagImage | None = field(default=None, compare=False)  # where `path` is BAG#NUMBER


def images_of_bag(bag: str | os.PathLike[str], topic: str | None = None) -> list[Image]:
    """Every image of a ROS bag's image `topic` (None: its only one). Raises BadInput (bad_image)."""
    return [
        Image(Path(one.path).name, f"{Path(bag).stem}-{one.number:06d}", one.path, one)
        for one in list_bag_images(os.path.abspath(bag), topic)
    ]


def images_under(folder: str | os.PathLike[str], excluded: str | os.PathLike[str] | None = None) -> list[Image]:
    """Every image of the tree, sorted by name.

    Links to folders outside the tree are followed, each folder once. Hidden files and folders, the folder `excluded`
    and anything but regular files are left out. Raises BadInput (bad_image) if `folder` is none.
    """
    root = existing_folder(folder)
    folders: dict[str, list[str]] = {}
    for name in sorted(image_tree(root, excluded).changes()):
        folders.setdefault(str(PurePosixPath(name).parent), []).append(name)
    found = [
        Image(name, (PurePosixPath(parent) / of_results).as_posix(), str(root / name))
        for parent, group in folders.items()
        for name, of_results in zip(group, result_stems(group), strict=True)
    ]
    return sorted(found)


def image_tree(folder: str | os.PathLike[str], excluded: str | os.PathLike[str] | None = None) -> ImageTree:
    """The tree of a `folder` without the folder `excluded`. Raises BadInput (bad_image) if `folder` is none."""
    return ImageTree(existing_folder(folder), None if excluded is None else os.path.realpath(excluded))


def listed_images(
    folder: str | os.PathLike[str], paths: Iterable[str], excluded: str | os.PathLike[str] | None = None
) -> list[Image]:
    """The images at `paths`: absolute, or relative to the current folder or to `folder`. `excluded` is no image folder.

    An image that does not exist (any more) is included, and refused when it is read. Raises BadInput (bad_image) for a
    path that is no image under `folder`, and if there is no path at all.
    """
    root, known = os.path.abspath(folder), {image.name: image for image in images_under(folder, excluded)}
    texts = [text for text in (path.strip("\r\n") for path in paths) if text]
    if not texts:
        raise BadInput("bad_image", "no file names came on standard input: give one path a line")
    chosen = set()
    for text in texts:
        paths_read = (os.path.abspath(text), os.path.abspath(os.path.join(root, text)))
        names = [os.path.relpath(path, root).replace(os.sep, "/") for path in paths_read]
        name = next((name for name in names if name in known), None)
        if name is None:
            inside = (name for name in names if not name.startswith("../") and _is_image(PurePosixPath(name).name))
            name = next((name for name in inside if not os.path.lexists(os.path.join(root, name))), None)
            if name is None:
                raise BadInput("bad_image", f"{text} is not an image under {folder}")
            of_results = (PurePosixPath(name).parent / stem(Path(name))).as_posix()
            taken = of_results in {image.stem for image in known.values()}
            known[name] = Image(name, name if taken else of_results, os.path.join(root, name))
        chosen.add(known[name])
    return sorted(chosen)  # with the results' names of a run over the whole folder


def maps_among(images: Iterable[Image]) -> list[Image]:
    """Height maps among the `images`: TIFF files, not packed, with the keys of a GeoTIFF."""
    tiffs = (image for image in images if Path(image.path).suffix.lower() in (".tif", ".tiff"))
    return [image for image in tiffs if os.path.isfile(image.path) and is_geotiff(Path(image.path))]


def result_stems(images: Sequence[str]) -> list[str]:
    """Unique names of the results: the images' stems, with the suffix where stems are equal."""
    stems = [stem(Path(image)) for image in images]
    often = Counter(stems)
    return unique_names([Path(image).name if often[one] > 1 else one for image, one in zip(images, stems, strict=True)])


def unique_names(names: Sequence[str]) -> list[str]:
    """The names; a repeated one gets the first number that makes it unique."""
    taken, given = set(names), set[str]()
    unique = []
    for name in names:
        numbered = (f"{name}-{number}" for number in count(2))
        one = next(one for one in numbered if one not in taken) if name in given else name
        taken.add(one)
        given.add(one)
        unique.append(one)
    return unique


def record_path(out: Path, image: Image) -> Path:
    """Path of the record of an `image` in the folder `out`."""
    return out / f"{image.stem}.fix.json"


@contextmanager
def lock_results(out: Path) -> Iterator[None]:
    """Lock the folder `out` of results against other batches.

    Raises BadInput (bad_image) if another batch writes to it, or if the lock file cannot be used.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(hold_lock(out / LOCK, wait=False))
        except Locked as cause:
            raise BadInput(
                "bad_image",
                f"another batch is writing to {out} (process {cause.owner}): wait for it, or choose another -D",
            ) from cause
        except OSError as cause:
            raise BadInput("bad_image", f"{out / LOCK}: cannot be used as lock file ({cause.strerror})") from cause
        yield


@dataclass(eq=False)
class ImageTree:
    """The images of the tree of a folder as they come: of its folders those are listed anew that may have changed.

    Links to folders outside the tree are followed, each folder once, by its own name rather than by a link. Hidden
    files and folders, the folder `excluded` (a real path) and anything but regular files are left out.
    """

    root: Path
    excluded: str | None = None
    _listed: dict[str, _Listing] = field(default_factory=dict)

    def changes(self) -> list[str]:
        """Paths, relative to the tree's folder, of the images in folders that were listed anew: at first of all."""
        top = os.path.realpath(self.root)
        entered, found, waiting = {top}, [], [self.root]
        while waiting:
            here = waiting.pop()
            listing, is_new = self._listing(here)
            if is_new:
                found += [(here / name).relative_to(self.root).as_posix() for name in listing.images]
            inside = []
            for path in (here / name for name in listing.folders):
                real = os.path.realpath(path)
                inside_by_link = path.is_symlink() and Path(real).is_relative_to(top)
                if real != self.excluded and real not in entered and not inside_by_link:
                    entered.add(real)
                    inside.append(path)
            waiting += inside[::-1]
        return found

    def _listing(self, folder: Path) -> tuple[_Listing, bool]:
        """Content of a `folder`, and whether it was listed anew."""
        now, known = time.monotonic(), self._listed.get(str(folder))
        try:
            stamp = os.stat(folder).st_mtime_ns
            is_same = known is not None and known.stamp == stamp
            changed_s = known.changed_s if known is not None and is_same else now
            if known is not None and is_same and now - changed_s > COARSE_S and now - known.listed_s < RELIST_S:
                return known, False
            with os.scandir(folder) as entries:
                held = [one for one in entries if not one.name.startswith(".")]
            kinds = {one.name: _kind_of(one) for one in held}
            folders = sorted(name for name, kind in kinds.items() if kind == "folder")
            images = [name for name, kind in kinds.items() if kind == "file" and _is_image(name)]
            found = _Listing(stamp, now, changed_s, folders, images)
        except OSError:  # a folder that may not be read, or is gone
            found = _Listing(0, now, now, [], [])
        self._listed[str(folder)] = found
        return found, True


@dataclass(frozen=True)
class _Listing:
    """Content of a folder when it was listed."""

    stamp: int  # time of its last change [ns], by the clock of its file system
    listed_s: float  # by the clock of this process
    changed_s: float  # when the stamp was seen first
    folders: list[str]
    images: list[str]


def _kind_of(entry: os.DirEntry[str]) -> Literal["folder", "file", "other"]:
    """Kind of an entry, or of what it leads to; a link to nowhere, or to itself, is a file that will be refused."""
    if entry.is_symlink():
        if os.path.isdir(entry.path):
            return "folder"
        return "file" if os.path.isfile(entry.path) or not os.path.exists(entry.path) else "other"
    return "folder" if entry.is_dir() else "file" if entry.is_file() else "other"  # a pipe would block the reader


def _is_image(name: str) -> bool:
    lower = name.lower()
    unpacked = Path(lower).stem if Path(lower).suffix in PACKING_SUFFIXES else lower
    hidden = lower.startswith(".") or lower.endswith(PICTURES)
    return not hidden and Path(unpacked).suffix in PICTURE_SUFFIXES
