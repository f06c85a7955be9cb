"""Names for reports: proper names (IAU), else Bayer, Flamsteed or variable-star designations from BSC5."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from _sources import BscStar

BSC_GREEK = {
    "Alp": "alpha", "Bet": "beta", "Gam": "gamma", "Del": "delta", "Eps": "epsilon", "Zet": "zeta", "Eta": "eta",
    "The": "theta", "Iot": "iota", "Kap": "kappa", "Lam": "lambda", "Mu": "mu", "Nu": "nu", "Xi": "xi",
    "Omi": "omicron", "Pi": "pi", "Rho": "rho", "Sig": "sigma", "Tau": "tau", "Ups": "upsilon", "Phi": "phi",
    "Chi": "chi", "Psi": "psi", "Ome": "omega",
}  # fmt: skip
VARIABLE = re.compile(r"(?:[A-Z]{1,2}|V\d{3,4}) +[A-Z][A-Za-z]{2}")
MATCH_ARCSEC = 20.0
PROPER_NAMES = Path(__file__).resolve().parent / "proper_names.csv"


def designation(star: BscStar) -> str | None:
    """Such as "alpha Cen", "gamma2 Vel", "61 Cyg" or "R Dor"; None for a star with numbers only."""
    flamsteed, letter, index, constellation = (
        star.name[:3].strip(), star.name[3:6].strip(), star.name[6].strip(), star.name[7:10].strip(),
    )  # fmt: skip
    if letter in BSC_GREEK:
        return f"{BSC_GREEK[letter]}{index} {constellation}"
    if flamsteed:
        return f"{flamsteed} {constellation}"
    if VARIABLE.fullmatch(star.variable):
        return re.sub(" +", " ", star.variable)
    return None


def names_csv(bsc: list[BscStar], hip: np.ndarray, distance_arcsec: np.ndarray, holes: dict[int, tuple]) -> str:
    """Lines "hip,name" in order of HIP: each BSC5 star named by its brightest row at that Hipparcos star."""
    lines = [line.split(",") for line in PROPER_NAMES.read_text(encoding="utf-8").splitlines()[1:]]
    proper = dict(lines)
    hole_of = {hr: h for h, hrs in holes.items() for hr in hrs}
    best: dict[int, BscStar] = {}
    used = set()
    for star, h, d in zip(bsc, hip.tolist(), distance_arcsec, strict=True):
        if star.hr in hole_of:
            h = hole_of[star.hr]
        elif d > MATCH_ARCSEC:
            continue
        if h not in best or star.v_mag < best[h].v_mag:
            best[h] = star
    out = ["hip,name"]
    for h in sorted(best):
        name = designation(best[h])
        if name is not None:
            used.add(name)
            out.append(f"{h},{proper.get(name, name)}")
    missing = set(proper) - used
    assert not missing, f"proper names without a star: {sorted(missing)}"
    return "\n".join(out) + "\n"
