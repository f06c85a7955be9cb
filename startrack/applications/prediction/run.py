"""Predictions at places by a store of draws: the quantities of places, and those along a path with odometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from startrack.applications.chunk_store import Chunk, ChunkStore
from startrack.applications.prediction.draws import (
    Conditions,
    Place,
    Predictor,
    Status,
    Task,
    join_chunks,
    times_between,
)
from startrack.applications.prediction.places import area_cells, default_spacing_m, numbered_places
from startrack.applications.prediction.quantities import (
    CELL_QUANTITIES,
    ERROR_RATIO,
    FILTERED,
    SMOOTHED,
    Cells,
    summarize_cells,
)
from startrack.camera import Camera, load_camera
from startrack.core.statistics import error_ellipse
from startrack.core.types import Array, Bools
from startrack.estimation.observations import (
    FrameEstimate,
    OdometryErrors,
    Steps,
    moves_by_scale_and_heading,
)
from startrack.estimation.trajectory import TrackFilter, radius_holding, smooth
from startrack.rendering import exposure_for_snr
from startrack.terrain import Terrain

DEPTH_V_MAG = 3.0, 9.0  # limiting magnitudes that are tried; beyond, the faintest stars of the simulated sky are missed
DEPTH_STEP_MAG = 0.1  # to which the depth is found: a tenth of the exposure
DEPTH_SHARE = 0.9  # of the places that must reach the wanted radius


def cells_of_draws(draws: Chunk) -> Cells:
    """The quantities of places (k,) from their draws (k, n, ...)."""
    status = draws["status"]
    located = (status == Status.OK) & np.isfinite(draws["covariance_m2"]).all(axis=(2, 3))
    shares = [np.mean(status == code, axis=1) for code in Status]
    lengths = (draws[name] for name in ("radius95_m", "protection_level_m"))
    radius, level = (_known_medians(np.where(status == Status.OK, one, np.inf)) for one in lengths)
    found = (radius, *shares, *_ellipses(draws["covariance_m2"], located), level)
    cells = {one.key: values for one, values in zip(CELL_QUANTITIES, found, strict=True)}
    # Root mean square of the errors over the stated one.
    error_m2 = np.where(located, np.square(draws["offset_m"]).sum(axis=-1), 0.0).sum(axis=1)
    stated_m2 = np.where(located, np.trace(draws["covariance_m2"], axis1=2, axis2=3), 0.0).sum(axis=1)
    return cells | {ERROR_RATIO: np.sqrt(error_m2 / np.where(stated_m2 > 0.0, stated_m2, np.nan))}


def _known_medians(length_m: Array) -> Array:
    """Medians (k,) over the draws of lengths (k, n); NaN where they are infinite."""
    median = np.median(length_m, axis=1)
    return np.where(np.isfinite(median), median, np.nan)


def _ellipses(covariance_m2: Array, located: Bools) -> tuple[Array, Array, Array]:
    """Standard deviations (k,) [m] on both axes of the mean of the covariances (k, n, 2, 2) of the draws that are
    `located` (k, n), and the azimuth (k,) of the long one [deg].
    """
    count = located.sum(axis=1)
    total = np.where(located[:, :, None, None], covariance_m2, 0.0).sum(axis=1)
    major, minor, azimuth = np.full((3, len(count)), np.nan)
    known = count > 0
    major[known], minor[known], azimuth[known] = error_ellipse(total[known] / count[known, None, None])
    return major, minor, np.degrees(azimuth)


def share_within(cells: Cells, radius95_m: float) -> float:
    """Share of the places in `cells` whose 95 % radius is at most `radius95_m`."""
    return float(np.mean(cells["radius95_m"] <= radius95_m))


def add_odometry(position_m: Array, cells: Cells, errors: OdometryErrors) -> Cells:
    """The `cells` at points (k, 2) along a path with the 95 % radii by the images and odometry together.

    Each point has one image with its predicted ellipse; of those without a radius the odometry alone counts. Moves have
    these `errors`. Radii are NaN where nothing is known.
    """
    known = np.isfinite(cells["radius95_m"])
    alone = FrameEstimate(
        mean=np.zeros(2), covariance=np.eye(2), response=np.eye(2), noise=np.eye(2), post=np.zeros(0, dtype=np.int64),
        by_post=np.zeros((2, 0)),
    )  # fmt: skip
    estimates = [
        replace(alone, covariance=covariance, noise=covariance) if is_known else None
        for covariance, is_known in zip(ellipse_m2(cells), known, strict=True)
    ]
    move_m = np.diff(position_m, axis=0)
    steps = Steps(move_m, errors.sigma_m(move_m), errors.sigma_1 * moves_by_scale_and_heading(move_m))
    filtered = smoothed = np.full((len(known), 2, 2), np.inf)
    if known.any():
        state, filtered = TrackFilter.start(0, steps.by_shared_m.shape[-1]), filtered.copy()
        for k, estimate in enumerate(estimates):
            if k:
                state.predict(steps, k - 1)
            if estimate is not None:
                state.update(estimate)
            if known[: k + 1].any():
                filtered[k] = state.covariance_m2
        smoothed = smooth(estimates, steps).covariance_m2
    radii = (radius_holding(covariance_m2, 0.95) for covariance_m2 in (filtered, smoothed))
    found = (np.where(np.isfinite(radius), radius, np.nan) for radius in radii)
    return cells | dict(zip((FILTERED, SMOOTHED), found, strict=True))


def ellipse_m2(cells: Cells) -> Array:
    """Covariances (k, 2, 2) of the predicted ellipses, east and north."""
    azimuth = np.radians(cells["azimuth_deg"])
    along, across = (np.stack([np.sin(a), np.cos(a)], axis=-1) for a in (azimuth, azimuth + 0.5 * np.pi))
    long, short = (np.square(cells[name])[:, None, None] for name in ("sigma_major_m", "sigma_minor_m"))
    return np.asarray(long * along[:, :, None] * along[:, None] + short * across[:, :, None] * across[:, None])


@dataclass(frozen=True)
class Predictions:
    """Predictions at the same places: the draws come from the store where it has them."""

    places: Sequence[Place]
    store: ChunkStore[Task]
    inputs: tuple[tuple[str, str], ...] = ()  # see Task
    overwrite: bool = False  # compute again what the store has
    _new: set[Conditions] = field(default_factory=set)

    def cells(self, conditions: Conditions, what: str) -> Cells:
        """The predicted quantities of the places under `conditions`; `what` names them in the progress bar.

        Raises RunStopped.
        """
        tasks = [Task(conditions, place, self.inputs) for place in self.places]
        if self.overwrite and conditions not in self._new:
            self.store.discard(tasks)
        self._new.add(conditions)
        return cells_of_draws(join_chunks(self.store.chunks(what, tasks)))

    def depth(self, conditions: Conditions, target_m: float) -> tuple[Conditions, dict[str, Any]]:
        """The shortest exposure whose radius is at most `target_m` at nine of ten places; and the record of the search.

        It tries magnitudes one by one, as deep images cost most, then bisects the last one. The conditions returned
        have that exposure, or the longest tried.
        """
        low, deepest = DEPTH_V_MAG
        high, camera = low, load_camera(conditions.camera)
        tried: list[dict[str, float]] = []

        def exposure_s(v_mag: float) -> float:
            return exposure_for_snr(camera, conditions.sky_v_mag_arcsec2, v_mag=v_mag)

        def reaches(v_mag: float) -> bool:
            conditions_there = replace(conditions, exposure_s=exposure_s(v_mag))
            share = share_within(self.cells(conditions_there, f"depth V {v_mag:.1f}"), target_m)
            tried.append({"exposure_s": exposure_s(v_mag), "share": share})
            return share >= DEPTH_SHARE

        while not (found := reaches(high)) and high < deepest:
            low, high = high, min(high + 1.0, deepest)
        while found and high - low > DEPTH_STEP_MAG:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if reaches(middle) else (middle, high)
        record = {
            "target_radius95_m": target_m,
            "share": DEPTH_SHARE,
            "exposure_s": exposure_s(high) if found else None,
            "limiting_v_mag": high if found else None,
            "tried": sorted(tried, key=lambda one: one["exposure_s"]),
        }
        return replace(conditions, exposure_s=exposure_s(high)), record


@dataclass(frozen=True, eq=False)
class Prediction:
    """Expected accuracy at positions."""

    positions_m: Array  # (k, 2) east and north from the terrain's origin
    cells: Cells  # arrays (k,) by the names of predict.ecsv's columns
    exposure_s: float
    limiting_v_mag: float  # of a star on the axis at 5 sigma

    @property
    def summary(self) -> dict[str, Any]:
        """Summary over the positions, by the keys of the summary in predict.json."""
        return summarize_cells(self.cells)


def predict_positions(
    camera: Camera, terrain: Terrain, times_utc: tuple[datetime, datetime], *, draws: int,
    positions_m: ArrayLike | None = None, spacing_m: float | None = None, **conditions: Any,
) -> Prediction:  # fmt: skip
    """The prediction of a camera and a terrain in memory, in this process.

    `times_utc`, `draws`, `positions_m`, `spacing_m` and the `conditions` are those of `startrack.predict`.
    """
    if positions_m is None:
        cells = area_cells(terrain, spacing_m or default_spacing_m(terrain))
        points, places = cells.position_m, cells.places
    else:
        points = np.asarray(positions_m, dtype=float)
        if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not np.isfinite(points).all():
            raise ValueError(f"positions_m has shape {points.shape}: finite numbers (k, 2) are needed")
        if not bool(np.all(terrain.allowed(points))):
            raise ValueError("no camera can stand at some of positions_m")
        places = numbered_places(range(len(points)), points)
    if draws < 1:
        raise ValueError(f"draws={draws}: at least one is needed")
    times = times_between(*times_utc, draws)
    predictor = Predictor(camera, terrain, Conditions(camera.name, terrain.name, times, **conditions))
    found = cells_of_draws(join_chunks(predictor.draw(place) for place in places))
    return Prediction(points, found, predictor.exposure_s, predictor.limiting_v_mag)
