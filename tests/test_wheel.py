"""The wheel: its content, and its use outside the checkout."""

import json
import os
import re
import shutil
import struct
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

from startrack.kernels import build

ROOT = Path(__file__).parent.parent
BUILD = "from hatchling.build import build_wheel; import sys; print(build_wheel(sys.argv[1]))"
BUILD_SOURCES = BUILD.replace("build_wheel", "build_sdist")
COMPILED_BY = "from startrack.kernels.library import text_of; print(text_of('compiler_name'))"
MODULES_OF_EXTRAS = (  # that the tests below do not load
    "matplotlib.pyplot", "playwright.sync_api", "axe_playwright_python.sync_playwright", "sphinx", "furo",
    "myst_parser", "sphinx_copybutton", "photutils.psf", "sep",
)  # fmt: skip
TESTS_OF_EXTRAS = (
    "test_exposure_read.py", "test_terrain_maps.py", "test_catalog_gaia.py", "test_site.py",
    "test_exposure_mosaic.py::test_a_tiff_mosaic_and_a_camera_raw_file_give_the_sensors_counts",
    "test_bag_images.py::test_each_image_is_read_alone_as_it_is_read_in_turn",
    "test_bag_images.py::test_no_room_is_made_for_more_than_a_bag_holds",
    "test_batch.py::test_parquet_is_written_with_the_extra_only",
    "test_batch.py::test_dask_with_a_killed_worker_equals_the_local_run",
    "test_cli.py::test_shell_completion_knows_the_commands",
)  # fmt: skip

pytestmark = pytest.mark.slow


