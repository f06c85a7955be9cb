"""Readers of the three original files. Column positions are those of the ReadMe files of CDS I/311, I/239 and V/50."""

from __future__ import annotations

import gzip
import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

SHA256 = {
    "hip2.dat.gz": "46f2115306494e9ae84ee2580e761de08edb5ca145b7f15e4201cfc0f4742ac5",
    "hip_main_V6.6.dat.gz": "ce779fac85a13968ee8bcb427a6ab4476506812151a81d2a069012c6422c629e",
    "bsc5.dat.gz": "c0afb625095233634471fa82cadcd29b4d0b473b27ee3e47e9cda75e50e390bd",
}


class BscStar(NamedTuple):
    """One row of the Bright Star Catalogue: J2000.0, FK5 (ICRS within 0.05 arcsec), to 0.1 s and 1 arcsec."""

    hr: int
    name: str  # columns 5-14: Flamsteed number, Bayer letter, its index, constellation
    variable: str  # columns 52-60
    ra_rad: float
    dec_rad: float
    pm_ra_mas_yr: float  # includes cos(dec)
    pm_dec_mas_yr: float
    v_mag: float
    b_v: float | None


def read_lines(folder: Path, name: str) -> list[str]:
    """Lines of the original file, after a check that it is the very file this script was written for."""
    raw = (folder / name).read_bytes()
    found = hashlib.sha256(raw).hexdigest()
    if found != SHA256[name]:
        raise SystemExit(f"{name}: sha256 {found}, expected {SHA256[name]}")
    return gzip.decompress(raw).decode("latin-1").splitlines()


def read_hip2(folder: Path) -> dict[str, np.ndarray]:
    """Hipparcos-2 (van Leeuwen 2007), 117,955 rows in order of HIP: radians, mas/yr, magnitudes."""
    lines = read_lines(folder, "hip2.dat.gz")

    def column(first: int, last: int, kind: type = float) -> np.ndarray:
        return np.array([kind(line[first:last]) for line in lines])

    return {
        "hip": column(0, 6, int),
        "components": column(13, 14, int),
        "ra": column(15, 28),
        "dec": column(29, 42),
        "pm_ra": column(51, 59),
        "pm_dec": column(60, 68),
        "hp": column(129, 136),
        "hp_error": column(137, 143),
        "hp_scatter": column(144, 149),
        "b_v": column(152, 158),
        "b_v_error": column(159, 164),
        "v_i": column(165, 171),
    }


def read_hip_main(folder: Path) -> dict[int, list[str]]:
    """Hipparcos 1997 cut to V <= 6.6: HIP -> its 78 fields (H0 to H77), stripped."""
    rows = [[f.strip() for f in line.split("|")] for line in read_lines(folder, "hip_main_V6.6.dat.gz")]
    return {int(row[1]): row for row in rows}


def read_bsc5(folder: Path) -> list[BscStar]:
    """The Bright Star Catalogue's rows that are stars (14 are novae, clusters and misprints without a position)."""
    stars = []
    for line in read_lines(folder, "bsc5.dat.gz"):
        line = line.ljust(197)
        if not line[75:77].strip():
            continue
        ra_h = int(line[75:77]) + int(line[77:79]) / 60 + float(line[79:83]) / 3600
        dec_deg = int(line[84:86]) + int(line[86:88]) / 60 + float(line[88:90]) / 3600
        stars.append(
            BscStar(
                hr=int(line[:4]),
                name=line[4:14],
                variable=line[51:60].strip(),
                ra_rad=float(np.radians(15 * ra_h)),
                dec_rad=float(np.radians(-dec_deg if line[83] == "-" else dec_deg)),
                pm_ra_mas_yr=1000 * float(line[148:154].strip() or 0),
                pm_dec_mas_yr=1000 * float(line[154:160].strip() or 0),
                v_mag=float(line[102:107]),
                b_v=float(line[109:114]) if line[109:114].strip() else None,
            )
        )
    return stars
