"""Draws of evidence at one place, located as images are, and their store on disk: a stopped prediction is resumed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from enum import IntEnum
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from startrack.applications.chunk_store import Chunk, ChunkStore, Progress, settings_digest
from startrack.camera import Camera, load_camera
from startrack.catalog import StarCatalog, has_deep_catalog, load_catalog, load_deep_catalog
from startrack.chain import COMPLETE_V_MAG, Settings, locate_measured
from startrack.core import MAX_COUNT
from startrack.core.runner import TASK_LIMIT_S
from startrack.core.types import TIME_SIGMA_S, Array, BadInput, NoSolution, Stars
from startrack.localization import require_localizer
from startrack.rendering import FAINTEST_V_MAG, Series, limiting_v_mag, load_sky_catalog
from startrack.simulation import draw_camera, draw_ground, simulate_measured
from startrack.terrain import Terrain, load_terrain

DRAW_FOLDER = ".predict"
LOCATED = "radius95_m", "covariance_m2", "offset_m", "protection_level_m"  # of draws with one position
DRAW_SOURCES = (  # their content is part of a chunk's key
    "localization/**/*.py", "simulation/*.py", "evidence/*.py", "rendering/*.py", "terrain/**/*.py", "chain/*.py",
    "estimation/*.py", "detection/*.py", "camera/*.py", "frames/*.py", "core/*.py", "psf.py",
    "applications/prediction/draws.py",
)  # fmt: skip
BELOW_LIMIT_MAG = 3.0  # below the limit at 5 sigma: fainter stars add 2 % to the variance of a star's flux


class Status(IntEnum):
    """Status of a draw: one position, several, or none."""

    OK = 0
    AMBIGUOUS = 1
    REFUSED = 2


@dataclass(frozen=True)
class Conditions:
    """Conditions of a prediction: small, so that they are cheap to send to a worker."""

    camera: str  # file, or the name of a shipped one
    terrain: str
    times_utc: tuple[datetime, ...]  # mid-exposure, one a draw
    sky_v_mag_arcsec2: float
    seed: int
    localizer: str
    exposure_s: float | None = None  # None: a V 6 star on the axis reaches 5 sigma


@dataclass(frozen=True)
class Place:
    """A position of the camera, and its number in the streams of random numbers."""

    number: int
    east_m: float
    north_m: float


@dataclass(frozen=True)
class Task:
    """The draws at one place; `inputs` are hashes of the files of the conditions, part of the key of its chunk."""

    conditions: Conditions
    place: Place
    inputs: tuple[tuple[str, str], ...] = ()

    def __len__(self) -> int:
        return len(self.conditions.times_utc)

    @property
    def key(self) -> str:
        """Hash of all that decides the draws: the content of the files, not their paths."""
        settings = asdict(self)
        for name in ("camera", "terrain"):
            settings["conditions"][name] = Path(settings["conditions"][name]).name
        return settings_digest(DRAW_SOURCES, settings)


class Predictor:
    """Draws of evidence for one camera above one terrain under one set of conditions.

    Raises BadInput: bad_calibration for a camera without a sensor, bad_terrain for a terrain without a site.
    """

    def __init__(self, camera: Camera, terrain: Terrain, conditions: Conditions) -> None:
        self.camera, self.terrain, self.conditions = camera, terrain, conditions
        self.settings = Settings(localizer=require_localizer(conditions.localizer))
        self._skies: dict[int, tuple[Stars, Array]] = {}

    @cached_property
    def exposure_s(self) -> float:
        """The exposure, given or default [s]."""
        return self._series_of(0, load_catalog(), None).exposure_used_s

    @cached_property
    def limiting_v_mag(self) -> float:
        """Magnitude V of a star on the axis at 5 sigma."""
        sky = self.conditions.sky_v_mag_arcsec2
        return limiting_v_mag(self.camera, sky, exposure_s=self.exposure_s)

    @cached_property
    def catalog(self) -> StarCatalog:
        """The stars that the pipeline measures in an image of this depth."""
        is_deep = has_deep_catalog() and self.limiting_v_mag >= COMPLETE_V_MAG
        return load_deep_catalog() if is_deep else load_catalog()

    @cached_property
    def faintest_v_mag(self) -> float:
        """Magnitude V of the faintest stars in the sky."""
        return min(FAINTEST_V_MAG, self.limiting_v_mag + BELOW_LIMIT_MAG)

    @cached_property
    def _series(self) -> list[Series]:
        """The exposures of each draw at all places: the sky's errors differ from draw to draw."""
        sky = load_sky_catalog("auto").brighter_than(self.faintest_v_mag)
        return [self._series_of(draw, sky, self.faintest_v_mag) for draw in range(len(self.conditions.times_utc))]

    def draw(self, place: Place) -> Chunk:
        """Arrays over the draws (n,) at a place, which depend on the seed, the place and the conditions only.

        `status` (a `Status`), and of draws with one position `radius95_m`, `covariance_m2` (n, 2, 2), `offset_m`
        (n, 2), found minus true position, and `protection_level_m`, infinite without a bound; NaN of the others.
        """
        rows = [self._draw_one(place, draw) for draw in range(len(self.conditions.times_utc))]
        status, *values = map(np.array, zip(*rows, strict=True))
        return {"status": status.astype(np.int8)} | dict(zip(LOCATED, values, strict=True))

    def _draw_one(self, place: Place, draw: int) -> tuple[Status, float, Array, Array, float]:
        """Status, 95 % radius [m], covariance (2, 2) [m2], offset (2,) [m], protection level [m] of a `draw`."""
        series = replace(self._series[draw], east_m=place.east_m, north_m=place.north_m)
        if draw not in self._skies:
            self._skies[draw] = series.draw_sky(self.conditions.times_utc[draw])
        scene, rng = series.scene(place.number, sky=self._skies[draw])
        of_ground, of_files = rng.spawn(2)
        ground, camera = draw_ground(self.terrain, rng=of_ground), draw_camera(self.camera, rng=of_files)
        scene = replace(scene, terrain=ground, camera=camera)
        late_s = TIME_SIGMA_S * of_files.standard_normal()
        stated = self.conditions.times_utc[draw] + timedelta(seconds=late_s)
        nothing = (np.nan, np.full((2, 2), np.nan), np.full(2, np.nan), np.nan)
        try:
            measured = simulate_measured(
                scene, self.catalog, self.terrain, self.camera, time_utc=stated, time_sigma_s=None, rng=rng
            )
            fix = locate_measured(measured, self.settings).fix
        except NoSolution:
            return Status.REFUSED, *nothing
        if fix.ambiguous:
            return Status.AMBIGUOUS, *nothing
        level_m = np.inf if fix.integrity is None else fix.integrity.protection_level_m
        return Status.OK, fix.radius95_m, fix.covariance_m2, (fix.position_enu_m - scene.position_enu_m)[:2], level_m

    def _series_of(self, draw: int, catalog: StarCatalog, faint_v_mag: float | None) -> Series:
        """Exposures of a draw under the stars of `catalog` and random ones to `faint_v_mag`; None: no random ones."""
        conditions = self.conditions
        return Series(
            camera=self.camera, terrain=self.terrain, catalog=catalog, seed=MAX_COUNT * conditions.seed + draw,
            time_utc=conditions.times_utc[draw], exposure_s=conditions.exposure_s,
            sky_v_mag_arcsec2=conditions.sky_v_mag_arcsec2, faint_v_mag=faint_v_mag, hot_pixels=0, cosmic_rays=0,
        )  # fmt: skip


