"""The JSON schemas: valid files fit them, changed ones do not, and they contain every key."""

from __future__ import annotations

import json
import tomllib
from copy import deepcopy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from jsonschema import Draft202012Validator, ValidationError
from schema_helpers import unknown_keys
from stage_helpers import as_stage

from startrack.camera import camera_to_dict
from startrack.chain import detect
from startrack.chain.stages import Measured, Oriented, Refused
from startrack.cli.main import main
from startrack.core.files import data_dir
from startrack.core.types import Mode
from startrack.exposure import write_sidecar
from startrack.output import SCHEMAS, refused_dict, result_dict
from startrack.rendering import write_truth

FILES = {"fix": "fix", "identification": "identification", "detection": "detections"}  # schema to NAME.KIND.json


def fits_schema(kind, value):
    Draft202012Validator(SCHEMAS[kind], format_checker=Draft202012Validator.FORMAT_CHECKER).validate(value)


def results(result):
    two = (Mode(east_m=1.0, north_m=2.0, weight=0.6), Mode(east_m=3.0, north_m=4.0, weight=0.4))
    ambiguous = replace(result, fix=replace(result.fix, modes=two, ambiguous=True))
    refused = Refused(reason="inconsistent_evidence", message="no", reached=as_stage(result, Measured))
    yield from (("fix", result_dict(r)) for r in (result, ambiguous, refused))
    yield "identification", result_dict(as_stage(result, Oriented, terrain=None), "identification")
    yield "detection", result_dict(result, "detections")
    yield from ((kind, refused_dict("a.png", "bad_image", "no", file)) for kind, file in FILES.items())


@pytest.mark.parametrize("kind", FILES)
def test_solved_and_refused_records_have_the_same_keys(located, kind):
    """Also within the sections that are there; lists are empty, not null."""
    flat = replace(located.result.exposure, pixels_adu=np.full((1024, 1024), 300.0, dtype=np.float32))
    file = FILES[kind]
    make = partial(result_dict, kind=file)
    solved = make(located.result)
    others = [
        make(detect(flat, located.result.camera)),
        make(Refused(reason="no_time", message="no", reached=as_stage(located.result, Oriented, terrain=None))),
        *(refused_dict("a.png", reason, "no", file) for reason in ("bad_image", "internal_error")),
    ]
    for other in others:
        fits_schema(kind, other)
        assert list(other) == list(solved)
        for key, value in solved.items():
            if isinstance(value, list):
                assert isinstance(other[key], list)
            elif isinstance(value, dict):
                assert other[key] is None or list(other[key]) == list(value)
    assert others[-1]["provenance"]["version"] == solved["provenance"]["version"]
    assert others[-1]["advice"] and solved["advice"] is None


def test_refusals_of_earlier_versions_fit():
    old = {"format": "startrack.fix/1", "image": "a.png", "status": "refused", "reason": "bad_image", "message": "no"}
    fits_schema("fix", old)
    fits_schema("fix", old | {"advice": "correct it"})


@pytest.mark.parametrize("kind", SCHEMAS)
def test_each_schema_is_one(kind):
    Draft202012Validator.check_schema(SCHEMAS[kind])
    assert json.loads(json.dumps(SCHEMAS[kind])) == SCHEMAS[kind]


def test_results_fit_and_have_no_key_that_the_schema_does_not_name(located):
    for kind, record in results(located.result):
        fits_schema(kind, record)
        fits_schema(kind, json.loads(json.dumps(record)))
        assert unknown_keys(record, SCHEMAS[kind]) == []


SPOILED = [
    ("fix", lambda d: d.pop("position"), "'position' is a required property"),
    ("fix", lambda d: d.update(position=None), "None is not of type 'object'"),
    ("fix", lambda d: d.update(advice="expose longer"), "None was expected"),
    ("fix", lambda d: d.update(status="refused", reason="no_stars"), "None was expected"),
    ("fix", lambda d: d.update(reason="no_stars"), "None was expected"),
    ("fix", lambda d: d.update(status="solved"), "is not one of"),
    ("fix", lambda d: d["position"].update(east_m=None), "is not of type 'number'"),
    ("fix", lambda d: d["position"].update(covariance_m2=[[1.0, 0.0]]), "is too short"),
    ("fix", lambda d: d["attitude"].update(heading_deg=360.0), "360"),
    ("fix", lambda d: d["stars"].pop("unexplained"), "'unexplained' is a required property"),
    ("fix", lambda d: d["provenance"].pop("image_sha256"), "'image_sha256' is a required property"),
    ("identification", lambda d: d["matches"][0].update(hip=0), "not valid under any"),
    ("identification", lambda d: d["camera"].pop("focal_px"), "'focal_px' is a required property"),
    ("detection", lambda d: d["detections"][0].pop("snr"), "'snr' is a required property"),
    ("detection", lambda d: d.update(format="startrack.fix/1"), "was expected"),
]


@pytest.mark.parametrize(("kind", "spoil", "message"), SPOILED)
def test_a_spoiled_result_does_not_fit(located, kind, spoil, message):
    record = deepcopy(result_dict(located.result, FILES[kind]))
    fits_schema(kind, record)
    spoil(record)
    with pytest.raises(ValidationError, match=message):
        fits_schema(kind, record)


def test_no_position_where_several_positions_fit(located):
    records = [record for kind, record in results(located.result) if kind == "fix" and not record["position"]]
    for record in records:
        with pytest.raises(ValidationError):
            fits_schema("fix", {**record, "position": result_dict(located.result)["position"]})
    assert {record["status"] for record in records} == {"ambiguous", "refused"}


def test_shipped_cameras_and_terrains_fit():
    for kind, folder in (("camera", "calib"), ("terrain", "terrain")):
        files = sorted(data_dir(folder).glob("*.toml"))
        assert files
        for path in files:
            value = tomllib.loads(path.read_text(encoding="utf-8"))
            fits_schema(kind, value)
            assert unknown_keys(value, SCHEMAS[kind]) == []


def test_written_cameras_sidecars_and_truths_fit(located, tmp_path):
    fits_schema("camera", camera_to_dict(located.result.camera))
    sidecar = write_sidecar(tmp_path / "a.png", located.result.exposure)
    fits_schema("sidecar", json.loads(sidecar.read_text(encoding="utf-8")))
    pose, _ = write_truth(tmp_path / "a.png", located.truth, {"seed": 7}, to_v_mag=5.0)
    fits_schema("truth", json.loads(pose.read_text(encoding="utf-8")))


def test_the_record_of_a_refused_horizon_fits(tmp_path, capsys):
    assert main(["horizon", str(tmp_path / "none.png"), "-o", str(tmp_path / "a.csv"), "--json"]) == 4
    fits_schema("horizon", json.loads(capsys.readouterr().out))


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("camera", "size_px = [2048, 2048]\nfocal_px = [652.0, 0.0]\ncentre_px = [1, 1]\nmax_angle_deg = 92"),
        ("camera", "size_px = [2048, 2048]\nfocal_px = [652, 652]\ncentre_px = [1, 1]\nmax_angle_deg = 92\nk = 'none'"),
        (
            "terrain",
            "body = 'mars'\n[origin]\nlatitude_deg = 1\nlongitude_deg = 2\n[cylinder]\ndiameter_m=1\ndepth_m=1",
        ),
        ("terrain", "body = 'moon'\n[origin]\nlatitude_deg = 1\nlongitude_deg = 2"),
        ("sidecar", "exposure_s = -1"),
    ],
)
def test_wrong_files_do_not_fit(kind, text):
    with pytest.raises(ValidationError):
        fits_schema(kind, tomllib.loads(text))
