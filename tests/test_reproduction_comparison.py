"""All methods at the same places: the chunks, the table and its statistics."""

from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from startrack.applications.reproduction import QUICK, Context, fix_store, write_artefact
from startrack.applications.reproduction.comparison import (
    COMPARED,
    ComparedErrors,
    compare_places,
    locate_by_rest,
    locate_by_stops,
    methods_on,
)
from startrack.applications.reproduction.method_results import MAP_GROUND, cumulative_picture, label_of, method_table
from startrack.applications.reproduction.methods import ALL_METHODS, KUA, Task, compute_chunk
from startrack.applications.reproduction.scene import VALLEY_GROUND, Scene
from startrack.applications.reproduction.simulator import draw_positions
from startrack.chain import Inputs, Refused
from startrack.cli.console import Progress

FEW = replace(QUICK, skies=2, compared_per_sky=1, compared_series=1)


@contextmanager
def hide_progress(what, total):
    yield Progress()


@pytest.fixture(scope="module")
def chunk():
    return compare_places(0, 1, 0, 2, series_every=3)


@pytest.mark.slow
def test_the_places_are_those_of_the_other_tables(chunk):
    np.testing.assert_array_equal(chunk["truth_m"], draw_positions(0, 1, 0, 2))
    kua = compute_chunk(Task(KUA, 0, 1, 0, 2))
    names = list(COMPARED)
    np.testing.assert_array_equal(chunk["position_m"][:, names.index("kua-hull")], kua["hull_m"])
    np.testing.assert_array_equal(chunk["position_m"][:, names.index("kua-pseudo-gradient")], kua["refined_m"])


@pytest.mark.slow
def test_a_place_is_the_same_in_any_chunk(chunk):
    np.testing.assert_array_equal(compare_places(0, 1, 1, 2, series_every=3)["position_m"], chunk["position_m"][1:])
    assert Task(ALL_METHODS, 0, 1, 0, 3).key != Task(ALL_METHODS, 1, 1, 0, 3).key


@pytest.mark.slow
def test_the_dark_skyline_is_that_of_the_rendered_picture(chunk, monkeypatch):
    names = list(COMPARED)
    errors = np.hypot(*np.moveaxis(chunk["position_m"] - chunk["truth_m"][:, None], -1, 0))
    assert chunk["is_tried"][:, names.index("startrack-drive")].tolist() == [False, False]
    assert (errors[:, names.index("startrack")] < 50.0).all()
    assert (errors[:, names.index("cozman-krotkov-dark")] < 300.0).all()
    scene = Scene(0, 1, 0)
    np.testing.assert_array_equal(scene.dark.elevation_rad, scene.located.skyline.elevation_rad)

    def refuse(exposure, *args):
        return Refused(reason="not_identified", message="nothing fits", reached=Inputs(exposure=exposure))

    monkeypatch.setattr("startrack.applications.reproduction.scene.locate", refuse)
    refused = {
        name
        for name, one in zip(COMPARED, compare_places(0, 1, 0, 1, series_every=3)["position_m"][0], strict=True)
        if np.isnan(one).all() and not COMPARED[name].is_series
    }
    assert refused == {"startrack", "startrack-stars", "naval-lit", *(n for n in COMPARED if n.endswith("-dark"))}


@pytest.mark.slow
def test_many_exposures_are_right_to_less_than_one():
    scene = Scene(0, 0, 0)
    rest, drive = (np.hypot(*(locate(scene) - scene.truth_m)) for locate in (locate_by_rest, locate_by_stops))
    assert rest < 3.0 and drive < 20.0


def test_methods_of_a_round_crater_are_not_used_on_a_map():
    assert set(COMPARED) - set(methods_on(MAP_GROUND)) == {"kua-drive", "kua-hull", "kua-pseudo-gradient"}
    assert set(methods_on(MAP_GROUND)) - set(methods_on(VALLEY_GROUND)) == {"sigel-wettergreen", "malay"}
    assert Task(ALL_METHODS, 0, 1, 0, 1, ground=MAP_GROUND).key != Task(ALL_METHODS, 0, 1, 0, 1).key


