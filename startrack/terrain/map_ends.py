"""Directions in which a ground gives no evidence: beyond the maps' ends, below what could stand there, and in glare."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.core.types import Array, Bools
from startrack.frames import latlon_from_enu
from startrack.terrain.horizon_table import AZIMUTH_BINS, MIDDLES_RAD

if TYPE_CHECKING:
    from startrack.terrain.traced_map import TracedMap

UNKNOWN_FROM, RIM_PLACES = 12, 48  # places across the search area, and on its rim, at which ends are looked up
LEAST_END_M = 1.0  # distance from a camera to the ends of the maps: nearer ones count as at it
STEPS_A_BIN = 4  # from place to place along an azimuth, in the width of a bin there; at least the spacing of posts
GLARE, OFF_MAP = "glare of a lit rim", "ground off the map"
Sectors = tuple[tuple[float, float], ...]  # azimuth ranges [rad], each from the first eastward to the second


def unknown_elevations_rad(ground: TracedMap) -> Array:
    """Elevation (AZIMUTH_BINS,) [rad] below which ground off the maps might be seen from somewhere in the search area.

    -pi/2 where none might.
    """
    line = np.linspace(-1, 1, UNKNOWN_FROM) * ground.search_radius_m
    places = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    around = np.arange(RIM_PLACES) * 2 * np.pi / RIM_PLACES
    rim = ground.search_radius_m * np.stack([np.sin(around), np.cos(around)], axis=-1)
    places = np.vstack([places[np.hypot(*places.T) < ground.search_radius_m], rim])
    bins = np.repeat((np.arange(AZIMUTH_BINS)[:, None] + [0.02, 0.5, 0.98]).ravel(), len(places))
    azimuths, where = bins * 2 * np.pi / AZIMUTH_BINS, np.tile(places, (3 * AZIMUTH_BINS, 1))
    tan, _, edge = ground.with_voids().horizons(where, azimuths)
    edge = np.maximum(edge, LEAST_END_M)
    up = ground.ground_m(places) + ground.camera_height_m
    away = where + edge[:, None] * np.stack([np.sin(azimuths), np.cos(azimuths)], axis=-1)
    drop = np.sum(np.minimum(np.abs(away), 1e7) ** 2, axis=-1) / (2 * ground.ground.radius_m)
    possible = (ground.ground.highest_m - drop - np.tile(up, 3 * AZIMUTH_BINS)) / edge + ground.ground.sag_per_m * edge
    unknown = np.where((edge < 1e9) & (possible > tan), np.arctan(possible), -np.pi / 2)
    return np.asarray(unknown.reshape(AZIMUTH_BINS, -1).max(axis=1))


def distances_to_end_m(ground: TracedMap) -> Array:
    """Distance (AZIMUTH_BINS,) [m] from the origin at which the maps end or have a void, in the middle of each bin.

    It is too far by less than the spacing of the finest posts, or 0.5 % of it. A void that is narrower than a bin, and
    than two steps between the places that are looked up, may be missed.
    """
    post_m = min(one.post_m for one in ground.maps)
    farthest_m = 1.5 * max(float(np.hypot(*one.heights_m.shape)) * one.post_m for one in ground.maps)
    growth = 2 * np.pi / (AZIMUTH_BINS * STEPS_A_BIN)
    near = np.arange(post_m, min(post_m / growth, farthest_m), post_m)
    more = int(np.log(max(farthest_m / near[-1], 1.0)) / np.log1p(growth)) + 1
    s = np.concatenate([near, np.geomspace(near[-1], farthest_m, more + 1)[1:]])
    places = latlon_from_enu(ground.site, np.outer(np.sin(MIDDLES_RAD), s), np.outer(np.cos(MIDDLES_RAD), s), 0.0)
    known = np.zeros((AZIMUTH_BINS, len(s)), dtype=bool)
    for one in ground.maps:
        known |= np.isfinite(one.sample(one.row_column(*places)))
    return np.asarray(np.where(known.all(axis=1), farthest_m, s[np.argmin(known, axis=1)]))


def facts_of_ends(ground: TracedMap, unknown_rad: Array) -> dict[str, Any]:
    """Facts about the ends of a `ground`'s maps, as JSON values; `unknown_rad` is that of `unknown_elevations_rad`."""
    end_m = distances_to_end_m(ground)
    nearest = int(np.argmin(end_m))
    highest_post_m = max(float(np.nanmax(one.heights_m)) for one in ground.maps)
    return {
        "nearest_m": round(float(end_m[nearest])),
        "nearest_azimuth_deg": round(float(np.degrees(MIDDLES_RAD[nearest]))),
        "highest_beyond_m": round(max(ground.highest_beyond_m, highest_post_m)),
        "highest_beyond_from": "map" if ground.highest_beyond_m <= highest_post_m else "stated",
        "missing": [
            {
                "from_deg": first * 360 // AZIMUTH_BINS, "to_deg": (last * 360 // AZIMUTH_BINS - 1) % 360 + 1,
                "nearest_m": round(float(np.take(end_m, range(first, last), mode="wrap").min())),
                "up_to_deg": round(float(np.degrees(np.take(unknown_rad, range(first, last), mode="wrap").max())), 1),
            }
            for first, last in circular_runs(unknown_rad > -np.pi / 2)
        ],
    }  # fmt: skip


def circular_runs(flags: Bools) -> list[tuple[int, int]]:
    """First index, and last plus one, of each run of True around the circle; indices may exceed the length."""
    n = len(flags)
    if flags.all():
        return [(0, n)]
    offset = int(np.argmin(flags))  # of an element that is False
    steps = np.diff(np.concatenate([[0], np.roll(flags, -offset).astype(np.int8), [0]]))
    first, last = (np.flatnonzero(steps == sign) + offset for sign in (1, -1))
    return [(int(a) % n, int(a) % n + int(b - a)) for a, b in zip(first, last, strict=True)]


def are_in_sectors(azimuths_rad: Array, sectors_rad: Sectors) -> Bools:
    """Whether the azimuths (...) are in one of the sectors."""
    azimuths = np.asarray(azimuths_rad)
    inside = np.zeros(azimuths.shape, dtype=bool)
    for start, end in sectors_rad:
        inside |= (azimuths - start) % (2 * np.pi) <= (end - start) % (2 * np.pi)
    return inside


def describe_masks(glare_rad: Sectors, unknown_rad: Array) -> list[str]:
    """Lines of text, one for each masked range of azimuths.

    `unknown_rad` (n,) of n equal sectors from north eastward is the elevation below which unmapped ground may stand,
    or -pi/2.
    """
    lines = [
        f"azimuths {_range_text(start, end)}: no evidence is taken there, {GLARE} (glare_deg)"
        for start, end in glare_rad
    ]
    step = 2 * np.pi / len(unknown_rad)
    for first, last in circular_runs(unknown_rad > -np.pi / 2):
        highest = np.degrees(np.take(unknown_rad, range(first, last), mode="wrap").max())
        lines.append(
            f"azimuths {_range_text(first * step, last * step)}: the maps end, and {OFF_MAP} could stand up to "
            f"{highest:.1f} degrees high; no evidence is taken below that"
        )
    return lines


def _range_text(start_rad: float, end_rad: float) -> str:
    """Text of a range of azimuths [rad] in whole degrees."""
    if end_rad - start_rad >= 2 * np.pi - 1e-9:
        return "0 to 360 degrees"
    return f"{np.degrees(start_rad) % 360:.0f} to {np.degrees(end_rad) % 360:.0f} degrees"
