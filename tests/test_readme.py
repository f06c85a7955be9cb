"""README.md and docs/: what they state about commands, files, keys and names (snippets: tests/test_pages.py)."""

import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib

import pytest
from astropy.table import Table
from page_helpers import ROOT, run_page
from PIL import ExifTags, Image

from startrack.camera import camera_from_dict
from startrack.camera.lenses import LENSES
from startrack.cli.main import COMMANDS, main
from startrack.core import file_kinds
from startrack.core.errors import Reason
from startrack.terrain import terrain_from_dict

README = (ROOT / "README.md").read_text(encoding="utf-8")
FORMATS = (ROOT / "docs/formats.md").read_text(encoding="utf-8")
LISTED_IN_ONE_ROW = {"timing_ms", "camera"}
PAGES = sorted([ROOT / "README.md", ROOT / "CONVENTIONS.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("*/README.md")])


def blocks(text, language):
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def marked_line(name):
    """The one line of the block after <!-- name -->."""
    (block,) = re.findall(rf"<!-- {name} -->\n```sh\n(.*?)```", README, flags=re.DOTALL)
    (line,) = block.strip().splitlines()
    return line


def test_the_page_is_true(clone):
    """Its snippets run, and what it states about them holds."""
    ran = run_page(ROOT / "README.md")
    files = {
        f"near-wall.{end}"
        for end in ("annotated.png", "corr", "fix.json", "skyline.ecsv", "skyline.png", "stars.ecsv", "wcs")
    }
    assert files == {path.name for path in (clone / "startrack-out").glob("near-wall*")}
    with_camera, with_fov = (
        int(re.search(r"(\d+) stars", text)[1]) for line, text in ran.printed.items() if "lowell" in line
    )
    (least,) = re.findall(r"names more than ([\d,]+) stars", README)
    assert with_camera > int(least.replace(",", "")) and with_fov > 1000
    (text,) = (text for line, text in ran.printed.items() if "mine.png --json" in line)
    record = json.loads(text.splitlines()[-1])
    error_m = abs(record["position"]["east_m"] - 2500) + abs(record["position"]["north_m"] + 1200)
    assert error_m < 2 * record["position"]["radius999_m"] < 200
    (text,) = (text for code, text in ran.printed.items() if code.startswith("import startrack"))
    assert re.match(r"near-wall.png  ok  E -6[89]\d\d.\d m  N (46|47)\d\d.\d m  ±\d+.\d m", text)
    assert "Canopus" in text and "seen" in text


def test_the_true_position_is_the_one_the_page_gives():
    east, north = re.search(r"stood at E (-?[\d.]+) m, N (-?[\d.]+) m", README).groups()
    known = json.loads((ROOT / "sample_images/near-wall.truth.json").read_text())
    assert known["position_enu_m"][:2] == [float(east), float(north)]


def test_pages_and_pictures_of_the_sample_show_one_solution():
    """The line that `locate` prints (`test_the_page_is_true`, `test_pages.py`) is the one of which the pictures are."""
    pages = [ROOT / "README.md", ROOT / "docs/library.md", ROOT / "docs/tutorials/first-fix.md"]
    printed = [re.findall(r"^near-wall\.png  ok .* stars", page.read_text(encoding="utf-8"), re.M) for page in pages]
    (line,) = {one for found in printed for one in found}
    assert all(printed)
    drawn = {}
    for name in ("hero.webp", "annotated.webp", "skyline.webp", "report.webp", "posterior.png"):
        with Image.open(ROOT / "docs/images" / name) as image:
            drawn[name] = image.info.get("Description") or image.getexif()[ExifTags.Base.ImageDescription]
    assert set(drawn.values()) == {line.replace("±", "+-").replace("°", "")}, drawn
    east, north = (float(re.search(rf"{axis} (-?[\d.]+) m", line)[1]) for axis in "EN")
    truth = json.loads((ROOT / "sample_images/near-wall.truth.json").read_text())["position_enu_m"]
    error_m = ((east - truth[0]) ** 2 + (north - truth[1]) ** 2) ** 0.5
    (stated,) = re.findall(r"True error: ([\d.]+) m", README)
    assert float(stated) == pytest.approx(error_m, abs=0.07)  # roundings of both


def test_ci_runs_the_command_of_the_page():
    """.ci/run takes the line out of the page; here only that it finds the right one."""
    line = marked_line("test")
    script = (ROOT / ".ci/run").read_text(encoding="utf-8")
    (sed,) = re.findall(r"\$\((sed .*README\.md)\)", script)
    found = subprocess.run(["bash", "-c", sed], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert found.splitlines() == [line]
    assert line.startswith("python3 -m venv .venv && .venv/bin/pip install")
    assert ".venv/bin/pytest" in line


@pytest.mark.parametrize(("quick", "slow"), [(0, 0), (1, 0), (0, 1), (2, 3)], ids=lambda code: f"exit{code}")
def test_ci_runs_the_slow_tests_after_the_command(tmp_path, quick, slow):
    """In a clone whose tests are a stub: both runs happen, the second's output is the last, and a failure stays."""
    stub = f'#!/bin/sh\necho "pytest $*"\ncase "$*" in *slow*) exit {slow};; esac\nexit {quick}\n'
    for name, text in (
        (".ci/run", (ROOT / ".ci/run").read_text(encoding="utf-8")),
        ("README.md", "<!-- test -->\n```sh\npython3 --version && .venv/bin/pytest -n auto\n```\n"),
        (".venv/bin/pytest", stub),
        ("bin/chromium", "#!/bin/sh\n"),
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
        (tmp_path / name).chmod(0o755)
    path = f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"
    ran = subprocess.run([tmp_path / ".ci/run"], env={**os.environ, "PATH": path}, capture_output=True, text=True)
    printed = [line for line in ran.stdout.splitlines() if line.startswith("pytest")]
    assert printed == ["pytest -n auto", "pytest -n auto --dist loadfile -m slow"]
    assert ran.stdout.endswith("loadfile -m slow\n")
    assert (ran.returncode == 0) == (quick == slow == 0)


@pytest.mark.parametrize("mark", [None, "slow"])
def test_only_the_mark_selects_slow_tests(mark):
    """Of a file of slow tests, pytest alone collects none, and `-m slow` all of them."""
    flags = ["-q", "--collect-only", *(["-m", mark] if mark else [])]
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", *flags, "tests/test_wheel.py"], cwd=ROOT, capture_output=True, text=True
    )
    assert ran.returncode == (0 if mark else 5), ran.stdout + ran.stderr  # 5: pytest collected no test
    assert ("deselected" in ran.stdout) == (mark is None)


def test_commands_of_the_table_are_the_commands():
    assert re.findall(r"^\| `startrack (\w+)", README, flags=re.MULTILINE) == list(COMMANDS)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_have_targets(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), target


def test_camera_and_terrain_of_the_format_page_are_the_shipped_ones():
    camera, terrain = (tomllib.loads(block) for block in blocks(FORMATS, "toml"))
    shipped = tomllib.loads((ROOT / "calib/fisheye-2048.toml").read_text())
    assert {key: value for key, value in camera.items() if key != "mount"} == shipped
    assert terrain == tomllib.loads((ROOT / "terrain/shackleton-thesis.toml").read_text())
    # The mount that is shown is the one that stands in when it is absent.
    assert camera_from_dict(camera).R_body_cam == pytest.approx(camera_from_dict(shipped).R_body_cam, abs=1e-12)
    assert terrain_from_dict(terrain).name == "shackleton-thesis"


def test_lenses_and_kinds_of_files_of_the_pages_are_those_of_the_lists():
    for lens in LENSES:
        assert f"`{lens.model}`: rho = {lens.law}" in FORMATS
        assert [key for key in lens.file_keys() if f"\n| `{key}` |" not in FORMATS] == []
    kinds = re.search(r"^PNG .*", FORMATS, flags=re.MULTILINE)[0]
    assert [kind for kind in file_kinds.FORMATS if kind not in kinds] == []
    assert f"Images may be {', '.join(file_kinds.FORMATS)} or" in (ROOT / "docs/options.md").read_text(encoding="utf-8")


def leaf_keys(value, before=""):
    """Keys as the page writes them: of nested dictionaries with dots, of lists of dictionaries by themselves."""
    for key, inner in value.items():
        if isinstance(inner, dict) and before + key not in LISTED_IN_ONE_ROW:
            yield from leaf_keys(inner, f"{before}{key}.")
            continue
        yield before + key
        if isinstance(inner, dict):
            yield from inner
        elif isinstance(inner, list) and inner and isinstance(inner[0], dict):
            yield from inner[0]


@pytest.mark.parametrize(
    "command", ["locate near-wall.png", "identify lowell-2018-08-06.fits.bz2", "detect near-centre.png"]
)
def test_every_key_that_is_written_is_explained(clone, capsys, command):
    name, image = command.split()
    assert main([name, f"sample_images/{image}", "--json", "--no-plots"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert [key for key in leaf_keys(record) if f"`{key}`" not in FORMATS] == []
    assert f"`{record['format']}`" in FORMATS
    tables = list((clone / "startrack-out").glob("*.ecsv"))
    assert len(tables) == {"locate": 2, "identify": 1, "detect": 0}[name]
    for table in tables:
        columns = Table.read(table, format="ascii.ecsv").colnames
        assert [column for column in columns if f"`{column}`" not in FORMATS] == []


def test_reasons_and_their_exit_codes_are_those_of_the_code():
    rows = re.findall(r"^\| `(\w+)` \| ([134]) \|", FORMATS, flags=re.MULTILINE)
    assert {name: int(code) for name, code in rows} == {one.value: one.exit_code for one in Reason}


def test_tables_of_the_format_page_are_made_from_the_code():
    """After a new quantity, reason or package: python docs/make_tables.py."""
    spec = importlib.util.spec_from_file_location("make_tables", ROOT / "docs/make_tables.py")
    make_tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_tables)
    texts, between = [page.read_text(encoding="utf-8") for page in make_tables.PAGES], "\n<!-- next page -->\n"
    made = make_tables.page_with_tables(between.join(texts)).split(between)  # at once: the tables are made once
    for page, text, new in zip(make_tables.PAGES, texts, made, strict=True):
        assert new == text, page


def test_links_between_pages_show_titles_and_no_file_names():
    texts = [
        text for page in PAGES for text in re.findall(r"\[([^\]\n]+)\]\([^)\n]+\)", page.read_text(encoding="utf-8"))
    ]
    assert len(texts) > 100
    assert [text for text in texts if text.endswith(".md")] == []
