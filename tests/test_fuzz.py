"""Mutated input files give an answer or a refusal with a reason; `python -m tests.fuzz` tries many more."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from fuzz import campaign, targets
from fuzz.seeds import SIDECAR
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from startrack.camera import camera_from_dict, camera_to_dict, load_camera
from startrack.core.errors import BadInput
from startrack.exposure import read_exposure
from startrack.terrain import terrain_from_dict

RUNS, SEED = 60, 1
SHOWN = ("layers", "record")  # of results, of which a page shows what can be read


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz")
    targets.prepare(folder)
    return folder


@pytest.mark.parametrize("kind", targets.READERS)
def test_mutated_files_give_an_answer_or_a_reason(kind, folder, capfd):
    reasons = [targets.read(kind, *targets.mutated(kind, SEED, index), folder) for index in range(RUNS)]
    assert None in reasons
    assert sum(reason is not None for reason in reasons) > RUNS / 5 or kind in SHOWN
    assert "".join(capfd.readouterr()) == ""


# Values of all kinds that TOML and JSON can hold, and the numbers at which types end.
EDGES = st.sampled_from([0, -1, 2**31, 2**63, 2**64, 10**400, 1e308, -1e308, 5e-324, float("nan"), float("inf")])
SCALARS = st.one_of(EDGES, st.booleans(), st.integers(-1000, 1000), st.floats(), st.text(max_size=12))
VALUES = st.recursive(SCALARS, lambda part: st.lists(part, max_size=4) | st.dictionaries(st.text(max_size=6), part))
CAMERA = camera_to_dict(load_camera("fisheye-2048"))
CYLINDER = {
    "body": "moon", "origin": {"latitude_deg": -89.66, "longitude_deg": 129.78},
    "cylinder": {"diameter_m": 2e4, "depth_m": 2e3}, "search": {"radius_m": 1e4},
}  # fmt: skip
PATHS_OF = {
    "camera": [*CAMERA, "covariance", *(f"sensor.{key}" for key in CAMERA["sensor"])],
    "terrain": [*CYLINDER, "format", "name", "dem", "rover", "origin.latitude_deg", "cylinder.depth_m",
                "cylinder.diameter_sigma_m", "search.glare_deg", "search.max_slope_deg"],
}  # fmt: skip


def answer_of(read: Callable[[], Any], *reasons: str) -> Any:
    """What `read` returns; None where it refuses for one of the reasons, in one line."""
    try:
        return read()
    except BadInput as cause:
        refusal = cause
    assert refusal.reason in reasons
    assert str(refusal).isprintable()
    return None


def replace_key(file: dict, path: str, value: object) -> dict:
    """The file with one key, of a table as "table.key", set to a value."""
    table, _, key = path.rpartition(".")
    return file | ({table: file.get(table, {}) | {key: value}} if table else {key: value})


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(path=st.sampled_from(PATHS_OF["camera"]), value=VALUES)
def test_any_value_of_a_camera_file_is_used_or_refused(path, value):
    camera = answer_of(lambda: camera_from_dict(replace_key(CAMERA, path, value)), "bad_calibration")
    if camera is not None:
        assert camera_from_dict(camera_to_dict(camera)).size_px == camera.size_px


@settings(max_examples=60, deadline=None)
@given(path=st.sampled_from(PATHS_OF["terrain"]), value=VALUES)
def test_any_value_of_a_terrain_file_is_used_or_refused(path, value):
    terrain = answer_of(lambda: terrain_from_dict(replace_key(CYLINDER, path, value)), "bad_terrain")
    if terrain is not None:
        assert terrain.site.body in ("moon", "earth")


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(key=st.sampled_from(list(SIDECAR)), value=VALUES)
def test_any_value_of_a_sidecar_is_used_or_refused(folder, key, value):
    (folder / "sound.json").write_text(json.dumps({key: value}))
    exposure = answer_of(lambda: read_exposure(folder / "sound.png"), "bad_image", "no_time")
    if exposure is not None:
        assert all(warning.isprintable() for warning in exposure.warnings)


def test_each_kind_of_failure_is_counted():
    """Exceptions, ended processes, hangs and too much memory; the files after them are still tried."""
    outcome = campaign.run_campaign(campaign.SELF_TEST, 7, SEED, hang_s=5.0)
    assert (outcome.answers, outcome.refusals) == (2, 1)
    assert [crash["index"] for crash in outcome.crashes] == [2, 3]
    assert (outcome.hangs, outcome.above_cap) == ([4], [5])
    assert [found["index"] for found in outcome.above_bounds] == [6]


def test_access_outside_the_folder_is_seen(tmp_path):
    inside, outside = tmp_path / "inside", tmp_path / "outside.txt"
    inside.mkdir()
    with targets.no_access_beside(inside):
        (inside / "a.txt").write_text("a")
    with pytest.raises(targets.Broken, match=r"outside\.txt"), targets.no_access_beside(inside):
        outside.write_text("b")
    with pytest.raises(targets.Broken, match=r"outside\.txt"), targets.no_access_beside(inside):
        outside.read_text()
    with pytest.raises(targets.Broken, match=r"b\.txt"), targets.no_access_beside(tmp_path, written=(inside,)):
        (tmp_path / "b.txt").write_text("b")


def test_a_message_of_many_words_is_a_finding(folder, monkeypatch):
    def refuse(data, number, folder):
        raise BadInput("bad_image", 1000 * "word ")

    monkeypatch.setitem(targets.READERS, "png", refuse)
    with pytest.raises(targets.Broken, match="message"):
        targets.read("png", b"", 0, folder)


@pytest.mark.parametrize(("kind", "index"), [("tiff", 1356), ("elevation", 723), ("elevation", 1903)])
def test_mutated_files_that_once_failed_are_refused_or_read(folder, kind, index):
    """A compression of many numbers, posts 1e-304 m apart, and a map of 519 million posts in one piece."""
    assert targets.read(kind, *targets.mutated(kind, SEED, index), folder) in (None, "bad_image", "bad_terrain")
