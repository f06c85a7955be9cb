"""FITS headers and binary tables as bytes: a few cards need no library that takes half a second to load.

Format: Pence et al. 2010, A&A 524, A42 (FITS 3.0).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

BLOCK_BYTES, CARD_BYTES = 2880, 80
Card = bool | int | float | str


def header_block(cards: Mapping[str, Card]) -> bytes:
    """A header: one card for each key, COMMENT among them, END, and blanks up to the block."""
    lines = [_card(key, value) for key, value in cards.items()] + ["END".ljust(CARD_BYTES)]
    return _filled("".join(lines).encode("ascii"), b" ")


def table_file(columns: Sequence[tuple[str, str, np.ndarray]], cards: Mapping[str, Card]) -> bytes:
    """A FITS file with one binary table: columns as (name, unit, values), 64-bit floats or integers, or texts."""
    data = [_stored(values) for _, _, values in columns]
    rows = np.empty(len(data[0]), dtype=[(name, d.dtype) for (name, _, _), d in zip(columns, data, strict=True)])
    head: dict[str, Card] = {
        "XTENSION": "BINTABLE", "BITPIX": 8, "NAXIS": 2, "NAXIS1": rows.dtype.itemsize, "NAXIS2": len(rows),
        "PCOUNT": 0, "GCOUNT": 1, "TFIELDS": len(columns),
    }  # fmt: skip
    for i, ((name, unit, _), d) in enumerate(zip(columns, data, strict=True), start=1):
        rows[name] = d
        head |= {f"TTYPE{i}": name, f"TFORM{i}": f"{d.dtype.itemsize}A" if d.dtype.kind == "S" else _form(d)}
        head |= {f"TUNIT{i}": unit} if unit else {}
    primary = header_block({"SIMPLE": True, "BITPIX": 8, "NAXIS": 0, "EXTEND": True})
    return primary + header_block({**head, **cards}) + _filled(rows.tobytes(), b"\0")


def _stored(values: np.ndarray) -> np.ndarray:
    if values.dtype.kind == "U":
        texts = np.char.encode(values, "ascii", "replace")
        return texts if texts.dtype.itemsize else texts.astype("S1")
    return values.astype(">i8" if values.dtype.kind in "iu" else ">f8")


def _form(stored: np.ndarray) -> str:
    return "K" if stored.dtype.kind == "i" else "D"


def _card(key: str, value: Card) -> str:
    if key.startswith("COMMENT"):  # COMMENT1, COMMENT2, ...: keys of a mapping are unique
        return f"COMMENT {value}"[:CARD_BYTES].ljust(CARD_BYTES)
    if isinstance(value, bool):
        text = "T" if value else "F"
    elif isinstance(value, str):
        text = "'" + value.replace("'", "''").ljust(8) + "'"
        return f"{key:<8}= {text}"[:CARD_BYTES].ljust(CARD_BYTES)
    else:
        text = str(value) if isinstance(value, int) else repr(float(value)).upper()
    return f"{key:<8}= {text:>20}".ljust(CARD_BYTES)


def _filled(data: bytes, filler: bytes) -> bytes:
    return data + filler * (-len(data) % BLOCK_BYTES)
