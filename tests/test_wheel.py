"""The wheel: its content, and its use outside the checkout."""

import json
import os
import re
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BUILD = "from hatchling.build import build_wheel; import sys; print(build_wheel(sys.argv[1]))"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    out = tmp_path_factory.mktemp("wheel")
    done = subprocess.run([sys.executable, "-c", BUILD, str(out)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return out / done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def unpacked_wheel(wheel, tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def names(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def run_elsewhere(unpacked, folder, *words):
    """`python words` with the wheel's content alone, in another folder."""
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(unpacked), "XDG_CACHE_HOME": str(unpacked.parent / "cache")},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_catalogue_cameras_and_terrains_are_inside(wheel):
    inside = names(wheel)
    for kind, ends in {"catalogs": ("*.npy", "*_names.csv"), "calib": ("*.toml",), "terrain": ("*.toml",)}.items():
        wanted = {path.name for end in ends for path in (ROOT / kind).glob(end)}
        assert wanted
        assert {f"startrack/data/{kind}/{name}" for name in wanted} <= inside
    sources = {str(path.relative_to(ROOT)) for path in (ROOT / "startrack").rglob("*.py")}
    assert sources <= inside
    assert "startrack/py.typed" in inside


def test_nothing_else_is_inside(wheel):
    inside = names(wheel)
    assert {name.split("/")[0].split("-")[0] for name in inside} == {"startrack"}
    strange = re.compile(r"(^|/)(tests?|benchmarks|sample_images|docs)/|/test_|\.pyc$|\.(png|fits|bz2)$")
    assert [name for name in inside if strange.search(name)] == []
    assert any(name.endswith("dist-info/licenses/LICENSE") for name in inside)
    assert wheel.stat().st_size < 6e6


def test_it_works_away_from_the_checkout(unpacked_wheel, tmp_path):
    where = run_elsewhere(unpacked_wheel, tmp_path, "-c", "import startrack; print(startrack.__file__)").strip()
    assert Path(where).is_relative_to(unpacked_wheel)
    image = str(ROOT / "sample_images/near-wall.png")
    out = run_elsewhere(unpacked_wheel, tmp_path, "-m", "startrack.cli.main", "locate", image, "--json", "--no-plots")
    position = json.loads(out)["position"]
    assert abs(position["east_m"] + 6900) < 40
    assert abs(position["north_m"] - 4700) < 40
    kept = {path.suffix for path in unpacked_wheel.rglob("*") if path.is_file() and "__pycache__" in path.parts}
    assert kept <= {".pyc"}, "compiled code lies in the user's cache"


def test_every_shipped_file_is_read_from_it(unpacked_wheel, tmp_path):
    out = run_elsewhere(unpacked_wheel, tmp_path, "-m", "startrack.cli.main", "doctor")
    for kind in ("calib", "terrain"):
        for path in (ROOT / kind).glob("*.toml"):
            assert path.stem in out


def test_the_command_is_declared(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (entry,) = [name for name in archive.namelist() if name.endswith("entry_points.txt")]
        assert "startrack = startrack.cli.main:main" in archive.read(entry).decode()


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="the oldest packages have no wheels for this Python")
def test_the_oldest_packages_that_are_allowed_locate_a_sample(wheel, tmp_path):
    """The lower bounds of pyproject.toml, all at once, in an environment of their own."""

    def output(*words):
        clean = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}
        clean["XDG_CACHE_HOME"] = str(tmp_path / "cache")
        return subprocess.run(list(map(str, words)), cwd=tmp_path, capture_output=True, text=True, env=clean)

    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv/bin/python"
    bounds = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    lowest = [re.sub(r">=([\w.]+).*", r"==\1", bound) for bound in bounds]
    (tmp_path / "lowest.txt").write_text("\n".join(lowest))
    pip = python, "-m", "pip"
    if output(*pip, "download", "-q", "--no-deps", "-d", tmp_path, "filelock").returncode:
        pytest.skip("no index of packages is reached")
    done = output(*pip, "install", "-q", "--only-binary=:all:", "-c", "lowest.txt", wheel)
    assert done.returncode == 0, done.stderr
    installed = json.loads(output(*pip, "list", "--format", "json").stdout)
    versions = {re.sub(r"[-_.]+", "-", one["name"].lower()): one["version"] for one in installed}
    for name, version in (bound.split("==") for bound in lowest):
        assert re.fullmatch(rf"{re.escape(version)}(\.0)*", versions[name])
    image = ROOT / "sample_images/near-wall.png"
    done = output(python, "-m", "startrack", "locate", image, "--json", "--no-plots")
    assert done.returncode == 0, done.stderr
    position = json.loads(done.stdout)["position"]
    assert abs(position["east_m"] + 6900) < 40
    assert abs(position["north_m"] - 4700) < 40
