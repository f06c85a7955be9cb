"""Corners and peaks: those of a skyline, a pose by three of them, and the position on a map."""

from contextlib import suppress

import numpy as np
import pytest

from startrack.applications.reproduction.published.naval import (
    SHARP_RAD,
    find_features,
    locate_by_features,
    map_features,
    resect,
)
from startrack.applications.reproduction.published.skylines import lit_skyline
from startrack.applications.reproduction.simulator import crater, draw_positions
from startrack.core.types import MIDDLES_RAD, SECTORS, NotLocated
from startrack.terrain import load_terrain


def test_a_corner_and_a_peak_stand_out_and_a_slope_does_not():
    sector = np.arange(SECTORS)
    peak = 0.1 * np.clip(1.0 - np.abs(sector - 60) / 10, 0.0, None)
    corner = 0.02 * np.clip(np.minimum((sector - 130) / 8, 1.0), 0.0, None) * np.clip((238 - sector) / 8, 0.0, 1.0)
    found = find_features(0.2 + 0.1 * np.sin(MIDDLES_RAD) + peak + corner)
    assert abs(found[0] - 60) <= 1 and any(abs(found - 138) <= 2)
    assert len(find_features(0.2 + 0.1 * np.sin(MIDDLES_RAD))) == 0
    assert (
        len(find_features(np.full(SECTORS, 0.2) + 0.1 * SHARP_RAD * np.random.default_rng(0).normal(size=SECTORS))) == 0
    )


def test_three_bearings_give_the_position_whatever_the_heading():
    rng = np.random.default_rng(1)
    points, position = rng.uniform(-1e4, 1e4, (50, 3, 2)), np.array([300.0, -200.0])
    away = points - position
    for one, bearing in zip(points, np.arctan2(away[..., 0], away[..., 1]), strict=True):
        np.testing.assert_allclose(resect(one[None], bearing + rng.uniform(0, 2 * np.pi))[0], position, atol=1e-3)


def test_a_smooth_crater_has_no_features():
    cylinder = crater()
    skyline = lit_skyline(draw_positions(0, 0, 0, 1)[0], cylinder, rng=np.random.default_rng(0))
    assert len(map_features(cylinder).points_m) == 0
    with pytest.raises(NotLocated, match="corners and peaks"):
        locate_by_features(skyline, cylinder, map_features(cylinder))


@pytest.mark.slow
def test_shackleton_is_recognized_by_its_crests_without_a_heading():
    terrain, errors = load_terrain("shackleton-rendered"), []
    features = map_features(terrain)
    for sky in range(8):
        place, rng = draw_positions(0, sky, 0, 1)[0], np.random.default_rng(sky)
        skyline = lit_skyline(place, terrain, rng.uniform(0.0, 2 * np.pi), rng=rng)
        with suppress(NotLocated):
            errors.append(np.hypot(*(locate_by_features(skyline, terrain, features) - place)))
    assert len(errors) >= 4 and np.median(errors) < 373.0  # what is published
