"""What to do next: after a refusal, and without a command."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest

from startrack.cli.console import print_outcome
from startrack.cli.main import main
from startrack.core.errors import Reason, next_step

ACTIONS = {"calibrate": ("board", "verify", "show", "convert"), "terrain": ("show", "import", "build")}
LOWELL = str(Path(__file__).parents[1] / "sample_images/lowell-2018-08-06.fits.bz2")  # 180 degrees, on the Earth
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


def test_of_a_missing_file_a_similar_name_is_the_advice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "night-12.png").write_bytes(b"no picture")
    (tmp_path / "crater.toml").write_text("")
    out = ["-D", str(tmp_path / "out")]
    assert main(["locate", str(tmp_path / "other.png"), *out]) == 4
    advice = "  next: Check the name and the folder of the file.\n"
    assert capsys.readouterr() == ("other.png  refused  bad_image: No such file\n", advice)
    assert main(["locate", str(tmp_path / "nigth-12.png"), *out]) == 4
    heard = capsys.readouterr()
    assert heard == ("nigth-12.png  refused  bad_image: No such file: is night-12.png meant?\n", "")
    assert main(["terrain", "show", str(tmp_path / "cratr.toml")]) == 4
    assert capsys.readouterr().err.endswith("cratr.toml: No such file: is crater.toml meant?\n")
    (tmp_path / "link.png").symlink_to(tmp_path / "nowhere")
    assert main(["locate", str(tmp_path / "link.png"), *out]) == 4
    assert "No such file\n" in capsys.readouterr().out


def test_a_solution_has_no_advice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", SAMPLE, "-D", str(tmp_path), "--json", "--no-plots"]) == 0
    assert json.loads(capsys.readouterr().out)["advice"] is None


@pytest.mark.parametrize("reason", list(Reason))
def test_advice_is_not_given_twice(reason: Reason) -> None:
    assert next_step(reason, "the file ends after 12 bytes") == reason.advice
    for message in ("no camera file is known: give -c FILE", "wrong terrain, time or camera file?", "see --time-sigma"):
        assert next_step(reason, message) == ""


def test_a_wrong_field_of_view_is_advised_to_try_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", LOWELL, "--fov", "90", "-o", str(tmp_path / "c.toml"), "--no-plots"]) == 3
    heard = capsys.readouterr()
    assert "if the field of view may be another, try startrack identify --fov 40.5..198" in heard.out
    assert "camera file may be" not in heard.out + heard.err and "next:" not in heard.err


def test_identify_without_a_camera_file_names_the_flag_that_needs_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sky.fits.bz2").write_bytes(Path(LOWELL).read_bytes())
    assert main(["identify", str(tmp_path / "sky.fits.bz2"), "-D", str(tmp_path)]) == 4
    assert "give -c FILE, a sidecar with camera, or --fov DEG" in capsys.readouterr().out


def test_a_lens_found_differs_from_no_file_and_leads_to_calibrate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["identify", LOWELL, "--fov", "180", "-D", str(tmp_path), "--no-plots"]) == 0
    heard = capsys.readouterr()
    assert "differs from the camera file" not in heard.err
    assert "startrack calibrate IMAGE --fov 180 --site LAT,LON -o CAMERA.toml" in heard.out


def test_calibrate_names_the_path_of_the_camera_and_the_air_in_its_lens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["calibrate", LOWELL, "--fov", "180", "-D", str(tmp_path), "--no-plots"]
    assert main(words) == 0
    heard = capsys.readouterr()
    assert heard.out.startswith(f"{tmp_path / 'camera.toml'}  ok  ")
    assert "the refraction of the air is in the lens: give --site" in heard.err
    assert main([*words, "-O", "--site=34.7443,-111.4223,2361"]) == 0
    assert "refraction" not in capsys.readouterr().err


def test_the_advice_of_a_command_comes_before_that_of_the_reason(capsys: pytest.CaptureFixture[str]) -> None:
    reason = Reason.INCONSISTENT_EVIDENCE
    for own, shown in (("Check the site.", "Check the site."), (reason.advice, reason.advice)):
        record = {"status": "refused", "reason": str(reason), "message": "they differ", "advice": own}
        assert print_outcome(argparse.Namespace(json=False, quiet=False), record, "a  refused") == 3
        assert capsys.readouterr() == ("a  refused\n", f"  next: {shown}\n")
