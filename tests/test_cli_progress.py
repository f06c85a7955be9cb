"""Signs of life of long work, and what a picture that is not identified says of its sky."""

from __future__ import annotations

import io
import json
import re
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image
from render_helpers import FISHEYE
from scipy.spatial.transform import Rotation

from startrack import chain
from startrack.camera import camera_text
from startrack.catalog import apparent_stars, load_catalog
from startrack.chain import detect, identify
from startrack.chain.sky_state import BRIGHT_SKY, DARK_SKY, FEW_STARS, VISIBLE_SNR, count_expected_stars
from startrack.cli import console, images
from startrack.cli.main import main
from startrack.exposure import exposure_of, read_exposure


def test_long_work_without_a_terminal_prints_lines(monkeypatch):
    """While a step lasts too; none before the first interval is over, and none after the end."""
    monkeypatch.setattr(console, "LINE_S", 0.05)
    monkeypatch.setattr("sys.stderr", io.StringIO())
    with console.progress("horizon of 3 pictures", 3) as steps:
        steps.advance(text="measured the skyline of a.png")
        while sys.stderr.getvalue().count("\n") < 2:
            time.sleep(0.01)
        steps.advance(text="b.png")
    lines = sys.stderr.getvalue().splitlines()
    line = r"horizon of 3 pictures: 1 of 3, measured the skyline of a\.png, \d+ s"
    assert re.fullmatch(line, lines[0])
    time.sleep(0.2)
    assert sys.stderr.getvalue().splitlines() == lines
    with console.progress("table", 3, shown=False):
        time.sleep(0.2)
    assert sys.stderr.getvalue().splitlines() == lines


@pytest.mark.parametrize(("flags", "shown"), [([], True), (["-q"], False), (["--json"], False)])
@pytest.mark.parametrize("command", ["locate", "identify"])
def test_a_long_search_of_one_image_prints_lines(tmp_path, capsys, monkeypatch, command, flags, shown):
    monkeypatch.setattr(console, "LINE_S", 0.05)
    solve = {"locate": "locate_exposure", "identify": "identify"}[command]
    found = getattr(chain, solve)
    monkeypatch.setattr(chain, solve, lambda *args: time.sleep(0.2) or found(*args))
    image = Path(__file__).parent.parent / "sample_images/near-centre.png"
    assert main([command, str(image), "-D", str(tmp_path), "--no-plots", *flags]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith(f"{command} near-centre: ")]
    assert bool(lines) == shown
    assert all(re.fullmatch(r".*: \d+ s", line) for line in lines)


@pytest.mark.parametrize(
    "command", ["calibrate {image} --fov 160 -o {out}", "horizon {image} --fov 160 --site=34,-111 -o {out}",
                "track {image} -t shackleton-thesis -D {out}", "render --count 3 -c {camera} -D {out}"],
)  # fmt: skip
def test_commands_that_last_count_their_steps(tmp_path, monkeypatch, command):
    counted = []

    @contextmanager
    def record(what, steps):
        try:
            yield steps
        finally:
            counted.append((what.split()[0], steps.completed))

    monkeypatch.setattr(console, "_lines_about", record)
    picture(tmp_path, 100.0, 0)
    files = {"image": tmp_path / "a.png", "camera": tmp_path / "camera.toml", "out": tmp_path / "out.csv"}
    main(command.format(**files).split())
    assert [what for what, _ in counted] == [command.split()[0]]
    assert counted[0][1] > 0


def test_expected_stars_are_those_in_the_frame_of_a_clear_sky():
    """Against the stars of the catalogue that a camera in 100 random attitudes has in view above the noise."""
    stars = apparent_stars(load_catalog(), None, None)
    noise = np.random.default_rng(1).normal(1000.0, 6.0, (512, 512))
    y, x = np.mgrid[:512, :512]
    noise += 500 * np.exp(-0.5 * ((x - 250) ** 2 + (y - 250) ** 2))  # a source: an image without any is refused
    detected = detect(exposure_of(noise.round().astype(np.uint16)), FISHEYE)
    detected = replace(detected, exposure=replace(detected.exposure, exposure_s=0.5))
    found = detected.detections
    sensor, counts = FISHEYE.sensor, []
    limit_e = VISIBLE_SNR * np.median(found.noise_e) * np.sqrt(4 * np.pi) * sensor.psf_sigma_px
    bright = stars.v_mag < -2.5 * np.log10(limit_e / (0.5 * sensor.zero_point_e_per_s))
    for R in Rotation.random(100, rng=np.random.default_rng(2)).as_matrix():
        xy_px, inside = FISHEYE.project(stars.rays_icrs[bright] @ R.T)
        counts.append(np.count_nonzero(inside & (np.abs(xy_px - 255.5) < 256).all(axis=1)))
    assert min(counts) > 100
    expected = count_expected_stars(detected.exposure, found, FISHEYE, stars.v_mag)
    assert expected == pytest.approx(np.mean(counts), rel=0.05)


