"""A new lens, terrain, image format and command: each is one file and one entry of a list.

The files lie in a folder of their own. `sitecustomize`, which every process runs first, adds them and the entries to
the sources as they are imported: nothing of the package is changed on disk.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

ROOT = Path(__file__).parent.parent
TIME = "2030-01-01T00:00:00"

pytestmark = pytest.mark.slow

FILES = {
    "startrack.camera.sine": '''
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from startrack.camera.lens import Lens


@dataclass(frozen=True)
class Sine(Lens):
    """rho = 2 sin(a / 2)."""

    model: ClassVar[str] = "sine"
    label: ClassVar[str] = "sine"
    law: ClassVar[str] = "2 sin(a / 2)"

    def rho(self, angle_rad):
        return 2.0 * np.sin(np.asarray(angle_rad) / 2.0)

    def slope(self, angle_rad):
        return np.cos(np.asarray(angle_rad) / 2.0)
''',
    "startrack.terrain.wall": '''
from dataclasses import dataclass
import numpy as np

from startrack.core.declaration import Table, Text
from startrack.frames import Site
from startrack.terrain.protocol import Terrain, TerrainFile

TABLE = Table(keys={"file": Text(max_chars=100, required=True, description="height [m]")})


@dataclass(frozen=True, eq=False, kw_only=True)
class Wall(Terrain):
    """At every azimuth a plane wall that faces the camera, 1000 m from the origin."""

    name: str
    site: Site
    height_m: float
    file: TerrainFile
    camera_height_m: float = 1.5
    search_radius_m: float = 300.0

    def distance_m(self, points_m, azimuths_rad):
        return 1000 - points_m[..., 0] * np.sin(azimuths_rad) - points_m[..., 1] * np.cos(azimuths_rad)

    def horizon_rad(self, points_m, azimuths_rad):
        return np.arctan2(self.height_m, self.distance_m(points_m, azimuths_rad))

    def horizon_bounds_rad(self, centres_m, half_m, azimuths_rad, azimuth_half_rad=0.0):
        turn = np.minimum(azimuth_half_rad, np.pi / 2)
        off_origin = np.hypot(centres_m[..., 0], centres_m[..., 1])
        slack = np.sqrt(2.0) * np.asarray(half_m) + off_origin * (np.sin(turn) + 1 - np.cos(turn))
        distance = self.distance_m(centres_m, azimuths_rad)
        return np.arctan2(self.height_m, distance + slack), np.arctan2(self.height_m, distance - slack)

    def ground_m(self, points_m):
        return np.zeros(np.shape(points_m)[:-1])


def make_wall(keys, folder, **shared):
    return Wall(height_m=float((folder / keys["wall"]["file"]).read_text()), **shared)
''',
    "startrack.exposure.counts": '''
import numpy as np

from startrack.exposure.decoding import Decoded


def decode(raw):
    """COUNTS, width and height, 16 bits each, and the pixels row by row."""
    width, height = np.frombuffer(raw, "<u2", 2, 6)
    pixels = np.frombuffer(raw, "<u2", int(width) * int(height), 10).reshape(height, width)
    return Decoded(pixels_adu=pixels.astype(np.float32), saturation_adu=65535.0)
''',
    "startrack.cli.size": '''
from startrack.cli.flags import FACTS, IMAGES, MORE, Command
from startrack.cli.images import read


def run(args):
    """Print the size of each image; 0."""
    for path in args.images:
        print(*read(path, args).size_px)
    return 0


COMMANDS = (Command("size", run, "sizes of images", "Print sizes.", {"input": (IMAGES, *FACTS), "more": MORE}),)
''',
}
WALL = "__import__('startrack.terrain.wall', fromlist='*')"
ENTRIES = {  # of the module of each list: the entry, with the beginning of the line that follows it
    "startrack.camera.lenses": [("    __import__('startrack.camera.sine', fromlist='*').Sine,", "    Pinhole,")],
    "startrack.terrain.io": [
        (f'    "wall": Kind({WALL}.TABLE, {WALL}.make_wall),', '    "cylinder": Kind('),
    ],
    "startrack.core.file_kinds": [('    "COUNTS": Format((b"COUNTS",), (".counts",)),', '    "PNG": Format(')],
    "startrack.cli.main": [('    "size": "size",', '    "locate": "pictures"')],
}
SITECUSTOMIZE = """
import importlib.machinery, importlib.util, json, pathlib, sys

here = pathlib.Path(__file__).parent
entries = json.loads((here / "entries.json").read_text())


