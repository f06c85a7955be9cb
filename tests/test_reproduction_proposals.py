"""What the thesis proposes: each beside the method that it changes."""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from startrack.applications.reproduction import QUICK, Context, fix_store, proposals
from startrack.applications.reproduction.proposals import best_of_grid, descend_by_skyline, simplify_crater
from startrack.applications.reproduction.simulator import Sky, crater, draw_positions, visible_stars
from startrack.cli.console import Progress
from startrack.terrain import load_terrain

CRATER = crater()


def test_the_best_of_a_grid_explains_more_stars_than_its_middle():
    points = Sky.draw(0, 0).project_to_rim_plane(CRATER)
    for truth in draw_positions(0, 0, 0, 5):
        seen = visible_stars(points, truth, CRATER.radius_m)
        end = truth + np.array([40.0, -30.0])
        best = best_of_grid(points, seen, end, CRATER.radius_m)
        assert np.hypot(*(best - truth)) < 50.0
        wrong = [np.count_nonzero(visible_stars(points, one, CRATER.radius_m) != seen) for one in (best, end)]
        assert wrong[0] <= wrong[1]


@pytest.mark.parametrize("skips", [False, True])
def test_the_stars_along_the_skyline_lead_to_the_position(skips):
    points, errors = Sky.draw(0, 0).project_to_rim_plane(CRATER), []
    for truth in draw_positions(0, 0, 0, 10):
        seen = visible_stars(points, truth, CRATER.radius_m)
        end = descend_by_skyline(points, seen, truth + np.array([300.0, 200.0]), CRATER.radius_m, skips=skips)
        errors.append(np.hypot(*(end - truth)))
    assert np.median(errors) < 100.0


def test_the_simplified_crater_is_shackleton():
    centre, radius, rim = simplify_crater(load_terrain("shackleton-rendered"))
    assert np.hypot(*centre) < 1500.0 and 9000.0 < radius < 11_500.0 and abs(rim) < 4500.0


@contextmanager
def hide_progress(what, total):
    yield Progress()


@pytest.mark.slow
def test_each_proposal_helps_as_the_thesis_expects(tmp_path):
    size = replace(QUICK, skies=10, per_sky=300, compared_per_sky=2)
    with fix_store(tmp_path, jobs=1, progress=hide_progress) as store:
        values = proposals(Context(size, 0, store)).values["reproduced"]
    mean = {way: one["mean_m"] for way, one in values.items()}
    assert mean["with a grid about its end, where it wanders"] < mean["pseudo-gradient, where it wanders"]
    hidden = ", an obstacle of 40 by 40 degrees"
    assert mean["by those beside the obstacle" + hidden] < mean["pseudo-gradient" + hidden] / 2
    assert mean["startrack" + hidden] < 100.0