@pytest.mark.parametrize("noise_steps", [0.2, 1.0])
def test_a_picture_whose_rounding_hides_stars_is_told_from_a_noisy_one(tmp_path, capsys, noise_steps):
    """A few stars on a dim sky in 8 bits: what helps is finer values, and only where the rounding rules."""
    rng = np.random.default_rng(5)
    image, field = np.full((400, 400), 3.0), np.mgrid[:400, :400]
    for y, x in rng.uniform(20, 380, (9, 2)):
        image += 60 * np.exp(-0.5 * ((field[0] - y) ** 2 + (field[1] - x) ** 2) / 2.0**2)
    image += rng.normal(0, noise_steps, image.shape)
    Image.fromarray(image.round().clip(0, 255).astype(np.uint8)).save(tmp_path / "dim.jpg", quality=95)
    words = ["--fov", "120", "-D", str(tmp_path), "--no-plots"]
    assert main(["identify", str(tmp_path / "dim.jpg"), *words]) == 3
    (line,) = capsys.readouterr().out.splitlines()
    assert ("below half a step of the pixel values" in line and "raw or 16-bit" in line) == (noise_steps < 0.5)
    assert (FEW_STARS in line) == (noise_steps > 0.5)


@pytest.mark.parametrize("noise_steps", [0.2, 1.0])
def test_a_picture_without_sources_states_that_rounding_hides_them(tmp_path, capsys, noise_steps):
    image = np.random.default_rng(5).normal(3.4, noise_steps, (400, 400))
    Image.fromarray(image.round().clip(0, 255).astype(np.uint8)).save(tmp_path / "dim.png")
    assert main(["identify", str(tmp_path / "dim.png"), "--fov", "120", "-D", str(tmp_path), "--no-plots"]) == 3
    (line,) = capsys.readouterr().out.splitlines()
    assert "no point source" in line
    assert ("below half a step of the pixel values" in line and "raw or 16-bit" in line) == (noise_steps < 0.5)


@pytest.mark.parametrize(
    "flags",
    [["-c", "{camera}"], *(pytest.param(["--fov", fov], marks=pytest.mark.slow) for fov in ("160", "120..170"))],
)
@pytest.mark.parametrize(("level", "text"), [(100.0, "background from 1"), (40_000.0, "(90 % of the range)")])
def test_a_picture_that_is_not_identified_states_its_sky(tmp_path, capsys, flags, level, text):
    """Sources, background, and the stars of a clear sky; a bright sky and few stars come before the files."""
    picture(tmp_path, level, 60)
    words = [word.format(camera=tmp_path / "camera.toml") for word in flags]
    assert main(["identify", str(tmp_path / "a.png"), "-D", str(tmp_path), "--no-plots", *words]) == 3
    (line,) = capsys.readouterr().out.splitlines()
    assert re.search(r"Measured: \d+ point sources", line) and text in line
    assert (line.endswith(BRIGHT_SKY)) if level > 1000.0 else FEW_STARS in line
    assert "where a clear sky would show about" in line
    if ".." in flags[-1]:
        assert "no lens of 120 to 170 degrees" in line


@pytest.mark.parametrize("flags", [["-c", "{camera}"], pytest.param(["--fov", "40"], marks=pytest.mark.slow)])
def test_many_sources_on_a_dark_sky_are_no_clouds(tmp_path, capsys, flags):
    """Then the camera file or the field of view comes first, also in the advice."""
    picture(tmp_path, 100.0, 700)
    facts = tmp_path / "a.json"
    facts.write_text(facts.read_text().replace('"exposure_s": 0.5', '"exposure_s": 0.05'))
    words = [word.format(camera=tmp_path / "camera.toml") for word in flags]
    assert main(["identify", str(tmp_path / "a.png"), "-D", str(tmp_path), "--no-plots", *words]) == 3
    heard = capsys.readouterr()
    assert "clouds" not in heard.out + heard.err and "Moon" not in heard.out + heard.err
    assert ("if the field of view may be another" in heard.out) == (flags[0] == "--fov")
    assert ("may be another lens's" in heard.out) == (flags[0] == "-c")


