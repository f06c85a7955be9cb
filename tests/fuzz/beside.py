"""Readers of the files beside pictures: what each does with one mutated file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from .access import Broken
from .seeds_beside import BAG_FORMS, GRIDS, PICTURE, RECORDS, results


def _read_correction(data: bytes, number: int, folder: Path) -> None:
    """As a mask, a dark frame or a flat field."""
    from startrack.exposure import read_exposure

    path = folder / "correction.png"
    path.write_bytes(data)
    exposure = read_exposure(folder / "frame.png", **{("mask", "dark", "flat")[number]: path})
    if not np.isfinite(exposure.pixels_adu).all():
        raise Broken("pixels that are not finite")


def _read_odometry(data: bytes, number: int, folder: Path) -> None:
    """Of a drive that has ended, and of one that goes on."""
    from startrack.applications.tracking import read_odometry

    path = folder / "odometry.tum"
    path.write_bytes(data)
    for growing in (True, False):
        found = read_odometry(path, growing=growing)
        found.require_possible(5.0)
        if not np.isfinite(found.increments_body_m(np.linspace(*found.time_s[[0, -1]], 7))).all():
            raise Broken("increments that are not finite")


def _read_table(data: bytes, number: int, folder: Path) -> None:
    """As obstacles or as a path."""
    from startrack.core.obstacles import read_obstacles
    from startrack.rendering import read_drive

    path = folder / "table.csv"
    path.write_bytes(data)
    if number == 0:
        read_obstacles(path, "bad_image").hides(np.linspace(-7, 7, 99), np.zeros(99))
    else:
        drive = read_drive(path, 0.05)
        if not np.isfinite(drive.position_m(0.5 * drive.distance_m[-1] / 0.05)).all():
            raise Broken("positions that are not finite")


def _read_attitude(data: bytes, number: int, folder: Path) -> None:
    from startrack.chain import read_near_attitude
    from startrack.frames import Site

    path = folder / "attitude.json"
    path.write_bytes(data)
    near = read_near_attitude(path)
    if not np.isfinite(near.R_cam_icrs_at(near.time_utc, Site("moon", -1.5, 0.3))).all():
        raise Broken("an attitude that is not finite")


def _read_bag(data: bytes, number: int, folder: Path) -> None:
    """Every image, and the odometry."""
    from startrack.applications.tracking import read_odometry
    from startrack.exposure import list_bag_images, read_bag_exposures, read_bag_image

    path = folder / BAG_FORMS[number]
    path.write_bytes(data)
    for one in (*read_bag_exposures(path), *map(read_bag_image, list_bag_images(path))):
        if not np.isfinite(one.pixels_adu).all():
            raise Broken("pixels that are not finite")
    read_odometry(path)


def _read_grid(data: bytes, number: int, folder: Path) -> None:
    from startrack.terrain import Grid, map_of_array, read_map
    from startrack.terrain.maps.reading import SUFFIX, read_array

    path = folder / GRIDS[number]
    path.write_bytes(data)
    if path.suffix == SUFFIX:
        map_of_array(read_array(path), Grid(post=10.0), latitude_rad=0.1, longitude_rad=0.2)
    else:
        read_map(path)


def _read_label(data: bytes, number: int, folder: Path) -> None:
    from startrack.terrain.maps.reading import read_map

    (folder / "HILL.IMG").write_bytes((61 * np.arange(61 * 61) % 997).astype("<i2").tobytes())
    path = folder / "HILL.LBL"
    path.write_bytes(data)
    read_map(path)


def _read_page(name: str, data: bytes, folder: Path) -> None:
    """The page of a folder of results of which that `name` is mutated."""
    from startrack.output import page_text, results_under

    within = folder / "page"
    within.mkdir(exist_ok=True)
    for other, sound in results().items():
        (within / other).write_bytes(data if other == name else sound)
    found, unread = results_under(within)
    page_text(found, unread=unread)


READERS_BESIDE: dict[str, Callable[[bytes, int, Path], None]] = {
    "correction": _read_correction, "odometry": _read_odometry, "table": _read_table, "attitude": _read_attitude,
    "bag": _read_bag, "grid": _read_grid, "label": _read_label,
    "record": lambda data, number, folder: _read_page(RECORDS[number], data, folder),
    "layers": lambda data, number, folder: _read_page(PICTURE, data, folder),
}  # fmt: skip
