"""A range of fields of view: steps without gaps, and the first that identifies the image."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from startrack.cli.flag_types import fields_of_view_rad
from startrack.cli.main import main
from startrack.core import FIELD_TOLERANCE_1

LOWELL = str(Path(__file__).parents[1] / "sample_images/lowell-2018-08-06.fits.bz2")  # 180 degrees


@pytest.mark.parametrize(("low", "high"), [(8.0, 20.0), (3.0, 280.0), (60.0, 60.0), (170.0, 175.0)])
def test_the_steps_leave_no_gap(low: float, high: float) -> None:
    tried = np.degrees(fields_of_view_rad(f"{low}..{high}", 3.0, 280.0))
    true = np.geomspace(low, high, 2000)
    nearest = np.abs(true[:, None] / tried - 1).min(axis=1)
    assert nearest.max() < FIELD_TOLERANCE_1 + 1e-9
    assert low * 0.9999999 <= tried[0] and tried[-1] <= high * 1.0000001


@pytest.mark.parametrize("text", ["20..8", "1..20", "8..", "..20", "8..x"])
def test_a_wrong_range_is_wrong_usage(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError):
        fields_of_view_rad(text, 3.0, 280.0)


@pytest.mark.parametrize("command", ["calibrate", "horizon --site=34,-111 -o a.csv"])
def test_a_range_where_one_number_counts_is_wrong_usage(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([*command.split(), LOWELL, "--fov", "150..200"])
    assert end.value.code == 2
    assert "'150..200': give one number; startrack identify takes MIN..MAX" in capsys.readouterr().err


@pytest.mark.slow
def test_a_photograph_is_identified_within_a_range(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["identify", LOWELL, "-D", str(tmp_path), "--no-plots", "--fov"]
    assert main([*words, "120..200", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["stars"]["identified"] > 300
    assert main([*words, "20..25"]) == 3
    assert "no lens of 20 to 25 degrees explains" in capsys.readouterr().out
