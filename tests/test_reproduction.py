"""The thesis's simulator with its methods and ours: statistics, figures, and resumed runs."""

import io
import json
import os
import sys
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from scipy import stats

from startrack.applications import chunk_store
from startrack.applications.reproduction import (
    ARTEFACTS,
    FULL,
    QUICK,
    Context,
    Size,
    comparison,
    fix_store,
    methods,
    scene,
    simulator,
    write_artefact,
)
from startrack.applications.reproduction.error_figures import _error_map
from startrack.applications.reproduction.methods import KUA, OURS, Task, compute_chunk, tasks_of
from startrack.applications.reproduction.published.kua_drive import DRIVE_M
from startrack.applications.reproduction.published.skylines import MAP_STEP_M, MapGrid
from startrack.applications.reproduction.simulator import (
    PERFECT,
    Mistakes,
    Sky,
    cell_centroid,
    change_steps_m,
    changes_m,
    crater,
    crater_edge,
    directions,
    draw_positions,
    gaps_m,
    mean_gap_m,
    star_count,
    visible_stars,
)
from startrack.cli.console import Progress, progress
from startrack.cli.main import main
from startrack.cli.studies import ARTEFACT_NAMES
from startrack.core import runner
from startrack.core.files import hold_lock
from startrack.localization import ExactPosterior, Hull, PseudoGradient

SMALL = Size(
    "small", skies=10, per_sky=300, ours_per_sky=3, bound_per_sky=3, deep_per_sky=2, one_sky=500, ours_one_sky=120,
    sweep_skies=1, sweep_per_sky=1, traverses=10, compared_per_sky=1, compared_on_map=1,
    compared_in_valley=1, compared_series=1,
)  # fmt: skip
FEW = {"methods": replace(SMALL, skies=2)}  # whose errors other files test: here the table is written only
COARSE_M, VALLEY_M = 10 * MAP_STEP_M, DRIVE_M  # step of the grid of skylines; radius of valleys that a drive fits in
TINY = replace(SMALL, skies=3, per_sky=8, ours_per_sky=2, bound_per_sky=2, deep_per_sky=1, one_sky=8, ours_one_sky=4)


@contextmanager
def hide_progress(what, total):
    yield Progress()