def build_archive(code, out):
    """The archive that `code` makes of the project in the folder `out`."""
    done = subprocess.run([sys.executable, "-c", code, str(out)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return out / done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build_archive(BUILD, tmp_path_factory.mktemp("wheel"))


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
        env={**os.environ, "PYTHONPATH": str(unpacked), "XDG_CACHE_HOME": str(unpacked.parent / "cache"),
             "PYTHONPYCACHEPREFIX": ""},
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


def test_the_compiled_kernels_are_inside_for_this_system_and_any_python(wheel):
    assert re.fullmatch(r"startrack-[\d.]+-py3-none-(?!any)\w+\.whl", wheel.name)
    target = build.this_target()
    libraries = sorted(name for name in names(wheel) if "/compiled/" in name)
    assert libraries == [f"startrack/kernels/compiled/{target.library_name(level)}" for level in target.levels]


def test_nothing_else_is_inside(wheel):
    inside = names(wheel)
    assert {name.split("/")[0].split("-")[0] for name in inside} == {"startrack"}
    strange = re.compile(r"(^|/)(tests?|benchmarks|sample_images|docs)/|/test_|\.pyc$|\.(png|fits|bz2)$")
    assert [name for name in inside if strange.search(name)] == []
    assert any(name.endswith("dist-info/licenses/LICENSE") for name in inside)
    assert wheel.stat().st_size < 6.5e6


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


class Environment:
    """A new virtual environment of a Python, whose commands see nothing of the checkout. Skips without an index."""

    def __init__(self, base, folder):
        self.folder = folder
        self.run(base, "-m", "venv", "venv")
        self.python = folder / "venv/bin/python"
        if self.finish(self.python, "-m", "pip", "download", "-q", "--no-deps", "filelock").returncode:
            pytest.skip("no index of packages is reached")

    def finish(self, *words, **more):
        clean = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONPYCACHEPREFIX")}
        clean |= {"XDG_CACHE_HOME": str(self.folder / "cache"), **more}
        return subprocess.run(list(map(str, words)), cwd=self.folder, capture_output=True, text=True, env=clean)

    def run(self, *words, **more):
        """The output of a command that succeeds, with `more` variables of the environment."""
        done = self.finish(*words, **more)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def pip(self, *words, **more):
        return self.run(self.python, "-m", "pip", *words, **more)

    def locate_sample(self):
        image = ROOT / "sample_images/near-wall.png"
        position = json.loads(self.run(self.python, "-m", "startrack", "locate", image, "--json", "--no-plots"))[
            "position"
        ]
        assert abs(position["east_m"] + 6900) < 40
        assert abs(position["north_m"] - 4700) < 40


@pytest.fixture(scope="module")
def source_archive(tmp_path_factory):
    return build_archive(BUILD_SOURCES, tmp_path_factory.mktemp("sources"))


def locate_elsewhere(unpacked, folder):
    """Locate a sample with the content of a wheel or of sources; the compiler of the kernels."""
    image = str(ROOT / "sample_images/near-centre.png")
    out = run_elsewhere(unpacked, folder, "-m", "startrack", "locate", image, "--json", "--no-plots")
    assert json.loads(out)["status"] == "ok"
    return run_elsewhere(unpacked, folder, "-c", COMPILED_BY)


def test_a_wheel_of_the_sources_is_compiled_by_a_package_where_there_is_no_compiler(source_archive, tmp_path):
    own = Environment(sys.executable, tmp_path)
    own.pip("wheel", "-q", "--no-deps", "-w", "out", source_archive, PATH=str(own.python.parent), CC="")
    (made,) = (tmp_path / "out").glob("*.whl")
    with zipfile.ZipFile(made) as archive:
        archive.extractall(tmp_path / "site")
    assert "Clang" in locate_elsewhere(tmp_path / "site", tmp_path)


@pytest.mark.parametrize("tag", ["manylinux_2_17_aarch64", "macosx_13_0_arm64"])
def test_a_wheel_for_another_system_holds_its_libraries(tag, zig_site, tmp_path):
    """An archive for that system's processor, by the first bytes of its libraries; they are not run here."""
    path = os.pathsep.join([str(zig_site), str(ROOT)])
    environment = {**os.environ, build.VARIABLE: tag, "PYTHONPATH": path}
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr
    (made,) = tmp_path.glob(f"startrack-*-py3-none-{tag}.whl")
    with zipfile.ZipFile(made) as archive:
        libraries = {Path(name).name: archive.read(name) for name in archive.namelist() if "/compiled/" in name}
    target = build.TARGETS[tag]
    assert set(libraries) == {target.library_name(level) for level in target.levels}
    for content in libraries.values():
        assert processor(content) == (target.system, "x86_64" if "v3" in target.levels else "aarch64")


def test_the_kernels_compile_for_windows(zig_site, tmp_path, monkeypatch):
    """For one level of processors only: zig compiles the C library of Windows anew for each, for a minute."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(zig_site), str(ROOT)]))
    (library,) = build.build(tmp_path, ("baseline",), build.TARGETS["win_amd64"])
    assert library.suffix == ".dll" and processor(library.read_bytes()) == ("win32", "x86_64")


def processor(content):
    """The system and the processor that the bytes of a library are for, by the formats' published numbers."""
    if content[:4] == b"\x7fELF":
        return "linux", {62: "x86_64", 183: "aarch64"}[struct.unpack_from("<H", content, 18)[0]]
    if content[:4] == b"\xcf\xfa\xed\xfe":
        return "darwin", {0x01000007: "x86_64", 0x0100000C: "aarch64"}[struct.unpack_from("<I", content, 4)[0]]
    assert content[:2] == b"MZ"
    (header,) = struct.unpack_from("<I", content, 60)
    assert content[header : header + 4] == b"PE\0\0"
    return "win32", {0x8664: "x86_64", 0xAA64: "aarch64"}[struct.unpack_from("<H", content, header + 4)[0]]


def test_an_editable_installation_of_the_sources_compiles_beside_them(source_archive, tmp_path):
    own = Environment(sys.executable, tmp_path)
    with tarfile.open(source_archive) as archive:
        archive.extractall(tmp_path, filter="data")
    (sources,) = tmp_path.glob("startrack-*")
    own.pip("install", "-q", "--no-deps", "-e", sources)
    where = own.run(own.python, "-c", "import startrack; print(startrack.__file__)")
    assert Path(where.strip()).is_relative_to(sources)
    assert locate_elsewhere(sources, tmp_path).strip()


def newest_python(minor):
    """A Python 3.`minor` of pyenv or on the path; None without one."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    return next(iter(pyenv.glob(f"3.{minor}.*/bin/python3")), None) or shutil.which(f"python3.{minor}")


@pytest.mark.parametrize("minor", [11, 13])
def test_the_newest_packages_locate_a_sample_and_removal_leaves_nothing(wheel, tmp_path, minor):
    base = newest_python(minor)
    if base is None:
        pytest.skip(f"there is no Python 3.{minor} on this machine")
    own = Environment(base, tmp_path)
    own.pip("install", "-q", "--only-binary=:all:", wheel)
    own.locate_sample()
    assert len(list(own.folder.glob("venv/lib/python*/site-packages/startrack*"))) == 2
    own.pip("uninstall", "-q", "-y", "startrack")
    assert [path for path in own.folder.glob("venv/**/*") if path.name.startswith("startrack")] == []


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="the oldest packages have no wheels for this Python")
def test_the_oldest_packages_that_are_allowed_locate_a_sample_and_pass_the_tests_of_the_extras(wheel, tmp_path):
    """The lower bounds of pyproject.toml, all at once, in an environment of their own."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    bounds = [*project["dependencies"], *(bound for name in extras if name != "bench" for bound in extras[name])]
    found = [re.match(r"([\w.-]+)(?:\[\w+\])?>=([\w.]+)", bound) for bound in bounds]
    lowest = dict(one.groups() for one in found if one)
    own = Environment(sys.executable, tmp_path)
    (tmp_path / "lowest.txt").write_text("\n".join(map("==".join, lowest.items())))
    own.pip("install", "-q", "--only-binary=:all:", "-c", "lowest.txt", f"{wheel}[test,dev]")
    installed = json.loads(own.pip("list", "--format", "json"))
    versions = {re.sub(r"[-_.]+", "-", one["name"].lower()): one["version"] for one in installed}
    assert lowest.keys() - versions.keys() <= {"embreex"}  # which other processors do not get
    for name in lowest.keys() & versions.keys():
        assert re.fullmatch(rf"{re.escape(lowest[name])}(\.0)*", versions[name])
    own.locate_sample()
    own.run(own.python, "-c", f"import {', '.join(MODULES_OF_EXTRAS)}")
    own.run(
        own.python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *(ROOT / "tests" / one for one in TESTS_OF_EXTRAS)
    )
