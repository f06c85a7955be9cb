"""benchmarks/map_against_ground.py: its draws are those that its files state, and its stages work on one frame."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from startrack.terrain import load_terrain

AZIMUTHS = np.linspace(0.0, 2 * np.pi, 360, endpoint=False)
DRAWS, PLACE_M = 60, np.array([500.0, 800.0])


@pytest.fixture
def benchmarks(monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path, str(Path(__file__).parent.parent / "benchmarks")])
    return importlib.import_module


@pytest.mark.parametrize("name", ["drawn-20", "posts-3km"])
def test_the_waves_of_drawn_errors_are_those_of_the_stated_files(benchmarks, monkeypatch, name):
    cases, stated = benchmarks("_ground_cases"), load_terrain("shackleton")
    crests = cases.crests_from(stated, PLACE_M, len(AZIMUTHS))
    monkeypatch.setattr(cases, "crests_from", lambda *other: crests)
    case = cases.cases_of(None)[name]
    grounds = [case.ground(stated, PLACE_M, np.random.default_rng(k)).terrain for k in range(DRAWS)]
    errors = np.degrees([ground.rise(AZIMUTHS) for ground in grounds])
    sigmas = case.waves_deg(stated)
    for number in (1, 2, 3, 4):
        parts = [errors @ wave(number * AZIMUTHS) * 2 / len(AZIMUTHS) for wave in (np.cos, np.sin)]
        assert np.sqrt(np.mean(np.square(parts))) == pytest.approx(sigmas[number - 1], rel=0.3)
    assert 0.022 < np.sqrt(np.mean(np.square(errors))) < 0.029


@pytest.mark.slow
def test_a_frame_is_rendered_located_and_counted(benchmarks, monkeypatch, tmp_path):
    one, cases = benchmarks("map_against_ground"), benchmarks("_ground_cases")
    faint = cases.Case(1, "shackleton-thesis", (0.07,), light_e=lambda view, rng: (0.1 * view.inside, {"light_e": 0.1}))
    monkeypatch.setattr(one, "cases_of", lambda reference: {"faint": faint})
    one.render_frame(("faint", 0, str(tmp_path), None))
    assert json.loads(one.truth_path(tmp_path, "faint", 0).read_text("utf-8"))["drawn"] == {"light_e": 0.1}
    row = one.locate_frame((str(tmp_path), "faint", 0, "shipped"))
    assert row["status"] == "ok"
    assert row["error_m"] == pytest.approx(np.hypot(*row["off_m"]))
    assert row["error_m"] < row["radius999_m"]
    line = one.summary("shipped", "faint", 0.07, [row, row | {"error_m": 2.5 * row["radius999_m"]}])
    assert line[:6] == ["faint", "7 %", "2", "2", "1", "1"]
