"""Writes the tables of docs/formats.md and docs/track.md that are made from the code: quantities and reasons.

    python docs/make_tables.py

Each table stands between `<!-- table NAME -->` and `<!-- end -->`; the text around it is written by hand.
"""

from __future__ import annotations

import re
from pathlib import Path

from startrack.errors import Reason
from startrack.output.quantities import QUANTITIES
from startrack.output.quantities_prediction import CELL_QUANTITIES, PATH_QUANTITIES
from startrack.tracking.quantities import FRAME_QUANTITIES

PAGES = [Path(__file__).parent / name for name in ("formats.md", "track.md")]


def quantity_table() -> str:
    """Keys of the result record with unit and meaning."""
    rows = [
        f"| `{one.path}` | {one.unit} | {one.description} |" for one in QUANTITIES if one.recorded and not one.derived
    ]
    return "\n".join(["| key | unit | meaning |", "| --- | --- | --- |", *rows])


def track_table() -> str:
    """Columns of track.ecsv with unit and meaning."""
    rows = [f"| `{one.key}` | {one.unit} | {one.description} |" for one in FRAME_QUANTITIES]
    return "\n".join(["| column | unit | meaning |", "| --- | --- | --- |", *rows])


def reason_table() -> str:
    """Reasons with their exit codes and meanings."""
    rows = [f"| `{one.value}` | {one.exit_code} | {one.meaning} |" for one in Reason]
    return "\n".join(["| reason | exit code | meaning |", "| --- | --- | --- |", *rows])


def prediction_table() -> str:
    """Bands of predict.tif and columns of predict.ecsv."""
    rows = [f"| `{one.name}` | {one.unit} | {one.description} |" for one in (*CELL_QUANTITIES, *PATH_QUANTITIES)]
    return "\n".join(["| band, column | unit | meaning |", "| --- | --- | --- |", *rows])


def page_with_tables(text: str) -> str:
    """The page `text` with its tables as the code has them."""
    tables = {
        "quantities": quantity_table(),
        "reasons": reason_table(),
        "track": track_table(),
        "prediction": prediction_table(),
    }
    return re.sub(
        r"(<!-- table (\w+) -->\n).*?(\n?<!-- end -->)",
        lambda found: found[1] + tables[found[2]] + found[3],
        text,
        flags=re.DOTALL,
    )


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(page_with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")
