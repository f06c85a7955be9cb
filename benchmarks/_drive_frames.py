"""Frames of simulated drives: observations from evidence, without images, or from rendered pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cached_property

import numpy as np
from _cameras import EXPOSURE_S, camera_for_share

from startrack.applications.tracking import ObservedFrame, TrackErrors, observe_frame
from startrack.applications.tracking.frame_estimate import estimate_frame
from startrack.applications.tracking.observed_frame import image_fixes, observe_again
from startrack.catalog import apparent_stars, load_catalog
from startrack.chain import Located, Settings, locate
from startrack.core.types import Array, Evidence, NotLocated
from startrack.evidence.star_photometer import visibility_llr
from startrack.frames import R_enu_icrs, azel_from_rays
from startrack.localization import ExactPosterior
from startrack.rendering import Series, render
from startrack.terrain import HeightMap, Terrain

SNR_5_MAG, FAINTEST_MAG = 6.0, 8.6  # of a star with 5 sigma, and of the faintest star used
FLUX_SCATTER = 0.03  # beyond the catalogue's own
NEAR_RAD = np.radians(1.5)  # of the skyline: stars farther off do not depend on the position
AROUND_RAD = np.linspace(0.0, 2 * np.pi, 721)
FIRST_ERROR_M, FIRST_SIGMA_M = 7.0, 8.0  # of the first guess, in place of a search
FIRST_DAY, DAYS = datetime(2026, 1, 1, tzinfo=UTC), 300


@dataclass(frozen=True, eq=False)
class Course:
    """Where and when the frames are taken, on a true ground, and the map that is stated."""

    ground: Terrain
    stated: Terrain
    raised_rad: float  # of the true horizon above that of the ground
    position_m: Array  # (n, 2)
    time_utc: tuple[datetime, ...]
    uses_sky: bool = False

    @cached_property
    def shared(self) -> TrackErrors:
        """The clock is exact."""
        return TrackErrors.of(self.stated, None, self.uses_sky)


def frames_by_evidence(course: Course, rng: np.random.Generator) -> Iterator[ObservedFrame]:
    """Observations from simulated photometry of the catalogue's stars near the skyline."""
    catalog = load_catalog()
    error_mag = rng.normal(size=len(catalog)) * np.hypot(catalog.v_sigma_mag, FLUX_SCATTER)
    for number, (position, when) in enumerate(zip(course.position_m, course.time_utc, strict=True)):
        evidence = simulate_evidence(course, position, when, error_mag, rng)
        at = position + FIRST_ERROR_M * rng.normal(size=2)
        estimate = estimate_frame(evidence, course.stated, course.shared, at, FIRST_SIGMA_M**2 * np.eye(2))
        yield ObservedFrame(f"frame-{number:03d}", when, None, (estimate,), evidence)


def frames_by_fixes(course: Course, rng: np.random.Generator) -> Iterator[ObservedFrame]:
    """As `frames_by_evidence`, each located in the whole search area: an image that is refused has no position."""
    for frame in frames_by_evidence(course, rng):
        assert frame.evidence is not None
        try:
            fixes = image_fixes(ExactPosterior()(frame.evidence, course.stated), course.stated)
        except NotLocated as refusal:
            yield replace(frame, modes=(), evidence=None, reason=str(refusal.reason), message=str(refusal))
            continue
        yield observe_again(replace(frame, fixes=fixes), course.shared, course.stated)


def simulate_evidence(
    course: Course, position: Array, when: datetime, error_mag: Array, rng: np.random.Generator,
    near_rad: float = NEAR_RAD,
) -> Evidence:  # fmt: skip
    """The stars up to `near_rad` from the skyline of one exposure."""
    site, ground = course.stated.site, course.ground
    assert site is not None
    stars = apparent_stars(load_catalog(), when, site)
    azimuth, elevation = azel_from_rays(stars.rays_icrs @ R_enu_icrs(site, when).T)
    about = np.interp(azimuth, AROUND_RAD, ground.horizon_rad(position[None], AROUND_RAD)) + course.raised_rad
    use = np.flatnonzero((stars.v_mag < FAINTEST_MAG) & (np.abs(elevation - about) < near_rad))
    visible = elevation[use] > ground.horizon_rad(position[None], azimuth[use]) + course.raised_rad
    snr = 5.0 * 10 ** (-0.4 * (stars.v_mag[use] - SNR_5_MAG))
    light = visible * snr * 10 ** (-0.4 * error_mag[use]) + rng.normal(size=len(use))
    fraction = np.hypot(0.4 * np.log(10) * stars.v_sigma_mag[use], FLUX_SCATTER)
    llr = visibility_llr(light, snr, np.ones(len(use)), np.sqrt(1.0 + np.square(fraction * snr)))
    return Evidence(azimuth_rad=azimuth[use], elevation_rad=elevation[use], llr=llr)


def frames_by_pixels(course: Course, share: float, seed: int) -> Iterator[ObservedFrame]:
    """Observations from rendered frames of 2048 px; the sky's light is the `share` of the background (0: stars alone).

    Without a share the sky is as dark as the renderer's usual one, and its light is not used.
    """
    camera, sky_mag = camera_for_share(share)
    assert isinstance(course.ground, HeightMap) or not course.raised_rad
    series = Series(
        camera=camera, terrain=course.ground, catalog=load_catalog(), seed=seed, exposure_s=EXPOSURE_S,
        sky_v_mag_arcsec2=sky_mag,
    )  # fmt: skip
    settings = Settings(evidence_sources="both" if share else "stars")
    for number, (position, when) in enumerate(zip(course.position_m, course.time_utc, strict=True)):
        east, north = (float(a) for a in position)
        posed = replace(series, time_utc=when, east_m=east, north_m=north)
        scene, noise = posed.scene(number, f"frame-{number:03d}")
        exposure, _ = render(scene, rng=noise)
        outcome = locate(exposure, camera, course.stated, load_catalog(), settings)
        if share and isinstance(outcome, Located) and outcome.sky_unused:
            print(f"frame {number}: {outcome.sky_unused}", flush=True)
        yield observe_frame(outcome, course.shared)


def draw_course(
    ground: Terrain, stated: Terrain, raised_rad: float, *, frames: int, spacing_m: float, every_s: float,
    radius_m: float, slope_rad: float, rng: np.random.Generator,
) -> Course:  # fmt: skip
    """A straight drive (or a rest, `spacing_m` 0) within a radius, on ground no steeper than a slope."""
    while True:
        heading = rng.uniform(0.0, 2 * np.pi)
        along = spacing_m * np.arange(frames)[:, None] * [np.sin(heading), np.cos(heading)]
        position = rng.uniform(-radius_m, radius_m, 2) + along
        steepest = stated.slope_rad(position).max() if isinstance(stated, HeightMap) else 0.0
        if np.hypot(*position.T).max() < radius_m and steepest < slope_rad:
            break
    start = FIRST_DAY + timedelta(days=float(rng.uniform(0.0, DAYS)))
    times = tuple(start + timedelta(seconds=every_s * k) for k in range(frames))
    return Course(ground, stated, raised_rad, position, times)
