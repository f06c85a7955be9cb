"""From draws to the predicted quantities of places, and to the summary of an area."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.applications.prediction.draws import AMBIGUOUS, OK, REFUSED
from startrack.core.chunk_store import Chunk
from startrack.core.types import Array, Bools
from startrack.output.quantities_prediction import CELL_QUANTITIES, ERROR_RATIO, SHARE_KEYS

Cells = dict[str, Array]  # the quantities of places (k,), by the names of CELL_QUANTITIES; and ERROR_RATIO


def predicted(draws: Chunk) -> Cells:
    """The quantities of places (k,) from their draws (k, n, ...)."""
    status = draws["status"]
    located = (status == OK) & np.isfinite(draws["covariance_m2"]).all(axis=(2, 3))
    shares = [np.mean(status == code, axis=1) for code in (OK, AMBIGUOUS, REFUSED)]
    radius = np.median(np.where(status == OK, draws["radius95_m"], np.inf), axis=1)
    radius[~np.isfinite(radius)] = np.nan
    found = (radius, *shares, *_ellipses(draws["covariance_m2"], located))
    cells = {one.name: values for one, values in zip(CELL_QUANTITIES, found, strict=True)}
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


def summarized(cells: Cells) -> dict[str, Any]:
    """The summary of the places in `cells`, by the keys of the schema."""
    radius, ratio = cells["radius95_m"], cells[ERROR_RATIO]
    return {
        "median_radius95_m": median_or_none(radius),
        **{key: float(np.mean(radius < bound)) for key, bound in SHARE_KEYS.items()},
        **{name: float(np.mean(cells[name])) for name in ("p_ok", "p_ambiguous", "p_refused")},
        ERROR_RATIO: float(np.sqrt(np.nanmean(np.square(ratio)))) if np.isfinite(ratio).any() else None,
    }


def median_or_none(radius_m: Array) -> float | None:
    """Median of radii (k,), NaN where there is no position; None if half of them or more are such."""
    median = float(np.median(np.where(np.isnan(radius_m), np.inf, radius_m)))
    return median if np.isfinite(median) else None


def share_within(cells: Cells, radius95_m: float) -> float:
    """Share of the places in `cells` whose 95 % radius is at most `radius95_m`."""
    return float(np.mean(cells["radius95_m"] <= radius95_m))
