"""The images of a folder tree; the names of their results, and the lock of these."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path, PurePosixPath

from startrack.core.errors import BadInput
from startrack.core.files import Locked, existing_folder, hold_lock
from startrack.exposure import PACKING_SUFFIXES, PICTURE_SUFFIXES, BagImage, list_bag_images, stem
from startrack.output import PICTURES
from startrack.terrain import is_geotiff

LOCK = ".startrack-batch.lock"


@dataclass(frozen=True, order=True)
class Image:
    """One image of a batch: a file, or a message of a bag."""

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
    """Every image of the tree of a `folder` without the folder `excluded`, by name. Raises as `names_under`."""
    folders: dict[str, list[str]] = {}
    for name in sorted(names_under(folder, excluded)):
        folders.setdefault(str(PurePosixPath(name).parent), []).append(name)
    found = [
        Image(name, (PurePosixPath(parent) / of_results).as_posix(), str(Path(folder) / name))
        for parent, group in folders.items()
        for name, of_results in zip(group, result_stems(group), strict=True)
    ]
    return sorted(found)


def names_under(folder: str | os.PathLike[str], excluded: str | os.PathLike[str] | None = None) -> list[str]:
    """Paths of the images of the tree of a `folder`, relative to it, with / on every system.

    Links to folders outside the tree are followed, each folder once, by its own name rather than by a link. Hidden
    files and folders, the folder `excluded` and anything but regular files are left out. Raises BadInput (bad_image) if
    `folder` is none.
    """
    root = existing_folder(folder)
    top, left_out = os.path.realpath(root), None if excluded is None else os.path.realpath(excluded)
    entered, found, waiting = {top}, list[str](), [root]
    while waiting:
        inside, here = list[Path](), waiting.pop()
        with suppress(OSError), os.scandir(here) as entries:  # a folder that may not be read, or is gone
            for one in sorted((one for one in entries if not one.name.startswith(".")), key=lambda one: one.name):
                if one.is_dir():
                    real = os.path.realpath(one.path)
                    inside_by_link = one.is_symlink() and Path(real).is_relative_to(top)
                    if real != left_out and real not in entered and not inside_by_link:
                        entered.add(real)
                        inside.append(here / one.name)
                # A pipe would block the reader; a broken link is an image that will be refused.
                elif _is_image(one.name) and (one.is_file() or not os.path.exists(one.path)):
                    found.append((here / one.name).relative_to(root).as_posix())
        waiting += inside[::-1]
    return found


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
    """Those of the `images` that are height maps: TIFF files, not packed, with the keys of a GeoTIFF."""
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


def _is_image(name: str) -> bool:
    lower = name.lower()
    unpacked = Path(lower).stem if Path(lower).suffix in PACKING_SUFFIXES else lower
    hidden = lower.startswith(".") or lower.endswith(PICTURES)
    return not hidden and Path(unpacked).suffix in PICTURE_SUFFIXES
