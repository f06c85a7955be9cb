"""The images of a command, read with the facts that flags state; their camera, site, and terrain, made ready once."""

from __future__ import annotations

import argparse
import logging
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack import exposure as images
from startrack.camera import Camera, load_camera
from startrack.catalog import daylight_warnings
from startrack.chain import NearAttitude, Settings, read_near_attitude
from startrack.cli.console import progress
from startrack.cli.flags import checked_flag
from startrack.core.errors import BadInput, one_line
from startrack.core.files import is_path
from startrack.core.types import Exposure, PositionPrior
from startrack.estimation.observations import OdometryErrors
from startrack.frames import Site, angle_between_rad, parse_utc, rays_from_azel
from startrack.identification import Identifier
from startrack.terrain import TERRAIN_KEYS, Terrain, load_terrain

if TYPE_CHECKING:
    from startrack.applications.batch import Image

SITE_TOLERANCE_DEG = 0.1  # as far as an azimuth of a skyline may be wrong
FACT_FLAGS = {  # keyword of `read_exposure`: argument of the command
    "time_utc": "time", "time_sigma_s": "time_sigma", "exposure_s": "exposure", "camera": "camera",
    "terrain": "terrain", "mask": "mask", "dark": "dark", "flat": "flat",
}  # fmt: skip
LOADERS: dict[str, Callable[[str], object]] = {  # of the files among these facts
    "camera": load_camera, "terrain": load_terrain, "mask": images.read_mask, "dark": images.read_dark,
    "flat": images.read_flat,
}  # fmt: skip


def read(path: str, args: argparse.Namespace) -> Exposure:
    """The image with its facts; flags take precedence over sidecar and header. With --image-topic also of a bag."""
    bag = images.split_bag_path(path) if hasattr(args, "image_topic") else None
    if bag is None:
        return images.read_exposure(path, **flag_facts(args))
    return images.read_bag_image(images.choose_bag_image(*bag, args.image_topic), **flag_facts(args))


def read_each_once(args: argparse.Namespace) -> list[Exposure]:
    """The images of one camera; a picture that came before, or has no time where others do, is named and left out."""
    found = [read(path, args) for path in args.images]
    has_time, first, kept = any(one.time_utc is not None for one in found), dict[str, Exposure](), list[Exposure]()
    for one in found:
        why = f"no_time: {images.NO_TIME}" if has_time and one.time_utc is None else ""
        same = one if why else first.setdefault(one.sha256, one)
        if same is not one:
            why = f"bad_image: the same picture as {one_line(same.name)}"
        if why:
            print(f"{one_line(one.name)}: left out, {why}", file=sys.stderr, flush=True)
        else:
            kept.append(one)
    return kept


def maps_left_out(found: Iterable[Image]) -> set[Image]:
    """The height maps among the images `found` in a folder, each named on stderr."""
    from startrack.applications.batch import maps_among

    maps = sorted(maps_among(found))
    for one in maps:
        print(f"{one_line(one.name)}: left out, a height map (GeoTIFF)", file=sys.stderr, flush=True)
    return set(maps)


OF_TRACKS = {"max_speed_m_s": "max_speed", "time_sigma_s": "odometry_time_sigma"}  # flags of `track` alone


def odometry_errors(args: argparse.Namespace) -> OdometryErrors:
    """The errors of odometry that flags state, the usual ones where they do not."""
    flags = {"sigma_1": args.odometry_sigma, "floor_m": args.odometry_floor}
    flags |= {name: getattr(args, flag, None) for name, flag in OF_TRACKS.items()}
    return OdometryErrors(**{name: value for name, value in flags.items() if value is not None})


def flag_facts(args: argparse.Namespace) -> dict[str, Any]:
    """The facts given by flags, by the parameter names of `read_exposure`."""
    given = {key: getattr(args, name, None) for key, name in FACT_FLAGS.items()}
    facts = {key: value for key, value in given.items() if value is not None}
    return facts | {"time_utc": parse_utc(args.time)} if "time_utc" in facts else facts


def absolute_reference(reference: str) -> str:
    """The path absolute, as workers may run in other folders; a shipped name as it is."""
    return os.path.abspath(reference) if is_path(reference) else reference


def absolute_facts(args: argparse.Namespace) -> dict[str, Any]:
    """The facts given by flags, with absolute paths. Raises BadInput where one of the files cannot be used."""
    facts = flag_facts(args)
    for key in (key for key in LOADERS if key in facts):
        LOADERS[key](facts[key])
        facts[key] = (absolute_reference if key in ("camera", "terrain") else os.path.abspath)(facts[key])
    return facts


