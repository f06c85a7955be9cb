"""The documentation site builds without a warning, and its pictures are small."""

import subprocess
import sys
from pathlib import Path

import pytest
from page_helpers import ROOT
from PIL import Image

MAX_PICTURE_BYTES = 300_000
MAX_ANIMATION_BYTES = 1_500_000
MAX_ALL_BYTES = 6_000_000


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    """Sphinx warns of links inside the site without target, of pages in no list, and of faulty docstrings."""
    pytest.importorskip("sphinx", reason="the extra `docs` is not installed")
    words = ["-m", "sphinx", "-W", "--keep-going", "-q", "-j", "2", "docs", str(tmp_path)]
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    index = (tmp_path / "index.html").read_text(encoding="utf-8")
    for door in ("Rover navigation", "All-sky cameras", "Star identification"):
        assert door in index
    reference = (tmp_path / "api/pipeline.html").read_text(encoding="utf-8")
    assert "whole-PSF flux [electrons, or ADU when the gain is unknown]" in reference  # comments of fields


def test_pictures_of_the_site_are_small() -> None:
    pictures = [path for path in (ROOT / "docs").rglob("*") if path.suffix in (".png", ".webp", ".jpg", ".svg")]
    assert pictures
    sizes = {path: path.stat().st_size for path in pictures}
    assert [path.name for path, size in sizes.items() if size > largest_bytes(path)] == []
    assert sum(sizes.values()) < MAX_ALL_BYTES


def largest_bytes(path: Path) -> int:
    """How large the file of a picture may be: an animation holds many."""
    if path.suffix == ".svg":
        return MAX_PICTURE_BYTES
    with Image.open(path) as image:
        return MAX_ANIMATION_BYTES if getattr(image, "n_frames", 1) > 1 else MAX_PICTURE_BYTES
