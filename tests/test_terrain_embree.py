"""Horizons against Embree, a ray engine of others, on the same surface: bilinear between the map's posts."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from startrack.terrain import load_terrain

pytest.importorskip("embreex", reason="there are no wheels of embreex for every machine")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "half_m"), [("shackleton", 13_500.0), ("kepler", 6_000.0)])
def test_horizons_are_those_of_embree(name, half_m, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path, str(Path(__file__).parent.parent / "benchmarks")])
    from _embree import EmbreeHorizons

    whole = load_terrain(name)
    crop = whole.maps[0].crop_around(whole.site.latitude_rad, whole.site.longitude_rad, half_m)
    terrain = replace(whole, maps=(crop,), search_radius_m=0.3 * half_m)
    place, azimuth = half_m * np.array([0.1, -0.15]), np.radians(np.arange(0.25, 360, 0.5))
    tan, distance, edge = terrain.horizons(place[None], azimuth)
    inside = distance < edge - 2 * crop.post_m  # horizons near the crop's border are not comparable
    off = np.degrees(np.arctan(tan) - EmbreeHorizons(terrain, place).horizon_rad(azimuth))[inside]
    assert inside.sum() > 400
    assert np.sqrt(np.mean(off**2)) < 0.002
    assert np.quantile(np.abs(off), 0.99) < 0.005
    moved = np.degrees(terrain.horizon_rad(place + np.array([20.0, 0.0]), azimuth) - np.arctan(tan))
    assert np.sqrt(np.mean(moved**2)) > 0.01  # a map that is 20 m off would be noticed
