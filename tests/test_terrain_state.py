"""`startrack terrain state`: errors written into a terrain file, by flags, by answers, or listed."""

from __future__ import annotations

import json
import sys
import tomllib
from io import StringIO
from pathlib import Path

import pytest
from test_terrain_files import terrain_file

from startrack.cli.main import main
from startrack.core.types import BadInput
from startrack.terrain import load_terrain, state_errors, stateable_errors

PIT = """# My crater.
format = 1
body = "moon"   # of course

[origin]
latitude_deg = -89.0
longitude_deg = 0.0

[cylinder]  # surveyed
diameter_m = 9000.0
depth_m = 1600.0  # mean

# where to search
[search]
glare_deg = [
    [350.0, 10.0],
]
"""


class Keyboard:
    """A terminal with somebody who types the answers."""

    def __init__(self, *answers: str) -> None:
        self.answers = list(answers)

    def isatty(self) -> bool:
        return True

    def readline(self) -> str:
        return self.answers.pop(0) + "\n" if self.answers else ""


@pytest.fixture
def pit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "my pit.toml"
    path.write_text(PIT)
    monkeypatch.setattr(sys, "stdin", StringIO())
    return path


def state(path: Path, *flags: str) -> int:
    return main(["terrain", "state", str(path), *flags])


def test_flags_are_written_and_the_rest_stays(pit, capsys):
    flags = "--depth-sigma", "3.2", "--diameter-sigma", "0", "--ellipse-sigma", "1e-4", "--camera-height-sigma", "0.05"
    assert state(pit, *flags) == 0
    heard = capsys.readouterr().out
    assert "written   depth_sigma_m = 3.2" in heard and "left out  rim_tilt_sigma_deg" in heard
    text = pit.read_text()
    assert [line for line in text.splitlines() if "_sigma_" not in line and line != "[rover]"][:-1] == PIT.splitlines()
    at = text.splitlines().index("depth_m = 1600.0  # mean")
    assert text.splitlines()[at + 1] == "depth_sigma_m = 3.2"
    terrain = load_terrain(pit)
    assert (terrain.depth_sigma_m, terrain.diameter_sigma_m, terrain.ellipse_sigma_1) == (3.2, 0.0, 1e-4)
    assert (terrain.rim_tilt_sigma_rad, terrain.camera_height_sigma_m) == (None, 0.05)
    assert list(pit.parent.iterdir()) == [pit]


def test_an_exact_crater(pit, capsys):
    assert state(pit, "--exact", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown == {"format": "startrack.terrain/1", "file": str(pit), "stated": {"exact": True}, "unstated": []}
    assert all(error.is_stated and error.sigma == 0.0 for error in load_terrain(pit).errors.shape)
    assert state(pit) == 0
    assert "states every error" in capsys.readouterr().out


def test_without_a_terminal_the_missing_errors_are_listed(pit, capsys):
    assert state(pit) == 2
    heard = capsys.readouterr()
    assert "left out  depth_sigma_m, error of the depth [m]: 1.6, and with probability 1 % 16" in heard.out
    assert "rim_tilt_sigma_deg" in heard.out and "0.002, and with probability 0.5 % 0.1" in heard.out
    assert "--ellipse-sigma X" in heard.err
    assert pit.read_text() == PIT


def test_a_terminal_is_asked(pit, capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdin", Keyboard("3.2", "wide", "", "0.001"))
    assert state(pit) == 0
    cylinder = tomllib.loads(pit.read_text())["cylinder"]
    assert cylinder == {"diameter_m": 9000.0, "depth_m": 1600.0, "depth_sigma_m": 3.2, "ellipse_sigma_1": 0.001}
    heard = capsys.readouterr().out
    assert "diameter_sigma_m, error of the width [m] (left out: 9, and with probability 1 % 90)" in heard
    assert "'wide'" in heard
    monkeypatch.setattr(sys, "stdin", Keyboard())
    before = pit.read_text()
    assert state(pit) == 0
    assert pit.read_text() == before


@pytest.mark.parametrize(
    ("flags", "code", "named"),
    [
        (["--depth-sigma", "900"], 4, "depth_sigma_m must be below 800 m"),
        (["--exact", "--depth-sigma", "3"], 4, "exact is true, but depth_sigma_m is not 0"),
        (["--ellipse-sigma", "7"], 4, "ellipse_sigma_1 must be"), (["--stretch-sigma", "0.1"], 2, "another kind"),
        (["--depth-sigma", "-1"], 2, "negative"), (["--depth-sigma", "deep"], 2, "--depth-sigma"),
    ],
    ids=str,
)  # fmt: skip
def test_what_cannot_be_stated_leaves_the_file_alone(pit, capsys, flags, code, named):
    if code == 2:
        with pytest.raises(SystemExit) as leaving:
            state(pit, *flags)
        assert leaving.value.code == 2
    else:
        assert state(pit, *flags) == code
    assert named in capsys.readouterr().err
    assert pit.read_text() == PIT


def test_a_stated_error_is_not_replaced(pit, capsys):
    assert state(pit, "--depth-sigma", "3") == 0
    before = pit.read_text()
    assert state(pit, "--depth-sigma", "4") == 4
    assert "it states cylinder.depth_sigma_m already" in capsys.readouterr().err
    assert pit.read_text() == before
    assert state(pit.with_name("none.toml"), "--exact") == 4


def test_the_errors_of_a_map(tmp_path, capsys):
    path = terrain_file(tmp_path)
    assert state(path, "--horizon-sigma", "0.1", "--stretch-sigma", "0", "--vertical-sigma", "0.001", "-q") == 0
    assert capsys.readouterr().out == ""
    values = tomllib.loads(path.read_text())
    assert values["dem"] == {
        "file": "hill.tif", "height_sigma_m": 2.0, "horizon_sigma_deg": 0.1, "stretch_sigma_1": 0.0,
        "vertical_sigma_deg": 0.001,
    }  # fmt: skip
    assert state(path, "--exact") == 0
    assert tomllib.loads(path.read_text())["rover"] == {"camera_height_sigma_m": 0.0}
    assert not any(error.is_missing for error in stateable_errors(path.read_text()))


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_any_notation_of_tables_keeps_its_meaning(newline):
    text = PIT.replace("\n", newline)
    changed = state_errors(text, {("search", "radius_m"): 5.0, ("rover", "camera_height_sigma_m"): 0.1})
    values = tomllib.loads(changed)
    assert values["search"] == {"glare_deg": [[350.0, 10.0]], "radius_m": 5.0}
    assert values["rover"] == {"camera_height_sigma_m": 0.1}
    assert changed.count("\n") == changed.count(newline)
    assert state_errors("[dem]", {("dem", "stretch_sigma_1"): 0.0}) == "[dem]\nstretch_sigma_1 = 0.0\n"
    with pytest.raises(BadInput, match=r"write `depth_sigma_m = 1.0` into \[cylinder\] by hand"):
        state_errors("cylinder = {depth_m = 3.0}\n", {("cylinder", "depth_sigma_m"): 1.0})