@pytest.mark.slow
def test_stars_on_a_map_are_in_sight_above_its_horizon():
    scene = Scene(0, 0, 0, MAP_GROUND)
    np.testing.assert_array_equal(scene.truth_m, Scene(0, 0, 0).truth_m)
    for k in range(0, len(scene.sky), 100):
        horizon = scene.terrain.horizon_rad(scene.truth_m[None], scene.sky.azimuth_rad[k : k + 1])
        assert scene.seen[k] == (scene.sky.elevation_rad[k] > horizon[0])
    assert np.hypot(*(scene.listed_m - scene.truth_m)) < 200.0


def test_statistics_of_errors_with_a_refusal():
    position = np.full((3, len(COMPARED), 2), np.nan)
    position[:2, 0] = [[3.0, 4.0], [0.0, 1.0]]
    tried = np.ones((3, len(COMPARED)), dtype=bool)
    tried[2, 2] = False
    bounds = np.array([[[-1.0, -2.0], [1.0, 2.0]], [[np.nan] * 2] * 2])
    found = ComparedErrors(
        tuple(COMPARED), np.zeros((3, 2)), position, tried, np.stack([bounds] * 3), np.ones((3, len(COMPARED)))
    )
    assert found.bound_statistics(0) == (1.5, 1.0) and found.tried("startrack") == 2 and found.ms_per_fix[2] == 1500.0
    one = found.statistics("startrack-list")
    assert one["mean_m"] == one["median_m"] == 3.0 and one["mean_sigma_m"] == pytest.approx(2.0)
    assert one["max_m"] == 5.0 and (one["count"], one["refused"]) == (2, 1)
    assert found.statistics("kua-hull")["mean_m"] is None and found.statistics("kua-hull")["refused"] == 3


def test_each_curve_ends_with_its_name_clear_of_the_others():
    names, refused = tuple(COMPARED), ["naval-lit", "naval-dark"]
    distance_m = np.where([one in refused for one in names], np.nan, 30.0)  # the curves lie one upon the other
    position_m = np.stack([np.full((4, len(names)), distance_m), np.zeros((4, len(names)))], axis=-1)
    tried = np.ones((4, len(names)), dtype=bool)
    found = ComparedErrors(names, np.zeros((4, 2)), position_m, tried, np.zeros((4, 2, 2, 2)), np.zeros(tried.shape))
    figure, picture = Figure(figsize=(9.0, 6.4)), cumulative_picture(found)
    picture.draw(figure)
    figure.draw_without_rendering()
    (axes,) = figure.axes
    shown = [text for text in axes.texts if text.get_text()]
    assert {text.get_text() for text in shown} == {label_of(one) for one in names if one not in refused}
    assert all(label_of(one) in picture.caption for one in refused)
    boxes = sorted((Text.get_window_extent(text) for text in shown), key=lambda box: box.y0)
    assert all(below.y1 <= above.y0 + 1.0 for below, above in pairwise(boxes))
    assert boxes[0].y0 > axes.bbox.y0 and boxes[-1].y1 < axes.bbox.y1


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes(tmp_path):
    def write(name):
        with fix_store(tmp_path / name, jobs=1, progress=hide_progress) as store:
            artefact = method_table(Context(FEW, 3, store))
        return artefact, {
            path.name: path.read_bytes() for path in write_artefact(artefact, tmp_path / name, plots=True)
        }

    artefact, one = write("one")
    assert one == write("two")[1] and set(one) == {"methods.md", "methods.ecsv", "methods.png"}
    assert all(method.name in artefact.text for method in COMPARED.values())
    assert set(artefact.timing_ms) == set(COMPARED)
