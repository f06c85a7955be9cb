"""Every command and code snippet of docs/ is run, with the files that its page assumes (README.md: test_readme.py)."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from page_helpers import ROOT, run_page, same_output, snippets

PAGES = [*sorted(ROOT.glob("docs/*.md")), *sorted(ROOT.glob("docs/tutorials/*.md"))]


def no_files(folder: Path) -> None:
    """The page needs the samples alone."""


@dataclass(frozen=True)
class Assumed:
    """What a page assumes: files in the folder, and flags that make its commands quick."""

    files: Callable[[Path], None] = no_files
    flags: dict[str, list[str]] = field(default_factory=dict)


def folder_of_images(folder: Path) -> None:
    (folder / "mark").touch()
    (folder / "FOLDER").mkdir()
    for end in (".png", ".json"):
        shutil.copy(ROOT / f"sample_images/near-wall{end}", folder / "FOLDER")


def own_maps(folder: Path) -> None:
    shutil.copy(ROOT / "terrain/site01-10m.tif", folder / "fine.tif")
    shutil.copy(ROOT / "terrain/ldem75s-240m.tif", folder / "coarse.tif")


def small_camera(folder: Path) -> None:
    from test_cli_render import CAMERA

    (folder / "small.toml").write_text(CAMERA)


ASSUMED = {
    "batch": Assumed(folder_of_images),
    "terrain": Assumed(own_maps),
    "track": Assumed(small_camera, {"render": ["-c", "small.toml", "-q"]}),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in PAGES if any(snippets(page))], ids=lambda page: str(page.relative_to(ROOT))
)
def test_snippets_of_the_page_run(page, clone, capsys):
    assumed = ASSUMED.get(page.stem, Assumed())
    assumed.files(clone)
    with capsys.disabled():
        run_page(page, assumed.flags)


def test_output_is_compared_line_by_line():
    same_output("one 1.50 m\ntwo\nthree 3\n", "one 1.50 m\n...\nthree 3\n")
    same_output("fix 1.0 m  9.9 s\n", "fix 1.1 m  1.4 s\n")
    for shown in ("one 1.60 m\n", "two\none 1.50 m\n", "four\n"):
        with pytest.raises(AssertionError):
            same_output("one 1.50 m\ntwo\n", shown)
