"""Solutions of a batch stay until an equally good result replaces them; its tables never mix settings or contents."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from astropy.table import Table
from batch_helpers import frames, stdin_of

from startrack.applications.batch import stored_record
from startrack.cli.main import main

ROOT = Path(__file__).parent.parent
SOLVED = "00.png"  # of three images; the others are of the lens cap


@pytest.fixture(scope="module")
def batch_done(tmp_path_factory) -> Path:
    """A folder of three images, one of them solved, with its results; the camera file lies beside the folder."""
    root = tmp_path_factory.mktemp("solutions")
    images = frames(root / "images", 3)
    shutil.copy(ROOT / "calib" / "fisheye-2048.toml", root / "camera.toml")
    shutil.copy(ROOT / "sample_images" / "near-centre.png", images[0])
    images[0].with_suffix(".json").write_text(json.dumps({"camera": "../camera.toml"}))
    assert batch(root) == 5
    assert stored_record(root / "out" / "00.fix.json")["status"] == "ok"
    return root


@pytest.fixture
def folder(batch_done, tmp_path) -> Path:
    """A copy of it for destructive changes."""
    return Path(shutil.copytree(batch_done, tmp_path / "copy"))


def batch(root: Path, *flags: object) -> int:
    return main(["batch", str(root / "images"), "-D", str(root / "out"), "-j", "1", *map(str, flags)])


def files(root: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (root / "out").glob("00.*")}


def table(root: Path) -> dict[str, str]:
    rows = Table.read(root / "out" / "results.ecsv", format="ascii.ecsv")
    return dict(zip(rows["image"], rows["status"], strict=True))


def result_in_manifest(root: Path) -> str | None:
    return json.loads((root / "out" / "manifest.json").read_text())["images"][0]["result"]


@pytest.mark.parametrize("flags", [("-c", "nowhere.toml"), ("-t", "nowhere.toml"), ("-c", "no-such-name")])
def test_files_of_flags_are_read_before_anything_changes(folder, capsys, flags):
    before = {path: path.read_bytes() for path in (folder / "out").iterdir()}
    assert batch(folder, *flags) == 4
    assert flags[1] in capsys.readouterr().err
    assert {path: path.read_bytes() for path in (folder / "out").iterdir()} == before


def lose_the_camera(folder: Path) -> None:
    (folder / "camera.toml").unlink()


def lose_the_sidecar(folder: Path) -> None:
    (folder / "images" / "00.json").write_text("{")


def break_the_image(folder: Path) -> None:
    (folder / "images" / SOLVED).write_bytes(b"not a picture")


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [lose_the_camera, lose_the_sidecar, break_the_image])
@pytest.mark.parametrize("flags", [(), ("-O",)])
def test_an_unusable_input_keeps_the_earlier_solution(folder, capsys, spoil, flags):
    before = files(folder)
    spoil(folder)
    assert batch(folder, *flags) == 5
    assert "1 earlier result kept, and left out of the tables" in capsys.readouterr().err
    assert files(folder) == before
    assert table(folder)[SOLVED] == "refused"
    assert result_in_manifest(folder) is None


def test_a_restored_input_reuses_its_solution(folder, capsys):
    camera = (folder / "camera.toml").read_bytes()
    lose_the_camera(folder)
    assert batch(folder) == 5
    (folder / "camera.toml").write_bytes(camera)
    capsys.readouterr()
    assert batch(folder) == 5
    assert "(3 were there already)" in capsys.readouterr().out
    assert (table(folder)[SOLVED], result_in_manifest(folder)) == ("ok", "00.fix.json")


def test_a_refusal_for_lack_of_stars_replaces_a_solution(folder):
    shutil.copy(folder / "images" / "01.png", folder / "images" / SOLVED)
    shutil.copy(folder / "images" / "01.json", folder / "images" / "00.json")
    assert batch(folder) == 5
    assert stored_record(folder / "out" / "00.fix.json")["reason"] == "no_stars"
    assert [name for name in files(folder) if name.endswith(("ecsv", "wcs", "corr"))] == []


@pytest.mark.parametrize("end", ["stars.ecsv", "skyline.ecsv", "skyline.png", "annotated.png", "wcs", "corr"])
def test_a_solution_without_one_of_its_files_is_incomplete(folder, end):
    from startrack.applications.batch.task import has_companions

    record, result = stored_record(folder / "out" / "00.fix.json"), folder / "out" / "00.fix.json"
    assert has_companions(record, result, plots=True)
    (folder / "out" / f"00.{end}").unlink()
    assert not has_companions(record, result, plots=True)
    assert has_companions(record, result, plots=False) == end.endswith(".png")


def test_the_tables_hold_one_kind_of_settings(folder, capsys, monkeypatch):
    """A run of one image with another flag: the other images' results were made without it."""
    monkeypatch.setattr("sys.stdin", stdin_of("01.png"))
    assert batch(folder, "--exposure", "2", "--files-on-stdin") == 5
    assert "2 results of other settings or contents left out" in capsys.readouterr().err
    assert table(folder) == {"01.png": "refused"}


