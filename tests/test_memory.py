"""A lack of memory is a refusal in words, with the exit code of an environment that does not suffice."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from startrack.cli.main import main
from startrack.cli.pictures import locate
from startrack.core import limits
from startrack.core.types import BadInput
from startrack.exposure import decoding
from startrack.terrain import load_terrain

resource = pytest.importorskip("resource")
TOO_LITTLE_BYTES = 390_000_000  # too little for any command
WITHOUT_IMAGES_BYTES = 850_000_000  # too little for those that read images


@pytest.fixture
def picture(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.random.default_rng(1).integers(90, 110, (64, 64)).astype(np.uint16))
    return path


def run_within(limit_bytes, *words, folder):
    return subprocess.run(
        [sys.executable, "-m", "startrack.cli.main", *words],
        capture_output=True, text=True, timeout=60, check=False, cwd=folder,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit_bytes, limit_bytes)),
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)},
    )  # fmt: skip


def test_a_small_limit_ends_in_words(picture):
    done = run_within(TOO_LITTLE_BYTES, "detect", str(picture), folder=picture.parent)
    assert (done.returncode, done.stdout) == (4, "")
    assert done.stderr.startswith(
        "startrack detect  refused  out_of_memory: the limit of address space (ulimit -v) is 0.39 GB"
    )
    assert "Traceback" not in done.stderr and "report" not in done.stderr


@pytest.mark.parametrize("words", [("schema", "fix"), ("terrain", "show", "shackleton-thesis", "--no-plots")])
def test_commands_without_images_need_no_memory_for_them(words, tmp_path):
    done = run_within(WITHOUT_IMAGES_BYTES, *words, folder=tmp_path)
    assert done.returncode == 0, done.stderr


def test_a_terrain_with_a_map_is_refused_before_it_is_read(monkeypatch):
    monkeypatch.setattr(limits, "_limit_bytes", lambda: WITHOUT_IMAGES_BYTES)
    with pytest.raises(BadInput, match=r"haworth\.toml: the limit of address space") as caught:
        load_terrain("haworth")
    assert caught.value.reason == "out_of_memory"


def test_each_image_is_refused_by_an_object_of_its_own(picture):
    words = "identify", str(picture), str(picture), "--fov", "60", "--json"
    done = run_within(WITHOUT_IMAGES_BYTES, *words, folder=picture.parent)
    assert done.returncode == 4
    records = [json.loads(line) for line in done.stdout.splitlines()]
    assert [one["reason"] for one in records] == ["out_of_memory"] * 2
    assert "0.85 GB" in records[0]["message"] and records[0]["format"].startswith("startrack.identification/")


def test_a_picture_too_large_for_the_limit_is_refused_before_it_is_decoded(monkeypatch):
    monkeypatch.setattr(limits, "_limit_bytes", lambda: int(1.2e9))
    decoding.check_size(2000, 2000)
    with pytest.raises(BadInput, match=r"is 1\.20 GB, .* 1\.28 GB with a picture of 16\.0 Mpx") as caught:
        decoding.check_size(4000, 4000)
    assert caught.value.reason == "out_of_memory"


def exception_from(cause):
    try:
        raise RuntimeError("a library") from cause
    except RuntimeError as error:
        return error


def opencvs_error():
    error = cv2.error("Failed to allocate 100 bytes")
    error.code = -4
    return error


@pytest.mark.parametrize(
    "cause",
    [
        MemoryError(), np._core._exceptions._ArrayMemoryError((10**6, 10**6), np.dtype(float)),
        OSError(errno.ENOMEM, "no"), opencvs_error(), exception_from(MemoryError()),
    ],
)  # fmt: skip
def test_a_lack_of_memory_is_known_by_its_exception(cause, picture, monkeypatch, capsys):
    def fail(*_):
        raise cause

    refusal = limits.memory_refusal(cause)
    assert refusal is not None and refusal.reason == "out_of_memory" and "memory is short" in str(refusal)
    monkeypatch.setattr(locate, "_solve_image", fail)
    assert main(["detect", str(picture), "--json"]) == 4
    heard = capsys.readouterr()
    record = json.loads(heard.out)
    assert record["reason"] == "out_of_memory" and "ulimit" in record["advice"] and "report" not in record["advice"]


def test_other_errors_are_a_lack_of_memory_where_no_library_can_be_loaded(monkeypatch):
    cause = RuntimeError("Could not locate or load CSPICE shared library")
    assert limits.memory_refusal(cause) is None
    monkeypatch.setattr(limits, "has_room", lambda: False)
    refusal = limits.memory_refusal(cause)
    assert refusal is not None and "CSPICE" in str(refusal)


def test_a_decoder_without_memory_does_not_call_the_picture_damaged(picture, monkeypatch):
    def fail(_):
        raise MemoryError

    monkeypatch.setattr("startrack.exposure.png.decode", fail)
    with pytest.raises(BadInput, match=r"a\.png: memory is short") as caught:
        decoding.decode_file(picture)
    assert caught.value.reason == "out_of_memory"
