"""Files that are no images, unusual names, and the time of reading."""

import hashlib
import os
import subprocess
import sys

import cv2
import numpy as np
import pytest

from startrack.core.types import BadInput
from startrack.exposure import read_exposure

WHOLE = cv2.imencode(".png", np.arange(600, dtype=np.uint16).reshape(20, 30))[1].tobytes()


@pytest.mark.parametrize("target", ["missing.png", "folder", "a\0b.png", "pipe.png"])
def test_what_is_no_file(tmp_path, target):
    (tmp_path / "folder").mkdir()
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(BadInput, match=r"No such file|is a folder|null|not a regular file") as caught:
        read_exposure(os.path.join(tmp_path, target))
    assert caught.value.reason == "bad_image"


def test_permission_denied(tmp_path, monkeypatch):
    """Root may read any file, so the error of the system is simulated."""
    path = tmp_path / "frame.png"
    path.write_bytes(WHOLE)

    def deny_access(*_args, **_keywords):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.read_bytes", deny_access)
    with pytest.raises(BadInput, match="Permission denied"):
        read_exposure(path)


@pytest.mark.parametrize("name", ["space and ünïcode ☾.png", "line\nbreak.png", "dots.in.name.png", "UPPER.PNG"])
def test_names(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(WHOLE)
    exposure = read_exposure(path)
    assert exposure.name == name[:-4]
    assert exposure.path == str(path)
    path.write_bytes(WHOLE[:-1])
    with pytest.raises(BadInput) as caught:
        read_exposure(path)
    assert "\n" not in str(caught.value)


def test_the_hash_is_of_the_file(tmp_path):
    path = tmp_path / "frame.png"
    path.write_bytes(WHOLE)
    assert read_exposure(path).sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_import_is_light():
    code = "import startrack.exposure, sys; print({'cv2', 'astropy', 'tifffile', 'PIL'} & set(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "set()"