def check_fov(args: argparse.Namespace) -> None:
    """A usage error for a field of view beside a camera."""
    if args.fov is not None and args.camera is not None:
        args.usage_error("--fov is for an unknown lens, -c for a known one: give one of them")


def near_attitude_of(args: argparse.Namespace) -> NearAttitude | None:
    """The rough attitude of --near-attitude; None without it. Raises BadInput (bad_image)."""
    return None if args.near_attitude is None else read_near_attitude(args.near_attitude)


def settings_of(args: argparse.Namespace) -> Settings:
    """The settings that the flags of `locate` and `batch` state. Raises BadInput (bad_image) as `near_attitude_of`."""
    return Settings(
        identifier=Identifier(near_sky=args.near_sky), localizer=args.localizer, evidence_sources=args.evidence,
        near=None if args.near is None else PositionPrior(*args.near), near_attitude=near_attitude_of(args),
    )  # fmt: skip


def check_one_time(args: argparse.Namespace) -> None:
    """A usage error for the time of one image where there are several."""
    if args.time is not None and len(args.images) > 1:
        args.usage_error("--time is the time of one image; give each of several its own in a sidecar NAME.json")


def approximate_camera(args: argparse.Namespace, exposures: list[Exposure]) -> Camera | None:
    """The initial camera: the flag's, else (without --fov) the one that the images name."""
    named = args.camera or (None if args.fov else next((e.camera for e in exposures if e.camera), None))
    return load_camera(named) if named else None


def flag_site(args: argparse.Namespace) -> Site | None:
    """The site of --site; None without it. A usage error for a place that is not on the Earth."""
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
    """The site of --site, else of the terrain that a flag or the images name; None if there is none.

    Prints on stderr what the files of the `exposures` state and is not used, and where it is day.
    """
    given = flag_site(args)
    if given is not None and not args.quiet:
        _compare_site(args.site, given, exposures)
    named = next((e.terrain for e in exposures if e.terrain), None)
    site = given if given is not None or named is None else load_terrain(named).site
    for one in () if args.quiet else exposures:
        by_day = [] if site is None or one.time_utc is None else daylight_warnings(site, one.time_utc)
        for warning in (*one.warnings, *by_day):
            print(f"{one_line(one.name)}: {warning}", file=sys.stderr, flush=True)
    return site


def _compare_site(flag: str, site: Site, exposures: list[Exposure]) -> None:
    """Print a line on stderr where a header states another place than --site."""
    stated = [(e.name, e.header_site_rad) for e in exposures if e.header_site_rad is not None]
    if not stated:
        return
    name, (latitude, longitude) = stated[0]
    here = rays_from_azel(site.longitude_rad, site.latitude_rad)
    # Programs count longitudes to the east or to the west.
    there = rays_from_azel(np.array([longitude, -longitude]), np.array([latitude, latitude]))
    apart_deg, mirrored_deg = np.degrees(angle_between_rad(here, there)).tolist()
    if min(apart_deg, mirrored_deg) > SITE_TOLERANCE_DEG:
        place = "{:.4f}, {:.4f}".format(*np.degrees([latitude, longitude]))
        text = f"the header's site {place} is {apart_deg:.1f} degrees from --site {flag}, which is used"
        if mirrored_deg < apart_deg:
            text += f" (with the other sign of the longitude {mirrored_deg:.1f}; east is positive)"
        print(f"{one_line(name)}: {text}", file=sys.stderr, flush=True)


def prepare_reference(reference: str | None, args: argparse.Namespace) -> Terrain | None:
    """Prepare the terrain that a file or shipped name refers to; None if it cannot be loaded."""
    if reference is None:
        return None
    with suppress(BadInput):  # reported by the command that loads the terrain for its image
        terrain = load_terrain(reference)
        prepare(terrain, args)
        return terrain
    return None


def prepare(terrain: Terrain, args: argparse.Namespace) -> None:
    """Compute a terrain's horizon table, unless it is known or there is none."""
    if terrain.is_prepared:
        return
    what, shown = f"horizons of {terrain.name}, once", not args.quiet
    about_s = terrain.costs_s().get("horizons") if shown and sys.stderr.isatty() else None
    with _terrain_log(args), progress(what, shown=shown, about_s=about_s) as bar:
        terrain.prepare(bar.update)


@contextmanager
def _terrain_log(args: argparse.Namespace) -> Iterator[None]:
    """Print the terrain's log of the block on stderr: begin, wait, and with -v the path of the table."""
    if args.quiet or (sys.stderr.isatty() and not args.verbose):  # a terminal has the bar
        yield
        return
    log, handler = logging.getLogger("startrack.terrain"), logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.DEBUG if args.verbose else logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
