"""Skyline of a fixed camera by photographs of the night sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from startrack.applications.horizon.clouds import cloud_probability, cloud_sigma_rad
from startrack.applications.horizon.columns import (
    AVERAGINGS,
    AZIMUTH_COLUMNS,
    COLUMNS_PER_AZIMUTH,
    GRID_STEP_RAD,
    LOWEST_RAD,
    SKYLINE_AZIMUTHS,
)
from startrack.applications.horizon.frames import LeftOut, Progress, SkyFrame, orient_frames
from startrack.applications.horizon.posterior import (
    HIGH_RAD,
    KINDS,
    NEAR_EDGE_RAD,
    WEAKEST_CONTRAST,
    add_step_log_likelihood,
    combine_columns,
    star_log_likelihood,
    steps_at,
)
from startrack.applications.horizon.skylight import StarLight, Steps, find_steps, measure_stars
from startrack.camera import Camera
from startrack.catalog import StarCatalog
from startrack.core.errors import NoSolution
from startrack.core.limits import check_time
from startrack.core.runner import map_in_threads
from startrack.core.types import Array, Bools, Exposure, Ints, MeasuredSkyline
from startrack.frames import Site, off_axis_rad, rays_from_azel

# Of a bin whose skyline is another one in another picture (a dome, a crane, a branch). Of 14 pictures the highest edges
# at a rotating dome are clouds' with probabilities of 0.001 to 0.01, those of clouds elsewhere with 0.02 to 0.65.
MOVED_PROBABILITY = 0.007
MOVED_RAD = np.radians(20.0)  # by anything up to this
UNKNOWN_SIGMA_RAD = np.radians(2.0)  # a wider posterior is no measurement, nor is a star farther away
PLACE_SIGMA_RAD = np.radians(0.04)  # a quarter of a usual pixel: the edge's place depends on how the ground is lit
WALL_RAD = np.radians(1.0)  # variation from which one elevation does not describe a bin
WEATHER_1 = 0.1  # of the refraction: what the weather changes
GAP_SIGNIFICANCE = 5.0  # of light below the skyline that is brighter than usual ground
DEEPEST_GAP_RAD = np.radians(15.0)
DECISIVE_LLR = 2.0
# That an edge is inside the ground where no star tells: below what two sigma leave out. The skyline behind is up to so
# much higher, tried in so many steps of the grid; stars of so many columns (ten degrees) have it in common.
IN_FRONT_PROBABILITY, HIGHEST_BEHIND_RAD, HEIGHT_STEPS, BESIDE_COLUMNS = 0.02, np.radians(15.0), 5, 41
MOST_NATS = 50.0
CLOUD_STEPS = 2  # which of the AVERAGINGS shows the edges of clouds: the widest one of single pixels

Light = tuple[StarLight, list[Steps]]  # of one picture: stars, and steps of each width


def join_skylines(together: MeasuredSkyline, alone: Sequence[MeasuredSkyline]) -> MeasuredSkyline:
    """The skyline of all pictures `together`, with what each picture `alone` shows and they do not show alike.

    Where the highest and the lowest edge of two pictures more probably differ because something moved than by their
    errors, and more probably than because the highest is a cloud's, the bin has the highest edge, its sigma, and the
    source "varies". A bin that only single pictures know has the value of the most accurate of them, and the scatter
    of them all adds to its sigma.

    Args:
        together: skyline (n,) of all pictures.
        alone: skylines (n,) of the pictures, one by one.
    """
    elevation, sigma, cloud, sources = (
        np.stack([getattr(one, name) for one in alone])
        for name in ("elevation_rad", "sigma_rad", "cloud_probability", "source")
    )
    bins, shown = np.arange(len(together)), np.isfinite(elevation)
    high, low = (np.argmax(np.where(shown, way * elevation, -np.inf), axis=0) for way in (1.0, -1.0))
    with np.errstate(invalid="ignore"):
        apart, both = elevation[high, bins] - elevation[low, bins], np.hypot(sigma[high, bins], sigma[low, bins])
        same = np.exp(-0.5 * np.square(apart / both)) / (both * np.sqrt(2.0 * np.pi))
        varies = (same < MOVED_PROBABILITY / MOVED_RAD) & (cloud[high, bins] < MOVED_PROBABILITY)
    chosen = np.where(varies, high, np.argmin(sigma, axis=0))
    one = shown.any(axis=0) & (varies | ~together.known)
    off = np.where(shown & ~varies, elevation - elevation[chosen, bins], 0.0)
    scatter = np.sqrt(np.square(off).sum(axis=0) / np.maximum(shown.sum(axis=0) - 1, 1))
    return MeasuredSkyline(
        azimuth_rad=together.azimuth_rad,
        elevation_rad=np.where(one, elevation[chosen, bins], together.elevation_rad),
        sigma_rad=np.where(one, np.hypot(sigma[chosen, bins], scatter), together.sigma_rad),
        source=np.select([varies, one], ["varies", sources[chosen, bins]], together.source),
        cloud_probability=np.where(one, cloud[chosen, bins], together.cloud_probability),
    )


@dataclass(frozen=True)
class SkylineResult:
    """The measured skyline, the frames that it comes from, and the photographs left out."""

    skyline: MeasuredSkyline
    frames: tuple[SkyFrame, ...]
    left_out: tuple[LeftOut, ...]


@dataclass(frozen=True, eq=False)
class MeasuredFrame:
    """Frame with its light, its skyline, and its log-likelihoods.

    `by_stars` (AZIMUTH_COLUMNS, n) are those of its stars, `by_steps` (KINDS, AZIMUTH_COLUMNS, n) those of its steps.
    """

    frame: SkyFrame
    light: Light
    skyline: MeasuredSkyline
    by_stars: Array
    by_steps: NDArray[np.float32]


def measure_skyline(
    exposures: Sequence[Exposure], catalog: StarCatalog, site: Site, *, camera: Camera | None = None,
    fov_rad: float | None = None,
) -> SkylineResult:  # fmt: skip
    """The skyline of a fixed camera on the Earth from one or several exposures.

    Args:
        exposures: each with its time.
        catalog: stars.
        site: where the camera stands.
        camera: its lens; None: `fov_rad` is needed.
        fov_rad: field of view to 10 %, as for `identify_blind`.

    Raises:
        BadInput: no_time, no_calibration, size_mismatch.
        NoSolution: the stars of no exposure are identified.
    """
    frames, left_out = orient_frames(exposures, catalog, site, camera=camera, fov_rad=fov_rad)
    return measure_frames(frames, left_out, site)


def measure_frames(
    frames: tuple[SkyFrame, ...], left_out: tuple[LeftOut, ...], site: Site, progress: Progress = lambda text: None
) -> SkylineResult:
    """The skyline at a `site` from `frames` with their attitudes; `left_out` are the photographs without.

    `progress` is called with a text at each step. Raises NoSolution if there is no frame.
    """
    if not frames:
        first = left_out[0]
        raise NoSolution(f"{first.name}: {first.message}", reason=first.reason)
    measured = []
    for frame, one in zip(frames, map_in_threads(lambda frame: measure_frame(frame, site), frames), strict=True):
        progress(f"measured the skyline of {frame.name}")
        measured.append(one)
    return SkylineResult(skyline_of_frames(measured, site), frames, left_out)


def skyline_of_frames(measured: Sequence[MeasuredFrame], site: Site) -> MeasuredSkyline:
    """The skyline at a `site` by one or more frames that were `measured` there."""
    alone = [one.skyline for one in measured]
    if len(measured) == 1:
        return alone[0]
    # Other stars stand there in another picture. Steps are the same edges: which of them is the skyline, a second
    # picture shows no better than the first.
    by_stars = sum((one.by_stars for one in measured), np.zeros(()))
    by_steps = sum((one.by_steps for one in measured), np.zeros((), np.float32))
    frames, lights = [one.frame for one in measured], [one.light for one in measured]
    together = _skyline_of(frames, lights, by_stars + by_steps / len(measured), site)
    return join_skylines(together, alone)


def measure_frame(frame: SkyFrame, site: Site) -> MeasuredFrame:
    """Light, skyline and log-likelihoods of one `frame` at a `site`."""
    check_time()
    stars = measure_stars(frame)
    check_time()
    steps, by_stars = find_steps(frame, stars), star_log_likelihood(stars.rays, stars.missing)
    by_steps = np.zeros((len(KINDS), *by_stars.shape), np.float32)  # it is kept of every picture
    for found, averaging in zip(steps, AVERAGINGS, strict=True):
        add_step_log_likelihood(by_steps, found, averaging.weight)
    light = stars, steps
    return MeasuredFrame(frame, light, _skyline_of([frame], [light], by_stars + by_steps, site), by_stars, by_steps)


def _skyline_of(
    frames: Sequence[SkyFrame], lights: Sequence[Light], log_likelihood: Array, site: Site
) -> MeasuredSkyline:  # fmt: skip
    """The skyline by the `log_likelihood` (KINDS, AZIMUTH_COLUMNS, n) of the `lights` of `frames`."""
    check_time()
    stars, steps = zip(*lights, strict=True)
    mean, sigma = combine_columns(log_likelihood)
    # The columns' posterior as bins of one degree; the errors that the frames share are added once.
    azimuth = np.radians(np.arange(SKYLINE_AZIMUTHS, dtype=np.float64) * (360.0 / SKYLINE_AZIMUTHS))
    elevation, scatter = (_columns_of_bins(one, 0).mean(axis=1) for one in (mean, np.square(sigma)))
    variation = _columns_of_bins(mean, COLUMNS_PER_AZIMUTH // 2).var(axis=1)  # within one degree to either side
    added = np.square(_common_sigma_rad(frames, azimuth, elevation, site)) + PLACE_SIGMA_RAD**2
    added += np.square(_gap_depth(steps, mean))
    by_stars, by_light = _has_star(stars, azimuth, elevation), _has_step(steps, mean)
    known = (scatter + variation + added < UNKNOWN_SIGMA_RAD**2) & (by_stars | by_light)
    # A shorter run than three is a halo or a reflection more often than ground, and beside an unknown bin the ground
    # often rises.
    known &= np.roll(known, 1) & np.roll(known, -1)
    lowest = float(elevation[known].min()) if known.any() else 0.0
    cloud = _cloud_probability(lights, azimuth, elevation, mean, lowest)
    # The skyline behind a cloud's edge may be anywhere down to the lowest bin.
    known &= scatter + variation + added + cloud * np.square(elevation - lowest) < UNKNOWN_SIGMA_RAD**2
    added += np.square(cloud_sigma_rad(cloud, elevation - lowest))
    in_front, height = _higher_skyline(stars, mean)
    known &= scatter + variation + added + in_front * np.square(height) / 3.0 < UNKNOWN_SIGMA_RAD**2
    added += np.square(cloud_sigma_rad(in_front, height))
    # The errors of the columns of a bin are independent where each has its step; wide ones they have in common.
    common = np.square(scatter) / (scatter + NEAR_EDGE_RAD**2)
    variance = (scatter - common) / COLUMNS_PER_AZIMUTH + common + added
    variance += np.square(variation) / (variation + WALL_RAD**2)
    source = np.select([by_stars & by_light, by_light, by_stars], ["both", "sky light", "stars"], "")
    return MeasuredSkyline(
        azimuth_rad=azimuth,
        elevation_rad=np.where(known, elevation, np.nan),
        sigma_rad=np.where(known, np.sqrt(variance), np.inf),
        source=np.where(known, source, ""),
        cloud_probability=cloud,
    )


def _cloud_probability(
    lights: Sequence[Light], azimuth: Array, elevation: Array, mean: Array, lowest_rad: float
) -> Array:  # fmt: skip
    """Probability (n,) that the edge at the `azimuth` and `elevation` (n,) of a bin is a cloud's.

    An edge that several pictures show is a cloud's only if it is in each of them, and the clouds of different pictures
    are independent. `mean`: of the columns; `lowest_rad`: elevation down to which the skyline may be lower.
    """
    probability = np.ones(len(elevation))
    for stars, steps in lights:
        shows = _has_star([stars], azimuth, elevation) | _has_step([steps], mean)
        one = cloud_probability(steps[CLOUD_STEPS], stars, mean, elevation, lowest_rad)
        probability[shows] *= one[shows]
    return probability


def _higher_skyline(stars: Sequence[StarLight], mean: Array) -> tuple[Array, Array]:
    """Probability (n,) that the edge of a bin is inside the ground, before a higher skyline, and up to where [rad].

    A snow line below a ridge is as sharp and as long as a skyline, and every column shows it alike: stars alone, those
    missing above it beside a bin, tell. `mean` (AZIMUTH_COLUMNS,): elevations of the edges.
    """
    from scipy.ndimage import uniform_filter1d

    by_stars = sum((star_log_likelihood(one.rays, one.missing) for one in stars), np.zeros(()))
    above = np.arange(0, int(HIGHEST_BEHIND_RAD / GRID_STEP_RAD), HEIGHT_STEPS)
    row = np.rint((mean - LOWEST_RAD) / GRID_STEP_RAD).astype(np.int64)[:, None] + above
    taken = np.take_along_axis(by_stars, np.minimum(row, by_stars.shape[1] - 1), axis=1)
    beside = uniform_filter1d(taken - taken[:, :1], BESIDE_COLUMNS, axis=0, mode="wrap") * BESIDE_COLUMNS
    prior = np.exp(-above * (GRID_STEP_RAD / HIGH_RAD))
    weight = np.exp(np.minimum(beside, MOST_NATS)) * prior / prior.sum()
    odds, second = IN_FRONT_PROBABILITY * weight.sum(axis=1), weight @ np.square(above * GRID_STEP_RAD)
    height = np.sqrt(3.0 * second / weight.sum(axis=1))  # of heights that are evenly spread
    probability, height = (_columns_of_bins(one, 0).mean(axis=1) for one in (odds / (1.0 + odds), height))
    return probability, height


def _gap_depth(steps: Sequence[list[Steps]], elevation_rad: Array) -> Array:
    """Depth (SKYLINE_AZIMUTHS,) [rad] below the skyline at which light is seen again, as through a tree with gaps."""
    depth = np.zeros(AZIMUTH_COLUMNS)
    for one in (one for by_width in steps for one in by_width[:2]):
        below = elevation_rad[one.column] - one.elevation_rad
        light = (one.contrast > WEAKEST_CONTRAST) & (one.significance > GAP_SIGNIFICANCE)
        light &= (below > NEAR_EDGE_RAD) & (below < DEEPEST_GAP_RAD)
        np.maximum.at(depth, one.column[light], below[light])
    return np.asarray(_columns_of_bins(depth, 2 * COLUMNS_PER_AZIMUTH).mean(axis=1))


def _columns_of_bins(values: Array, beside: int) -> Array:
    """Array (SKYLINE_AZIMUTHS, n) of the `values` (AZIMUTH_COLUMNS,) in each bin and in so many columns `beside` it."""
    own = np.arange(-beside, COLUMNS_PER_AZIMUTH + beside)
    return values[(np.arange(0, AZIMUTH_COLUMNS, COLUMNS_PER_AZIMUTH)[:, None] + own) % AZIMUTH_COLUMNS]


def _common_sigma_rad(frames: Sequence[SkyFrame], azimuth: Array, elevation: Array, site: Site) -> Array:
    """Error (n,) of lens, attitude and refraction: that of the best frame, for frames share the lens."""
    rays_enu = rays_from_azel(azimuth, elevation)
    by_frame = []
    for frame in frames:
        rays = rays_enu @ frame.R_cam_enu.T
        angle = np.minimum(off_axis_rad(rays), frame.camera.max_angle_rad)
        scale = frame.camera.mean_scale_rad_per_px(angle)
        by_frame.append(np.hypot(frame.camera.projection_sigma_px(rays) * scale, frame.attitude_sigma_rad))
    lift = 0.0 if site.air is None else site.air.lift_rad(elevation)
    return np.hypot(np.min(by_frame, axis=0), WEATHER_1 * lift)


def _has_star(stars: Sequence[StarLight], azimuth: Array, elevation: Array) -> Bools:
    """Whether stars decide about each bin (n,): one seen near above the skyline, and one missing near below it."""
    found = np.zeros((2, len(azimuth)), dtype=bool)
    for rays in (light.rays.take(np.abs(light.rays.llr) > DECISIVE_LLR) for light in stars):
        height = rays.elevation_rad - elevation[:, None]
        number, star = np.nonzero(np.abs(height) < UNKNOWN_SIGMA_RAD)
        apart = np.abs((rays.azimuth_rad[star] - azimuth[number] + np.pi) % (2 * np.pi) - np.pi)
        near = apart * np.cos(elevation[number]) < UNKNOWN_SIGMA_RAD
        for side, way in enumerate((1.0, -1.0)):
            found[side, number[near & (way * height[number, star] > 0.0) & (way * rays.llr[star] > 0.0)]] = True
    return np.asarray(found.all(axis=0))


def _has_step(steps: Sequence[list[Steps]], elevation_rad: Array) -> Bools:
    """Whether steps of light that are no noise lie at the skyline of most columns of each bin."""
    found = np.zeros(AZIMUTH_COLUMNS, dtype=bool)
    for one in (one for by_width in steps for one in by_width):
        found[steps_at(one, elevation_rad).column] = True
    return np.asarray(_columns_of_bins(found, 0).mean(axis=1) >= 0.5)


def skyline_at(skyline: MeasuredSkyline, azimuth_rad: Array) -> Array:
    """Elevations (n,) [rad] of a `skyline` at azimuths (n,), interpolated between two known ones.

    Beside an unknown one it is the elevation at the nearest azimuth; nan where that is unknown.
    """
    n = len(skyline)
    place = np.asarray(azimuth_rad) * (n / (2 * np.pi))
    low = np.floor(place).astype(np.int64)
    share = place - low
    between = (1 - share) * skyline.elevation_rad[low % n] + share * skyline.elevation_rad[(low + 1) % n]
    return np.asarray(np.where(np.isfinite(between), between, skyline.elevation_rad[_nearest_bin(n, azimuth_rad)]))


def _nearest_bin(n: int, azimuth_rad: Array) -> Ints:
    """Index (m,) of the nearest of `n` even azimuths around the compass to each of `azimuth_rad` (m,)."""
    return np.asarray(np.rint(np.asarray(azimuth_rad) * (n / (2 * np.pi))).astype(np.int64) % n)


def predicted_visible(skyline: MeasuredSkyline, azimuth_rad: Array, elevation_rad: Array) -> tuple[Bools, Bools]:
    """Whether directions (n,) are above a `skyline`, and which are more than two sigma from it where it is known.

    `azimuth_rad` and `elevation_rad` (n,) are apparent directions.
    """
    height = elevation_rad - skyline_at(skyline, azimuth_rad)
    return height > 0, np.abs(height) > 2 * skyline.sigma_rad[_nearest_bin(len(skyline), azimuth_rad)]
