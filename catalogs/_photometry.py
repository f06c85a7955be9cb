"""Johnson V of every Hipparcos row and how far to trust it. The rules are stated in README.md."""

from __future__ import annotations

import numpy as np
from _corrections import NEIGHBOUR_IN_HP_V_MAG
from numpy.polynomial import Polynomial
from scipy.spatial import cKDTree

APERTURE_ARCSEC = 32.0  # an entry this close to another may hold its light
HIP_MAIN_LIMIT_MAG = 6.6  # the 1997 file is cut there: what it lacks is fainter
TYPICAL_B_V = 0.6  # given to the rows without a colour
TYPICAL_HP_MINUS_V_MAG = 0.12
# V = Hp - P(B-V), highest power first, as noted with the original files: refitted and compared.
README_B_V = (-0.02802922, 0.21839618, -0.58154553, 0.63177578, -0.39516376, 0.30821187, 0.00832223)


def colours_known(h: dict[str, np.ndarray]) -> np.ndarray:
    """Rows with a measured colour: the others hold zeros."""
    return ~((h["b_v"] == 0) & (h["b_v_error"] == 0))


def fit_hp_minus_v(x: np.ndarray, hp_minus_v: np.ndarray, degree: int, clip_mag: float) -> tuple[Polynomial, float]:
    """Hp - V as a polynomial of a colour, clipped, and its rms [mag]."""
    keep = np.ones(len(x), dtype=bool)
    for _ in range(8):
        p = Polynomial.fit(x[keep], hp_minus_v[keep], degree)
        residual = hp_minus_v - p(x)
        keep = abs(residual) < clip_mag
    return p, float(np.std(residual[keep]))


def shared_rows(h: dict[str, np.ndarray], main: dict[int, list[str]]) -> tuple[np.ndarray, np.ndarray]:
    """Indices into Hipparcos-2 of the stars that the 1997 file has too, and their V there."""
    row = [i for i, hip in enumerate(h["hip"].tolist()) if hip in main and main[hip][5]]
    return np.array(row), np.array([float(main[int(h["hip"][i])][5]) for i in row])


def v_magnitudes(h: dict[str, np.ndarray], main: dict[int, list[str]]) -> tuple[np.ndarray, np.ndarray, Polynomial]:
    """V (n,), the catalogue's part of its sigma (n,) [mag], and the polynomial Hp - V = P(V-I)."""
    known = colours_known(h)
    row, v_main = shared_rows(h, main)
    use = known[row]
    p, _ = fit_hp_minus_v(h["v_i"][row][use], h["hp"][row][use] - v_main[use], degree=8, clip_mag=0.12)
    # Clipped to the range that was fitted: a polynomial of the eighth degree must not run on.
    v_poly = h["hp"] - np.where(known, p(np.clip(h["v_i"], *p.domain)), TYPICAL_HP_MINUS_V_MAG)
    v = np.maximum(v_poly, HIP_MAIN_LIMIT_MAG + 0.005)
    sigma = np.select([~known, h["v_i"] > 3, h["v_i"] > 1.5], [0.10, 0.10, 0.06], 0.04)
    sigma = np.hypot(sigma, abs(v - v_poly) / 2 + np.where(h["components"] > 1, 0.05, 0.0))
    v[row] = v_main
    sigma[row] = np.select([h["v_i"][row] > 2.5, h["v_i"][row] > 1.5], [0.05, 0.03], 0.02)
    for i in row:
        v[i], sigma[i] = _settle(main[int(h["hip"][i])], v[i], sigma[i], v_poly[i], known[i], h["hp_error"][i])
    for hip, v_mag in NEIGHBOUR_IN_HP_V_MAG.items():
        i = np.searchsorted(h["hip"], hip)
        v[i], sigma[i] = v_mag, 0.15
    return v, sigma, p


def _settle(f: list[str], v: float, sigma: float, v_poly: float, known: bool, hp_error: float) -> tuple[float, float]:
    """V and sigma of one star of the 1997 file, where its V and its Hp contradict each other or miss a companion."""
    magnitude_of, companions, delta_hp = f[48], int(f[58] or 1), f[66]
    if f[7] == "G" and known and hp_error < 0.02 and v_poly > 0 and magnitude_of != "-":
        # Ground-based V of a double is at times one component's. Sirius (V < 0) is beyond what Hp can measure.
        gap = abs(v - v_poly)
        v, sigma = (v_poly, 0.05) if gap > 0.2 else (v, np.hypot(sigma, gap / 2 if gap > 0.05 else 0.0))
    if companions > 1 and magnitude_of in ("A", "B") and delta_hp:
        # The magnitude is one component's; the other, 10 to 20 arcsec away, has no row of its own (Mizar B).
        v, sigma = v - 2.5 * np.log10(1 + 10 ** (-0.4 * float(delta_hp))), np.hypot(sigma, 0.04)
    return float(v), float(sigma)


def variability_mag(h: dict[str, np.ndarray], main: dict[int, list[str]], rays: np.ndarray) -> np.ndarray:
    """Standard deviation (n,) of each star's own V [mag], from the scatter and the range of Hp over three years."""
    quiet = np.interp(h["hp"], *_quiet_scatter(h))
    scatter = h["hp_scatter"].copy()
    duplicity = np.zeros(len(scatter), dtype=bool)
    for i, hip in enumerate(h["hip"].tolist()):
        f = main.get(hip)
        if f is None:
            continue
        if f[49] and f[50]:
            scatter[i] = max(scatter[i], (float(f[50]) - float(f[49])) / 3.29)  # 5th to 95th percentile of Hp
        duplicity[i] = f[52] == "D"
    own = np.sqrt(np.maximum(scatter**2 - quiet**2, 0.0))
    # Red variables swing more in V than in the broad Hp.
    own = np.where(h["v_i"] > 2.0, 1.5 * own, own)
    # Next to another star the scatter is the neighbour's light coming and going, not the star's.
    neighbour = cKDTree(rays).query(rays, k=2)[0][:, 1] < np.radians(APERTURE_ARCSEC / 3600)
    in_main = np.isin(h["hip"], list(main))
    own = np.where(neighbour & ~in_main, np.minimum(own, 0.15), own)
    own = np.where(duplicity, np.minimum(own, 0.05), own)
    # Secondary entries have no scatter; the error of their mean says how badly the pair was separated.
    return np.where(h["hp_scatter"] == 0, np.maximum(own, np.minimum(h["hp_error"], 0.15)), own)


def _quiet_scatter(h: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Hp (k,) and the scatter (k,) of a constant star there: 1.5 x the median of all single ones."""
    centres = np.arange(4.5, 13.0)
    single = (h["components"] == 1) & (h["hp_scatter"] > 0)
    medians = [np.median(h["hp_scatter"][single & (abs(h["hp"] - c) < 0.5)]) for c in centres]
    return centres, 1.5 * np.array(medians)
