"""The Earth's air over a site: how it raises the stars (refraction) and dims them (extinction).

The standard atmosphere: temperature falls by 6.5 K/km up to 11 km, and is constant above. Refraction is one integral at
all elevations, tabulated once for an `Air` and interpolated.

Sources: Hohenkerk and Sinclair (1985), NAO Technical Note 63 (refractive index and its gradient, as in SLALIB's
sla_REFRO); Auer and Standish (2000), AJ 119, 2472 (the integral over the zenith angle along the ray).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from startrack.core.declaration import Number, Table
from startrack.core.types import Array, BadInput
from startrack.frames.directions import azel_from_rays, rays_from_azel, turn_azel

SEA_LEVEL_HPA, SEA_LEVEL_C = 1013.25, 15.0  # US Standard Atmosphere 1976
USUAL_HUMIDITY_1, USUAL_WAVELENGTH_UM = 0.5, 0.55  # a quarter of a percent of refraction between dry and saturated air
LAPSE_K_M, TROPOPAUSE_M, TOP_M = 0.0065, 11_000.0, 80_000.0
LOWEST_SITE_M, HIGHEST_SITE_M = -500.0, 9000.0  # of sites on the Earth's ground
ZERO_C_K = 273.15
EARTH_RADIUS_M = 6_371_008.8  # mean (IUGG 1980); 0.3 % of it change refraction at 5 degrees by 0.2 arcsec
GAS_J_KMOL_K, DRY_KG_KMOL, WATER_KG_KMOL = 8314.32, 28.9644, 18.0152
VAPOUR_POWER = 18.36  # partial pressure of water vapour ~ temperature to this power
# Relative errors of refraction, 1 sigma. Of average air: 10 K of temperature and 10 hPa. Of stated air: 0.1 um of
# wavelength (0.4 %), 1 K and 1 hPa.
USUAL_SIGMA_1, STATED_SIGMA_1 = 0.035, 0.005
USUAL_EXTINCTION_MAG, EXTINCTION_SIGMA_MAG = 0.2, 0.1  # per airmass, in clear air; in haze beyond most stars'
LOWEST_PREDICTED_RAD = np.radians(3.0)  # apparent elevation; below it refraction is not predictable
LOWEST_TABULATED_RAD = np.radians(-3.0)  # apparent elevation; lower the lift is what it is there
LOWEST_RAY_M = -1000.0  # from the sea; rays that would pass lower meet the ground: their lift is continued linearly
TABULATED = 1000  # elevations; denser near the horizon, so that interpolation errs by 0.05 arcsec at most
BEND_NODES, RADIUS_STEPS = 32, 10  # of the integral in each of two layers, and for the height of each

AIR_KEYS: dict[str, Number] = {  # of [air] in a terrain file, and of "air" in a sidecar
    "pressure_hpa": Number(low=0.0, high=1100.0, description="at the site, not reduced to sea level; 0: no air"),
    "temperature_c": Number(low=-90.0, high=60.0),
    "humidity_1": Number(low=0.0, high=1.0, description="relative; if absent 0.5"),
    "wavelength_um": Number(low=0.3, high=1.1, description="of the camera's light; if absent 0.55"),
    "refraction_sigma_1": Number(low=0.0, high=0.2, description="relative error of the refraction of stars; if absent "
                                 "0.035, and 0.005 where pressure and temperature are stated"),
    "extinction_mag": Number(low=0.0, high=2.0, description="per airmass; if absent, 0.2 in rendered images, and from "
                             "the stars of a picture that is located"),
}  # fmt: skip
AIR_TABLE = Table(description="The Earth's air over the site. What is absent is that of the standard atmosphere.",
                  keys=AIR_KEYS)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Air:
    """The air at a site on the Earth. Raises BadInput (bad_terrain) for impossible values."""

    pressure_hpa: float
    temperature_c: float
    humidity_1: float = USUAL_HUMIDITY_1  # relative
    wavelength_um: float = USUAL_WAVELENGTH_UM
    height_m: float = 0.0  # of the site above the sea: the air's temperature is constant 11 km above the sea
    refraction_sigma_1: float = USUAL_SIGMA_1  # relative standard deviation of the refraction
    extinction_mag: float | None = None  # per airmass; None: not stated

    def __post_init__(self) -> None:
        for key, declared in AIR_KEYS.items():
            value = getattr(self, key)
            if value is not None:
                try:
                    object.__setattr__(self, key, declared.check(value, f"air.{key}"))
                except ValueError as cause:
                    raise BadInput("bad_terrain", str(cause)) from cause

    @classmethod
    def at(cls, height_m: float) -> Air:
        """The standard atmosphere `height_m` above the sea."""
        height_m = float(np.clip(height_m, LOWEST_SITE_M, HIGHEST_SITE_M))
        sea_k = SEA_LEVEL_C + ZERO_C_K
        ratio = 1.0 - LAPSE_K_M * height_m / sea_k
        hpa = SEA_LEVEL_HPA * ratio ** _gravity_power(0.0)
        return cls(pressure_hpa=hpa, temperature_c=sea_k * ratio - ZERO_C_K, height_m=height_m)

    def with_stated(self, stated: Mapping[str, Any]) -> Air:
        """Copy of this air with the values that are `stated`, by key of `AIR_KEYS`; other keys do not count.

        Where both pressure and temperature are stated, the error of refraction is smaller.
        """
        given = {key: value for key, value in stated.items() if key in AIR_KEYS}
        if {"pressure_hpa", "temperature_c"} <= given.keys():
            given = {"refraction_sigma_1": min(self.refraction_sigma_1, STATED_SIGMA_1)} | given
        return replace(self, **given)

    @property
    def is_none(self) -> bool:
        """Whether there is no air: neither refraction nor extinction."""
        return self.pressure_hpa == 0.0

    @cached_property
    def _table(self) -> _Table:
        return _table_of(self.pressure_hpa, self.temperature_c, self.humidity_1, self.wavelength_um, self.height_m)

    @property
    def rendered_extinction_mag(self) -> float:
        """Magnitudes per airmass of rendered images: the stated ones, else those of clear air."""
        return USUAL_EXTINCTION_MAG if self.extinction_mag is None else self.extinction_mag

    def apparent_rad(self, true_rad: ArrayLike) -> Array:
        """Apparent elevations (...) [rad] of sources beyond the air at the elevations `true_rad` (...).

        Inverse of `true_rad`, continuous and increasing everywhere. In dry air and above 10 degrees it is ERFA's
        A tan z + B tan^3 z (`refco`) to 1 arcsec. At an apparent elevation below -3 degrees the lift is that at -3.
        """
        true = np.asarray(true_rad, dtype=float)
        return true + np.interp(true, self._table.true_rad, self._table.lift_rad)

    def true_rad(self, apparent_rad: ArrayLike) -> Array:
        """Elevations (...) [rad] without air of sources at the apparent elevations `apparent_rad` (...)."""
        return np.asarray(apparent_rad, dtype=float) - self.lift_rad(apparent_rad)

    def lift_rad(self, apparent_rad: ArrayLike) -> Array:
        """Lift (...) [rad] by the air of sources at the apparent elevations `apparent_rad` (...)."""
        return np.asarray(
            np.interp(np.asarray(apparent_rad, dtype=float), self._table.apparent_rad, self._table.lift_rad)
        )

    def refract(self, rays_icrs: Array, R_enu_icrs: Array) -> Array:
        """Apparent directions (..., 3), ICRS axes, of sources in the directions `rays_icrs` (..., 3) without air.

        `R_enu_icrs` (3, 3) gives the vertical.
        """
        azimuth, elevation = azel_from_rays(rays_icrs @ R_enu_icrs.T)
        return np.asarray(rays_from_azel(azimuth, self.apparent_rad(elevation)) @ R_enu_icrs)

    def straighten(self, rays_icrs: Array, R_enu_icrs: Array) -> Array:
        """Directions (..., 3), ICRS axes, without air of sources at apparent `rays_icrs` (..., 3).

        Inverse of `refract`; `R_enu_icrs` (3, 3) gives the vertical.
        """
        azimuth, elevation = azel_from_rays(rays_icrs @ R_enu_icrs.T)
        return np.asarray(rays_from_azel(azimuth, self.true_rad(elevation)) @ R_enu_icrs)


def turn_sky(azimuth_rad: Array, elevation_rad: Array, R: Array, air: Air | None) -> tuple[Array, Array]:
    """Apparent azimuth and elevation (n,), (n,) [rad] of stars after the sky beyond the `air` turned by `R` (3, 3).

    They were seen at `azimuth_rad` (n,) and `elevation_rad` (n,). `R` is a rotation in enu.
    """
    if air is None:
        return turn_azel(azimuth_rad, elevation_rad, R)
    azimuth, elevation = turn_azel(azimuth_rad, air.true_rad(elevation_rad), R)
    return azimuth, air.apparent_rad(elevation)


def airmass(elevation_rad: ArrayLike) -> Array:
    """Airmass (...) of lines of sight at apparent `elevation_rad` (...) [rad]: 1 at the zenith, below 0 that of 0.

    Source: Rozenberg 1966, Twilight, p. 160.
    """
    s = np.sin(np.maximum(elevation_rad, 0.0))
    return np.asarray(1.0 / (s + 0.025 * np.exp(-11.0 * s)))


class _Table(NamedTuple):
    """Elevations (n,) [rad], ascending, and the lift at each."""

    apparent_rad: Array
    true_rad: Array
    lift_rad: Array


@lru_cache(maxsize=16)
def _table_of(*air: float) -> _Table:
    """Table of refraction for `air`: hPa, degrees C, relative humidity, wavelength [um], height of the site [m]."""
    site_m, lowest_m = EARTH_RADIUS_M + air[-1], EARTH_RADIUS_M + LOWEST_RAY_M
    first = max(-np.arccos(min(lowest_m / site_m, 1.0)), LOWEST_TABULATED_RAD)
    apparent = first + (np.pi / 2 - first) * np.square(np.linspace(0.0, 1.0, TABULATED))
    lift = _Layers(*air).lift_rad(apparent) if air[0] else np.zeros(TABULATED)
    if not np.all(np.diff(lift) <= 1e-12):  # as where all of hot air is vapour
        raise BadInput("bad_terrain", f"no air has {air[0]:g} hPa at {air[1]:g} C with a humidity of {air[2]:g}")
    slope = (lift[1] - lift[0]) / (apparent[1] - apparent[0])
    apparent = np.append(LOWEST_TABULATED_RAD - 1e-9, apparent)
    lift = np.append(lift[0] + slope * (apparent[0] - apparent[1]), lift)
    return _Table(apparent, apparent - lift, lift)


def _gravity_power(height_m: float) -> float:
    """Power of the temperature to which pressure falls in the troposphere over a site at `height_m`."""
    return 9.784 * (1.0 - 2.8e-7 * height_m) * DRY_KG_KMOL / GAS_J_KMOL_K / LAPSE_K_M


class _Layers:
    """Refractive index and its gradient, layer by layer, over a site at radius `self.site_m`."""

    def __init__(self, hpa: float, celsius: float, humidity: float, wavelength_um: float, height_m: float) -> None:
        per_um2 = wavelength_um**-2
        a = (287.6155 + (1.62887 + 0.01360 * per_um2) * per_um2) * ZERO_C_K * 1e-6 / SEA_LEVEL_HPA
        self.kelvin, self.power = celsius + ZERO_C_K, _gravity_power(height_m)
        saturated = 10 ** ((0.7859 + 0.03477 * celsius) / (1.0 + 0.00412 * celsius))
        saturated *= 1.0 + hpa * (4.5e-6 + 6e-10 * celsius**2)
        vapour = humidity * saturated / (1.0 - (1.0 - humidity) * saturated / hpa) if saturated < hpa else 0.0
        w = vapour * (1.0 - WATER_KG_KMOL / DRY_KG_KMOL) * self.power / (VAPOUR_POWER - self.power)
        self.dry, self.wet = a * (hpa + w) / self.kelvin, (a * w + 11.2684e-6 * vapour) / self.kelvin
        self.site_m = EARTH_RADIUS_M + height_m
        self.tropopause_m, self.top_m = EARTH_RADIUS_M + TROPOPAUSE_M, EARTH_RADIUS_M + TOP_M

    def below(self, radius_m: Array) -> tuple[Array, Array]:
        """Index less 1, and its gradient [1/m], in the troposphere at radii (...)."""
        t = np.maximum(1.0 - LAPSE_K_M * (radius_m - self.site_m) / self.kelvin, 0.1)
        dry, wet = self.dry * t ** (self.power - 1.0), self.wet * t ** (VAPOUR_POWER - 1.0)
        slope = (self.power - 1.0) * dry - (VAPOUR_POWER - 1.0) * wet
        return dry - wet, -LAPSE_K_M / self.kelvin / t * slope

    def above(self, radius_m: Array) -> tuple[Array, Array]:
        """Index less 1, and its gradient [1/m], in the stratosphere at radii (...)."""
        kelvin = self.kelvin - LAPSE_K_M * (self.tropopause_m - self.site_m)
        decay_1_m = self.power * LAPSE_K_M / max(kelvin, 0.1 * self.kelvin)
        n = self.below(np.asarray(self.tropopause_m))[0] * np.exp(-decay_1_m * (radius_m - self.tropopause_m))
        return n, -decay_1_m * n

    def lift_rad(self, apparent_rad: Array) -> Array:
        """Refraction (n,) [rad] at apparent elevations (n,)."""
        zenith = np.maximum(np.pi / 2 - apparent_rad, 1e-9)  # at the zenith itself the radius is not determined
        invariant_m = (1.0 + self.below(np.asarray(self.site_m))[0]) * self.site_m * np.sin(zenith)
        tropopause, top = (
            np.arcsin(invariant_m / ((1.0 + layer(np.asarray(r))[0]) * r))
            for layer, r in ((self.below, self.tropopause_m), (self.above, self.top_m))
        )
        lower = _bend(self.below, invariant_m, tropopause, zenith, self.site_m)
        return lower + _bend(self.above, invariant_m, top, tropopause, self.tropopause_m)


def _bend(layer: Any, invariant_m: Array, first: Array, last: Array, start_m: float) -> Array:
    """Integral (n,) of -r n' / (n + r n') over the zenith angle along the ray, from `first` to `last` (n,) [rad].

    n r sin z is the ray's `invariant_m` (n,): it gives the radius r at each angle z, by Newton's method.
    """
    nodes, weights = np.polynomial.legendre.leggauss(BEND_NODES)
    half = 0.5 * (last - first)[:, None]
    target = invariant_m[:, None] / np.sin(first[:, None] + half * (1.0 + nodes))
    radius = np.full_like(target, start_m)
    for _ in range(RADIUS_STEPS):
        n, slope = layer(radius)
        radius = radius - ((1.0 + n) * radius - target) / (1.0 + n + radius * slope)
    n, slope = layer(radius)
    return np.asarray((half * weights * (-radius * slope / (1.0 + n + radius * slope))).sum(axis=1))
