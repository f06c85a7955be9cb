"""Batches of images: finding, resuming, and equal tables for any division of the work."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from astropy.table import QTable
from jsonschema import ValidationError
from schema_helpers import check_printed_schema

from startrack.applications.batch import Task, images_under, listed_images, locate_image, write_tables
from startrack.camera import load_camera, save_camera
from startrack.catalog import load_catalog
from startrack.chain import Settings
from startrack.cli.main import main
from startrack.core.errors import BadInput
from startrack.exposure import write_exposure, write_sidecar
from startrack.localization import LOCALIZERS
from startrack.localization.thesis_methods import point_fix
from startrack.rendering import Series, render
from startrack.terrain import load_terrain

TABLES = ("results.ecsv", "results.parquet", "trajectory.tum", "manifest.json")


@pytest.fixture(scope="module")
def night(tmp_path_factory) -> Path:
    """Three small frames of one crater in a tree, a file that is no image, and files that a batch must not read."""
    root = tmp_path_factory.mktemp("night")
    camera = replace(
        load_camera("fisheye-2048"), name="small", size_px=(768, 768), focal_px=(244.0, 244.0), centre_px=(383.5, 383.5)
    )
    save_camera(camera, root / "small.toml")
    series = Series(
        camera=camera, terrain=load_terrain("shackleton-thesis"), catalog=load_catalog(), seed=3,
        faint_v_mag=None, hot_pixels=20, terrain_ref="shackleton-thesis",
    )  # fmt: skip
    for number, name in enumerate(("a 1.png", "späti/a 1.png", "späti/b.png")):
        path = root / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        scene, rng = replace(series, camera_ref=str(root / "small.toml")).scene(number, Path(name).stem)
        exposure, truth = render(scene, rng=rng)
        write_exposure(path, exposure)
        write_sidecar(path, exposure)
        (root / f"truth-{number}.json").write_text(json.dumps(truth.position_enu_m.tolist()))
    (root / "images" / "broken.png").write_bytes(b"not a picture")
    (root / "images" / "notes.txt").write_text("no picture either")
    (root / "images" / ".hidden.png").write_bytes(b"")
    return root


@pytest.fixture(scope="module")
def batch_output(night) -> Path:
    """The complete batch on one core."""
    out = night / "out"
    assert main(["batch", str(night / "images"), "-D", str(out), "-j", "1", "-q"]) == 5  # broken.png is not solved
    return out


def children(pid: int) -> list[int]:
    path = Path(f"/proc/{pid}/task/{pid}/children")  # Linux; elsewhere not checked
    return [int(one) for one in path.read_text().split()] if path.exists() else []


def is_alive(pid: int) -> bool:
    try:
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False


def tables(out: Path) -> dict[str, bytes]:
    return {name: (out / name).read_bytes() for name in TABLES}


def test_images_are_found_in_the_order_of_their_names(night):
    found = images_under(night / "images")
    assert [image.name for image in found] == ["a 1.png", "broken.png", "späti/a 1.png", "späti/b.png"]
    assert [image.stem for image in found] == ["a 1", "broken", "späti/a 1", "späti/b"]
    assert images_under(night / "images", night / "images" / "späti") == found[:2]
    with pytest.raises(BadInput, match="no such folder"):
        images_under(night / "nowhere")


def test_equal_stems_keep_their_suffix(tmp_path):
    for name in ("a.png", "a.tif", "b.fits.bz2", "b.jpg", "c.annotated.png", "c.skyline.png"):
        (tmp_path / name).touch()
    assert [image.stem for image in images_under(tmp_path)] == ["a.png", "a.tif", "b.fits.bz2", "b.jpg"]


def test_named_images_must_lie_in_the_folder(night, monkeypatch):
    named = listed_images(night / "images", ["späti/b.png\n", str(night / "images" / "a 1.png") + "\n", "\n"])
    assert [image.name for image in named] == ["a 1.png", "späti/b.png"]
    monkeypatch.chdir(night)  # as find and ls name them
    assert listed_images("images", ["images/späti/b.png\n", "./images/a 1.png\n"]) == listed_images(
        "images", ["späti/b.png", "a 1.png"]
    )
    with pytest.raises(BadInput, match="no file names came on standard input"):
        listed_images("images", ["\n"])
    with pytest.raises(BadInput, match="not an image under"):
        listed_images(night / "images", ["../small.toml"])


def test_the_tables_agree_with_the_results(night, batch_output):
    table = QTable.read(batch_output / "results.ecsv", format="ascii.ecsv")
    assert list(table["image"]) == ["a 1.png", "broken.png", "späti/a 1.png", "späti/b.png"]
    assert list(table["status"]) == ["ok", "refused", "ok", "ok"]
    parquet = pq.read_table(batch_output / "results.parquet").to_pydict()
    for number, row in enumerate((0, 2, 3)):
        truth = json.loads((night / f"truth-{number}.json").read_text())
        east, north = table["east_m"][row].to_value("m"), table["north_m"][row].to_value("m")
        assert np.hypot(east - truth[0], north - truth[1]) < table["radius999_m"][row].to_value("m")
        assert parquet["east_m"][row] == pytest.approx(east, abs=1e-4)
    assert parquet["east_m"][1] is None
    manifest = json.loads((batch_output / "manifest.json").read_text())
    records = [json.loads((batch_output / image["result"]).read_text()) for image in manifest["images"]]
    assert len({tuple(record) for record in records}) == 1  # the same keys, solved or refused
    assert [image["status"] for image in manifest["images"]] == ["ok", "refused", "ok", "ok"]
    check_printed_schema("manifest", {**manifest, "settings": {}})
    with pytest.raises(ValidationError, match="image_sha256"):
        check_printed_schema("manifest", {**manifest, "images": [{"image": "a.png", "result": None, "status": "ok"}]})
    assert str(night) not in (batch_output / "manifest.json").read_text() + (batch_output / "results.ecsv").read_text()


def test_the_trajectory_is_of_poses_in_the_order_of_time(batch_output):
    lines = np.loadtxt(batch_output / "trajectory.tum")
    assert lines.shape == (3, 8)
    assert np.all(np.diff(lines[:, 0]) > 0)
    np.testing.assert_allclose(np.linalg.norm(lines[:, 4:], axis=1), 1.0, atol=1e-8)


def records_in(out: Path) -> list[dict]:
    return [json.loads(path.read_text()) for path in sorted(out.rglob("*.fix.json"))]


def test_a_trajectory_holds_poses_above_one_terrain(batch_output, tmp_path):
    """Coordinates of different terrains have different origins: one file each."""
    records = records_in(batch_output)
    write_tables(tmp_path, records, {})
    assert (tmp_path / "trajectory.tum").read_bytes() == (batch_output / "trajectory.tum").read_bytes()
    first, *others = [record for record in records if record["status"] == "ok"]
    first["provenance"]["terrain"] = "/somewhere/other.toml"
    write_tables(tmp_path, records, {})
    assert sorted(path.name for path in tmp_path.glob("*.tum")) == [
        "trajectory-other.tum", "trajectory-shackleton-thesis.tum",
    ]  # fmt: skip
    assert len(np.loadtxt(tmp_path / "trajectory-other.tum", ndmin=2)) == 1
    assert len(np.loadtxt(tmp_path / "trajectory-shackleton-thesis.tum", ndmin=2)) == len(others)
    table = QTable.read(tmp_path / "results.ecsv", format="ascii.ecsv")
    assert {*table["terrain"][table["status"] == "ok"]} == {"other", "shackleton-thesis"}
    assert {*table["camera"][table["status"] == "ok"]} == {"small"}
    for record in (first, others[0]):  # files of one name and different content are different terrains
        record["provenance"]["terrain"] = f"/{record['image']}/t.toml"
        record["inputs"] = {"../t.toml": record["image"]}
    write_tables(tmp_path, [first, others[0]], {})
    assert {"trajectory-t.tum", "trajectory-t-2.tum"} <= {path.name for path in tmp_path.glob("*.tum")}


def test_parquet_is_written_with_the_extra_only(batch_output, tmp_path, monkeypatch):
    write_tables(tmp_path, records_in(batch_output), {})
    assert (tmp_path / "results.parquet").exists()
    monkeypatch.setattr("startrack.applications.batch.tables.find_spec", lambda name: None)
    write_tables(tmp_path, records_in(batch_output), {})
    assert not (tmp_path / "results.parquet").exists()  # the one of the earlier run would be out of date
    assert (tmp_path / "results.ecsv").exists()


class FixedPosition:
    """A user's own localizer."""

    def __call__(self, evidence, terrain):
        return point_fix(np.array([123.0, 45.0]), terrain)


