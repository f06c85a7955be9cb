"""From draws to the predicted quantities of places, and to the summary of an area."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.chunk_store import Chunk
from startrack.output.quantities_prediction import CELL_QUANTITIES, SHARE_KEYS
from startrack.prediction.draws import AMBIGUOUS, OK, REFUSED
from startrack.types import Array

Cells = dict[str, Array]  # the quantities of places (k,), by the names of CELL_QUANTITIES


def predicted(draws: Chunk) -> Cells:
    """The quantities of places (k,) from their draws (k, n, ...)."""
    status = draws["status"]
    shares = [np.mean(status == code, axis=1) for code in (OK, AMBIGUOUS, REFUSED)]
    radius = np.median(np.where(status == OK, draws["radius95_m"], np.inf), axis=1)
    radius[~np.isfinite(radius)] = np.nan
    found = (radius, *shares, *_ellipses(draws))
    return {one.name: values for one, values in zip(CELL_QUANTITIES, found, strict=True)}


def _ellipses(draws: Chunk) -> tuple[Array, Array, Array]:
    """Standard deviations (k,) [m] on both axes of the mean covariance, and the azimuth (k,) of the long one [deg]."""
    located = (draws["status"] == OK) & np.isfinite(draws["covariance_m2"]).all(axis=(2, 3))
    count = located.sum(axis=1)
    total = np.where(located[:, :, None, None], draws["covariance_m2"], 0.0).sum(axis=1)
    major, minor, azimuth = np.full((3, len(count)), np.nan)
    known = count > 0
    squares, axes = np.linalg.eigh(total[known] / count[known, None, None])
    minor[known], major[known] = np.sqrt(np.maximum(squares, 0.0)).T
    east, north = axes[:, :, 1].T
    azimuth[known] = np.degrees(np.arctan2(east, north)) % 180.0
    return major, minor, azimuth


def summarized(cells: Cells) -> dict[str, Any]:
    """The summary of the places in `cells`, by the keys of the schema."""
    radius = np.where(np.isnan(cells["radius95_m"]), np.inf, cells["radius95_m"])
    median = float(np.median(radius))
    return {
        "median_radius95_m": median if np.isfinite(median) else None,
        **{key: float(np.mean(radius < bound)) for key, bound in SHARE_KEYS.items()},
        **{name: float(np.mean(cells[name])) for name in ("p_ok", "p_ambiguous", "p_refused")},
    }


def share_within(cells: Cells, radius95_m: float) -> float:
    """Share of the places in `cells` whose 95 % radius is at most `radius95_m`."""
    return float(np.mean(np.nan_to_num(cells["radius95_m"], nan=np.inf) <= radius95_m))
