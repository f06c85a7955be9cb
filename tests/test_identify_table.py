"""`identify` lists the stars that it names; with --catalog-table those of the catalogue in view too."""

from __future__ import annotations

import json
from pathlib import Path

from astropy.table import Table

from startrack.cli.main import main

IMAGE = Path(__file__).parent.parent / "sample_images" / "near-wall.png"


def test_the_table_of_identify_holds_the_named_stars(tmp_path):
    tables = {}
    for flags in ([], ["--catalog-table"]):
        out = tmp_path / str(len(flags))
        assert main(["identify", str(IMAGE), "-D", str(out), "--no-plots", "-q", *flags]) == 0
        tables[len(flags)] = Table.read(out / "near-wall.stars.ecsv", format="ascii.ecsv")
    named = json.loads((out / "near-wall.identification.json").read_text())["stars"]["identified"]
    assert len(tables[0]) == named and set(tables[0]["status"]) == {"identified"}
    assert len(tables[1]) > named and (tables[1]["status"] == "identified").sum() == named
