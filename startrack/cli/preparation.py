"""Preparation of a terrain for its first fix: compiled kernels and, for a height map, the table of its horizons."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from startrack.cli.progress import progress
from startrack.core.compilation import announce_compilation
from startrack.core.errors import BadInput

if TYPE_CHECKING:
    from startrack.terrain import Terrain

RAYS = 360  # of the fix that compiles the kernels: one a degree above the skyline and one below
OFFSET_RAD = 0.01
LLR = 4.0
EDGE_SIGMA_RAD = 0.001


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
        llr=np.repeat([LLR, -LLR], RAYS),
        edge_sigma_rad=np.full(2 * RAYS, 0.0 if terrain.hard_edges else EDGE_SIGMA_RAD),
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
