"""What a map costs on this machine, measured on a small part: its table of horizons, and the position of an image."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from startrack.core.runner import count_cores
from startrack.terrain.horizon_table import AZIMUTH_BINS, FIELDS, MIDDLES_RAD, fill_table

if TYPE_CHECKING:
    from startrack.terrain.traced_map import TracedMap

PROBES, PROBE_S = 24, 0.3  # parts that are measured; about how long all of them may take
ENDS_S = 1.0  # of the ends of the maps, for the table
# Of an image of 1024 px in a crater 12 km wide, with posts of 240, 60 and 15 m (5, 8 and 12 us a horizon), in search
# areas of 0.6 and 2.5 km: 1.7 to 3.4 s of CPU time, which few of its parts share out among cores.
FRAME_S, HORIZONS_OF_FRAME = 1.5, 100_000.0


def costs_of(ground: TracedMap) -> dict[str, float]:
    """Times [s] of a `ground`, as `Terrain.costs_s` names them."""
    table = {} if ground.is_prepared else {"horizons": seconds_of_table(ground)}
    return table | {"frame": seconds_of_frame(ground)}


def seconds_of_table(ground: TracedMap) -> float:
    """Time [s] that the table of horizons of a `ground` takes on all cores, by cells all over it."""
    square, cells = ground.square, ground.square.cells_within_reach
    sines, cosines, found = np.sin(MIDDLES_RAD), np.cos(MIDDLES_RAD), np.empty((1, AZIMUTH_BINS, FIELDS))

    def trace(part: float) -> None:
        cell = cells[int(part * len(cells))]
        place = square.centres_m[cell : cell + 1], square.half_m, ground.camera_height_m
        fill_table(ground.ground.record, *place, sines, cosines, np.pi / AZIMUTH_BINS, found)

    return ENDS_S + _mean_seconds(trace) * len(cells) / count_cores()


def seconds_of_frame(ground: TracedMap) -> float:
    """Time [s] that the position of an image on a `ground` takes, by horizons seen from places all over it."""
    whole = ground.without_table()

    def trace(part: float) -> None:
        radius_m = ground.search_radius_m * np.sqrt(part)
        turn = 2.4 * PROBES * part  # the golden angle, nearly
        whole.horizons(radius_m * np.array([np.sin(turn), np.cos(turn)]), MIDDLES_RAD)

    return FRAME_S + _mean_seconds(trace) / AZIMUTH_BINS * HORIZONS_OF_FRAME


def _mean_seconds(work: Callable[[float], None]) -> float:
    """Mean time of `work` on parts all over the whole, which it takes by a number from 0 to 1."""
    parts = [(0.618 * number + 0.5) % 1.0 for number in range(PROBES)]  # evenly spread, the first of them too
    start, done = clock.perf_counter(), 0
    while done < PROBES and clock.perf_counter() - start < PROBE_S:
        work(parts[done])
        done += 1
    return (clock.perf_counter() - start) / done
