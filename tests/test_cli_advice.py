"""What to do next: after a refusal, and without a command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from startrack.cli.main import main
from startrack.errors import Reason, next_step

SAMPLE = str(Path(__file__).parents[1] / "sample_images/near-wall.png")


def test_startrack_alone_shows_where_to_start(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) == 5
    for word in ("locate", "calibrate", "identify", "demo", "--help"):  # three tasks, and where to see more
        assert any(f"startrack {word}" in line for line in shown)


def test_a_refusal_ends_with_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "no.png").write_bytes(b"no picture")
    words = ["locate", str(tmp_path / "no.png"), "-D", str(tmp_path / "out")]
    assert main(words) == 4
    assert capsys.readouterr().err == f"  next: {Reason.BAD_IMAGE.advice}\n"
    assert main([*words, "-q"]) == 4
    assert "next:" not in capsys.readouterr().err
    assert main([*words, "--json"]) == 4
    heard = capsys.readouterr()
    assert json.loads(heard.out)["advice"] == Reason.BAD_IMAGE.advice
    assert heard.err == ""


def test_a_solution_has_no_advice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", SAMPLE, "-D", str(tmp_path), "--json", "--no-plots"]) == 0
    assert "advice" not in json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("reason", list(Reason))
def test_advice_is_not_given_twice(reason: Reason) -> None:
    assert next_step(reason, "the file ends after 12 bytes") == reason.advice
    for message in ("no camera file is known: give -c FILE", "wrong terrain, time or camera file?", "see --time-sigma"):
        assert next_step(reason, message) == ""
