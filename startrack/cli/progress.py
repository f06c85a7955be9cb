"""What a user sees of work that lasts: the progress bar of every command, and the preparation of a terrain."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from startrack.core.compilation import announce_compilation
from startrack.core.errors import BadInput

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

    from startrack.terrain import Terrain

RAYS = 360  # of the fix that compiles the kernels: one a degree above the skyline and one below
OFFSET_RAD = 0.01  # of these rays from the skyline


class Progress:
    """One row of a bar of rich; without a bar there is no output."""

    def __init__(self, bar: RichProgress | None = None, row: Any = None) -> None:
        self._bar, self._row = bar, row

    def advance(self, steps: int = 1, text: str | None = None) -> None:
        """Further steps are done; `text` names the current step."""
        fields: dict[str, Any] = {} if text is None else {"text": text}
        if self._bar is not None:
            self._bar.update(self._row, advance=steps, **fields)

    def update(self, completed: int, total: int) -> None:
        """Numbers of steps done and of all steps."""
        if self._bar is not None:
            self._bar.update(self._row, completed=completed, total=total)


@contextmanager
def progress(what: str, total: int | None = None, *, shown: bool = True) -> Iterator[Progress]:
    """A bar on stderr with a text behind it, if `shown` and stderr is a terminal; it disappears at the end."""
    if not shown or total == 0 or not sys.stderr.isatty():
        yield Progress()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with RichProgress(*columns, TextColumn("{task.fields[text]}"), console=Console(stderr=True), transient=True) as bar:
        yield Progress(bar, bar.add_task(what, total=total, text=""))


def prepare_reference(reference: str | None, args: argparse.Namespace) -> Terrain | None:
    """Prepare the terrain that a file or shipped name refers to; None if it cannot be loaded."""
    if reference is None:
        return None
    from startrack.terrain import load_terrain

    with suppress(BadInput):  # reported by the command that loads the terrain for its image
        terrain = load_terrain(reference)
        prepare(terrain, args)
        return terrain
    return None


def prepare(terrain: Terrain, args: argparse.Namespace) -> None:
    """Compute a terrain's horizon table, unless it is known or there is none."""
    if terrain.is_prepared:
        return
    announce_compilation()
    with _terrain_log(args), progress(f"horizons of {terrain.name}, once", shown=not args.quiet) as bar:
        terrain.prepare(bar.update)


def compile_kernels(terrain: Terrain) -> None:
    """Compile the kernels of a fix on this terrain, by one fix from an ideal skyline seen from the origin."""
    import numpy as np

    from startrack.core.types import Evidence, NotLocated
    from startrack.localization import ExactPosterior

    announce_compilation()
    azimuth = np.linspace(0.0, 2 * np.pi, RAYS, endpoint=False)
    skyline = terrain.horizon_rad(np.zeros((RAYS, 2)), azimuth)
    evidence = Evidence(
        azimuth_rad=np.tile(azimuth, 2),
        elevation_rad=np.concatenate([skyline + OFFSET_RAD, skyline - OFFSET_RAD]),
        llr=np.repeat([1.0, -1.0], RAYS),
        edge_sigma_rad=np.full(2 * RAYS, 0.0 if terrain.hard_edges else OFFSET_RAD),
    )
    with suppress(NotLocated):  # the kernels are compiled in any case
        ExactPosterior()(evidence, terrain)


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
