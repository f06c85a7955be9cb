"""Random errors of the catalogue's magnitudes, and random stars that the catalogue lacks."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, Stars

# Stars brighter than V over the whole sky: N = N_REF e^(GROWTH (V - V_REF)).
GROWTH_PER_MAG = 1.08  # slope of star counts at V 6-10: 2.9 per magnitude
V_REF_MAG = 7.0
N_REF = 15_600  # Hipparcos with the Bright Star Catalogue has 15,479 to V 7.0 and lacks about 1 % there
# Against an independent list to V 7.5 Hipparcos lacks 0.3 % at V 6.0-6.5 and 1.1 % at 6.5-7.0.
FIRST_LACKING_MAG = 6.5
MIN_LACKING = 0.01
BIN_MAG = 0.25
CLUSTER_RAD = 0.07  # scatter of a field star about a catalogue star: 4 degrees


def draw_v_errors(stars: Stars, scatter_mag: float, *, rng: np.random.Generator) -> Array:
    """True minus stated magnitude (n,) of `stars`, drawn from `rng`: normal, sigma and `scatter_mag` in quadrature."""
    return rng.standard_normal(len(stars)) * np.hypot(stars.v_sigma_mag, scatter_mag)


def draw_field_stars(stars: Stars, to_v_mag: float, *, rng: np.random.Generator) -> Stars:
    """Random stars (from `rng`) that the catalogue `stars` lacks, to `to_v_mag`: ids "FIELD n", hip 0, brightest first.

    In each quarter of a magnitude from FIRST_LACKING_MAG on, as many as the counts N(V) above exceed the catalogue's,
    and at least 1 % of the catalogue's. They follow the density of the catalogue: each lies near a randomly chosen
    catalogue star; uniform without catalogue stars.
    """
    edges = np.arange(FIRST_LACKING_MAG, to_v_mag + 1e-9, BIN_MAG)
    if len(edges) < 2:
        return _field_stars(np.empty((0, 3)), np.empty(0))
    expected = np.diff(N_REF * np.exp(GROWTH_PER_MAG * (edges - V_REF_MAG)))
    listed = np.histogram(stars.v_mag, edges)[0]
    lacking = rng.poisson(np.maximum(expected - listed, MIN_LACKING * listed))
    low = np.repeat(edges[:-1], lacking)
    # Inverse of the cumulative e^(GROWTH V) within a bin.
    steep = np.expm1(GROWTH_PER_MAG * BIN_MAG)
    v_mag = np.sort(low + np.log1p(rng.random(len(low)) * steep) / GROWTH_PER_MAG)
    rays = rng.standard_normal((len(v_mag), 3))
    if len(stars):
        rays = stars.rays_icrs[rng.integers(len(stars), size=len(v_mag))] + CLUSTER_RAD * rays
    return _field_stars(rays / np.linalg.norm(rays, axis=1, keepdims=True), v_mag)


def concatenate_stars(first: Stars, second: Stars) -> Stars:
    """The stars of `first` and `second`, in that order."""
    return Stars(
        catalog_id=np.concatenate([first.catalog_id, second.catalog_id]),
        hip=np.concatenate([first.hip, second.hip]),
        rays_icrs=np.concatenate([first.rays_icrs, second.rays_icrs]),
        v_mag=np.concatenate([first.v_mag, second.v_mag]),
        v_sigma_mag=np.concatenate([first.v_sigma_mag, second.v_sigma_mag]),
    )


def _field_stars(rays_icrs: Array, v_mag: Array) -> Stars:
    n = len(v_mag)
    ids = np.char.add("FIELD ", np.arange(1, n + 1).astype(str)) if n else np.empty(0, dtype="U9")
    return Stars(
        catalog_id=ids, hip=np.zeros(n, dtype=np.int64), rays_icrs=rays_icrs, v_mag=v_mag, v_sigma_mag=np.zeros(n)
    )
