"""A folder of results to make pages of, as `locate` and `batch` leave it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from startrack.report import write_json, write_results

NASTY = "ein <b>\"Bild\"</b> & 'mehr' </script><script>alert(1)</script> ünï✶.png"


def results_in(out: Path, located: Any) -> Path:
    """One image solved, one ambiguous in a folder below, two refused."""
    record = write_results(located.result, out / "small.fix.json") | {"image": "small.png"}
    record["provenance"] |= {"camera": "/somewhere/else/cameras/small-fisheye.toml"}
    write_json(out / "small.fix.json", record)
    (out / "night 1").mkdir()
    modes = [
        {"east_m": 6000.0, "north_m": -2500.0, "weight": 0.75},
        {"east_m": -3000.0, "north_m": 10.0, "weight": 0.25},
    ]
    ambiguous = {key: value for key, value in record.items() if key != "position"} | {
        "image": "night 1/two.png", "status": "ambiguous", "reason": "ambiguous", "message": "two places fit",
        "modes": modes, "warnings": ["EXIF orientation 6 is not used"],
    }  # fmt: skip
    write_json(out / "night 1/two.fix.json", ambiguous)
    shutil.copy(out / "small.annotated.png", out / "night 1/two.annotated.png")
    shutil.copy(out / "small.wcs", out / "night 1/two.wcs")
    refused = {"format": "startrack.fix/1", "status": "refused"}
    write_json(out / "bad.fix.json", {**refused, "image": NASTY, "reason": "bad_image", "message": NASTY})
    write_json(out / "dark.fix.json", {**refused, "image": "dark.png", "reason": "no_stars", "message": "no star"})
    return out
