"""The demonstration: one command from nothing to a report."""

from __future__ import annotations

import json
import webbrowser
from pathlib import Path

import numpy as np
import pytest

from startrack.cli.main import main


def test_the_demo_locates_its_own_picture_and_opens_the_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    assert main(["demo", "-D", str(tmp_path)]) == 0
    assert opened == [(tmp_path / "demo.report.html").resolve().as_uri()]
    fix = json.loads((tmp_path / "demo.fix.json").read_text())
    truth = json.loads((tmp_path / "demo.truth.json").read_text())["position_enu_m"]
    error = np.hypot(fix["position"]["east_m"] - truth[0], fix["position"]["north_m"] - truth[1])
    assert error < fix["position"]["radius999_m"]
    assert "the camera stood at E -6900 m, N 4700 m" in capsys.readouterr().out
    assert main(["demo", "-D", str(tmp_path), "--no-open", "-q"]) == 0  # again, over its own files
    assert len(opened) == 1
    assert capsys.readouterr().out == ""
