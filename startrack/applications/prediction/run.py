"""From places to predictions, on a store of draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from startrack.applications.prediction.draws import (
    LIMIT_SNR,
    Conditions,
    Place,
    Predictor,
    Task,
    join_chunks,
    predictor_of,
    times_between,
)
from startrack.applications.prediction.places import area_cells, default_spacing_m
from startrack.applications.prediction.quantities import Cells, summarize_cells
from startrack.applications.prediction.statistics import cells_of_draws, share_within
from startrack.camera import Camera, load_camera
from startrack.core.chunk_store import ChunkStore
from startrack.core.types import Array
from startrack.rendering import exposure_for_snr
from startrack.terrain import Terrain

DEPTH_V_MAG = 3.0, 9.0  # limiting magnitudes that are tried; beyond, the faintest stars of the simulated sky are missed
DEPTH_STEP_MAG = 0.1  # to which the depth is found: a tenth of the exposure
DEPTH_SHARE = 0.9  # of the places that must reach the wanted radius


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

        By magnitudes one by one, as deep images cost most, then by bisection of the last one. The conditions returned
        have that exposure, or the longest tried.
        """
        low, deepest = DEPTH_V_MAG
        high = low
        tried: list[dict[str, float]] = []

        def reaches(v_mag: float) -> bool:
            share = share_within(self.cells(at_depth(conditions, v_mag), f"depth V {v_mag:.1f}"), target_m)
            tried.append({"exposure_s": float(at_depth(conditions, v_mag).exposure_s or 0.0), "share": share})
            return share >= DEPTH_SHARE

        while not (found := reaches(high)) and high < deepest:
            low, high = high, min(high + 1.0, deepest)
        while found and high - low > DEPTH_STEP_MAG:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if reaches(middle) else (middle, high)
        best = at_depth(conditions, high)
        record = {
            "target_radius95_m": target_m,
            "share": DEPTH_SHARE,
            "exposure_s": best.exposure_s if found else None,
            "limiting_v_mag": high if found else None,
            "tried": sorted(tried, key=lambda one: one["exposure_s"]),
        }
        return best, record


def at_depth(conditions: Conditions, v_mag: float) -> Conditions:
    """The conditions with the exposure that reaches `v_mag` on the axis at 5 sigma."""
    camera, sky = load_camera(conditions.camera), conditions.sky_v_mag_arcsec2
    return replace(conditions, exposure_s=exposure_for_snr(camera, sky, v_mag=v_mag, snr=LIMIT_SNR))


def variant_record(conditions: Conditions, cells: Cells) -> dict[str, Any]:
    """The summary of the places for one camera and exposure, with both."""
    predictor = predictor_of(conditions)
    return {
        "camera": predictor.camera.name,
        "exposure_s": predictor.exposure_s,
        "limiting_v_mag": predictor.limiting_v_mag,
        "summary": summarize_cells(cells),
    }


@dataclass(frozen=True, eq=False)
class Prediction:
    """Expected accuracy at positions."""

    positions_m: Array  # (k, 2) east and north from the terrain's origin
    cells: Cells  # arrays (k,) by the names of predict.ecsv's columns
    exposure_s: float
    limiting_v_mag: float  # of a star on the axis at 5 sigma

    @property
    def summary(self) -> dict[str, Any]:
        """As in predict.json."""
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
        places = [Place(k, float(east), float(north)) for k, (east, north) in enumerate(points)]
    if draws < 1:
        raise ValueError(f"draws={draws}: at least one is needed")
    times = times_between(*times_utc, draws)
    predictor = Predictor(camera, terrain, Conditions(camera.name, terrain.name, times, **conditions))
    found = cells_of_draws(join_chunks(predictor.draw(place) for place in places))
    return Prediction(points, found, predictor.exposure_s, predictor.limiting_v_mag)
