"""Interrupted batches: processes that die, a full disk, a closed pipe, Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from astropy.table import Table
from batch_helpers import frames

from startrack.cli.main import main


def start_batch(folder: Path, *flags: str, before: str = "") -> subprocess.Popen[str]:
    """The command in a shell, after the shell command `before`."""
    command = [sys.executable, "-m", "startrack.cli.main", "batch", str(folder), *flags]
    shell = ["bash", "-c", f'{before} exec "$@"', "bash", *command]
    return subprocess.Popen(shell, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def test_a_scheduler_that_does_not_answer_is_bad_input(tmp_path, capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("startrack.core.runner.CONNECT_S", 0.2)
    frames(tmp_path / "images", 1)
    out, nobody = str(tmp_path / "out"), "tcp://127.0.0.1:1"
    assert main(["batch", str(tmp_path / "images"), "-D", out, "--cluster", nobody]) == 4
    assert f"{nobody}: no Dask scheduler answers" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--cluster", "nonsense"), "not the address of a Dask scheduler"),
        (("--cluster", "http://host:8786"), "not the address of a Dask scheduler"),
        (("--cluster", "tcp://host:99999"), "not the address of a Dask scheduler"),
        (("--cluster", "tcp://host:8786", "-j", "2"), "not allowed with"),
    ],
)
def test_a_cluster_is_an_address_and_has_its_own_processes(tmp_path, capsys, flags, words):
    with pytest.raises(SystemExit, match="2"):
        main(["batch", str(tmp_path), *flags])
    assert words in capsys.readouterr().err


@pytest.fixture(scope="module")
def many_frames(tmp_path_factory) -> Path:
    """A folder with more frames than a batch can locate before it is stopped."""
    folder = tmp_path_factory.mktemp("many")
    frames(folder, 400)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wishes", "to_the_group", "why"),
    [
        ([signal.SIGINT], False, "interrupted"),
        ([signal.SIGINT, signal.SIGINT], True, "interrupted"),  # as timeout sends them
        ([signal.SIGTERM], True, "terminated"),  # as systemd and Slurm do
    ],
)
def test_a_signal_ends_the_batch_after_the_frames_in_progress_and_writes_the_tables(
    many_frames, tmp_path, wishes, to_the_group, why
):
    out = tmp_path / "out"
    process = start_batch(many_frames, "-D", str(out), "-j", "2", "-O", "-v", "--no-plots")
    assert process.stdout is not None
    for _ in range(5):
        process.stdout.readline()
    for wish in wishes:
        process.send_signal(wish)
        if to_the_group:
            os.killpg(process.pid, wish)
    with process:
        assert process.stderr is not None
        rest, err = process.stdout.read(), process.stderr.read()  # communicate() forgets the lines read ahead
    done = len(rest.splitlines()) + 5
    assert process.returncode == 5
    assert err.count("finishing the images in progress") == 1
    assert f"{why}: {done} of 400 images done, tables in {out}; the same command without -O goes on" in err
    assert len(Table.read(out / "results.ecsv", format="ascii.ecsv")) == len(list(out.glob("*.fix.json"))) == done
    assert not list(out.glob(".*"))


@pytest.mark.parametrize("delay_s", [0.1, 0.4, 0.8])
def test_an_early_signal_ends_the_batch_at_once(many_frames, tmp_path, delay_s):
    """While the program is loaded, and while its processes start."""
    with start_batch(many_frames, "-D", str(tmp_path / "out"), "-j", "2", "-O", "--no-plots") as process:
        time.sleep(delay_s)
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=120)
    assert process.returncode in (-signal.SIGINT, 5, 130)  # before Python is ready, the system ends the process
    if process.returncode == 5:
        assert "images done" in err


def test_a_later_signal_drops_the_images_in_progress_and_writes_the_tables(tmp_path, monkeypatch):
    """The signal is raised inside the process, so that it arrives between two images."""
    frames(tmp_path / "images", 40)
    monkeypatch.setattr("startrack.cli.pictures.batch.SAME_SIGNAL_S", -1.0)
    results = []

    def interrupt(*_: object, **__: object) -> None:
        results.append(1)
        if len(results) in (3, 4):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("builtins.print", interrupt)
    out = tmp_path / "out"
    assert main(["batch", str(tmp_path / "images"), "-D", str(out), "-j", "2", "-v", "--no-plots"]) == 5
    assert len(Table.read(out / "results.ecsv", format="ascii.ecsv")) == len(list(out.glob("*.fix.json")))
    assert len(list(out.glob("*.fix.json"))) < 40


@pytest.mark.slow
def test_a_closed_pipe_ends_the_batch_early(many_frames, tmp_path):
    with start_batch(many_frames, "-D", str(tmp_path / "out"), "-j", "1", "--json", "--no-plots") as process:
        assert process.stdout is not None and process.stderr is not None
        assert json.loads(process.stdout.readline())["image"] == "00.png"
        process.stdout.close()
        err = process.stderr.read()
    assert process.returncode == 5
    assert "the output is no longer read" in err
    assert "Traceback" not in err


def test_a_closed_pipe_ends_the_image_commands_early(many_frames, tmp_path):
    images = sorted(str(path) for path in many_frames.glob("*.png"))[:300]
    command = [sys.executable, "-m", "startrack.cli.main", "detect", *images, "-D", str(tmp_path / "out"), "--no-plots"]
    with subprocess.Popen([*command, "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 5


@pytest.mark.slow
def test_with_json_nothing_else_is_printed(tmp_path, capsys):
    frames(tmp_path / "images", 2)
    assert main(["batch", str(tmp_path / "images"), "-D", str(tmp_path / "out"), "-j", "1", "--json"]) == 5
    streams = capsys.readouterr()
    assert [json.loads(line)["image"] for line in streams.out.splitlines()] == ["00.png", "01.png"]
    assert "2 images: 2 refused" in streams.err


@pytest.mark.slow
def test_a_full_disk_ends_the_batch_with_one_message(tmp_path):
    """A limit on file sizes simulates the full disk: after it is lifted, the same command continues.

    Python 3.11 would keep bytecode that the limit has cut, which no later process could import.
    """
    frames(tmp_path / "images", 4)
    flags = "-D", str(tmp_path / "out"), "-j", "1"
    full = start_batch(tmp_path / "images", *flags, before="ulimit -f 8; export PYTHONDONTWRITEBYTECODE=1;")
    out, err = full.communicate()
    assert (full.returncode, out, len(err.splitlines())) == (5, "", 1)
    assert "cannot be written (File too large): 0 of 4 images done" in err
    assert main(["batch", str(tmp_path / "images"), *flags, "-q"]) == 5
    assert len(Table.read(tmp_path / "out" / "results.ecsv", format="ascii.ecsv")) == 4


def test_a_read_only_folder_is_reported_at_once(tmp_path, capsys):
    frames(tmp_path / "images", 1)
    assert main(["batch", str(tmp_path / "images"), "-D", "/proc"]) == 2
    assert "/proc: results cannot be written" in capsys.readouterr().err


def test_bad_input_is_named_with_its_cause_without_any_flag(tmp_path, capsys):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "broken.png").write_bytes(b"no picture")
    assert main(["batch", str(tmp_path / "images"), "-D", str(tmp_path / "out"), "-j", "1"]) == 5
    out, err = capsys.readouterr()
    assert err.startswith("broken.png  refused  bad_image: ") and err.count("broken.png") == 1
    assert out.startswith("1 image: 1 refused (1 bad_image); tables in ")