class Editor(importlib.machinery.SourceFileLoader):
    def get_code(self, name):
        text = pathlib.Path(self.path).read_text()
        for entry, following in entries[name]:
            assert text.count("\\n" + following) == 1, (name, following)
            text = text.replace("\\n" + following, "\\n" + entry + "\\n" + following)
        return compile(text, self.path, "exec")


class Finder:
    @staticmethod
    def find_spec(name, path, target=None):
        if (here / f"{name}.py").is_file():
            return importlib.util.spec_from_file_location(name, here / f"{name}.py")
        if name in entries:
            origin = importlib.machinery.PathFinder.find_spec(name, path).origin
            return importlib.util.spec_from_file_location(name, origin, loader=Editor(name, origin))
        return None


sys.meta_path.insert(0, Finder)
"""
CAMERA = """
name = "own"
model = "sine"
size_px = [512, 512]
focal_px = [170.0, 170.0]
centre_px = [255.5, 255.5]
max_angle_deg = 92.5
[sensor]
zero_point_e_per_s = 44000.0
gain_e_per_adu = 0.5
bias_adu = 100.0
read_noise_e = 2.5
"""
TERRAIN = """
name = "walls"
body = "moon"
[origin]
latitude_deg = -89.66
longitude_deg = 129.78
[wall]
file = "height.txt"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the four new files, a camera, a terrain, and one image."""
    base = tmp_path_factory.mktemp("extension")
    (base / "own").mkdir()
    for name, text in {**FILES, "sitecustomize": SITECUSTOMIZE}.items():
        (base / "own" / f"{name}.py").write_text(text)
    (base / "own/entries.json").write_text(json.dumps(ENTRIES))
    (base / "own.toml").write_text(CAMERA)
    (base / "walls.toml").write_text(TERRAIN)
    (base / "height.txt").write_text("150")
    pose = ("--time", TIME, "--east", "120", "--north", "-80", "--exposure", "2")
    startrack(base, "render", "-c", "own.toml", "-t", "walls.toml", *pose, "-o", "night/one.png")
    pixels = cv2.imread(str(base / "night/one.png"), cv2.IMREAD_UNCHANGED)
    counts = pixels.astype("<u2").tobytes()
    height, width = (int(n).to_bytes(2, "little") for n in pixels.shape)
    (base / "night/one.counts").write_bytes(b"COUNTS" + width + height + counts)
    (base / "night/one.png").unlink()
    return base


def startrack(base, *words, code=0):
    """What the command prints; its exit code is `code`."""
    path = os.pathsep.join([str(base / "own"), str(ROOT)])
    done = subprocess.run(
        [sys.executable, "-m", "startrack", *words], cwd=base, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout


def test_the_command_reads_the_format(folder):
    assert "sizes of images" in startrack(folder, "--help")
    assert startrack(folder, "size", "night/one.counts").split() == ["512", "512"]


def test_help_and_schema_name_the_format_and_the_law(folder):
    assert "COUNTS, PNG" in startrack(folder, "size", "--help")
    assert ", or 2 sin(a / 2)" in startrack(folder, "schema", "camera")


def test_it_is_located(folder):
    position = json.loads(startrack(folder, "locate", "night/one.counts", "--json", "--no-plots"))["position"]
    assert position["terrain"] == "walls"
    assert abs(position["east_m"] - 120) < position["radius999_m"] < 100
    assert abs(position["north_m"] + 80) < position["radius999_m"]


def test_a_batch_locates_again_where_a_file_of_the_terrain_has_changed(folder):
    words = ("batch", "night", "-D", "batch", "-j", "1", "--no-plots")
    assert "1 image: 1 ok;" in startrack(folder, *words)
    assert "(1 were there already)" in startrack(folder, *words)
    (folder / "height.txt").write_text("150.01")
    assert "1 image: 1 ok;" in startrack(folder, *words)


def test_it_is_tracked(folder):
    record = json.loads(startrack(folder, "track", "night", "-D", "track", "--json", "--no-plots"))
    assert record["status"] == "used"
    assert abs(record["east_m"] - 120) < 100


def test_it_is_predicted(folder):
    words = ("predict", "-t", "walls.toml", "-c", "own.toml", "--time", TIME, "--spacing", "300", "--draws", "1")
    text = startrack(folder, *words, "-j", "1", "--exposure", "2", "-D", "predict", "--json", "--no-plots")
    assert re.search(r'"terrain": "walls', text)
