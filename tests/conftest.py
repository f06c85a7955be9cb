"""Fixtures of several test files."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the command: more threads sum in another order

import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from startrack.kernels import build

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@dataclass(frozen=True)
class Located:
    """A small rendered exposure, the pipeline's result for it, and its truth."""

    result: Any  # pipeline.Result
    truth: Any  # render.Truth
    heading_pitch_roll_deg: tuple[float, float, float]


def pytest_configure(config: pytest.Config) -> None:
    """Where bytecode is kept out of the tree, it goes to pytest's cache: else each process compiles all anew."""
    if sys.dont_write_bytecode and hasattr(config, "cache"):
        os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix = str(config.cache.mkdir("bytecode"))
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        sys.dont_write_bytecode = False


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A browser, where one is installed."""
    playwright = pytest.importorskip("playwright.sync_api", reason="the extra `browser` is not installed")
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    with playwright.sync_playwright() as driver:
        if path is None and not Path(driver.chromium.executable_path).exists():
            pytest.skip("no Chromium is installed")
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def axe() -> str:
    """The rules of axe-core, as a script."""
    package = pytest.importorskip("axe_playwright_python", reason="axe-core is not installed")
    return (Path(package.__file__).parent / "axe.min.js").read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def zig_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package ziglang, a compiler for all systems. Skips without an index of packages."""
    folder = tmp_path_factory.mktemp("zig")
    words = ["install", "-q", "--no-deps", "--disable-pip-version-check", "--target", str(folder), build.ZIGLANG]
    if subprocess.run([sys.executable, "-m", "pip", *words], capture_output=True).returncode:
        pytest.skip("no index of packages is reached")
    return folder


@pytest.fixture(scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """An empty cache of horizon tables for the tests of one file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that looks like the clone to a command that reads the samples."""
    (tmp_path / "sample_images").symlink_to(Path(__file__).parent.parent / "sample_images")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def located() -> Located:
    """A rendered and located exposure of a 1024 px fisheye, 6.5 km off the middle of the thesis's crater."""
    from startrack.camera import load_camera
    from startrack.catalog import load_catalog
    from startrack.chain import pipeline
    from startrack.rendering import Series, render
    from startrack.terrain import load_terrain

    camera = replace(
        load_camera("fisheye-2048"),
        name="fisheye-1024",
        size_px=(1024, 1024),
        focal_px=(326.0, 326.0),
        centre_px=(511.5, 511.5),
    )
    catalog, angles_deg = load_catalog().brighter_than(7.0), (30.0, 2.0, -3.0)
    heading, pitch, roll = np.radians(angles_deg).tolist()
    series = Series(
        camera=camera,
        terrain=load_terrain("shackleton-thesis"),
        catalog=catalog,
        seed=7,
        time_utc=datetime(2030, 6, 1, tzinfo=UTC),
        east_m=6000.0,
        north_m=-2500.0,
        heading_rad=heading,
        pitch_rad=pitch,
        roll_rad=roll,
        faint_v_mag=None,
        hot_pixels=20,
    )
    scene, rng = series.scene(0, "small")
    exposure, truth = render(scene, rng=rng)
    return Located(pipeline.locate(exposure, camera, series.terrain, catalog), truth, angles_deg)
