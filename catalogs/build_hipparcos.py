"""Writes hipparcos.npy and star_names.csv from the original catalogue files.

    python catalogs/build_hipparcos.py FOLDER            # FOLDER holds hip2.dat.gz, hip_main_V6.6.dat.gz, bsc5.dat.gz
    python catalogs/build_hipparcos.py FOLDER --check    # compares with the files here instead, exit 1 if they differ

Sources, rules and columns: README.md.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

import numpy as np
from _corrections import (
    ETA_CAR_HR,
    HIP_94_AQR_A,
    HIP_94_AQR_B,
    HOLES_HR,
    LONG_TERM_SIGMA_MAG,
    PLACE_94_AQR_B_DEG,
    V_94_AQR_B_MAG,
    V_ETA_CAR_MAG,
    V_SIGMA_ETA_CAR_MAG,
)
from _names import names_csv
from _photometry import README_B_V, TYPICAL_B_V, colours_known, shared_rows, v_magnitudes, variability_mag
from _sources import BscStar, read_bsc5, read_hip2, read_hip_main
from numpy.polynomial import Polynomial
from scipy.spatial import cKDTree

HERE = Path(__file__).resolve().parent
EPOCH_YR = 1991.25
MAS = np.pi / 180 / 3_600_000
ROW = np.dtype(
    [
        ("hip", "<i4"),  # 0 for a star of BSC5 that Hipparcos lacks
        ("hr", "<u2"),  # 0 for every other star
        ("ra", "<u4"),  # 2 pi / 2^32 rad = 0.30 mas
        ("dec", "<i4"),  # the same unit
        ("pm_ra", "<i4"),  # 0.01 mas/yr, cos(dec) included
        ("pm_dec", "<i4"),
        ("v", "<i2"),  # mmag
        ("v_sigma", "<u2"),
        ("b_v", "<i2"),
    ]
)
UNIT_RAD = 2 * np.pi / 2**32
ABSENT_ARCSEC = 25.0  # a BSC5 star farther than this from every Hipparcos row is missing there
BSC5_FAINTEST_MAG = 7.0  # fainter rows are components and long-period variables at their best


def rays_of(ra: np.ndarray, dec: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3)."""
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)


def moved(ra: float, dec: float, pm_ra: float, pm_dec: float, years: float) -> tuple[float, float]:
    """Position after `years` of proper motion [mas/yr], small steps only."""
    return ra + pm_ra * MAS * years / np.cos(dec), dec + pm_dec * MAS * years


def extra_rows(h: dict, main: dict[int, list[str]], bsc: list[BscStar], distance_arcsec: np.ndarray) -> list[tuple]:
    """Stars that Hipparcos-2 lacks: (hip, hr, ra, dec, pm_ra, pm_dec, v, sigma, b_v) at J1991.25."""
    by_hr = {s.hr: s for s in bsc}
    rows = []
    for hip, hrs in HOLES_HR.items():
        s = [by_hr[hr] for hr in hrs]
        summed = -2.5 * np.log10(sum(10 ** (-0.4 * star.v_mag) for star in s))
        # The 1997 file has the combined V of these, though no place; BSC5's sum must agree with it.
        v = float(main[hip][5])
        assert abs(v - summed) < 0.1, (hip, v, summed)
        b_v = next(star.b_v for star in s if star.b_v is not None)
        rows.append((hip, 0, s[0], v, 0.05, b_v))
    patched = {hr for hrs in HOLES_HR.values() for hr in hrs}
    for s, d in zip(bsc, distance_arcsec, strict=True):
        if d > ABSENT_ARCSEC and s.hr not in patched and s.v_mag <= BSC5_FAINTEST_MAG:
            v, sigma = (V_ETA_CAR_MAG, V_SIGMA_ETA_CAR_MAG) if s.hr == ETA_CAR_HR else (s.v_mag, 0.05)
            rows.append((0, s.hr, s, v, sigma, TYPICAL_B_V if s.b_v is None else s.b_v))
    out = []
    for hip, hr, s, v, sigma, b_v in rows:
        ra, dec = moved(s.ra_rad, s.dec_rad, s.pm_ra_mas_yr, s.pm_dec_mas_yr, EPOCH_YR - 2000.0)
        out.append((hip, hr, ra, dec, s.pm_ra_mas_yr, s.pm_dec_mas_yr, v, sigma, b_v))
    a = int(np.searchsorted(h["hip"], HIP_94_AQR_A))
    place = np.radians(PLACE_94_AQR_B_DEG)
    b_v_b = float(main[HIP_94_AQR_B][37])
    out.append((HIP_94_AQR_B, 0, *place, h["pm_ra"][a], h["pm_dec"][a], V_94_AQR_B_MAG, 0.15, b_v_b))
    return out


def counterparts(rays: np.ndarray, v: np.ndarray, bsc_rays: np.ndarray, bsc_v: np.ndarray) -> tuple:
    """Index of each BSC5 star's Hipparcos row and the distance [arcsec]: the nearest, but magnitude decides in pairs.

    BSC5 gives both components of alpha Cen and of 61 Cyg where neither is.
    """
    chord, index = cKDTree(rays).query(bsc_rays, k=3)
    arcsec = chord / MAS / 1000
    best = np.argmin(arcsec / 10 + np.minimum(abs(v[index] - bsc_v[:, None]), 3.0), axis=1)
    best = np.where(np.take_along_axis(arcsec, best[:, None], 1)[:, 0] < ABSENT_ARCSEC, best, 0)
    rows = np.arange(len(bsc_v))
    return index[rows, best], arcsec[rows, best]


