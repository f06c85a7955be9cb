"""Measured results say of which program they are: stored with a hash of the sources, and marked once these change."""

import importlib
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture
def results(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "benchmarks"), *sys.path])
    return importlib.import_module("_results")


@pytest.fixture
def sources(results):
    return importlib.import_module("_sources")


def test_the_page_is_that_of_the_stored_results(results):
    text = results.RESULTS.read_text(encoding="utf-8")
    assert text == results.results_text(), "make it anew: python benchmarks/run.py --render"


def test_each_result_has_its_place_and_a_command_that_exists(results):
    stored = results.stored_results()
    assert sorted(one.path.name for one in stored) == sorted(path.name for path in results.STORE.iterdir())
    assert len({one.place for one in stored}) == len(stored) > 30
    for one in stored:
        assert one.benchmark.is_file(), one.section
        assert re.fullmatch(r"20\d\d-\d\d-\d\d", one.date)
        for block in one.blocks:
            assert "text" in block or all(len(row) == len(block["head"]) for row in block["rows"]), one.section


def test_a_repeated_benchmark_stores_its_result(results):
    run = importlib.import_module("run")
    for one in results.stored_results():
        needs_flag = "args.write" in one.benchmark.read_text(encoding="utf-8")
        assert ("--write" in run.storing_command(one)) == needs_flag, one.section


def test_a_result_is_marked_when_its_sources_change_and_no_other_is(results, sources, monkeypatch):
    """As if a line of the detector were another one."""
    detector = ROOT / "startrack/detection/detector.py"
    stored = [replace(one, sources=sources.hash_of(one.benchmark)) for one in results.stored_results()]
    assert all(one.is_fresh for one in stored)
    code_of = sources.code_of
    monkeypatch.setattr(sources, "code_of", lambda path: code_of(path) + "\nx = 1" * (path == detector))
    sources.hash_of.cache_clear()
    for one in stored:
        assert one.is_fresh == (detector not in sources.sources_of(one.benchmark)), one.section
        assert (results.MARK in one.text()) != one.is_fresh
    names = {one.section for one in stored if one.is_fresh}
    sources.hash_of.cache_clear()
    assert "Horizons" in names and not names & {"Chain", "Slips", "Stars: detection", "Installation", "Mutated files"}


def test_what_a_benchmark_loads_is_among_its_sources(sources):
    """Of one that locates an image: all modules of startrack that it has loaded then, but those of unused names."""
    code = (
        "import sys, startrack; startrack.locate('sample_images/near-wall.png');"
        "print(*(m.__file__ for n, m in sys.modules.items() if n.startswith('startrack') and m.__file__), sep='\\n')"
    )
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    known = {str(path) for path in sources.sources_of(ROOT / "benchmarks/one_frame.py")}
    faces = {str(path) for path in (ROOT / "startrack").rglob("__init__.py")}  # that only gather names
    unused = {"camera/virtualsky.py"}  # its package gathers all names
    assert {Path(one).relative_to(ROOT / "startrack").as_posix() for one in {*loaded.split()} - known - faces} == unused


def test_comments_and_docstrings_are_no_part_of_the_sources(sources, tmp_path):
    plain, told = tmp_path / "plain.py", tmp_path / "told.py"
    plain.write_text('def f(x):\n    y = "# no comment"\n    return y\n')
    lines = ['"""A module."""', "# A comment.", "def f(x):", '    """Text', '    in two lines."""']
    told.write_text("\n".join([*lines, '    y = "# no comment"  # why', "", "    return y", ""]))
    assert sources.code_of(plain) == sources.code_of(told)
    told.write_text('def f(x):\n    y = "#"\n    return y\n')
    sources.code_of.cache_clear()
    assert sources.code_of(plain) != sources.code_of(told)


def test_markdown_becomes_blocks_and_markdown_again(results):
    body = "Some text\nin two lines.\n\n| a | b |\n| --- | --- |\n| 1 |  |\n\nMore."
    blocks = results.blocks_of(body)
    assert [sorted(one) for one in blocks] == [["text"], ["head", "rows"], ["text"]]
    one = replace(results.stored_results()[0], blocks=blocks)
    assert one.text().endswith(body)


def test_the_front_page_states_measured_figures(monkeypatch):
    """Errors [m] by stars, with the light of the sky, and by Kua's method, as the stored results have them."""
    monkeypatch.setattr(sys, "path", [str(ROOT / "docs"), *sys.path])
    figures = importlib.import_module("measured_figures")
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    stated = re.search(r"is ([\d.]+) m by the stars, and ([\d.]+) m with the light of the sky", text)
    kua = re.search(r"gives (\d+) m on such pictures", text)
    blocks = [block for name in figures.FRONT_PAGE for block in figures.result_of(name)["blocks"]]
    cells = {tuple(row[:2]): row for block in blocks for row in block.get("rows", [])}
    assert float(stated[1]) == round(float(cells["6.0", "without remeasuring near the skyline"][4]), 1)
    errors = next(block["rows"] for block in figures.result_of("Chain")["blocks"] if "head" in block)
    means = {row[0]: float(row[1]) for row in errors}
    assert float(stated[2]) == means["startrack"]
    assert float(kua[1]) == round(means["pseudo-gradient (Kua 2008)"])
