"""Inputs of the commands: images with the facts that flags state, the camera, and the site."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from startrack.core.errors import BadInput
from startrack.core.files import is_path

if TYPE_CHECKING:
    from startrack.camera import Camera
    from startrack.core.declaration import Key
    from startrack.core.types import Exposure
    from startrack.frames import Site

FACT_FLAGS = {  # keyword of `read_exposure`: argument of the command
    "time_utc": "time", "time_sigma_s": "time_sigma", "exposure_s": "exposure", "camera": "camera",
    "terrain": "terrain", "mask": "mask", "dark": "dark", "flat": "flat",
}  # fmt: skip


def read(path: str, args: argparse.Namespace) -> Exposure:
    """The image with its facts; flags take precedence over sidecar and header. With --image-topic also of a bag."""
    from startrack.exposure import choose_bag_image, read_bag_image, read_exposure, split_bag_path

    bag = split_bag_path(path) if hasattr(args, "image_topic") else None
    if bag is None:
        return read_exposure(path, **flag_facts(args))
    return read_bag_image(choose_bag_image(*bag, args.image_topic), **flag_facts(args))


def flag_facts(args: argparse.Namespace) -> dict[str, Any]:
    """The facts given by flags, by the parameter names of `read_exposure`."""
    from startrack.frames import parse_utc

    given = {key: getattr(args, name, None) for key, name in FACT_FLAGS.items()}
    facts = {key: value for key, value in given.items() if value is not None}
    return facts | {"time_utc": parse_utc(args.time)} if "time_utc" in facts else facts


def absolute_reference(reference: str) -> str:
    """The path absolute, as workers may run in other folders; a shipped name as it is."""
    return os.path.abspath(reference) if is_path(reference) else reference


def absolute_facts(args: argparse.Namespace) -> dict[str, Any]:
    """The facts given by flags, with absolute paths. Raises BadInput where one of the files cannot be used."""
    from startrack.camera import load_camera
    from startrack.exposure import read_dark, read_flat, read_mask
    from startrack.terrain import load_terrain

    load: dict[str, Callable[[str], object]] = {
        "camera": load_camera, "terrain": load_terrain, "mask": read_mask, "dark": read_dark, "flat": read_flat,
    }  # fmt: skip
    facts = flag_facts(args)
    for key in (key for key in load if key in facts):
        load[key](facts[key])
        is_name = key in ("camera", "terrain") and not is_path(facts[key])
        facts[key] = facts[key] if is_name else os.path.abspath(facts[key])
    return facts


def check_fov(args: argparse.Namespace) -> None:
    """A usage error for a field of view beside a camera."""
    if args.fov is not None and args.camera is not None:
        args.usage_error("--fov is for an unknown lens, -c for a known one: give one of them")


def check_one_time(args: argparse.Namespace) -> None:
    """A usage error for the time of one image where there are several."""
    if args.time is not None and len(args.images) > 1:
        args.usage_error("--time is the time of one image; give each of several its own in a sidecar NAME.json")


def camera_of(exposure: Exposure) -> Camera:
    """The camera named by flag, sidecar or header. Raises BadInput (no_calibration) if there is none."""
    from startrack.camera import load_camera

    if exposure.camera is None:
        raise BadInput("no_calibration", "no camera file is known: give -c FILE or a sidecar with camera")
    return load_camera(exposure.camera)


def approximate_camera(args: argparse.Namespace, exposures: list[Exposure]) -> Camera | None:
    """The initial camera: the flag's, else (without --fov) the one that the images name."""
    from startrack.camera import load_camera

    named = args.camera or (None if args.fov else next((e.camera for e in exposures if e.camera), None))
    return load_camera(named) if named else None


def flag_site(args: argparse.Namespace) -> Site | None:
    """The site of --site; None without it. A usage error for a place that is not on the Earth."""
    from startrack.frames import Site
    from startrack.terrain import TERRAIN_KEYS

    if not args.site:
        return None
    try:
        words = [float(word) for word in args.site.split(",")]
        names = ("latitude_deg", "longitude_deg", "height_m")[: max(len(words), 2)]
        keys = dict(zip(names, words, strict=True))
    except ValueError:
        args.usage_error(f"--site {args.site}: latitude, longitude and, if known, height: 34.74,-111.42,2361")
    site = checked_flag(args, TERRAIN_KEYS.keys["origin"], keys, "--site")
    return Site("earth", math.radians(site["latitude_deg"]), math.radians(site["longitude_deg"]), site["height_m"])


def site_of(args: argparse.Namespace, exposures: list[Exposure]) -> Site | None:
    """The site of --site, else of the terrain that a flag or the images name; None if there is none."""
    from startrack.terrain import load_terrain

    given = flag_site(args)
    named = next((e.terrain for e in exposures if e.terrain), None)
    return given if given is not None or named is None else load_terrain(named).site


def checked_flag(args: argparse.Namespace, key: Key, value: Any, flag: str) -> Any:
    """The value of a `flag` as the `key` of a file would have it; else a usage error."""
    try:
        return key.check(value, flag)
    except ValueError as cause:
        args.usage_error(str(cause))