@contextmanager
def small_grounds():
    """Within the block few skylines of a map are traced, which take minutes, and no method runs for its time alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "traced_grid", lru_cache(maxsize=1)(partial(MapGrid.trace, step_m=COARSE_M)))
        patch.setattr(scene, "valleys", lru_cache(maxsize=1)(scene.jacksboro))
        patch.setattr(scene, "VALLEY_RADIUS_M", VALLEY_M)
        patch.setattr(comparison, "_warm_up", lambda ground: None)
        patch.setattr(comparison, "REST_EXPOSURES", 2)
        scene.terrain_of.cache_clear()
        yield
    scene.terrain_of.cache_clear()


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    """Every table and figure of a small run, with its files. Workers of pytest-xdist share what is computed."""
    out = tmp_path_factory.mktemp("reproduced")
    shared = tmp_path_factory.getbasetemp().parent if "PYTEST_XDIST_WORKER" in os.environ else out
    with (
        hold_lock(shared / "reproduced.lock"),
        small_grounds(),
        fix_store(shared, jobs=1, progress=hide_progress) as store,
    ):
        artefacts = {name: make(Context(FEW.get(name, SMALL), 0, store)) for name, make in ARTEFACTS.items()}
    return {name: (artefact, write_artefact(artefact, out, plots=True)) for name, artefact in artefacts.items()}


# The simulator


def test_star_counts_are_liebes():
    assert star_count(6.0) == simulator.THESIS["stars"] == 2142
    assert star_count(2.0) == 28


def test_stars_are_uniform_on_the_hemisphere_and_positions_on_the_floor():
    sky = Sky.draw(3, 0, 8.0)
    assert stats.kstest(np.sin(sky.elevation_rad), "uniform").pvalue > 0.01
    assert stats.kstest(sky.azimuth_rad / (2 * np.pi), "uniform").pvalue > 0.01
    spots = draw_positions(3, 0, 0, 5000)
    assert stats.kstest(np.sum(spots**2, axis=1) / 1e8, "uniform").pvalue > 0.01
    assert stats.kstest(np.arctan2(*spots.T) / (2 * np.pi) + 0.5, "uniform").pvalue > 0.01


def test_smaller_runs_are_the_beginning_of_larger_ones():
    small, large = Sky.draw(0, 4, 5.0), Sky.draw(0, 4, 7.0)
    np.testing.assert_array_equal(small.elevation_rad, large.elevation_rad[: len(small)])
    np.testing.assert_array_equal(draw_positions(0, 4, 10, 20), draw_positions(0, 4, 0, 500)[10:20])
    whole = compute_chunk(Task(KUA, 0, 1, 0, 12))
    parts = [compute_chunk(Task(KUA, 0, 1, start, start + 6)) for start in (0, 6)]
    np.testing.assert_array_equal(whole["refined_m"], np.concatenate([part["refined_m"] for part in parts]))
    assert sum(map(len, tasks_of(OURS, 0, 0, 250))) == 250


def test_stars_in_sight_are_those_above_the_horizon_and_inside_the_drawn_edge():
    from matplotlib.path import Path as Polygon

    from startrack.applications.reproduction.artefact import fisheye_points

    sky, cylinder = Sky.draw(0, 0), crater()
    for position in draw_positions(0, 0, 0, 10):
        seen = visible_stars(sky.project_to_rim_plane(cylinder), position, cylinder.radius_m)
        horizon = cylinder.horizon_rad(np.tile(position, (len(sky), 1)), sky.azimuth_rad)
        np.testing.assert_array_equal(seen, sky.elevation_rad > horizon)
        polygon = Polygon(fisheye_points(*crater_edge(cylinder, position)))
        inside = polygon.contains_points(fisheye_points(sky.azimuth_rad, sky.elevation_rad))
        assert np.sum(inside != seen) <= 2  # a polygon of 360 points is not quite the circle


def test_lists_have_the_stated_error_rates():
    in_sight = np.repeat([True, False], 20_000)
    listed = Mistakes(missed=0.1, false=0.02).draw_list(in_sight, 0, 0, 0)
    assert np.mean(~listed[in_sight]) == pytest.approx(0.1, abs=0.008)
    assert np.mean(listed[~in_sight]) == pytest.approx(0.02, abs=0.004)
    sky = Sky.draw(0, 0, 3.0)
    llr = Mistakes(missed=0.1, false=0.02).evidence(sky, np.arange(len(sky)) < 5).llr
    assert llr[0] == pytest.approx(np.log(45)) and llr[-1] == pytest.approx(np.log(0.1 / 0.98))


@pytest.mark.parametrize("size", [1.0, 0.02, 40.0])  # as wide as the first grid, below its step, beyond its window
def test_the_middle_of_a_cell_with_straight_walls(size):
    """Circles of huge radius are straight lines: the cell is the rectangle -7 < x < 5, -2 < y < 3, times the size."""
    radius = 1e8
    normals = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    walls = size * np.array([5.0, 7.0, 3.0, 2.0])
    points = normals * (radius - walls)[:, None]
    found = cell_centroid(points, size * np.array([4.0, -1.5]), radius)
    np.testing.assert_allclose(found, size * np.array([-1.0, 0.5]), atol=0.04 * size)


# The methods


def test_the_localizers_give_what_the_table_is_made_of():
    task = Task(KUA, 0, 2, 0, 5)
    chunk, sky, cylinder = compute_chunk(task), Sky.draw(0, 2), crater()
    for k, position in enumerate(draw_positions(0, 2, 0, 5)):
        evidence = PERFECT.evidence(sky, visible_stars(sky.project_to_rim_plane(cylinder), position, cylinder.radius_m))
        hull, refined = Hull()(evidence, cylinder), PseudoGradient()(evidence, cylinder)
        np.testing.assert_allclose(hull.position_enu_m[:2], chunk["hull_m"][k], atol=1e-6)
        np.testing.assert_allclose(refined.position_enu_m[:2], chunk["refined_m"][k], atol=1e-6)


@pytest.mark.slow
def test_table_3_1_is_within_the_bars(small_run):
    values = small_run["table3.1"][0].values
    assert 30 <= values["reproduced"]["descent"]["mean_m"] <= 38  # thesis 34.2
    assert 25 <= values["reproduced"]["descent"]["sd_m"] <= 36  # 31.1
    assert 0.003 <= values["reproduced"]["never_settle"] <= 0.012  # 0.006
    assert 600 <= values["reproduced"]["hull"]["mean_m"] <= 700  # 637
    assert values["ours"]["over_limit"] <= 1.03
    assert values["ours"]["same_lists"]["refused"] == values["ours"]["magnitude_8"]["refused"] == 0
    assert values["ours"]["magnitude_8"]["mean_m"] <= 4.0


@pytest.mark.slow
def test_ours_is_near_the_middle_of_the_exact_cell():
    """Not in it: the posterior takes one star in 400 for a wrong one, which gives cells beside it some weight."""
    sky, cylinder = Sky.draw(0, 1), crater()
    points, off = sky.project_to_rim_plane(cylinder), []
    for position in draw_positions(0, 1, 0, 10):
        evidence = PERFECT.evidence(sky, visible_stars(points, position, cylinder.radius_m))
        fix = ExactPosterior()(evidence, cylinder)
        off.append(np.hypot(*(fix.position_enu_m[:2] - cell_centroid(points, position, cylinder.radius_m))))
    assert np.median(off) < 1.0


@pytest.mark.slow
def test_skyline_is_better_near_the_centre_and_stars_near_the_wall(small_run):
    artefact = small_run["fig3.10"][0]
    columns = {column.name: [float(v) for v in column.values] for column in artefact.columns}
    assert columns["hull_mean"][-1] > 2 * columns["hull_mean"][0]
    assert columns["descent_mean"][0] > 2 * columns["descent_mean"][-1]
    assert artefact.values["ours"]["mean_m"] < 0.8 * artefact.values["reproduced"]["mean_m"]


def test_the_published_trials_average_to_the_published_overall():
    assert np.mean([trial["mean_m"] for trial in simulator.THESIS["trials"]]) == pytest.approx(
        simulator.THESIS["overall"]["mean_m"], abs=0.05
    )
    assert max(trial["max_m"] for trial in simulator.THESIS["trials"]) == simulator.THESIS["overall"]["max_m"]


# The traverse


def test_changes_along_the_traverse_are_where_the_view_changes():
    sky, cylinder = Sky.draw(0, 0, 4.0), crater()
    points, changes = sky.project_to_rim_plane(cylinder), changes_m(sky, cylinder)
    ends = np.concatenate([[-9999.9], (changes[1:] + changes[:-1]) / 2, [9999.9]])
    views = [visible_stars(points, np.array([east, 0.0]), cylinder.radius_m) for east in ends]
    assert [int(np.sum(a != b)) for a, b in pairwise(views)] == [1] * len(changes)


def test_distances_between_changes_are_the_thesis_s():
    found = []
    for number in range(20):
        noticed = change_steps_m(changes_m(Sky.draw(0, number), crater()), crater())
        found.append((mean_gap_m(noticed, crater()), gaps_m(noticed, crater()).max()))
    mean, largest = np.array(found).T
    assert abs(mean.mean() - simulator.THESIS["gaps"]["mean_m"]) < 3 * mean.std() and mean.std() < 0.4
    assert largest.min() < simulator.THESIS["gaps"]["max_m"] < largest.max()


# Files


@pytest.mark.slow
@pytest.mark.parametrize("name", ARTEFACT_NAMES)
def test_each_table_and_figure_is_written(small_run, name):
    artefact, files = small_run[name]
    pictures = [path for path in files if path.suffix == ".png"]
    assert len(pictures) == {"table3.1": 0, "fig3.10": 2, "proposals": 0}.get(name, 1)
    for path in pictures:
        with Image.open(path) as picture:
            picture.load()
            assert picture.format == "PNG" and min(picture.size) >= 400
            assert len(picture.getcolors()) > 8  # something is drawn
        assert path.stat().st_size < 200_000
    text = files[-1].read_text(encoding="utf-8")
    assert text.startswith(f"## {artefact.title}") and all(path.name in text for path in pictures)
    json.dumps(artefact.values)
    if name not in {"fig3.3", "fig3.5", "fig3.6", "magnitude", "aspect"}:  # no number of the thesis belongs to these
        assert "thesis" in text and artefact.values["thesis"]


@pytest.mark.slow
def test_tables_are_read_by_astropy(small_run):
    from astropy import units
    from astropy.table import QTable

    tables = {p.name: QTable.read(p) for _, files in small_run.values() for p in files if p.suffix == ".ecsv"}
    assert set(tables) >= {"table3.1.ecsv", "fig3.7.ecsv", "fig3.9.ecsv", "magnitude.ecsv", "figA.2.ecsv"}
    assert len(tables["table3.1.ecsv"]) == 10
    thesis = tables["table3.1.ecsv"]["thesis_mean"]
    assert thesis.mean().to_value(units.km) == pytest.approx(0.0342, abs=1e-4)


def test_a_map_of_errors_has_common_classes_for_all_starfields():
    errors_m = tuple(np.random.default_rng(k).exponential(30.0 + 10.0 * k, 500) for k in range(3))
    found = methods.MethodErrors(tuple(draw_positions(0, k, 0, 500) for k in range(3)), errors_m, (), 1.0)
    figure = Figure()
    _error_map(found, ["one", "two", "three"], "").draw(figure)
    counts = [[len(points.get_offsets()) for points in axes.collections] for axes in figure.axes]
    assert np.sum(counts, axis=0).tolist() == [750, 600, 135, 15] and counts[0][0] > counts[2][0]
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words[-1] == f"worst 1 %: up to {found.errors.max():.0f} m"
    assert words[0] == f"half of the points: up to {np.median(found.errors):.0f} m"


def test_names_of_the_command_are_those_that_can_be_made():
    assert tuple(ARTEFACTS) == ARTEFACT_NAMES
    assert FULL.skies * FULL.per_sky == FULL.one_sky == 100_000  # as in the thesis
    assert QUICK.per_sky < FULL.per_sky
    fewer = FULL.limit_our_positions(700)
    assert (fewer.per_sky, fewer.one_sky) == (FULL.per_sky, FULL.one_sky)
    assert (fewer.ours_per_sky, fewer.bound_per_sky, fewer.deep_per_sky, fewer.ours_one_sky) == (700, 700, 500, 7000)


# Runs


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


@pytest.mark.slow
def test_any_number_of_workers_gives_the_same_bytes(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("startrack.applications.reproduction.QUICK", TINY)
    for jobs in ("1", "2"):
        assert main(["reproduce", "table3.1", "figB", "-j", jobs, "-D", str(tmp_path / jobs), "-v"]) == 0
    one, two = contents(tmp_path / "1"), contents(tmp_path / "2")
    assert one == two
    assert set(one) == {"table3.1.md", "table3.1.ecsv", "figB.md", "figB.png"}
    assert capsys.readouterr().out.count("table3.1: pseudo-gradient") == 2


@pytest.mark.slow
def test_a_cluster_gives_the_same_bytes(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("startrack.applications.reproduction.QUICK", TINY)
    with distributed.LocalCluster(1, processes=False, threads_per_worker=1, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        assert main(["reproduce", "table3.1", "--cluster", address, "-D", str(tmp_path / "c"), "-v"]) == 0
    assert main(["reproduce", "table3.1", "-j", "1", "-D", str(tmp_path / "1"), "-v"]) == 0
    assert contents(tmp_path / "c") == contents(tmp_path / "1")


def test_a_cluster_that_does_not_answer_is_named(tmp_path, capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(runner, "CONNECT_S", 0.5)
    assert main(["reproduce", "fig3.4", "--cluster", "tcp://127.0.0.1:9", "-D", str(tmp_path)]) == 4
    assert "127.0.0.1:9" in capsys.readouterr().err


def test_a_stopped_run_goes_on_from_where_it_was(tmp_path, monkeypatch):
    wanted = [task for sky in range(4) for task in tasks_of(KUA, 0, sky, 3)]
    computed = []

    def stop_after(task):
        if len(computed) == 2:
            raise KeyboardInterrupt
        computed.append(task)
        return compute_chunk(task)

    monkeypatch.setattr(methods, "compute_chunk", stop_after)
    with fix_store(tmp_path, jobs=1, progress=hide_progress) as store, pytest.raises(KeyboardInterrupt):
        list(store.chunks("stopped", wanted))
    assert len(list((tmp_path / methods.FIX_FOLDER).iterdir())) == 2  # whole chunks only, no temporary files
    computed.clear()
    monkeypatch.setattr(methods, "compute_chunk", lambda task: computed.append(task) or compute_chunk(task))
    with fix_store(tmp_path, jobs=1, progress=hide_progress) as store:
        computed_chunks = list(store.chunks("resumed", wanted))
        assert computed == wanted[2:]
        assert len(list(store.chunks("again", wanted))) == 4 and computed == wanted[2:]
    for task, chunk in zip(wanted, computed_chunks, strict=True):
        np.testing.assert_array_equal(chunk["refined_m"], compute_chunk(task)["refined_m"])


def test_chunks_of_other_settings_are_not_taken(tmp_path, monkeypatch):
    one = Task(KUA, 0, 0, 0, 3)
    others = [replace(one, seed=1), replace(one, stop=4), replace(one, aspect_ratio=5.0), replace(one, method=OURS),
              replace(one, mistakes=Mistakes(0.1, 0.1))]  # fmt: skip
    keys = {task.key for task in [one, *others]}
    monkeypatch.setattr(chunk_store, "__version__", "another")
    assert len(keys | {one.key}) == len(others) + 2


# The command


def test_json_has_one_object_for_each(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("startrack.applications.reproduction.QUICK", TINY)
    argv = ["reproduce", "fig3.8", "fig3.4", "--json", "--no-plots", "-j", "1", "-D", str(tmp_path), "--seed", "5"]
    assert main(argv) == 0
    records = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [record["name"] for record in records] == ["fig3.4", "fig3.8"]  # the thesis's order
    for record in records:
        assert record["format"] == "startrack.reproduction/1" and record["seed"] == 5
        assert record["thesis"] and record["reproduced"] and not any(f.endswith(".png") for f in record["files"])
    assert not list(tmp_path.glob("*.png"))


def test_usage(tmp_path, monkeypatch, capsys):
    def code(*argv):
        with pytest.raises(SystemExit) as stop:
            main(["reproduce", *argv, "-D", str(tmp_path)])
        return stop.value.code

    assert code("fig9.9") == 2 and "fig3.10" in capsys.readouterr().err
    assert code("--quick", "--full") == 2
    assert code("-j", "0") == 2
    monkeypatch.setattr("startrack.cli.flags.find_spec", lambda name: None)
    assert code("fig3.4") == 2
    message = capsys.readouterr().err
    assert "'.[plots]'" in message and "--no-plots" in message
    assert list(tmp_path.iterdir()) == []


def test_a_read_only_output_folder_is_named_at_once(tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert main(["reproduce", "-D", str(tmp_path / "file"), "--full"]) == 2
    assert str(tmp_path / "file") in capsys.readouterr().err


def test_a_progress_bar_on_a_terminal_only(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    shown = {}
    for kind in (io.StringIO, Terminal):
        monkeypatch.setattr("sys.stderr", kind())
        with progress("fixes", 10) as bar:
            bar.advance(10)
        shown[kind] = sys.stderr.getvalue()
    assert shown[io.StringIO] == "" and "fixes" in shown[Terminal]
    with progress("predict", 1000, jobs=2):
        assert "predict: about 17 minutes" in sys.stderr.getvalue()
    with progress("predict", 1000, shown=False):
        assert sys.stderr.getvalue().count("about") == 1


def test_directions_are_from_north_through_east():
    np.testing.assert_allclose(directions(np.radians([0.0, 90.0])), [[0, 1], [1, 0]], atol=1e-12)
