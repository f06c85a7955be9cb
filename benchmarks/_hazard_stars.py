"""Hazards of the stars: wrong magnitudes, missing and false light, and parts of the view that are dark."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from _hazard_grounds import turn

from startrack.chain import StarRays
from startrack.core.types import Array
from startrack.evidence.star_photometer import visibility_llr
from startrack.frames import azel_from_rays
from startrack.rendering import Scene

TOO_FAINT_MAG = 20.0
Rng = np.random.Generator


def magnitudes(scatter_mag: float, outliers: float) -> Callable[[Scene, Rng], Scene]:
    """Magnitudes wrong by a scatter, and those of a part of the stars by 0.5 to 2."""

    def change(scene: Scene, rng: Rng) -> Scene:
        n = len(scene.stars)
        error = rng.normal(0.0, scatter_mag, n) + (rng.random(n) < outliers) * rng.uniform(0.5, 2.0, n) * rng.choice(
            [-1.0, 1.0], n
        )
        return replace(scene, v_error_mag=scene.v_error_mag + error)

    return change


def missing(part: float) -> Callable[[Scene, Rng], Scene]:
    """A part of the stars is missing."""

    def change(scene: Scene, rng: Rng) -> Scene:
        gone = rng.random(len(scene.stars)) < part
        return replace(scene, v_error_mag=scene.v_error_mag + np.where(gone, TOO_FAINT_MAG, 0.0))

    return change


def false_light(part: float) -> Callable[[StarRays, Rng], StarRays]:
    """A part of the stars shows the light that is expected, hidden or not."""

    def change(rays: StarRays, rng: Rng) -> StarRays:
        false = (rng.random(len(rays.photometry.llr)) < part) & rays.photometry.usable
        return replace(
            rays, photometry=replace(rays.photometry, llr=np.where(false, _shown_llr(rays), rays.photometry.llr))
        )

    return change


def rows_wrong(part: float) -> Callable[[StarRays, Rng], StarRays]:
    """A part of the stars shows the opposite of the truth: the light that is expected, or that of a hidden star."""

    def change(rays: StarRays, rng: Rng) -> StarRays:
        light, shown = rays.photometry, _shown_llr(rays)
        wrong = (rng.random(len(light.llr)) < part) & light.usable
        return replace(rays, photometry=replace(light, llr=np.where(wrong, -np.sign(light.llr) * shown, light.llr)))

    return change


def _shown_llr(rays: StarRays) -> Array:
    """The log-likelihood ratio of stars with exactly the light that is expected."""
    light = rays.photometry
    sigma = np.maximum(light.sigma_e, 1.0)
    return np.asarray(visibility_llr(light.expected_e, light.expected_e, sigma, sigma))


def hidden_where(hides: Callable[[Array, Array, Array, Rng], Array]) -> Callable[[Scene, Rng], Scene]:
    """Stars are dark where a function of azimuths, elevations and heights above the skyline (n,) is true."""

    def change(scene: Scene, rng: Rng) -> Scene:
        azimuth, elevation = azel_from_rays(scene.stars.rays_icrs @ scene.R_enu_icrs.T)
        around = np.linspace(0.0, 2 * np.pi, 721)
        assert scene.terrain is not None
        skyline = np.asarray(scene.terrain.horizon_rad(scene.position_enu_m[None, :2], around)).ravel()
        dark = hides(azimuth, elevation, elevation - np.interp(azimuth % (2 * np.pi), around, skyline), rng)
        return replace(scene, v_error_mag=scene.v_error_mag + np.where(dark, TOO_FAINT_MAG, 0.0))

    return change


def mast(azimuth: Array, elevation: Array, above: Array, rng: Rng) -> Array:
    """A bar of 2 to 12 degrees from the ground to the zenith."""
    off, half_width = turn(azimuth, rng.uniform(0, 2 * np.pi)), np.radians(rng.uniform(1, 6))
    return np.asarray((np.abs(np.cos(elevation) * np.sin(off)) < half_width) & (np.cos(off) > 0))


def dust(azimuth: Array, elevation: Array, above: Array, rng: Rng) -> Array:
    """Ten to forty specks of 1 to 6 degrees within 12 degrees of the skyline."""
    dark = np.zeros(len(azimuth), dtype=bool)
    for _ in range(rng.integers(10, 41)):
        middle, height, radius = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(-2, 12)), rng.uniform(0.5, 3)
        off = np.hypot(np.cos(elevation) * turn(azimuth, middle), above - height)
        dark |= off < np.radians(radius)
    return dark


def quadrant(azimuth: Array, elevation: Array, above: Array, rng: Rng) -> Array:
    """A range of azimuths of 40 to 100 degrees."""
    return np.asarray(np.abs(turn(azimuth, rng.uniform(0, 2 * np.pi))) < np.radians(rng.uniform(20, 50)))