def test_without_a_camera_file_none_is_to_be_checked(tmp_path):
    """The lens of the first picture is taken for further ones."""
    picture(tmp_path, 100.0, 700)
    exposure = replace(read_exposure(tmp_path / "a.png"), exposure_s=0.05)
    for name, lens in (
        ("unknown", "if its lens may differ from that of the others"),
        ("mine", "if mine may be another"),
    ):
        assert lens in identify(exposure, replace(FISHEYE, name=name), load_catalog()).message


@pytest.mark.parametrize("command", ["identify", "calibrate", "horizon"])
@pytest.mark.parametrize(("level", "advice"), [(40_000.0, BRIGHT_SKY), (100.0, DARK_SKY)])
def test_a_picture_without_a_source_is_bright_or_dark(tmp_path, capsys, command, level, advice):
    picture(tmp_path, level, 0)
    words = {
        "identify": ["-D", str(tmp_path), "--no-plots"],
        "calibrate": ["-o", str(tmp_path / "new.toml"), "--no-plots"],
        "horizon": ["-o", str(tmp_path / "a.hrz"), "--site", "46,7"],
    }
    assert main([command, str(tmp_path / "a.png"), "--fov", "150", *words[command]]) == 3
    heard = capsys.readouterr()
    assert advice in heard.out + heard.err and "next:" not in heard.err


def picture(folder, level, sources):
    """A picture of some dots that are no stars, above an uneven background."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:512, :512]
    pixels = rng.normal(level * (1 + x / 1000), 5.0)
    for place in rng.uniform(20, 490, (sources, 2)):
        pixels += 500 * np.exp(-0.5 * ((x - place[0]) ** 2 + (y - place[1]) ** 2))
    (folder / "a.png").write_bytes(cv2.imencode(".png", pixels.round().astype(np.uint16))[1])
    (folder / "camera.toml").write_text(camera_text(FISHEYE))
    facts = {"time_utc": "2030-01-01T00:00:00Z", "exposure_s": 0.5, "camera": "camera.toml"}
    (folder / "a.json").write_text(json.dumps(facts))


def test_a_line_of_work_states_the_time_left(monkeypatch):
    """At the speed of the steps after the first one, which may compile; a step that lasts does not raise it."""
    now_s = 100.0
    monkeypatch.setattr(console, "time", SimpleNamespace(monotonic=lambda: now_s))
    steps = console.Progress(10)
    now_s += 60.0
    assert steps.line() == "0 of 10, 60 s"
    steps.advance(text="a.png")
    assert steps.line() == "1 of 10, a.png, 60 s, about 9 minutes left"
    now_s += 15.0
    steps.advance(3, text="b.png")
    assert steps.line() == "4 of 10, b.png, 75 s, about 30 s left"
    now_s += 20.0
    assert steps.line() == "4 of 10, b.png, 95 s, about 10 s left"
    now_s += 2000.0
    assert steps.line() == "4 of 10, b.png, 2095 s"
    steps.advance(6)
    assert steps.line() == "10 of 10, b.png, 2095 s"
    assert console.Progress().line() == "0 s"


def test_a_picture_counts_once_and_one_without_a_time_is_left_out(monkeypatch, capsys):
    a, b = (exposure_of(np.full((9, 9), level, np.uint16), time_utc="2030-01-01T00:00:00Z") for level in (1, 2))
    named = {k: replace(one, name=k, sha256=sha) for k, one, sha in (("a", a, "1"), ("b", b, "2"), ("c", a, "1"))}
    named["d"] = replace(a, name="d", sha256="3", time_utc=None)
    monkeypatch.setattr(images, "read", lambda path, args: named[path])
    assert [one.name for one in images.read_each_once(SimpleNamespace(images=list(named)))] == ["a", "b"]
    first, second = capsys.readouterr().err.splitlines()
    assert first == "c: left out, bad_image: the same picture as a" and second.startswith("d: left out, no_time: ")
    assert [one.name for one in images.read_each_once(SimpleNamespace(images=["d"]))] == ["d"]
