"""docs/constants.md and the errors of unstated facts in docs/method.md, against the code."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from startrack.core.types import TIME_SIGMA_S
from startrack.localization.clock import GROSS_PROBABILITY, GROSS_SIGMA_S
from startrack.terrain.shape import CYLINDER_FACTS, MAP_FACTS, STAR_REFRACTION

DOCS = Path(__file__).parents[1] / "docs"
METHOD = (DOCS / "method.md").read_text(encoding="utf-8")


def rows_of(page: str, table: str) -> list[list[str]]:
    """Cells of the rows of the table after a comment."""
    text = page.split(f"<!-- {table} -->\n")[1].split("\n\n")[0]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()[2:]]


def value_and_unit(cell: str) -> tuple[str, str]:
    """Numbers with commas between, and the unit after them; empty where there is none."""
    found = re.fullmatch(r"([-\d.e, ]*[\d.])(?: (\D.*))?", cell)
    assert found, cell
    return found[1], found[2] or ""


CONSTANTS = [
    (name, *value_and_unit(shown), meaning)
    for name, shown, meaning in rows_of((DOCS / "constants.md").read_text(encoding="utf-8"), "table of constants")
]


@pytest.mark.parametrize(("name", "shown", "unit"), [row[:3] for row in CONSTANTS], ids=[row[0] for row in CONSTANTS])
def test_a_constant_has_the_value_of_the_code(name: str, shown: str, unit: str) -> None:
    module, _, constant = name.strip("`").rpartition(".")
    found = getattr(importlib.import_module(f"startrack.{module}"), constant)
    value = np.atleast_1d(list(found.values()) if isinstance(found, dict) else found).astype(float)
    if constant.endswith("_RAD"):
        assert unit == "deg"
        value = np.degrees(value)
    assert [float(number) for number in shown.split(", ")] == pytest.approx(value.tolist(), rel=1e-9)


def test_constants_are_listed_once() -> None:
    names = [row[0] for row in CONSTANTS]
    assert len(set(names)) == len(names) > 40
    assert all(row[3] for row in CONSTANTS)


def test_the_text_has_the_values_of_the_table() -> None:
    """The sections that explain the constants repeat some of them."""
    values = {row[0].strip("`").partition(".")[2]: row[1] for row in CONSTANTS}
    chain = "likelihood.obstacle_chain."
    started = float(values[chain + "START"]) * 240
    for text in (
        f"probability {started:g} / 240 / 13",
        f"ends with probability {values[chain + 'STOP']} ",
        f"keeps its level ({values[chain + 'KEEP']})",
        f"neighbouring one ({values[chain + 'NEAR']}, ",
        f"probability {float(values[chain + 'NOTCH_START']) * 240:.2g} / 240 / 6",
        f"e = {values['search_profiles.SEARCH_EPSILON']}:",
        f"{values['search_profiles.SLACK_NATS']} nats, which are 29 degrees",
        f"limited to {values['likelihood.skyline_profiles.ROW_NATS']} nats",
        f"rounds ({values['importance_sampling.ROUNDS']} points)",
    ):
        assert text in METHOD, text


def test_facts_have_the_default_and_gross_errors_of_the_code() -> None:
    shown = {row[0].strip("`"): row[2:] for row in rows_of(METHOD, "table of facts")}
    clock = (TIME_SIGMA_S, GROSS_PROBABILITY, GROSS_SIGMA_S)
    known = {"time_sigma_s": clock} | {
        one.key: (one.sigma, one.gross_probability, one.gross_sigma)
        for one in (*CYLINDER_FACTS, *MAP_FACTS, STAR_REFRACTION)
    }
    assert set(shown) == set(known)
    for key, (sigma, probability, gross) in known.items():
        unit = shown[key][3]
        scale = 180 / np.pi if unit == "deg" else 1.0
        assert [float(cell) for cell in shown[key][:3]] == pytest.approx([scale * sigma, probability, scale * gross])
        assert re.fullmatch(r"s|m|deg|relative", unit)
