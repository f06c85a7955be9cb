"""Ids and names of stars."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from startrack.core.files import data_dir
from startrack.core.types import Ints


@lru_cache(maxsize=1)
def star_names() -> Mapping[int, str]:
    """Hipparcos number -> proper name ("Sirius"), else Bayer, Flamsteed or variable-star designation ("61 Cyg").

    The stars of the Bright Star Catalogue that have one; read-only.
    """
    lines = (data_dir("catalogs") / "star_names.csv").read_text(encoding="utf-8").splitlines()[1:]
    pairs = (line.split(",", 1) for line in lines)
    return MappingProxyType({int(hip): name for hip, name in pairs})


@lru_cache(maxsize=1)
def proper_name_designations() -> Mapping[str, str]:
    """Proper name ("Rigil Kentaurus") -> Bayer, Flamsteed or variable-star designation ("alpha1 Cen"); read-only."""
    lines = (data_dir("catalogs") / "proper_names.csv").read_text(encoding="utf-8").splitlines()[1:]
    pairs = (line.split(",", 1) for line in lines)
    return MappingProxyType({name: designation for designation, name in pairs})


def id_texts(sources: tuple[str, ...], source: Ints, number: Ints) -> NDArray[np.str_]:
    """Ids f"{sources[s]} {n}" (n,) of stars with source index s and number n, by array operations.

    118,000 Python strings would take longer than all the astrometry.
    """
    digits = np.searchsorted(10 ** np.arange(1, 19, dtype=np.int64), number, side="right") + 1
    width = max(map(len, sources)) + 1 + int(digits.max(initial=1))
    code_points = np.zeros((len(number), width), dtype=np.uint32)
    for s, prefix in enumerate(sources):
        start = len(prefix) + 1
        for d in np.unique(digits[source == s]).tolist():
            rows = np.flatnonzero((source == s) & (digits == d))
            code_points[rows, :start] = [ord(c) for c in f"{prefix} "]
            rest = number[rows]
            for column in range(start + d - 1, start - 1, -1):
                rest, last = np.divmod(rest, 10)
                code_points[rows, column] = ord("0") + last
    code_points.flags.writeable = False
    return code_points.view(f"<U{width}")[:, 0]
