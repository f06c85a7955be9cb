"""Waves of the horizon's error of shipped maps, by the maps themselves, by a finer map, and as observed once.

    python benchmarks/map_waves.py

A map at half its resolution shows whether errors scale from one spacing of posts to the next as the errors of heights
do. The observed row judges, and nothing is fitted to it: it is the horizon of Shackleton that another program traced on
5 m posts, less that of the map. Amplitudes are divided by the root of 2 there, as one coefficient is.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from _results import table, write_section

from startrack.core.files import data_dir
from startrack.core.types import Array
from startrack.frames import enu_from_latlon
from startrack.terrain import HeightMap, load_terrain, read_map
from startrack.terrain.imports.comparison import (
    Correlation,
    average_posts,
    compare_maps,
    correlate_with_coarser,
    map_of_rim,
)
from startrack.terrain.shape import WAVE_COUNT

REFERENCE = Path(__file__).parents[1] / "tests" / "data" / "shackleton_floor_horizon.csv"
NAMES = ("shackleton", "haworth", "faustini", "de-gerlache", "kepler")


def main() -> None:
    """Run, print and write the section."""
    terrains = {name: load_terrain(name) for name in NAMES}
    rows = []
    for name, terrain in terrains.items():
        assert isinstance(terrain, HeightMap)
        rim = map_of_rim(terrain.maps, terrain.search_radius_m)
        for made, one in (("", rim), (" at half its resolution", average_posts(rim, 2))):
            own = correlate_with_coarser(one, terrain, terrain.height_sigma_m)
            rows.append(_row(f"{name}, by the map itself{made}", own, terrain))
    maps = (read_map(data_dir("terrain") / name) for name in ("ldem75s-240m.tif", "site01-10m.tif"))
    comparison = compare_maps(*maps)
    shackleton = terrains["shackleton"]
    assert isinstance(shackleton, HeightMap)
    rows.append(_row("shackleton, by Site01", comparison and comparison.correlation, shackleton))
    rows.append(
        ["shackleton, observed from the floor", "", "", "", *(f"{a:.4f}" for a in observe_waves_deg(shackleton))]
    )
    waves = [f"wave {m}" for m in range(1, WAVE_COUNT + 1)]
    body = table(["map", "s.d., m", "length, km", "of the angle of height_sigma_m", *waves], rows)
    print(body)
    write_section("Waves of the horizon's error", "python benchmarks/map_waves.py", ("numpy",), body)


def observe_waves_deg(terrain: HeightMap) -> Array:
    """Amplitudes (WAVE_COUNT,) over the root of 2 [degrees] of the traced horizon less the map's."""
    traced = np.genfromtxt(REFERENCE, delimiter=",", names=True)
    place = enu_from_latlon(terrain.site, np.radians(-89.67), np.radians(129.78))[:2]
    horizon_rad = replace(terrain, camera_height_m=2.0).horizon_rad(place[None], np.radians(traced["azimuth_deg"]))
    off_deg = traced["elevation_deg"] - np.degrees(horizon_rad)
    return np.asarray(np.abs(np.fft.rfft(off_deg))[1 : WAVE_COUNT + 1] * np.sqrt(2) / len(off_deg))


def _row(name: str, correlation: Correlation | None, terrain: HeightMap) -> list[str]:
    if correlation is None:
        return [name, "none beyond two posts", *["-"] * (WAVE_COUNT + 2)]
    waves_rad = correlation.waves_rad(terrain)
    ratio = waves_rad[0] / (terrain.height_sigma_m * terrain.crest_rad_per_m)
    sizes = [f"{correlation.sigma_m:.1f}", f"{correlation.length_m / 1000:.1f}", f"{ratio:.2f}"]
    return [name, *sizes, *(f"{sigma:.4f}" for sigma in np.degrees(waves_rad))]


if __name__ == "__main__":
    main()