def test_the_tables_hold_what_the_images_hold_now(folder, capsys, monkeypatch):
    shutil.copy(folder / "images" / "02.png", folder / "images" / SOLVED)
    monkeypatch.setattr("sys.stdin", stdin_of("01.png"))
    assert batch(folder, "--files-on-stdin") == 5
    assert "1 result of other settings or contents left out" in capsys.readouterr().err
    assert table(folder) == {"01.png": "refused", "02.png": "refused"}


def test_a_run_of_some_images_gives_the_tables_of_all(folder, monkeypatch):
    before = table(folder)
    monkeypatch.setattr("sys.stdin", stdin_of("01.png"))
    assert batch(folder, "--files-on-stdin") == 5
    assert table(folder) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    "text", ['{"foo": 1}', '{"image": "01.png", "status": "ok", "reason": null}', "[]", '{"image": 1, "status": {}}']
)
def test_incomplete_records_are_not_used(folder, monkeypatch, text):
    result = folder / "out" / "01.fix.json"
    result.write_text(text)
    assert stored_record(result) is None
    monkeypatch.setattr("sys.stdin", stdin_of("02.png"))
    assert batch(folder, "--files-on-stdin") == 5
    assert list(table(folder)) == [SOLVED, "02.png"]
    assert batch(folder) == 5
    assert stored_record(result)["reason"] == "no_stars"


WRONG_VALUES = [
    ("stars.detected", "many"), ("stars.identified", 10**400), ("stars", 3), ("timing_ms.detect", []),
    ("timing_ms", [1]), ("position.east_m", "0"), ("position.covariance_m2", [1]), ("provenance.time_utc", "noon"),
    ("provenance.camera", 1), ("attitude.quat_xyzw_body_enu", None), ("attitude.sigma_arcsec", {}), ("reason", "text"),
    ("reason", []), ("message", None), ("message", 1), ("warnings", 1), ("warnings", [1]),
    ("search", 3), ("search.outcome", 1),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value"), WRONG_VALUES)
def test_a_record_with_a_value_of_another_kind_is_not_used(batch_done, tmp_path, path, value):
    record = json.loads((batch_done / "out" / "00.fix.json").read_text())
    part, _, key = path.rpartition(".")
    (record[part] if part else record)[key] = value
    result = tmp_path / "00.fix.json"
    result.write_text(json.dumps(record))
    assert stored_record(result) is None


@pytest.mark.slow
def test_an_image_whose_record_was_changed_by_hand_is_located_again(folder, capsys):
    result = folder / "out" / "00.fix.json"
    before = json.loads(result.read_text())
    result.write_text(json.dumps(before | {"timing_ms": {"detect": ""}, "reason": "text"}))
    assert batch(folder, "-v") == 5
    assert "internal error" not in "".join(capsys.readouterr())
    assert json.loads(result.read_text())["position"] == before["position"]


def test_warnings_are_counted_and_shown_with_verbose(folder, capsys):
    sidecar = folder / "images" / "01.json"
    sidecar.write_text(json.dumps(json.loads(sidecar.read_text()) | {"exposuer_s": 1.0}))
    assert batch(folder) == 5
    streams = capsys.readouterr()
    assert "; 1 with warnings (-v shows them)" in streams.out
    assert "exposuer_s" not in streams.err
    assert batch(folder, "-v") == 5
    assert "01.png: sidecar 01.json: key 'exposuer_s'" in capsys.readouterr().err


def test_results_whose_search_proved_nothing_are_counted(folder, capsys):
    result = folder / "out" / "00.fix.json"
    assert batch(folder) == 5
    assert "beam" not in capsys.readouterr().out
    record = json.loads(result.read_text())
    result.write_text(json.dumps(record | {"search": record["search"] | {"outcome": "beam"}}))
    assert batch(folder) == 5
    assert "; 1 with search: beam, not proven; tables in" in capsys.readouterr().out.splitlines()[-1]
