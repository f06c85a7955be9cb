"""The images of a batch for every layout and list, and the names of their results."""

from __future__ import annotations

import json
import os

import cv2
import pytest
from astropy.table import Table
from batch_helpers import frames, stdin_of, task_of
from earth_helpers import jacksboro

from startrack.applications.batch import images_under, locate_image
from startrack.applications.batch.find import result_stems
from startrack.cli.main import main
from startrack.core.types import BadInput
from startrack.exposure import read_exposure
from startrack.terrain import write_map


def names(folder, *apart) -> list[str]:
    return [image.name for image in images_under(folder, *apart)]


@pytest.mark.parametrize(
    ("images", "stems"),
    [
        (["a.fits", "a.png", "a.png-2.png", "a.png.png"], ["a.fits", "a.png", "a.png-2", "a.png-3"]),
        (["a.png", "b/a.png", "a.png-2.png"], ["a.png", "a.png-3", "a.png-2"]),
        (["a.png", "b.png"], ["a", "b"]),
        (["a.png"] * 3, ["a.png", "a.png-2", "a.png-3"]),
    ],
)
def test_no_two_results_have_one_name(images, stems):
    assert result_stems(images) == stems


def test_links_to_folders_are_followed_once_and_without_loops(tmp_path):
    root, elsewhere = tmp_path / "images", tmp_path / "elsewhere"
    for folder in (root / "day", root / ".hidden", elsewhere / "deep"):
        frames(folder, 1)
    for link, target in {
        "linked": elsewhere,
        "linked-again": elsewhere,
        "day-again": root / "day",
        "loop": root,
        "up": tmp_path,
    }.items():
        (root / link).symlink_to(target)
    (elsewhere / "back").symlink_to(elsewhere)
    assert names(root) == ["day/00.png", "linked/deep/00.png"]
    assert names(root, elsewhere) == ["day/00.png"]


def test_a_pipe_is_no_image_and_a_link_to_nothing_is_one(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "linked-pipe.png").symlink_to(tmp_path / "pipe.png")
    (tmp_path / "nothing.png").symlink_to(tmp_path / "gone.png")
    (tmp_path / "itself.png").symlink_to(tmp_path / "itself.png")
    (tmp_path / "folder.png").mkdir()
    assert names(tmp_path) == ["itself.png", "nothing.png"]
    assert locate_image(task_of(tmp_path / "pipe.png", tmp_path))[0]["reason"] == "bad_image"


@pytest.mark.slow
@pytest.mark.parametrize("end", ["\n", "\0"])
def test_an_image_deleted_during_the_run_is_refused_alone(tmp_path, monkeypatch, end):
    frames(tmp_path / "images", 2)
    monkeypatch.setattr("sys.stdin", stdin_of("00.png", "gone.png", "gone.png", "gone.fits", end=end))
    out = str(tmp_path / "out")
    assert main(["batch", str(tmp_path / "images"), "-D", out, "--files-on-stdin", "-j", "1", "--no-plots", "-q"]) == 5
    table = Table.read(tmp_path / "out" / "results.ecsv", format="ascii.ecsv")
    assert dict(zip(table["image"], table["reason"], strict=True)) == {
        "00.png": "no_stars", "gone.fits": "bad_image", "gone.png": "bad_image",
    }  # fmt: skip


def test_one_time_is_not_given_to_many_images(tmp_path, capsys):
    images = frames(tmp_path / "images", 2)
    command = ["batch", str(tmp_path / "images"), "-D", str(tmp_path / "out"), "-j", "1", "--no-plots", "-q"]
    with pytest.raises(SystemExit, match="2"):
        main([*command, "--time", "2031-03-26T20:58:11Z"])
    assert "--time is of one image" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    images[1].unlink()
    assert main([*command, "--time", "2031-03-26T20:58:11Z"]) == 5
    record = json.loads((tmp_path / "out" / "00.fix.json").read_text())
    assert record["provenance"]["time_utc"].startswith("2031-03-26T20:58:11")


def test_a_file_in_place_of_the_folder_is_named(tmp_path):
    (tmp_path / "one.png").write_bytes(b"")
    with pytest.raises(BadInput, match=r"one\.png: is a file, not a folder"):
        images_under(tmp_path / "one.png")
    with pytest.raises(BadInput, match="nothing: no such folder"):
        images_under(tmp_path / "nothing")


def test_no_folder_of_results_is_made_for_no_images(tmp_path):
    (tmp_path / "empty").mkdir()
    for folder in ("nope", "empty"):
        assert main(["batch", str(tmp_path / folder), "-D", str(tmp_path / "out"), "-q"]) == 4
    assert not (tmp_path / "out").exists()


def test_a_sidecar_in_capitals_counts_where_there_is_no_other(tmp_path):
    (image,) = frames(tmp_path, 1)
    small, capital = image.with_suffix(".json"), image.with_suffix(".JSON")
    facts = json.loads(small.read_text())
    capital.write_text(json.dumps(facts | {"exposure_s": 2.0}))
    assert read_exposure(image).exposure_s == 1.0
    small.unlink()
    assert read_exposure(image).exposure_s == 2.0
    task = task_of(image, tmp_path)
    assert [locate_image(task)[1], locate_image(task)[1]] == [False, True]
    capital.write_text(json.dumps(facts | {"exposure_s": 3.0}))
    assert not locate_image(task)[1]


def test_a_height_map_in_the_folder_is_left_out_and_named(tmp_path, capsys):
    """The picture beside it is a TIFF too, and a file with a map's suffix that is none is refused as an image."""
    images = tmp_path / "images"
    (image,) = frames(images, 1)
    (images / "a.tif").write_bytes(cv2.imencode(".tif", cv2.imread(str(image), cv2.IMREAD_UNCHANGED))[1].tobytes())
    (images / "a.json").write_text(image.with_suffix(".json").read_text())
    (images / "broken.tif").write_bytes(b"II*\0")
    write_map(images / "valley-1.tif", jacksboro())
    command = ["batch", str(images), "-D", str(tmp_path / "out"), "-j", "1", "--no-plots"]
    assert main(command) == 5
    shown = capsys.readouterr()
    assert "valley-1.tif: left out, a height map (GeoTIFF)\n" in shown.err
    assert shown.out.startswith("3 images: 3 refused")
    for name in ("a.tif", "broken.tif", image.name):
        (images / name).unlink()
    assert main(command) == 4
    assert "no PNG, TIFF" in capsys.readouterr().err


def test_an_image_whose_result_has_too_long_a_name_is_refused_alone(tmp_path, capsys):
    """File systems take names of 255 bytes."""
    (image,) = frames(tmp_path / "images", 1)
    image.rename(image.with_name(f"{250 * 'y'}.png"))
    words = ["batch", str(tmp_path / "images"), "-D", str(tmp_path / "out"), "-j", "1", "--no-plots"]
    assert main(words) == 5
    assert "File name too long" in capsys.readouterr().err
    (row,) = Table.read(tmp_path / "out" / "results.ecsv", format="ascii.ecsv")
    assert row["status"] == "refused"
