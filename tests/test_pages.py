"""Every command and code snippet of docs/ is run, with the files that its page assumes (README.md: test_readme.py)."""

from __future__ import annotations

import bz2
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from page_helpers import ROOT, run_page, same_output, snippets

from startrack.cli.main import main
from startrack.exposure import read_exposure, write_exposure

PAGES = [path for folder in ("", "tutorials/", "api/") for path in sorted(ROOT.glob(f"docs/{folder}*.md"))]


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


def nights(folder: Path) -> None:
    """Photographs of the sky, pictures of a chessboard, and a calibration of another program."""
    from test_calibration_board import POSES, chessboard, draw_picture

    pixels = read_exposure(ROOT / "sample_images/lowell-2018-08-06.fits.bz2")
    for k, name in enumerate(["night1.png", "night2.png", "tonight.png"]):
        write_exposure(folder / name, replace(pixels, pixels_adu=np.minimum(pixels.pixels_adu + k, 65535)))
    for k, pose in enumerate(POSES):
        write_exposure(folder / f"board{k}.png", draw_picture(pose, chessboard))
    convert = ["calibrate", "convert", "lowell-ldt", "--to", "kalibr", "-o", str(folder / "camchain.yaml")]
    assert main(convert) == 0


def fits_nights(folder: Path) -> None:
    content = bz2.decompress((ROOT / "sample_images/lowell-2018-08-06.fits.bz2").read_bytes())
    for name in ("night1.fits", "night2.fits"):
        (folder / name).write_bytes(content)


def own_maps(folder: Path) -> None:
    shutil.copy(ROOT / "terrain/site01-10m.tif", folder / "fine.tif")
    shutil.copy(ROOT / "terrain/ldem75s-240m.tif", folder / "coarse.tif")


def small_camera(folder: Path) -> None:
    from test_cli_render import CAMERA

    (folder / "small.toml").write_text(CAMERA)


def path_and_cameras(folder: Path) -> None:
    (folder / "waypoints.csv").write_text("east_m,north_m\n-3000,0\n0,1000\n")
    for name in ("mine.toml", "other.toml"):
        shutil.copy(ROOT / "calib/fisheye-2048.toml", folder / name)


QUICK_PREDICTION = ["-t", "shackleton-thesis", "--spacing", "9000", "--draws", "1", "--no-plots", "-j", "1"]
ASSUMED = {
    "batch": Assumed(folder_of_images),
    "calibration": Assumed(nights),
    "expected-accuracy": Assumed(flags={"predict": ["-j", "1"]}),  # to start processes takes longer than the draws
    "horizon": Assumed(fits_nights),
    "predict": Assumed(path_and_cameras, {"predict": QUICK_PREDICTION}),
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
        ran = run_page(page, assumed.flags)
    for code, printed in ran.printed.items():
        assert printed or "print(" not in code


def test_output_is_compared_line_by_line():
    same_output("one 1.50 m\ntwo\nthree 3\n", "one 1.50 m\n...\nthree 3\n")
    same_output("fix 1.0 m  9.9 s\n", "fix 1.1 m  1.4 s\n")
    for shown in ("one 1.60 m\n", "two\none 1.50 m\n", "four\n"):
        with pytest.raises(AssertionError):
            same_output("one 1.50 m\ntwo\n", shown)