def test_a_localizer_is_one_class_and_one_line_in_the_list(night, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(LOCALIZERS, "fixed", FixedPosition)
    image = night / "images" / "späti" / "b.png"
    task = Task("b.png", str(image), str(tmp_path / "b.fix.json"), plots=False)
    record, _ = locate_image(replace(task, settings=Settings(localizer="fixed")))
    assert (record["position"]["east_m"], record["position"]["north_m"]) == (123.0, 45.0)
    assert record["provenance"]["localizer"] == "fixed"
    assert record["position"]["dropped_probability"] is None
    assert locate_image(replace(task, settings=Settings(localizer="fixed"))) == (record, True)
    other, kept = locate_image(task)  # another localizer gives another result
    assert not kept
    assert other["position"]["east_m"] != 123.0
    assert main(["locate", str(image), "--localizer", "fixed", "-D", str(tmp_path), "--json", "--no-plots"]) == 0
    assert json.loads(capsys.readouterr().out)["position"]["east_m"] == 123.0


def test_batch_takes_a_localizer_by_name(night, tmp_path, capsys):
    command = ["batch", str(night / "images" / "späti"), "-D", str(tmp_path), "-j", "1", "-q", "--no-plots"]
    assert main([*command, "--localizer", "pseudo-gradient"]) == 0
    for record in records_in(tmp_path):
        assert record["position"]["radius95_m"] is record["position"]["covariance_m2"] is None
    table = QTable.read(tmp_path / "results.ecsv", format="ascii.ecsv")
    assert all(table[name].mask.all() for name in ("radius95_m", "radius999_m", "cov_east_east_m2"))
    assert json.loads((tmp_path / "manifest.json").read_text())["settings"]["localizer"] == "pseudo-gradient"
    with pytest.raises(SystemExit, match="2"):
        main([*command, "--localizer", "nobody"])
    assert "known are posterior, pseudo-gradient, hull" in capsys.readouterr().err


def test_several_processes_and_a_second_run_give_the_same_bytes(night, batch_output, capsys):
    out = night / "two"
    assert main(["batch", str(night / "images"), "-D", str(out), "-j", "2", "-q"]) == 5
    assert tables(out) == tables(batch_output)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.fix.json")}
    assert main(["batch", str(night / "images"), "-D", str(out), "-j", "2"]) == 5
    assert "(4 were there already)" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.fix.json")} == before


@pytest.mark.slow
def test_only_missing_or_incomplete_results_are_repeated(night, batch_output):
    out = night / "torn"
    shutil.copytree(batch_output, out)
    (out / "results.ecsv").unlink()
    (out / "späti" / "b.fix.json").write_text('{"format": "startrack.fix/1", "ima')
    kept = (out / "a 1.fix.json").stat().st_mtime_ns
    assert main(["batch", str(night / "images"), "-D", str(out), "-j", "1", "-q"]) == 5
    assert tables(out) == tables(batch_output)
    assert (out / "a 1.fix.json").stat().st_mtime_ns == kept


def test_a_changed_sidecar_or_flag_is_another_task(night, tmp_path):
    image = shutil.copy(night / "images" / "späti" / "b.png", tmp_path / "b.png")
    task = Task(name="b.png", path=str(image), result=str(tmp_path / "b.fix.json"), facts={}, plots=False)
    sidecar = json.loads((night / "images" / "späti" / "b.json").read_text()) | {"camera": str(night / "small.toml")}
    (tmp_path / "b.json").write_text(json.dumps(sidecar))
    first, kept = locate_image(task)
    assert first["status"] == "ok" and not kept
    assert locate_image(task) == (first, True)
    (tmp_path / "b.json").write_text(json.dumps({**sidecar, "time_utc": "2030-01-01T00:00:00Z"}))
    assert not locate_image(task)[1]
    (tmp_path / "b.json").unlink()
    refused, kept = locate_image(task)
    assert not kept
    assert (refused["status"], refused["reason"]) == ("refused", "no_calibration")


@pytest.mark.slow
def test_dask_with_a_killed_worker_equals_the_local_run(night, batch_output, monkeypatch):
    distributed = pytest.importorskip("distributed")
    out, killed = night / "dask", []
    with distributed.LocalCluster(2, processes=True, threads_per_worker=1, dashboard_address=None) as cluster:

        def kill_a_busy_worker() -> None:
            with distributed.Client(cluster.scheduler_address) as client:
                while not (busy := [address for address, tasks in client.processing().items() if tasks]):
                    time.sleep(0.01)
                pids = client.run(os.getpid)
                killed.append(pids[busy[0]])
            os.kill(killed[0], signal.SIGKILL)

        killer = threading.Thread(target=kill_a_busy_worker)
        killer.start()
        monkeypatch.chdir(night)  # the workers run in another folder
        command = ["batch", "images", "-D", out.name, "-q", "--cluster", cluster.scheduler_address]
        assert main(command) == 5
        killer.join()
    assert killed
    assert tables(out) == tables(batch_output)


@pytest.mark.slow
def test_a_batch_killed_at_any_time_is_resumed(night, batch_output):
    out, command = night / "killed", [sys.executable, "-m", "startrack.cli.main", "batch", str(night / "images"), "-q"]
    for results in (1, 2):
        process = subprocess.Popen([*command, "-D", str(out), "-j", "2"])
        while process.poll() is None and len(list(out.rglob("*.fix.json"))) < results:
            time.sleep(0.01)
        workers = children(process.pid)
        process.kill()
        process.wait()
        for _ in range(100):
            if not any(map(is_alive, workers)):
                break
            time.sleep(0.1)
        assert not any(map(is_alive, workers))  # no worker is left when the run is resumed
    assert main(["batch", str(night / "images"), "-D", str(out), "-j", "2", "-q"]) == 5
    assert tables(out) == tables(batch_output)
