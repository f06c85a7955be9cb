"""Which files of a tree are images, and what their results are called."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from startrack.exposure.facts import PACKING_SUFFIXES, PICTURE_SUFFIXES
from startrack.types import BadInput

OWN_PICTURES = (".annotated.png",)


@dataclass(frozen=True, order=True)
class Image:
    """One image of a batch."""

    name: str  # path relative to the folder, with / on every system
    stem: str  # of its results, relative to the folder of the results
    path: str


def images_under(folder: str | os.PathLike[str], apart_from: str | os.PathLike[str] | None = None) -> list[Image]:
    """Every image of the tree, in the order of their names; hidden files, links to folders and `apart_from` left out.

    Raises BadInput (bad_image) where there is no such folder.
    """
    root = Path(folder)
    if not root.is_dir():
        raise BadInput("bad_image", f"{folder}: no such folder")
    without = None if apart_from is None else Path(apart_from).resolve()
    return _images(root, _names(root, without))


def named_images(
    folder: str | os.PathLike[str], paths: Iterable[str], apart_from: str | os.PathLike[str] | None = None
) -> list[Image]:
    """The images named, one path each: absolute, or relative to the current folder or to `folder`.

    Raises BadInput (bad_image) for one that is no image under `folder`, and where no path came at all.
    """
    root, known = os.path.abspath(folder), {image.name: image for image in images_under(folder, apart_from)}
    texts = [text for text in (path.strip("\r\n") for path in paths) if text]
    if not texts:
        raise BadInput("bad_image", "no file names came on standard input: give one path a line")
    chosen = set()
    for text in texts:
        places = (os.path.abspath(text), os.path.abspath(os.path.join(root, text)))
        names = (os.path.relpath(place, root).replace(os.sep, "/") for place in places)
        name = next((name for name in names if name in known), None)
        if name is None:
            raise BadInput("bad_image", f"{text} is not an image under {folder}")
        chosen.add(known[name])
    return sorted(chosen)  # named as in a run over the whole folder


def output_stems(images: Sequence[str]) -> list[str]:
    """Names of the results: the images' stems; equal stems keep their suffix, equal names get a number."""
    names = [Path(image).name for image in images]
    stems = [_stem(name) for name in names]
    often = Counter(stems)
    chosen = [name if often[stem] > 1 else stem for name, stem in zip(names, stems, strict=True)]
    seen: Counter[str] = Counter()
    unique = []
    for name in chosen:
        seen[name] += 1
        unique.append(name if seen[name] == 1 else f"{name}-{seen[name]}")
    return unique


def _images(root: Path, names: Sequence[str]) -> list[Image]:
    folders: dict[str, list[str]] = {}
    for name in names:
        folders.setdefault(str(PurePosixPath(name).parent), []).append(name)
    found = [
        Image(name, (PurePosixPath(parent) / stem).as_posix(), str(root / name))
        for parent, group in folders.items()
        for name, stem in zip(group, output_stems(group), strict=True)
    ]
    return sorted(found)


def _names(root: Path, without: Path | None) -> list[str]:
    found = []
    for parent, folders, files in os.walk(root):
        here = Path(parent)
        folders[:] = [name for name in folders if not name.startswith(".") and (here / name).resolve() != without]
        found += [(here / name).relative_to(root).as_posix() for name in files if _is_image(name)]
    return sorted(found)


def _is_image(name: str) -> bool:
    lower = name.lower()
    if lower.startswith(".") or lower.endswith(OWN_PICTURES):
        return False
    return any(Path(one).suffix in PICTURE_SUFFIXES for one in _unpacked(lower))


def _unpacked(name: str) -> Iterator[str]:
    yield name
    if Path(name).suffix in PACKING_SUFFIXES:
        yield Path(name).stem


def _stem(name: str) -> str:
    path = Path(name)
    packed = path.suffix.lower() in PACKING_SUFFIXES
    return Path(path.stem).stem if packed and Path(path.stem).suffix else path.stem