@lru_cache(maxsize=2)
def predictor_of(conditions: Conditions) -> Predictor:
    """The predictor of the files that the conditions name. Raises BadInput for files that cannot be used."""
    return Predictor(load_camera(conditions.camera), load_terrain(conditions.terrain), conditions)


def draw_task(task: Task) -> Chunk:
    """The draws of a task, in any process."""
    return predictor_of(task.conditions).draw(task.place)


def draw_store(out: Path, *, draws: int, jobs: int, progress: Progress, cluster: str | None = None) -> ChunkStore[Task]:
    """The store of draws under the folder `out`, of which each place has `draws`.

    They are made in `jobs` processes or on a `cluster`, and reported to `progress`.
    """
    limit_s = draws * TASK_LIMIT_S  # a draw takes as long as an image
    return ChunkStore(
        out / DRAW_FOLDER, draw_task, lambda task: task.key, jobs=jobs, progress=progress, cluster=cluster,
        limit_s=limit_s,
    )  # fmt: skip


def times_between(first: datetime, last: datetime, count: int) -> tuple[datetime, ...]:
    """The middles of `count` equal parts of a time. Raises BadInput (no_time) if `last` is before `first`."""
    if last < first:
        raise BadInput("no_time", f"the end {last.isoformat()} is before the start {first.isoformat()}")
    step = (last - first) / count
    return tuple(first + (k + 0.5) * step for k in range(count))


def join_chunks(chunks: Iterable[Chunk]) -> Chunk:
    """The `chunks` of places as arrays over places (k, n, ...)."""
    rows = list(chunks)
    return {key: np.stack([row[key] for row in rows]) for key in rows[0]}
