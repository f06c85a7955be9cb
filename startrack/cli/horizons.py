"""A height map's horizons, worked out before they are needed: with a bar on a terminal, else told in a line."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from startrack.errors import BadInput

if TYPE_CHECKING:
    from startrack.terrain import Terrain


def ready_for(reference: str | None, args: argparse.Namespace) -> None:
    """Work out the horizons of the terrain that a file or shipped name refers to, unless they are known."""
    if reference is None:
        return
    from startrack.terrain import load_terrain

    with suppress(BadInput):  # said by whoever reads the terrain for the image
        ready(load_terrain(reference), args)


def ready(terrain: Terrain, args: argparse.Namespace) -> None:
    """Work out a terrain's horizons, unless they are known or it needs none."""
    if terrain.is_prepared:
        return
    with _told(args):
        if args.quiet or not sys.stderr.isatty():
            terrain.prepare()
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            row = bar.add_task(f"horizons of {terrain.name}, once", total=None)
            terrain.prepare(lambda done, total: bar.update(row, completed=done, total=total))


@contextmanager
def _told(args: argparse.Namespace) -> Iterator[None]:
    """While this lasts, what the terrain logs goes to stderr: that it begins or waits, and with -v where it is kept."""
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
