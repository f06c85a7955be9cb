"""Star catalogues: read, cut in magnitude, carried to a date and to a moving observer.

A catalogue is one structured .npy file in catalogs/ (columns: catalogs/README.md), brightest first, so that a cut in
magnitude is a slice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from startrack.catalog.names import id_texts, star_names
from startrack.core.files import data_dir
from startrack.core.types import Array, BadInput, Ints, Stars, Value, array
from startrack.frames import aberrate, as_utc

HIPPARCOS_EPOCH_YR = 1991.25  # J1991.25 (TT), ESA SP-1200 (1997), vol. 1
ANGLE_UNIT_RAD = 2 * np.pi / 2**32  # of the file's ra and dec columns
MAS_RAD = np.pi / 648_000_000
J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)  # TT and UTC differ by a minute: 0.02 mas for the fastest star
JULIAN_YEAR_S = 365.25 * 86400.0


@dataclass(frozen=True, kw_only=True)
class StarCatalog(Value):
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

    def __len__(self) -> int:
        return len(self.v_mag)

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
        """Whether it has Gaia's stars, so that it lacks none of the sky's to about magnitude 10."""
        return "GAIA" in self.sources

    @property
    def names(self) -> Mapping[int, str]:
        """Names by Hipparcos number, as `star_names`."""
        return star_names()

    def brighter_than(self, v_mag: float) -> StarCatalog:
        """The stars with V < v_mag."""
        return self._take_first(int(np.searchsorted(self.v_mag, v_mag, side="left")))

    def _take_first(self, n: int) -> StarCatalog:
        kept = {f: getattr(self, f)[:n] for f in self.__dataclass_fields__ if getattr(getattr(self, f), "ndim", 0)}
        return replace(self, **kept)

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
        moment = J2000 if time is None else as_utc(time)
        years = 2000.0 + (moment - J2000).total_seconds() / JULIAN_YEAR_S - self.epoch_yr
        rays = years * self.motion_rad_yr
        rays += self.rays_icrs
        rays /= np.sqrt(np.einsum("ni,ni->n", rays, rays))[:, None]
        if velocity_m_s is not None:
            rays = aberrate(rays, velocity_m_s)
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
    ra, dec = t["ra"] * ANGLE_UNIT_RAD, t["dec"] * ANGLE_UNIT_RAD
    sin_ra, cos_ra, sin_dec, cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
    east = t["pm_ra"] * (0.01 * MAS_RAD)
    north = t["pm_dec"] * (0.01 * MAS_RAD)
    return StarCatalog(
        name=name,
        epoch_yr=HIPPARCOS_EPOCH_YR,
        sources=("HIP", "HR"),
        source=t["hip"] == 0,
        number=np.where(t["hip"] > 0, t["hip"], t["hr"]),
        rays_icrs=np.stack([cos_dec * cos_ra, cos_dec * sin_ra, sin_dec], axis=1),
        motion_rad_yr=np.stack(
            [-sin_ra * east - sin_dec * cos_ra * north, cos_ra * east - sin_dec * sin_ra * north, cos_dec * north],
            axis=1,
        ),
        v_mag=t["v"] * 0.001,
        v_sigma_mag=t["v_sigma"] * 0.001,
        b_v=t["b_v"] * 0.001,
    )
