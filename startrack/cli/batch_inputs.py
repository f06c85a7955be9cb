"""Inputs of a batch: its images, and the files that its flags name."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.common import flag_facts
from startrack.core.errors import BadInput
from startrack.core.files import is_path

if TYPE_CHECKING:
    from startrack.applications.batch import Image

IMAGE_FLAGS = ("mask", "dark", "flat")


def find_images(args: argparse.Namespace) -> tuple[Sequence[Image], Sequence[Image]]:
    """The images to locate, and all images of the folder or bag. Raises BadInput (bad_image) where there is none."""
    from startrack.applications.batch import images_of_bag, images_under, listed_images
    from startrack.exposure import is_bag

    of_bag = is_bag(args.folder)
    _check_flags(args, of_bag)
    whole = images_of_bag(args.folder, args.image_topic) if of_bag else images_under(args.folder, args.dir)
    found = listed_images(args.folder, _paths_in(sys.stdin.buffer.read()), args.dir) if args.files_on_stdin else whole
    if not found:
        raise BadInput("bad_image", f"{args.folder}: no PNG, TIFF, FITS, JPEG or camera raw images there")
    if args.time is not None and len(found) > 1:
        args.usage_error(
            f"--time is of one image, and {args.folder} has {len(found)}: give each its time in a sidecar NAME.json "
            "with time_utc"
        )
    return found, whole


def _check_flags(args: argparse.Namespace, of_bag: bool) -> None:
    """A usage error for a flag of bags with a folder, and for one of folders with a bag."""
    if of_bag and args.files_on_stdin:
        args.usage_error(f"--files-on-stdin is for a folder of files, and {args.folder} is a ROS bag")
    if of_bag and args.time is not None:
        args.usage_error("--time is of one image: the images of a ROS bag have the times of their messages")
    if not of_bag and args.image_topic is not None:
        args.usage_error(f"--image-topic is for a ROS bag, and {args.folder} is none")


def absolute_facts(args: argparse.Namespace) -> dict[str, Any]:
    """The facts given by flags, with absolute paths, since workers run in other folders."""
    facts = flag_facts(args)
    named = {key: os.path.abspath(facts[key]) for key in ("camera", "terrain") if is_path(facts.get(key, ""))}
    return facts | named | {key: os.path.abspath(facts[key]) for key in IMAGE_FLAGS if key in facts}


def check_files_of_flags(facts: dict[str, Any]) -> None:
    """Raise BadInput for a camera, terrain or other file of a flag before anything is changed."""
    from startrack.camera import load_camera
    from startrack.exposure import read_dark, read_flat, read_mask
    from startrack.terrain import load_terrain

    load: dict[str, Callable[[str], object]] = {
        "camera": load_camera, "terrain": load_terrain, "mask": read_mask, "dark": read_dark, "flat": read_flat,
    }  # fmt: skip
    for key in (key for key in load if key in facts):
        load[key](facts[key])


def remove_paths(facts: dict[str, Any]) -> dict[str, str]:
    """The facts of flags for the manifest, without paths of this machine."""
    return {
        key: Path(value).name if key in ("camera", "terrain", *IMAGE_FLAGS) else str(value)
        for key, value in facts.items()
    }


def _paths_in(listed: bytes) -> list[str]:
    """Paths ended by NUL, as from `find -print0`, or else one a line."""
    return os.fsdecode(listed).split("\0" if b"\0" in listed else "\n")
