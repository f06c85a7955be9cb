"""The error along a path with odometry between its images: predicted ellipses in the filter and smoother of `track`."""

from __future__ import annotations

import numpy as np

from startrack.applications.prediction.statistics import Cells
from startrack.core.types import Array
from startrack.estimation.filter import TrackFilter
from startrack.estimation.observations import FrameEstimate, Observations, Steps
from startrack.estimation.smoother import radius_holding, smooth
from startrack.output.quantities_prediction import FILTERED, SMOOTHED

RADIUS_PART = 0.95


def with_odometry(position_m: Array, cells: Cells, *, sigma_1: float, floor_m: float) -> Cells:
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
        filtered = _filtered(estimates, steps)
        smoothed = smooth(Observations.of(estimates, 0.0), steps).covariance_m2
    radii = (radius_holding(covariance_m2, RADIUS_PART) for covariance_m2 in (filtered, smoothed))
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


def _filtered(estimates: list[FrameEstimate | None], steps: Steps) -> Array:
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
