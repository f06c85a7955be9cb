"""The star table: astropy reads back the measured values, and its status agrees with the renderer's truth."""

from __future__ import annotations

import csv
import re
from dataclasses import replace

import numpy as np
import pytest
from astropy import units
from astropy.table import Table
from stage_helpers import as_stage

from startrack.chain.stages import Identified, Oriented
from startrack.output import Column, ecsv_text, write_star_table
from startrack.output.tables import star_table_text, status_of

COLUMNS = (
    "catalog_id hip name v_mag azimuth_deg elevation_deg x_px y_px x_measured_px y_measured_px saturated "
    "expected_e flux_e sigma_e evidence status cause"
)


@pytest.fixture(scope="module")
def table(located, tmp_path_factory):
    path = tmp_path_factory.mktemp("table") / "small.stars.ecsv"
    write_star_table(path, located.result)
    return Table.read(path, format="ascii.ecsv")


def test_every_measured_star_is_a_row_in_its_units(table, located):
    light, stars = located.result.photometry, located.result.stars
    assert " ".join(table.colnames) == COLUMNS
    assert len(table) == len(light.star)
    assert table["catalog_id"].tolist() == stars.catalog_id[light.star].tolist()
    assert table["azimuth_deg"].unit == table["elevation_deg"].unit == units.deg
    assert table["x_px"].unit == table["y_measured_px"].unit == units.pix
    assert table["flux_e"].unit == units.electron
    assert table["v_mag"].unit == units.mag
    assert table["hip"].dtype == np.int64
    np.testing.assert_allclose(table["azimuth_deg"], np.degrees(light.azimuth_rad), atol=1e-5)
    np.testing.assert_allclose(np.stack([table["x_px"], table["y_px"]], axis=-1), light.xy_px, atol=6e-4)
    np.testing.assert_allclose(table["expected_e"], light.expected_e, rtol=1e-5)


def test_what_was_not_measured_is_masked(table, located):
    result = located.result
    measured = ~np.ma.getmaskarray(table["x_measured_px"])
    assert measured.sum() == len(result.identification)
    rows = table[measured]
    off = np.hypot(rows["x_px"] - rows["x_measured_px"], rows["y_px"] - rows["y_measured_px"])
    assert np.median(off.filled(99.0)) < 0.3
    unusable = table["status"] == "unusable"
    assert unusable.sum() > 10
    for name in ("flux_e", "sigma_e", "evidence"):
        assert (np.ma.getmaskarray(table[name]) == unusable).all()
    assert (np.ma.getmaskarray(table["cause"]) == ~unusable).all()
    assert set(table["cause"][unusable]) <= set(result.photometry.cause.tolist())


def test_the_status_agrees_with_the_truth(table, located):
    truth = dict(zip(located.truth.sources.catalog_id.tolist(), located.truth.hidden.tolist(), strict=True))
    for status, is_hidden in (("seen", False), ("hidden", True)):
        ids = table["catalog_id"][table["status"] == status].tolist()
        right = np.mean([truth[one] == is_hidden for one in ids])
        assert len(ids) > 500
        assert right > 0.98
    names = {row["catalog_id"]: row["name"] for row in table[:200]}
    assert names.get("HIP 30438") == "Canopus"


def test_status_of_evidence(located):
    light = located.result.photometry
    few = [replace_row(light, llr, cause) for llr, cause in ((3.5, ""), (-3.5, ""), (0.5, ""), (0.0, "bad pixels"))]
    assert [status_of(one)[0] for one in few] == ["seen", "hidden", "uncertain", "unusable"]


def replace_row(light, llr, cause):
    return replace(light, llr=np.array([llr]), cause_code=np.array([1 if cause else 0]), causes=("", cause))


def test_without_a_terrain_there_are_matches_and_predictions(located, tmp_path):
    result = as_stage(located.result, Oriented, terrain=None)
    write_star_table(tmp_path / "t.ecsv", result, catalog=True)
    table = Table.read(tmp_path / "t.ecsv", format="ascii.ecsv")
    assert table.colnames == [*COLUMNS.split()[:4], *COLUMNS.split()[6:11], "status"]
    matched = ~np.ma.getmaskarray(table["x_measured_px"])
    assert matched.sum() == len(result.identification)
    assert (~matched).sum() > 100
    assert set(table["status"][matched]) == {"identified"} and set(table["status"][~matched]) == {"predicted"}
    write_star_table(tmp_path / "named.ecsv", result)
    named = Table.read(tmp_path / "named.ecsv", format="ascii.ecsv")
    assert named.colnames == table.colnames
    assert [tuple(row) for row in named] == [tuple(row) for row in table[matched]]
    with pytest.raises(ValueError, match="identified"):
        star_table_text(as_stage(result, Identified))


def test_a_full_table_has_a_line_for_each_star(located):
    light = located.result.photometry
    many = np.resize(np.arange(len(light.star)), 35_000)
    rows = {name: getattr(light, name)[many] for name in vars(light) if name != "causes"}
    nobody = replace(located.result.names, stars=located.result.names.stars.take(slice(0)))
    result = replace(located.result, photometry=replace(light, **rows), names=nobody)
    text = star_table_text(result)
    assert text.count("\n") > 35_000


def test_texts_with_commas_quotes_and_letters_from_afar(tmp_path):
    texts = ["plain", "a, b", 'say "so"', "Škoda", "drive.mcap#12", ""]
    columns = [
        Column("text", texts, "string", description="it's a text"),
        Column("number", ["1", "", "3", "", "5", "6"], "int64"),
        Column("yes", [True, False, True, True, False, True], "bool"),
    ]
    path = tmp_path / "t.ecsv"
    path.write_text(ecsv_text(columns), encoding="utf-8")
    table = Table.read(path, format="ascii.ecsv")
    assert table["text"].filled("").tolist() == texts
    assert table["number"].filled(-1).tolist() == [1, -1, 3, -1, 5, 6]
    assert table["yes"].tolist() == [True, False, True, True, False, True]
    assert table["text"].description == "it's a text"
    rows = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    assert "#" not in re.sub('"[^"]*"', "", "".join(rows))  # pandas ends a line at a # outside quotes
    assert [row["text"] for row in csv.DictReader(rows)] == texts
    with pytest.raises(ValueError, match="different lengths"):
        ecsv_text([*columns, Column("short", [1.0])])
