"""Predicted accuracy: the same search as for images, files that other programs read, the same for any workers."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from astropy.table import Table
from jsonschema import Draft202012Validator

import startrack
from startrack.applications.prediction import (
    CELL_QUANTITIES,
    PREDICTION,
    Conditions,
    Place,
    Predictions,
    Predictor,
    Status,
    area_cells,
    cells_of_draws,
    path_points,
    share_within,
    summarize_cells,
    times_between,
)
from startrack.applications.prediction import report as prediction_report
from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import locate
from startrack.cli.main import main
from startrack.core.types import BadInput
from startrack.frames import Site, latlon_from_enu
from startrack.output import comparison_picture, path_picture
from startrack.output.picture.prediction import class_bounds_m, prediction_picture
from startrack.rendering import Drive, Series, exposure_for_snr, limiting_v_mag, load_sky_catalog, render
from startrack.terrain import Cylinder, load_terrain, write_bands

OK, AMBIGUOUS, REFUSED = Status
WHEN = datetime(2030, 6, 1, tzinfo=UTC)
NAMES = [one.key for one in CELL_QUANTITIES]
FLAGS = ["predict", "-t", "shackleton-thesis", "-c", "fisheye-2048", "--time", "2030-06-01T00:00:00"]


def run(out, *flags):
    return main([*FLAGS, "--exposure", "0.2", "-j", "1", "-D", str(out), *map(str, flags)])


@pytest.fixture(scope="module")
def area(tmp_path_factory):
    out = tmp_path_factory.mktemp("area")
    assert run(out, "--spacing", 9000, "--draws", 1) == 0
    return out


def test_the_map_is_a_geotiff_in_the_projection_of_the_terrain(area):
    rasterio = pytest.importorskip("rasterio")
    from rasterio.warp import transform

    table = Table.read(area / "predict.ecsv")
    with rasterio.open(area / "predict.tif") as file:
        assert list(file.descriptions) == NAMES
        assert np.isnan(file.nodata)
        assert set(file.dtypes) == {"float32"}
        sphere = rasterio.crs.CRS.from_string("+proj=longlat +R=1737400 +no_defs")
        xs, ys = transform(sphere, file.crs, table["longitude_deg"], table["latitude_deg"])
        values = np.array(list(file.sample(zip(xs, ys, strict=True))))
        assert np.isfinite(file.read(2)).sum() == len(table) == 5
        for name, band in zip(NAMES, values.T, strict=True):
            assert band == pytest.approx(np.ma.filled(np.ma.asarray(table[name]), np.nan), rel=1e-5, nan_ok=True)


def test_the_style_shows_a_band_of_the_map_in_classes_of_its_radii(area):
    rasterio = pytest.importorskip("rasterio")
    text = (area / "predict.qml").read_text()
    assert text.startswith("<!DOCTYPE qgis ")
    renderer = ElementTree.fromstring(text).find("pipe/rasterrenderer")
    with rasterio.open(area / "predict.tif") as file:
        band = int(renderer.get("band"))
        assert file.descriptions[band - 1] == "radius95_m"
        values = file.read(band)
    items = renderer.findall("rastershader/colorrampshader/item")
    bounds_m = [float(item.get("value")) for item in items]
    assert bounds_m == [*class_bounds_m(values), np.inf]
    assert all(item.get("label").endswith(" m") for item in items)  # its unit
    assert len({item.get("color") for item in items}) == len(items) > 1


def test_the_protection_level_is_a_band_beyond_the_circles(area):
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(area / "predict.tif") as file:
        bands = {name: file.read(1 + k) for k, name in enumerate(file.descriptions)}
    level_m, radius_m = bands["protection_level_m"], bands["radius95_m"]
    known = np.isfinite(level_m)
    assert known.sum() >= 3 and (np.isfinite(radius_m) | ~known).all()
    assert (level_m[known] > 1.2 * radius_m[known]).all()  # 1.05 times the 99.9 % circle, or more


def test_a_draw_has_the_protection_level_of_its_position(monkeypatch):
    from startrack.applications.prediction import draws

    fixes = []
    real = draws.locate_measured
    monkeypatch.setattr(draws, "locate_measured", lambda *given: fixes.append(real(*given)) or fixes[-1])
    conditions = Conditions("fisheye-2048", "shackleton-thesis", (WHEN,), 22.0, 3, "posterior", exposure_s=0.2)
    predictor = Predictor(load_camera("fisheye-2048"), load_terrain("shackleton-thesis"), conditions)
    found = predictor.draw(Place(0, 6000.0, 2000.0))
    assert found["status"].tolist() == [OK]
    assert found["protection_level_m"].tolist() == [fixes[0].fix.integrity.protection_level_m]


def test_the_summary_fits_its_schema_and_the_table(area):
    record = json.loads((area / "predict.json").read_text())
    Draft202012Validator(PREDICTION, format_checker=Draft202012Validator.FORMAT_CHECKER).validate(record)
    radius = np.asarray(Table.read(area / "predict.ecsv")["radius95_m"])
    assert record["summary"]["share_below_20_m"] == pytest.approx(np.mean(radius < 20))
    assert record["summary"]["median_radius95_m"] == pytest.approx(np.median(radius), rel=1e-5)
    assert record["exposure_s"] == 0.2
    assert record["places"] == 5
    assert (area / "predict.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_two_workers_write_the_same_bytes(area, tmp_path):
    assert run(tmp_path, "--spacing", 9000, "--draws", 1, "-j", 2) == 0
    for name in ("predict.tif", "predict.qml", "predict.ecsv", "predict.json", "predict.png"):
        assert (tmp_path / name).read_bytes() == (area / name).read_bytes(), name


def test_without_rasterio_all_but_the_map_is_written(area, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("startrack.terrain.maps.writing.find_spec", lambda name: None)
    out = tmp_path / "out"
    shutil.copytree(area, out)
    assert run(out, "--spacing", 9000, "--draws", 1) == 0
    assert "no predict.tif, which needs rasterio: pip install '.[dem]'" in capsys.readouterr().err
    assert {path.name for path in area.iterdir()} - {path.name for path in out.iterdir()} == {
        "predict.tif", "predict.qml",
    }  # fmt: skip


def test_a_stopped_run_is_resumed(area, capsys, monkeypatch):
    """Two chunks of five are lost, as if the run had been killed: only these are drawn again."""
    from startrack.applications.prediction import draws

    before = (area / "predict.ecsv").read_bytes()
    for chunk in sorted((area / ".predict").glob("*.npz"))[:2]:
        chunk.unlink()
    drawn = []
    real = draws.Predictor.draw
    monkeypatch.setattr(draws.Predictor, "draw", lambda self, place: drawn.append(place) or real(self, place))
    assert run(area, "--spacing", 9000, "--draws", 1, "--json") == 0
    assert len(drawn) == 2
    assert (area / "predict.ecsv").read_bytes() == before
    assert json.loads(capsys.readouterr().out) == json.loads((area / "predict.json").read_text())


def test_a_record_that_is_no_prediction_is_replaced(area):
    before = (area / "predict.json").read_bytes()
    (area / "predict.json").write_text("[" * 100_000)
    assert run(area, "--spacing", 9000, "--draws", 1) == 0
    assert (area / "predict.json").read_bytes() == before


def test_a_folder_with_another_prediction_is_kept(area, capsys):
    before = (area / "predict.json").read_bytes()
    assert run(area, "--spacing", 8000, "--draws", 1) == 2
    assert "holds another prediction (spacing_m" in capsys.readouterr().err
    assert (area / "predict.json").read_bytes() == before


@pytest.mark.parametrize(
    ("flags", "code", "text"),
    [
        (["--time", "2030-06-01"], 4, "no_time"),
        (["--time", "2030-06-02T00:00:00/2030-06-01T00:00:00"], 4, "before the start"),
        (["-c", "nothing"], 4, "no_calibration"),
        (["-t", "nothing"], 4, "bad_terrain"),
        (["--spacing", "0"], 2, "not above 0"),
        (["--spacing", "1"], 4, "more than 1000000"),
        (["--draws", "100000"], 2, "at most 1000"),
        (["--exposures", "1,1"], 2, "twice"),
        (["--exposures", "1,x"], 2, "is not a number"),
        (["--depth"], 2, "go together"),
        (["--target-radius95", "5"], 2, "go together"),
        (["--localizer", "guess"], 2, "known are"),
        (["--path", "no-such-file.csv"], 4, "bad_odometry"),
        (["--depth", "--exposure", "1"], 2, "not allowed"),
    ],
)
def test_bad_flags_have_one_line_and_leave_no_file(flags, code, text, tmp_path, capsys):
    out = tmp_path / "out"
    try:
        found = main([*FLAGS, "-D", str(out), *flags])
    except SystemExit as ended:
        found = ended.code
    assert found == code
    assert text in capsys.readouterr().err
    assert not out.exists()


def test_a_camera_without_a_sensor_is_refused():
    bare = replace(load_camera("fisheye-2048"), sensor=None)
    with pytest.raises(BadInput) as caught:
        startrack.predict(bare, "shackleton-thesis", time=WHEN, positions_m=[[0.0, 0.0]], draws=1)
    assert caught.value.reason == "bad_calibration"


@pytest.mark.slow
def test_a_draw_depends_on_seed_and_place_only():
    """Neither other places nor their order change it; another seed and another number do."""
    terrain, camera = load_terrain("shackleton-thesis"), load_camera("fisheye-2048")

    def draw(number, seed=0, first=()):
        conditions = Conditions("c", "t", (WHEN,), 22.0, seed, "posterior", exposure_s=0.2)
        predictor = Predictor(camera, terrain, conditions)
        for other in first:
            predictor.draw(Place(other, -3000.0, 0.0))
        return predictor.draw(Place(number, 2000.0, 1000.0))["offset_m"]

    here = draw(7)
    assert np.array_equal(draw(7, first=[3]), here)
    assert not np.array_equal(draw(8), here)
    assert not np.array_equal(draw(7, seed=1), here)


def test_the_library_gives_the_radius_of_the_search():
    found = startrack.predict(
        "fisheye-2048", "shackleton-thesis", time=("2030-06-01T00:00:00", "2030-06-15T00:00:00"), draws=2,
        positions_m=[[4000.0, 2000.0]], exposure=0.4,
    )  # fmt: skip
    assert found.cells["p_ok"] == pytest.approx(1.0)
    assert 1.0 < found.cells["radius95_m"][0] < 40.0
    # Of a normal error the 95 % radius is between 1.96 (a line) and 2.45 (a circle) long standard deviations.
    assert 1.6 < found.cells["radius95_m"][0] / found.cells["sigma_major_m"][0] < 3.0
    assert found.summary["p_ok"] == 1.0


@pytest.mark.slow
def test_predicted_radii_are_those_that_locate_states():
    """At a place near the wall and one in the middle, for whole images with other noise and another clock."""
    camera, terrain = load_camera("fisheye-2048"), load_terrain("shackleton-thesis")
    positions_m = np.array([[6500.0, 3000.0], [-500.0, 1500.0]])
    predicted_m = startrack.predict(camera, terrain, time=WHEN, positions_m=positions_m, draws=8).cells["radius95_m"]
    stated_m = []
    for east_m, north_m in positions_m:
        series = Series(
            camera=camera, terrain=terrain, catalog=load_sky_catalog("auto").brighter_than(9.5), seed=77,
            time_utc=WHEN, east_m=east_m, north_m=north_m,
        )  # fmt: skip
        images = [replace(render(scene, rng=rng)[0], time_sigma_s=1.0, time_sigma_is_stated=False)
                  for scene, rng in map(series.scene, range(4))]  # fmt: skip
        found = [locate(image, camera, terrain, load_catalog()) for image in images]
        stated_m.append(np.median([one.fix.radius95_m for one in found]))
    ratio = predicted_m / stated_m
    assert ratio.min() > 0.65 and ratio.max() < 1.5
    assert 0.75 < np.sqrt(ratio.prod()) < 1.33


def draws_of(status, radius, covariance):
    covariances = np.where(np.array(status)[:, :, None, None] == OK, np.array(covariance), np.nan)
    errors = np.zeros((*np.shape(status), 2))
    errors[..., 0] = np.sqrt(np.trace(covariances, axis1=2, axis2=3))  # as large as stated
    return {
        "status": np.array(status), "radius95_m": np.array(radius, dtype=float), "covariance_m2": covariances,
        "offset_m": errors, "protection_level_m": 2.0 * np.array(radius, dtype=float),
    }  # fmt: skip


def test_refused_draws_count_and_a_place_without_positions_has_no_radius():
    nan = np.nan
    status = [[OK, OK, REFUSED], [REFUSED, AMBIGUOUS, REFUSED], [OK, AMBIGUOUS, REFUSED]]
    cells = cells_of_draws(draws_of(status, [[3.0, 9.0, nan], [nan] * 3, [4.0, nan, nan]], [[9.0, 0.0], [0.0, 4.0]]))
    assert cells["radius95_m"] == pytest.approx([9.0, nan, nan], nan_ok=True)
    assert cells["protection_level_m"] == pytest.approx([18.0, nan, nan], nan_ok=True)
    assert cells["p_ok"] == pytest.approx([2 / 3, 0, 1 / 3])
    assert cells["p_ambiguous"] == pytest.approx([0, 1 / 3, 1 / 3])
    assert cells["p_refused"] == pytest.approx([1 / 3, 2 / 3, 1 / 3])
    assert cells["sigma_major_m"] == pytest.approx([3.0, nan, 3.0], nan_ok=True)
    assert cells["sigma_minor_m"] == pytest.approx([2.0, nan, 2.0], nan_ok=True)
    assert cells["azimuth_deg"][[0, 2]] == pytest.approx(90.0)
    assert summarize_cells(cells)["share_below_10_m"] == pytest.approx(1 / 3)
    assert summarize_cells(cells)["median_radius95_m"] is None
    assert share_within(cells, 9.0) == pytest.approx(1 / 3)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_the_ratio_is_that_of_the_errors_of_the_draws_to_the_stated(factor):
    """Places whose stated errors differ by a factor of 10; at one no draw has a position."""
    rng = np.random.default_rng(1)
    sigma_m = np.geomspace(1.0, 10.0, 400)
    covariance = np.square(sigma_m)[:, None, None, None] * np.diag([4.0, 1.0])
    draws = draws_of(np.full((400, 10), OK), np.ones((400, 10)), np.broadcast_to(covariance, (400, 10, 2, 2)))
    draws["offset_m"] = factor * sigma_m[:, None, None] * rng.normal(size=(400, 10, 2)) * [2.0, 1.0]
    draws["status"][7], draws["offset_m"][7], draws["covariance_m2"][7] = REFUSED, np.nan, np.nan
    cells = cells_of_draws(draws)
    assert summarize_cells(cells)["error_ratio"] == pytest.approx(factor, rel=0.05)
    assert np.delete(cells["sigma_major_m"], 7) == pytest.approx(2.0 * np.delete(sigma_m, 7))


def test_without_a_position_there_is_no_ratio():
    cells = cells_of_draws(draws_of([[REFUSED, AMBIGUOUS]], [[np.nan, np.nan]], np.eye(2)))
    assert summarize_cells(cells)["error_ratio"] is None


def test_the_azimuth_is_that_of_the_long_axis():
    """Long towards the north-east by 30 degrees from north."""
    along = np.array([np.sin(np.radians(30)), np.cos(np.radians(30))])
    covariance = 25.0 * np.outer(along, along) + np.eye(2)
    cells = cells_of_draws(draws_of([[OK]], [[5.0]], covariance))
    assert cells["azimuth_deg"] == pytest.approx([30.0])
    assert cells["sigma_major_m"] == pytest.approx([np.sqrt(26.0)])


@pytest.mark.parametrize("name", ["shackleton-thesis", "shackleton", "kepler"])
def test_cells_stand_where_the_map_has_them(name):
    """The middle of each cell, as projected, is the place whose position was drawn."""
    terrain = load_terrain(name)
    area = area_cells(terrain, 3000.0)
    assert (np.hypot(*area.position_m.T) <= terrain.search_radius_m).all()
    up_m = terrain.ground_m(area.position_m)
    lat, lon = latlon_from_enu(terrain.site, area.position_m[:, 0], area.position_m[:, 1], up_m)
    rows_columns = area.frame.row_column(lat, lon)
    assert rows_columns == pytest.approx(np.round(rows_columns), abs=1e-4)  # of a cell: 0.3 m
    columns = area.frame.heights_m.shape[1]
    assert np.array_equal(np.round(rows_columns) @ [columns, 1], area.cell)
    spacing = np.linalg.norm(area.position_m[:, None] - area.position_m[None], axis=-1)
    assert spacing[spacing > 0].min() == pytest.approx(3000.0, rel=0.01)
    assert np.abs(area.position_m).min(axis=0) == pytest.approx([0, 0], abs=20.0)  # one at the origin


def test_a_terrain_on_the_earth_has_no_map_projection():
    site = Site("earth", 0.5, 0.1)
    with pytest.raises(BadInput, match="no map projection"):
        area_cells(Cylinder(site=site, diameter_m=1000.0, depth_m=100.0), 100.0)


def test_times_are_the_middles_of_equal_parts():
    times = times_between(WHEN, WHEN + timedelta(hours=4), 4)
    assert [time - WHEN for time in times] == [timedelta(minutes=60 * k + 30) for k in range(4)]
    assert times_between(WHEN, WHEN, 3) == (WHEN,) * 3


def test_limiting_magnitude_is_the_inverse_of_the_exposure():
    camera = load_camera("fisheye-2048")
    for v_mag in (4.0, 6.0, 8.5):
        exposure_s = exposure_for_snr(camera, 21.5, v_mag=v_mag, snr=5.0)
        assert limiting_v_mag(camera, 21.5, exposure_s=exposure_s, snr=5.0) == pytest.approx(v_mag, abs=1e-9)


class KnownStore:
    """A store whose radius at every place is 12 m over the square root of the exposure."""

    def discard(self, tasks):
        raise AssertionError("nothing is overwritten")

    def chunks(self, what, tasks):
        for task in tasks:
            radius = np.array([12.0 / np.sqrt(task.conditions.exposure_s)])
            yield draws_of([[OK]], [radius], np.eye(2))


def test_depth_finds_the_exposure_of_a_known_radius():
    class Store(KnownStore):
        def chunks(self, what, tasks):
            return ({key: values[0] for key, values in chunk.items()} for chunk in super().chunks(what, tasks))

    predictions = Predictions([Place(0, 0.0, 0.0)], Store())
    conditions = Conditions("fisheye-2048", "shackleton-thesis", (WHEN,), 22.0, 0, "posterior")
    best, record = predictions.depth(conditions, 6.0)  # reached in 4 s
    assert 4.0 <= best.exposure_s <= 4.0 * 1.25
    assert record["exposure_s"] == best.exposure_s
    assert record["limiting_v_mag"] == pytest.approx(
        limiting_v_mag(load_camera("fisheye-2048"), 22.0, exposure_s=best.exposure_s, snr=5.0)
    )
    unreached, record = predictions.depth(conditions, 1e-3)
    assert record["exposure_s"] is record["limiting_v_mag"] is None
    assert unreached.exposure_s == record["tried"][-1]["exposure_s"]
    assert share_within({"radius95_m": np.array([6.0])}, 6.0) == 1.0


def test_bands_are_written_with_their_names(tmp_path):
    rasterio = pytest.importorskip("rasterio")
    area = area_cells(load_terrain("shackleton"), 5000.0)
    values = np.arange(len(area.cell), dtype=float)
    write_bands(tmp_path / "a.tif", area.frame, {"one": area.band(values), "two": area.band(-values)})
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.descriptions == ("one", "two")
        assert file.read(1) == pytest.approx(area.band(values), nan_ok=True)
        assert file.read(2) == pytest.approx(-area.band(values), nan_ok=True)
        assert file.crs.to_dict()["proj"] == "stere"


def test_every_waypoint_is_a_point_of_the_path():
    terrain = load_terrain("shackleton-thesis")
    waypoints_m = np.array([[0.0, 0.0], [0.0, 310.0], [30.0, 310.0], [430.0, 310.0]])
    points = path_points(Drive(waypoints_m=waypoints_m, speed_m_s=0.3), terrain, 100.0)
    assert points.distance_m == pytest.approx([0, 77.5, 155, 232.5, 310, 340, 440, 540, 640, 740])
    at = [0, 4, 5, 9]
    assert np.array_equal(points.position_m[at], waypoints_m)
    between = np.linalg.norm(np.diff(points.position_m, axis=0), axis=1)
    assert between == pytest.approx(np.diff(points.distance_m))
    assert points.spacing_m == pytest.approx(100.0)
    longer = path_points(Drive(waypoints_m=waypoints_m, speed_m_s=0.3), terrain, 5000.0)
    assert np.array_equal(longer.position_m, waypoints_m)
    with pytest.raises(BadInput, match="leaves the search area"):
        path_points(Drive(waypoints_m=np.array([[0.0, 0.0], [0.0, 11000.0]]), speed_m_s=1.0), terrain, 1000.0)
    with pytest.raises(BadInput, match="more than 1000000"):
        path_points(Drive(waypoints_m=waypoints_m, speed_m_s=1.0), terrain, 1e-5)


def test_the_picture_shows_the_classes_and_the_places_without_a_position():
    terrain = load_terrain("shackleton-thesis")
    area = area_cells(terrain, 1000.0)
    radius = np.where(area.position_m[:, 0] < -5000.0, np.inf, np.where(area.position_m[:, 1] > 0, 3.0, 30.0))
    pixels = prediction_picture(terrain, area.site, area.raster(radius), "title", ["line"])
    west, north, south = pixels[500, 140], pixels[300, 500], pixels[700, 500]
    assert west[0] > 1.4 * max(west[1:])  # vermillion
    assert north[0] > 150
    assert north[1] > 150  # light
    assert south.max() < 110  # dark
    assert class_bounds_m(radius) == [5.0, 10.0, 20.0]
    assert class_bounds_m(np.linspace(13.0, 22.0, 50)) == [14.0, 16.0, 18.0, 20.0]
    assert class_bounds_m(np.array([np.nan, np.inf])) == []
    assert class_bounds_m(np.full(3, 7.0)) == [10.0]


def test_pictures_of_curves_are_drawn_also_without_any_position():
    distance = np.linspace(0, 100, 5)
    for radius in (np.full(5, np.inf), np.array([3.0, 4.0, np.inf, 5.0, 3.0])):
        pixels = path_picture(distance, radius, np.isfinite(radius).astype(float), "title", ["line"])
        assert len(np.unique(pixels)) > 10
    for median in (None, 3.0):
        variants = [{"camera": "a", "exposure_s": 1.0, "summary": {"median_radius95_m": median}}]
        assert len(np.unique(comparison_picture(variants, "title"))) > 10


@pytest.fixture
def waypoints(tmp_path):
    path = tmp_path / "waypoints.csv"
    path.write_text("east_m,north_m\n0,0\n3000,3000\n")
    return path


def test_along_a_path_there_is_a_table_with_distances_and_no_map(waypoints, tmp_path, capsys):
    out = tmp_path / "out"
    flags = ["--exposures", "0.2,0.4", "-j", "1", "-D", str(out)]
    assert main([*FLAGS, *flags, "--path", str(waypoints), "--spacing", "4300", "--draws", "1"]) == 0
    assert "predict: places: 2, draws at each: 1\n" in capsys.readouterr().err
    table = Table.read(out / "predict.ecsv")
    assert list(table["distance_m"]) == pytest.approx([0, 3000 * 2**0.5], abs=1e-3)
    assert not (out / "predict.tif").exists()
    rows = Table.read(out / "predict-compare.ecsv")
    assert list(rows["exposure_s"]) == [0.2, 0.4]
    record = json.loads((out / "predict.json").read_text())
    assert record["kind"] == "path"
    assert record["variants"][0]["summary"] == record["summary"]
    assert record["variants"][0]["limiting_v_mag"] < record["variants"][1]["limiting_v_mag"]
    Draft202012Validator(PREDICTION).validate(record)
    assert (out / "predict-compare.png").exists()


def test_the_colours_of_the_map_are_continuous_and_its_contours_few():
    terrain = load_terrain("shackleton-thesis")
    area = area_cells(terrain, 1000.0)
    radius = np.exp(np.interp(area.position_m[:, 0], [-1e4, 1e4], np.log([1.0, 400.0])))
    assert len(class_bounds_m(radius)) > 3
    pixels = prediction_picture(terrain, area.site, area.raster(radius), "title", [])[500, 100:890].astype(int)
    steps = np.abs(np.diff(pixels, axis=0)).max(axis=1)
    lines = np.flatnonzero(steps > 30)
    assert np.median(steps) <= 2 and 0 < len(lines) < 20  # the edges of three contours and of the grid
    assert pixels[60].min() > pixels[700].min() - 30 and pixels[60].sum() > pixels[700].sum() + 100  # light to dark


def test_a_few_draws_are_called_rough(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        prediction_report.output, "path_picture", lambda *given: seen.append(given[4]) or np.zeros((2, 2, 3), np.uint8)
    )
    for draws, is_rough in ((1, True), (4, True), (5, False)):
        report = SimpleNamespace(
            plan=SimpleNamespace(
                points=SimpleNamespace(distance_m=np.zeros(2)), terrain=SimpleNamespace(name="t"),
                settings={"camera": "c", "exposure_s": 1.0, "first_time_utc": "2030-01-01T00:00", "draws": draws,
                          "last_time_utc": "2030-01-01T00:00", "spacing_m": 10.0},
            ),
            cells={"radius95_m": np.ones(2), "p_ok": np.ones(2)},
        )  # fmt: skip
        prediction_report._picture(report)
        assert seen[-1][0].endswith(": rough") == is_rough
        assert ("1 draw every" in seen[-1][0]) == (draws == 1)
