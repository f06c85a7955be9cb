"""Images that are followed: complete files, facts that come late, and folders that stay as they are."""

from __future__ import annotations

import os
import time

import pytest

from startrack.applications.batch import find as finding
from startrack.applications.batch import image_tree
from startrack.applications.tracking import follow_images, session
from startrack.core.types import BadInput


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """The same with short waits."""
    monkeypatch.setattr(session, "TRIES_S", (0.02, 0.2))
    monkeypatch.setattr(finding, "COARSE_S", 0.05)


class Run:
    """What became of the images of a folder; an image needs a sidecar."""

    def __init__(self, folder, until_idle_s=0.3):
        self.taken, self.refused = [], []
        tree = image_tree(folder)
        self.images = follow_images(
            lambda: [str(folder / name) for name in tree.changes()], self.take,
            lambda path, cause: self.refused.append(os.path.basename(path)), until_idle_s=until_idle_s,
        )  # fmt: skip

    def take(self, path):
        if not os.path.exists(path.replace(".png", ".json")):
            raise BadInput("no_time", "no time is known")
        self.taken.append(os.path.basename(path))

    def until(self, has_happened):
        """Go on until that is so."""
        end = time.monotonic() + 20.0
        while not has_happened() and time.monotonic() < end:
            next(self.images)
        assert has_happened()


def write(folder, name):
    folder.mkdir(exist_ok=True, parents=True)
    (folder / name).write_bytes(b"1")


def test_a_file_of_a_clock_that_is_ahead_is_taken(tmp_path):
    for name in ("a.png", "a.json"):
        write(tmp_path, name)
        os.utime(tmp_path / name, (time.time() + 1e6,) * 2)
    run = Run(tmp_path)
    assert [one for one in run.images if one] == [str(tmp_path / "a.png")]
    assert (run.taken, run.refused) == (["a.png"], [])


def test_a_file_that_grows_waits(tmp_path):
    write(tmp_path, "a.json")
    run = Run(tmp_path)
    for _ in range(10):
        with open(tmp_path / "a.png", "ab") as file:
            file.write(b"more")
        next(run.images)
        assert not run.taken
    run.until(lambda: run.taken == ["a.png"])


def test_an_image_that_was_refused_is_tried_again_with_its_facts(tmp_path):
    for name in ("a.png", "b.png", "b.json"):
        write(tmp_path, name)
    run = Run(tmp_path, until_idle_s=None)
    run.until(lambda: run.refused == ["a.png"])
    assert run.taken == ["b.png"]
    for _ in range(5):
        next(run.images)
    assert run.refused == ["a.png"]  # once
    write(tmp_path, "a.json")
    run.until(lambda: run.taken == ["b.png", "a.png"])


def test_folders_that_stay_are_not_listed_again(tmp_path, monkeypatch):
    for k in range(20):
        write(tmp_path / "day" / f"{k % 2}", f"{k}.png")
    tree = image_tree(tmp_path)
    assert len(tree.changes()) == 20
    time.sleep(0.1)  # longer than a step of the folders' times
    tree.changes()
    listed, scandir = [], os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: [listed.append(str(path)), scandir(path)][1])
    for _ in range(5):
        assert tree.changes() == []
    assert not listed
    write(tmp_path / "day" / "1", "new.png")
    assert "day/1/new.png" in tree.changes() and listed == [str(tmp_path / "day" / "1")]
    write(tmp_path / "night", "first.png")
    assert "night/first.png" in tree.changes()
    monkeypatch.setattr(finding, "RELIST_S", 0.0)  # as on a file system whose folders have no times
    assert len(tree.changes()) == 22
