"""The documentation site builds without a warning, and its pictures are small."""

import posixpath
import re
import subprocess
import sys
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import pytest
from page_helpers import ROOT
from PIL import Image

FETCHED = re.compile(
    r'<(?:script|img|iframe|source)\b[^>]*?\bsrc="([^"]*)"|<link\b[^>]*rel="(?:stylesheet|preload)"[^>]*href="([^"]*)"'
)
LINK, PLACE = re.compile(r'<a\b[^>]*?\bhref="([^"]*)"'), re.compile(r'\bid="([^"]*)"')
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
    first_screen = index[: index.index("hero.webp")]
    assert "All-sky cameras" in first_screen and "tutorials/calibrate-your-camera.html" in first_screen
    pages = {
        path.relative_to(tmp_path).as_posix(): path.read_text(encoding="utf-8") for path in tmp_path.rglob("*.html")
    }
    fetched = [
        (page, one) for page, text in pages.items() for one in map("".join, FETCHED.findall(text)) if "//" in one
    ]
    assert len(pages) > 40 and fetched == []  # no request leaves the site
    assert broken_links(tmp_path, pages) == []
    assert broken_links(tmp_path, {"a.html": '<a href="index.html#none">'} | pages) == [("a.html", "index.html#none")]
    assert 'role="heading" aria-level="2"' in index and '<pre tabindex="0">' in index
    reference = (tmp_path / "api/values.html").read_text(encoding="utf-8")
    assert "whole-PSF flux [electrons, or ADU when the gain is unknown]" in reference  # comments of fields


def broken_links(site: Path, pages: dict[str, str]) -> list[tuple[str, str]]:
    """Links of the `pages` to files that the site lacks, or to places that their pages lack."""
    places = {page: {unescape(one) for one in PLACE.findall(text)} for page, text in pages.items()}
    broken = []
    for page, text in pages.items():
        for link in map(unescape, LINK.findall(text)):
            path, _, place = unquote(link).partition("#")
            target = page if not path else posixpath.normpath(posixpath.join(posixpath.dirname(page), path))
            if "://" in link or link.startswith("mailto:"):
                continue
            if not (site / target).exists() or (place and target in places and place not in places[target]):
                broken.append((page, link))
    return broken


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
