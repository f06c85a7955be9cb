"""Results of earlier runs that a batch keeps: the valid ones only."""

from __future__ import annotations

import json
import shutil
from datetime import datetime
from pathlib import Path

import jsonschema
import pytest
from astropy.table import Table
from batch_helpers import FACTS, frames, task_of

from startrack.applications.batch import locate_image
from startrack.chain import are_unchanged, input_hashes
from startrack.cli.main import main
from startrack.output import SCHEMAS
from startrack.terrain import ForwardingTerrain, TerrainFile, load_terrain

DEM = """
body = "moon"
origin = {latitude_deg = -89.66, longitude_deg = 129.78}
dem = {file = "heights.tif"}
"""


@pytest.mark.parametrize(("missing", "reason"), [("camera", "no_calibration"), ("terrain", "bad_terrain")])
def test_a_refused_image_is_repeated_when_the_missing_file_exists(tmp_path, missing, reason):
    (image,) = frames(tmp_path, 1)
    image.with_suffix(".json").write_text(json.dumps(FACTS | {missing: "later.toml"}))
    task = task_of(image, tmp_path)
    refused, _ = locate_image(task)
    assert refused["reason"] == reason
    assert locate_image(task) == (refused, True)
    (tmp_path / "later.toml").write_text("nothing = 1\n")
    assert not locate_image(task)[1]


def test_a_refused_image_is_repeated_when_the_missing_height_map_exists(tmp_path):
    (image,) = frames(tmp_path, 1)
    (tmp_path / "dem.toml").write_text(DEM)
    image.with_suffix(".json").write_text(json.dumps(FACTS | {"terrain": "dem.toml"}))
    task = task_of(image, tmp_path)
    assert locate_image(task)[0]["reason"] == "bad_terrain"
    assert locate_image(task)[1]
    (tmp_path / "heights.tif").write_bytes(b"heights")
    assert not locate_image(task)[1]


def test_a_terrain_of_any_class_says_which_files_it_was_read_from(tmp_path, monkeypatch):
    class Tiles(ForwardingTerrain):
        file = TerrainFile(paths=(tmp_path / "a.tile", tmp_path / "b.tile"))

    for file in Tiles.file.paths:
        file.write_bytes(b"heights")
    known = load_terrain("shackleton-thesis")
    monkeypatch.setattr("startrack.terrain.io.load_terrain", lambda path: Tiles(known))
    (image,) = frames(tmp_path, 1)
    hashes = input_hashes(str(image), [], str(tmp_path / "tiles.toml"))
    assert set(hashes) == {"tiles.toml", "a.tile", "b.tile"}
    assert are_unchanged(str(image), hashes)
    Tiles.file.paths[1].write_bytes(b"others")
    assert not are_unchanged(str(image), hashes)


def test_an_internal_error_is_always_tried_again(tmp_path):
    (image,) = frames(tmp_path, 1)
    task = task_of(image, tmp_path, time_utc=datetime(2030, 1, 1))
    record, kept = locate_image(task)
    assert record["reason"] == "internal_error"
    assert json.loads((tmp_path / "00.fix.json").read_text()) == record
    assert not kept
    assert not locate_image(task)[1]


def test_a_result_that_could_not_be_written_is_always_tried_again(tmp_path):
    (image,) = frames(tmp_path, 1)
    image = image.rename(tmp_path / f"{'n' * 243}.png")  # NAME.fix.json is a name, NAME.annotated.png is too long
    (tmp_path / "00.json").rename(image.with_suffix(".json"))
    task = task_of(image, tmp_path, plots=True)
    record, kept = locate_image(task)
    assert (record["reason"], kept) == ("bad_image", False)
    assert "cannot be written (File name too long)" in record["message"]
    assert not locate_image(task)[1]


def test_an_early_refusal_has_the_hash_of_its_file(tmp_path):
    (image,) = frames(tmp_path, 1)
    image.with_suffix(".json").write_text(json.dumps(FACTS | {"camera": "nowhere.toml"}))
    early, _ = locate_image(task_of(image, tmp_path))
    assert early["provenance"]["time_utc"].startswith("2030-01-01")
    image.write_bytes(image.read_bytes()[:200])
    broken, _ = locate_image(task_of(image, tmp_path))
    assert broken["reason"] == "bad_image"
    for record in (early, broken):
        assert len(record["provenance"]["image_sha256"]) == 64
        jsonschema.validate(record, SCHEMAS["fix"])
    assert early["provenance"]["image_sha256"] != broken["provenance"]["image_sha256"]


def test_a_tree_may_move_with_its_results(tmp_path):
    (image,) = frames(tmp_path / "here", 1)
    first, _ = locate_image(task_of(image, tmp_path / "here"))
    shutil.move(tmp_path / "here", tmp_path / "there")
    assert locate_image(task_of(tmp_path / "there" / image.name, tmp_path / "there")) == (first, True)
    (tmp_path / "there" / "small.toml").write_text((tmp_path / "there" / "small.toml").read_text() + "mirrored = true")
    assert not locate_image(task_of(tmp_path / "there" / image.name, tmp_path / "there"))[1]


def batch(*words: object) -> int:
    return main(["batch", *map(str, words), "-j", "1", "--no-plots", "-q"])


def test_a_batch_of_other_images_is_not_replaced_without_overwrite(tmp_path, capsys):
    frames(tmp_path / "monday", 2)
    frames(tmp_path / "tuesday", 2, level=120)
    out = tmp_path / "out"
    assert batch(tmp_path / "monday", "-D", out) == 5
    before = {path: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(SystemExit, match="2"):
        batch(tmp_path / "tuesday", "-D", out)
    assert "other images" in capsys.readouterr().err
    (tmp_path / "tuesday").rename(tmp_path / "names")
    for path in sorted((tmp_path / "names").glob("0*")):
        path.rename(path.with_name(f"tuesday-{path.name}"))
    with pytest.raises(SystemExit, match="2"):  # no result would be replaced, but the tables
        batch(tmp_path / "names", "-D", out)
    assert {path: path.read_bytes() for path in out.iterdir()} == before
    assert batch(tmp_path / "names", "-D", out, "-O") == 5
    assert (out / "results.ecsv").read_bytes() != before[out / "results.ecsv"]


@pytest.mark.slow
def test_a_folder_that_grew_or_changed_in_part_is_still_the_same(tmp_path):
    images, out = frames(tmp_path / "images", 3), tmp_path / "out"
    assert batch(tmp_path / "images", "-D", out) == 5
    images[0].write_bytes(images[1].read_bytes())
    images[2].rename(tmp_path / "images" / "03.png")
    assert batch(tmp_path / "images", "-D", out) == 5


def test_the_page_has_the_images_of_the_tables(tmp_path, capsys):
    images, out = frames(tmp_path / "images", 3), tmp_path / "out"
    assert batch(tmp_path / "images", "-D", out) == 5
    images[0].unlink()
    images[1].rename(images[1].with_name("renamed.png"))
    assert batch(tmp_path / "images", "-D", out) == 5
    assert main(["report", str(out), "-q"]) == 0
    assert "left out 2 results" in capsys.readouterr().err
    table = Table.read(out / "results.ecsv", format="ascii.ecsv")
    page = Path(out / "report.html").read_text()
    assert list(table["image"]) == ["02.png", "renamed.png"]
    assert [name in page for name in ("00.png", "01.png", "02.png", "renamed.png")] == [False, False, True, True]
