"""benchmarks/compare_outputs.py: differences between two folders of outputs are found and reported."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent / "benchmarks/compare_outputs.py"
FIX = {
    "status": "ok",
    "reason": None,
    "position": {"east_m": 424.1605, "north_m": -320.7067, "up_m": 1.5},
    "timing_ms": {"detect": 698.2},
    "provenance": {"version": "0.1.0", "camera": "/old/frames/camera.toml"},
    "matches": [{"hip": 1, "x_px": 10.25}, {"hip": 2, "x_px": 20.5}],
}
STARS = """# %ECSV 1.0
# ---
# delimiter: ','
catalog_id,x_px,cause
HIP 1,10.250,
HIP 2,20.500,glare
"""


@pytest.fixture
def write_version(tmp_path):
    """Writes the fix and the star table of one version, and returns the folder."""

    def write(name, fix=FIX, stars=STARS):
        folder = tmp_path / name / "locate"
        folder.mkdir(parents=True)
        (folder / "a.fix.json").write_text(json.dumps(fix))
        (folder / "a.stars.ecsv").write_text(stars)
        return folder.parent

    return write


def compare(*words):
    run = subprocess.run([sys.executable, SCRIPT, *map(str, words)], capture_output=True, text=True, check=False)
    assert not run.stderr
    return run.returncode, run.stdout


def test_identical_folders_are_equal(write_version):
    code, text = compare(write_version("old"), write_version("new"))
    assert code == 0
    assert "| locate/a.fix.json | 10 | 0 | 0 | - | ok | 0 |" in text
    assert "| locate/a.stars.ecsv | 6 | 0 | 0 | - | - | - |" in text


def test_times_versions_and_folders_are_not_compared(write_version):
    other = {"timing_ms": {"detect": 1.0}, "provenance": {"version": "2", "camera": "/home/new/camera.toml"}}
    assert compare(write_version("old"), write_version("new", FIX | other))[0] == 0


def test_a_changed_number_is_found(write_version):
    moved = FIX | {"position": FIX["position"] | {"east_m": 427.1605, "north_m": -324.7067}}
    code, text = compare(write_version("old"), write_version("new", moved))
    assert code == 1
    assert "| locate/a.fix.json | 10 | 2 | 0 | 1.2e-02 position.north_m | ok | 5 |" in text
    assert "position.east_m: 1, largest 7.0e-03: 424.1605 -> 427.1605" in text
    assert compare(write_version("older"), write_version("newer", moved), "--tolerance", "0.02")[0] == 0


def test_objects_and_rows_are_paired_by_name(write_version):
    turned = FIX | {"matches": FIX["matches"][::-1]}
    stars = STARS.splitlines()
    code, _ = compare(
        write_version("old"), write_version("new", turned, "\n".join([*stars[:4], stars[5], stars[4]]) + "\n")
    )
    assert code == 0


def test_added_and_removed_keys_are_listed(write_version):
    code, text = compare(
        write_version("old"), write_version("new", FIX | {"covered": 0.5}, STARS.replace("HIP 2", "HIP 3"))
    )
    assert code == 0
    assert "- added: covered (1)" in text
    assert "- added: [].x_px (1)" in text and "- removed: [].x_px (1)" in text


def test_a_changed_status_is_reported(write_version):
    refused = {key: FIX[key] for key in FIX if key != "position"} | {"status": "refused", "reason": "no_stars"}
    code, text = compare(write_version("old"), write_version("new", refused))
    assert code == 1
    assert "| ok -> refused no_stars | - |" in text


@pytest.mark.parametrize(
    ("printed", "code", "differ", "last"),
    [("20.501", 0, 0, 1), ("20.502", 1, 1, 0), ("21", 1, 1, 0), ("", 1, 1, 0), ("inf", 1, 1, 0)],
)
def test_a_last_digit_of_a_table_is_no_difference(write_version, printed, code, differ, last):
    result, text = compare(write_version("old"), write_version("new", stars=STARS.replace("20.500", printed)))
    assert result == code
    assert f"| locate/a.stars.ecsv | 6 | {differ} | {last} |" in text


def test_a_missing_file_is_a_failure(write_version):
    old, new = write_version("old"), write_version("new")
    (new / "locate/a.stars.ecsv").unlink()
    code, text = compare(old, new)
    assert code == 1
    assert "Files removed: locate/a.stars.ecsv" in text
    assert compare(new, old)[0] == 0


def test_empty_folders_are_not_taken_for_equal(tmp_path):
    assert compare(tmp_path, tmp_path)[0] == 2