def packed(columns: list[np.ndarray]) -> np.ndarray:
    """The rows as written, brightest first."""
    hip, hr, ra, dec, pm_ra, pm_dec, v, sigma, b_v = columns
    t = np.empty(len(hip), dtype=ROW)
    t["hip"], t["hr"] = hip, hr
    t["ra"] = np.round(ra % (2 * np.pi) / UNIT_RAD).astype(np.int64) % 2**32
    t["dec"] = np.round(dec / UNIT_RAD)
    t["pm_ra"], t["pm_dec"] = np.round(100 * pm_ra), np.round(100 * pm_dec)
    t["v"], t["v_sigma"], t["b_v"] = (np.round(1000 * x) for x in (v, sigma, b_v))
    return t[np.lexsort((t["hr"], t["hip"], t["v"]))]


def build(folder: Path) -> tuple[np.ndarray, str]:
    """The table and the text of star_names.csv; prints the figures that README.md quotes."""
    h, main, bsc = read_hip2(folder), read_hip_main(folder), read_bsc5(folder)
    v, sigma_catalogue, p = v_magnitudes(h, main)
    sigma = np.hypot(sigma_catalogue, variability_mag(h, main, rays_of(h["ra"], h["dec"])))
    at_2000 = rays_of(*moved(h["ra"], h["dec"], h["pm_ra"], h["pm_dec"], 2000.0 - EPOCH_YR))
    bsc_rays = rays_of(np.array([s.ra_rad for s in bsc]), np.array([s.dec_rad for s in bsc]))
    nearest, distance_arcsec = counterparts(at_2000, v, bsc_rays, np.array([s.v_mag for s in bsc]))
    for s, i, d in zip(bsc, nearest, distance_arcsec, strict=True):
        if s.hr in LONG_TERM_SIGMA_MAG and d < 10:
            sigma[i] = max(sigma[i], LONG_TERM_SIGMA_MAG[s.hr])
    report(h, main, p, v, sigma)
    extra = np.array(extra_rows(h, main, bsc, distance_arcsec))
    print(f"{len(extra)} stars that Hipparcos-2 lacks:")
    for row in extra:
        print(f"  HIP {row[0]:.0f}" if row[0] else f"  HR {row[1]:.0f}", f"V {row[6]:.2f}")
    b_v = np.where(colours_known(h), h["b_v"], TYPICAL_B_V)
    own = [h["hip"], np.zeros(len(v)), h["ra"], h["dec"], h["pm_ra"], h["pm_dec"], v, sigma, b_v]
    table = packed([np.concatenate([a, b]) for a, b in zip(own, extra.T, strict=True)])
    return table, names_csv(bsc, h["hip"][nearest], distance_arcsec, HOLES_HR)


def report(h: dict, main: dict[int, list[str]], p: Polynomial, v: np.ndarray, sigma: np.ndarray) -> None:
    """Prints the fits and the counts."""
    row, v_main = shared_rows(h, main)
    use = colours_known(h)[row]
    offset = h["hp"][row][use] - v_main[use]
    residual = offset - p(h["v_i"][row][use])
    print(f"Hp - V = P(V-I): {use.sum()} stars, rms {np.std(residual[abs(residual) < 0.12]):.4f} after the clip")
    print(f"  V-I {p.domain}, lowest first: {p.convert().coef.round(6).tolist()}")
    again = np.polyfit(h["b_v"][row][use], offset, 6)
    print("Hp - V = P(B-V), refitted, highest first:", again.round(6).tolist())
    x = np.linspace(-0.25, 1.75, 201)
    gap = abs(np.polyval(again, x) - np.polyval(README_B_V, x)).max()
    residual = offset - np.polyval(again, h["b_v"][row][use])
    print(f"  rms {np.std(residual):.4f}; differs from the coefficients noted with the sources by {gap:.4f}")
    assert gap < 0.01, "the polynomial of B-V does not repeat"
    for limit in (5.0, 6.0, 6.5, 7.0, 7.5, 8.0, 8.5):
        bright = v < limit
        print(f"V < {limit}: {bright.sum()} Hipparcos rows, median sigma {np.median(sigma[bright]):.3f}, "
              f"above 0.1: {(sigma[bright] > 0.1).sum()}, above 0.3: {(sigma[bright] > 0.3).sum()}")  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the original files")
    parser.add_argument("--check", action="store_true", help="compare with the files here, write nothing")
    args = parser.parse_args()
    table, names = build(args.folder)
    buffer = io.BytesIO()
    np.save(buffer, table)
    status = 0
    for path, data in ((HERE / "hipparcos.npy", buffer.getvalue()), (HERE / "star_names.csv", names.encode("utf-8"))):
        if not args.check:
            path.write_bytes(data)
            print(f"{path.name}: {len(data)} bytes")
        elif path.read_bytes() != data:
            print(f"{path.name}: DIFFERS from what the sources give")
            status = 1
        else:
            print(f"{path.name}: as the sources give it")
    return status


if __name__ == "__main__":
    raise SystemExit(main())
