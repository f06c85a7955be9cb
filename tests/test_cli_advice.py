"""What to do next: after a refusal, and without a command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from startrack.cli.main import main
from startrack.core.errors import Reason, next_step

ACTIONS = {"calibrate": ("board", "verify", "show", "convert"), "terrain": ("show", "import", "build")}
SAMPLE = str(Path(__file__).parents[1] / "sample_images/near-wall.png")


def test_startrack_alone_shows_where_to_start(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) == 5
    for word in ("locate", "calibrate", "identify", "demo", "--help"):  # three tasks, and where to see more
        assert any(f"startrack {word}" in line for line in shown)


@pytest.mark.parametrize("command", ACTIONS)
def test_a_command_with_actions_alone_shows_them(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command]) == 2
    shown = capsys.readouterr()
    assert shown.err == "" and shown.out.startswith(f"usage: startrack {command} ")
    for action in ACTIONS[command]:
        assert f"startrack {command} {action} " in shown.out


def test_a_track_of_what_does_not_exist_names_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "nofolder"
    assert main(["track", str(path), "-D", str(tmp_path / "out")]) == 4
    (line, *_) = capsys.readouterr().err.splitlines()
    assert f"{path}: no such file or folder: give images, one folder of images, or one ROS bag" in line
    with pytest.raises(SystemExit) as end:
        main(["track", str(path), "--follow"])
    assert end.value.code == 2
    assert f"{path} is no folder" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_advice_on_several_positions_names_the_flag_that_chooses() -> None:
    assert "--near EAST,NORTH,SIGMA" in Reason.AMBIGUOUS.advice


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
