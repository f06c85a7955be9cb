"""From draws to the predicted quantities of places, and to those along a path with odometry."""

from __future__ import annotations

import numpy as np

from startrack.applications.prediction.draws import Status
from startrack.applications.prediction.quantities import CELL_QUANTITIES, ERROR_RATIO, FILTERED, SMOOTHED, Cells
from startrack.core.chunk_store import Chunk
from startrack.core.types import Array, Bools
from startrack.estimation.filter import TrackFilter
from startrack.estimation.observations import FrameEstimate, Observations, Steps
from startrack.estimation.smoother import radius_holding, smooth


def cells_of_draws(draws: Chunk) -> Cells:
    """The quantities of places (k,) from their draws (k, n, ...)."""
    status = draws["status"]
    located = (status == Status.OK) & np.isfinite(draws["covariance_m2"]).all(axis=(2, 3))
    shares = [np.mean(status == code, axis=1) for code in Status]
    radius = np.median(np.where(status == Status.OK, draws["radius95_m"], np.inf), axis=1)
    radius[~np.isfinite(radius)] = np.nan
    found = (radius, *shares, *_ellipses(draws["covariance_m2"], located))
    cells = {one.key: values for one, values in zip(CELL_QUANTITIES, found, strict=True)}
    return cells | {ERROR_RATIO: _error_ratio(draws, located)}


def _error_ratio(draws: Chunk, located: Bools) -> Array:
    """Root mean square (k,) of the errors of the draws (k, n, ...) that are `located` (k, n), over the stated one."""
    error_m2 = np.where(located, np.square(draws["offset_m"]).sum(axis=-1), 0.0).sum(axis=1)
    stated_m2 = np.where(located, np.trace(draws["covariance_m2"], axis1=2, axis2=3), 0.0).sum(axis=1)
    return np.sqrt(error_m2 / np.where(stated_m2 > 0.0, stated_m2, np.nan))


def _ellipses(covariance_m2: Array, located: Bools) -> tuple[Array, Array, Array]:
    """Standard deviations (k,) [m] on both axes of the mean of the covariances (k, n, 2, 2) of the draws that are
    `located` (k, n), and the azimuth (k,) of the long one [deg].
    """
    count = located.sum(axis=1)
    total = np.where(located[:, :, None, None], covariance_m2, 0.0).sum(axis=1)
    major, minor, azimuth = np.full((3, len(count)), np.nan)
    known = count > 0
    squares, axes = np.linalg.eigh(total[known] / count[known, None, None])
    minor[known], major[known] = np.sqrt(np.maximum(squares, 0.0)).T
    east, north = axes[:, :, 1].T
    azimuth[known] = np.degrees(np.arctan2(east, north)) % 180.0
    return major, minor, azimuth


def share_within(cells: Cells, radius95_m: float) -> float:
    """Share of the places in `cells` whose 95 % radius is at most `radius95_m`."""
    return float(np.mean(cells["radius95_m"] <= radius95_m))


def add_odometry(position_m: Array, cells: Cells, *, sigma_1: float, floor_m: float) -> Cells:
    """The `cells` at points (k, 2) along a path with the 95 % radii by the images and odometry together.

    Each point has one image with its predicted ellipse; of those without a radius the odometry alone counts. Moves err
    on each axis by `sigma_1` of their length and, in quadrature, by `floor_m`. Radii are NaN where nothing is known.
    """
    estimates = [
        _estimate(covariance) if known else None
        for covariance, known in zip(ellipse_m2(cells), np.isfinite(cells["radius95_m"]), strict=True)
    ]
    move_m = np.diff(position_m, axis=0)
    steps = Steps(move_m, np.hypot(sigma_1 * np.linalg.norm(move_m, axis=1), floor_m))
    nothing = np.full((len(estimates), 2, 2), np.inf)
    filtered = smoothed = nothing
    if any(one is not None for one in estimates):
        filtered = _filter_covariances(estimates, steps)
        smoothed = smooth(Observations.of(estimates, 0.0), steps).covariance_m2
    radii = (radius_holding(covariance_m2, 0.95) for covariance_m2 in (filtered, smoothed))
    found = (np.where(np.isfinite(radius), radius, np.nan) for radius in radii)
    return cells | dict(zip((FILTERED, SMOOTHED), found, strict=True))


def ellipse_m2(cells: Cells) -> Array:
    """Covariances (k, 2, 2) of the predicted ellipses, east and north."""
    azimuth = np.radians(cells["azimuth_deg"])
    along, across = (np.stack([np.sin(a), np.cos(a)], axis=-1) for a in (azimuth, azimuth + 0.5 * np.pi))
    long, short = (np.square(cells[name])[:, None, None] for name in ("sigma_major_m", "sigma_minor_m"))
    return np.asarray(long * along[:, :, None] * along[:, None] + short * across[:, :, None] * across[:, None])


def _estimate(covariance_m2: Array) -> FrameEstimate:
    """An image whose error is its own."""
    return FrameEstimate(
        mean=np.zeros(2), covariance=covariance_m2, response=np.eye(2), noise=covariance_m2,
        post=np.zeros(0, dtype=np.int64), by_post=np.zeros((2, 0)),
    )  # fmt: skip


def _filter_covariances(estimates: list[FrameEstimate | None], steps: Steps) -> Array:
    """Covariances (k, 2, 2) by the images so far; infinite before the first."""
    state, found = TrackFilter(0, 0.0), np.full((len(estimates), 2, 2), np.inf)
    begun = False
    for k, estimate in enumerate(estimates):
        if k:
            state.predict(steps.move_m[k - 1], float(steps.sigma_m[k - 1]))
        if estimate is not None:
            state.update(estimate)
            begun = True
        if begun:
            found[k] = state.covariance_m2
    return found
