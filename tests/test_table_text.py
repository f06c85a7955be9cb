"""The compiled texts of numbers are those of Python's own formats, character for character."""

import numpy as np
import pytest

from startrack.core.table_text import column_lines, join_columns

RNG = np.random.default_rng(3)
EDGES = [
    0.0,
    -0.0,
    np.nan,
    999999.5,
    9999995.0,
    99999.95,
    1e5,
    1e6,
    123456.5,
    0.0001,
    0.00001,
    1e-7,
    2.675,
    0.5,
    1.5,
    2.5,
]
WILD = [1e15, 3e18, 1e300, 1e-300, np.inf, -np.inf]
SETS = {
    "many sizes": RNG.normal(size=20_000) * 10.0 ** RNG.uniform(-6, 5, 20_000),
    "ties": RNG.integers(-(10**6), 10**6, 20_000) / 2.0 ** RNG.integers(0, 9, 20_000),
    "decimals that look like ties": RNG.integers(-(10**6), 10**6, 20_000) / 10.0 ** RNG.integers(0, 9, 20_000),
    "powers of ten": np.array([s * 10.0**k for k in range(-9, 9) for s in (1, -1)]),
    "edges": np.array(EDGES),
    "wild": np.array(EDGES + WILD),
    "none": np.array([]),
}


@pytest.mark.parametrize("form", ["%.1f", "%.3f", "%.5f", "%.9f", "%.12f", "%.1g", "%.3g", "%.6g", "%.9g", "%d", "%s"])
@pytest.mark.parametrize("name", SETS)
def test_the_texts_are_those_of_pythons_formats(form, name):
    values = SETS[name]
    values = values[np.isfinite(values)] if form == "%d" else values
    expected = ["" if value != value else form % value for value in values.tolist()]
    assert column_lines(form, values).decode().split("\n")[:-1] == expected


def test_columns_are_joined_line_by_line():
    columns = [column_lines("%s", np.array(["a", "Š", ""])), column_lines("%d", [1, None, 3]), b"x\n\nz\n"]
    assert join_columns(columns).decode() == "a,1,x\nŠ,,\n,3,z\n"
    assert join_columns([b"", b""]) == b""
