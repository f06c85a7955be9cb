"""The prior of the position on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from startrack.cli.main import main

SAMPLE = Path(__file__).parents[1] / "sample_images/near-wall.png"  # E -6900, N 4700


def test_near_is_in_the_posterior_and_a_wrong_one_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["locate", str(SAMPLE), "-D", str(tmp_path), "--no-plots", "--json", "--near"]
    assert main([*words, "-6900,4700,0.5"]) == 0
    fix = json.loads(capsys.readouterr().out)
    assert fix["provenance"]["near"] == "-6900,4700,0.5"
    assert fix["position"]["radius95_m"] < 1.5  # 3.5 without
    assert main([*words, "-6500,4700,30"]) == 3
    refused = json.loads(capsys.readouterr().out)
    assert refused["reason"] == "inconsistent_evidence"
    assert "--near -6500,4700,30" in refused["message"]


@pytest.mark.parametrize(
    ("words", "cause"),
    [(["--near", "1,2"], "EAST,NORTH,SIGMA"), (["--near", "1,2,0"], "not above 0"), (["--near", "1,x,3"], "'x'"),
     (["--near", "1,2,3", "--localizer", "hull"], "only --localizer posterior")],
)  # fmt: skip
def test_a_wrong_prior_is_wrong_usage(words: list[str], cause: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["locate", str(SAMPLE), *words])
    assert stop.value.code == 2
    assert cause in capsys.readouterr().err
