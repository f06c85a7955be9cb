"""The size of the house: what a stranger reads to follow one image, and each product apart. It may fall, not grow."""

import subprocess
import sys
from pathlib import Path

import pytest

import startrack

ROOT = Path(startrack.__file__).parent
MOST_LINES = {  # of Python, by folder; what is new is paid by its own product
    "applications/batch": 740,
    "applications/calibration": 2530,
    "applications/horizon": 1670,
    "applications/prediction": 990,
    "applications/reproduction": 3070,
    "applications/tracking": 2900,
    "cli": 4040,
    "output": 4790,
    ".": 53_700,
}
MOST_C_LINES, MOST_FILES = 5_740, 280
MOST_IN_A_FOLDER, MOST_IN_A_FILE = 14, 500
MOST_TO_FOLLOW_AN_IMAGE = 26_000  # lines that the chain and the renderer load
LOADED = (
    "import sys, startrack.chain.pipeline, startrack.rendering; "
    "print(*(one.__file__ for name, one in sys.modules.items() if name.split('.')[0] == 'startrack'), sep='\\n')"
)


def lines_of(paths: list[Path]) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def sources(folder: str, pattern: str = "*.py") -> list[Path]:
    return list((ROOT / folder).rglob(pattern))


@pytest.mark.parametrize("folder", MOST_LINES)
def test_a_product_keeps_its_budget(folder: str) -> None:
    assert 0.9 * MOST_LINES[folder] < lines_of(sources(folder)) <= MOST_LINES[folder]


def test_files_and_folders_are_few_and_short() -> None:
    files = sources(".")
    assert len(files) <= MOST_FILES
    assert lines_of([*sources("kernels", "*.c"), *sources("kernels", "*.h")]) <= MOST_C_LINES
    assert [path for path in files if lines_of([path]) > MOST_IN_A_FILE] == []
    folders = [path.parent for path in files]
    assert {one for one in folders if folders.count(one) > MOST_IN_A_FOLDER} == set()


def test_the_way_of_an_image_keeps_its_budget() -> None:
    loaded = subprocess.run([sys.executable, "-c", LOADED], check=True, capture_output=True, text=True).stdout.split()
    found = lines_of([Path(one) for one in loaded])
    assert 0.9 * MOST_TO_FOLLOW_AN_IMAGE < found <= MOST_TO_FOLLOW_AN_IMAGE
