"""Way of an image to the position: detect, identify, orient, measure, localize. Each stage returns a complete value."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from types import MappingProxyType
from typing import TypeVar

from startrack.camera import Camera, load_camera
from startrack.catalog import StarCatalog, load_catalog
from startrack.chain.measurement import measure_evidence
from startrack.chain.orientation import (
    check_inputs,
    check_one_attitude,
    detect_sources,
    identify_stars,
    identify_unknown_lens,
    site_on_earth,
    solve_orientation,
)  # fmt: skip
from startrack.chain.stages import Detected, Inputs, Located, Measured, Oriented, Outcome, Refused, Settings
from startrack.chain.two_looks import fix_by_all, look_at_skyline, look_first
from startrack.core.errors import Reason
from startrack.core.limits import check_time, limited_time, stating_work
from startrack.core.types import BadInput, Exposure, NoSolution
from startrack.detection import find_damage
from startrack.frames import Site
from startrack.localization import localizer_name
from startrack.terrain import Terrain, load_terrain

HIDDEN_BY_DAMAGE = {  # reasons that damage of the image causes too
    Reason.NOT_IDENTIFIED, Reason.INCONSISTENT_EVIDENCE, Reason.INSUFFICIENT_GEOMETRY, Reason.DAMAGED_IMAGE,
}  # fmt: skip
T = TypeVar("T", bound=Inputs)
AnyOutcome = TypeVar("AnyOutcome", bound=Outcome)


class Run:
    """The last complete value that a run from the `inputs` on has reached, and the wall times of its stages."""

    def __init__(self, inputs: Inputs) -> None:
        self._reached = inputs
        self._times = dict[str, float]()

    def reach(self, value: T) -> T:
        """The `value` itself, which is from now on the last complete one."""
        self._reached = value
        return value

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Context whose time counts as that of the stage `name`."""
        start = time.perf_counter()
        try:
            with stating_work(lambda: f"it was at the stage {name}"):
                check_time()
                yield
        finally:
            self._times[name] = self._times.get(name, 0.0) + 1e3 * (time.perf_counter() - start)

    def finish(self, value: T) -> T:
        """Copy of the run's result, its last `value`, with the times of the stages."""
        return replace(value, timing_ms=MappingProxyType(self._times))

    def refuse(self, cause: BadInput | NoSolution) -> Refused:
        """The refusal that the `cause` makes of the run, with the last complete value that was reached.

        Where damage of the image may be behind the cause, that is the reason.
        """
        damage = self._reached.damage if cause.reason in HIDDEN_BY_DAMAGE else None  # of which it may be the result
        return Refused(
            reason=cause.reason if damage is None else Reason.DAMAGED_IMAGE,
            message=str(cause) if damage is None else f"{damage.message} ({cause})",
            reached=self._reached,
            timing_ms=MappingProxyType(self._times),
        )


def add_timing(outcome: AnyOutcome, **more_ms: float) -> AnyOutcome:
    """Copy of an `outcome` with `more_ms`, wall times [ms] by stage, added to its stages' times."""
    times = dict(outcome.timing_ms)
    for stage, ms in more_ms.items():
        times[stage] = times.get(stage, 0.0) + ms
    return replace(outcome, timing_ms=MappingProxyType(times))


def locate(
    exposure: Exposure, camera: Camera, terrain: Terrain, catalog: StarCatalog, settings: Settings | None = None
) -> Located | Refused:
    """Position and attitude of the camera, or the reason why there is none.

    `exposure` must have a time and the image size of the `camera`, `terrain` a site; `catalog` is the list of stars.
    `settings` exchanges stages. Bad input of an image makes a refusal too: no image raises an exception.
    """
    settings = settings or Settings()
    given = Inputs(
        exposure=exposure, camera=camera, terrain=terrain, catalog_name=catalog.name,
        localizer_name=localizer_name(settings.localizer), damage=find_damage(exposure, camera),
    )  # fmt: skip
    run = Run(given)
    try:
        with limited_time(settings.time_limit_s):
            check_inputs(given)
            ground = terrain.with_air(exposure.air)
            inputs = run.reach(replace(given, terrain=ground))
            with run.stage("detect"):
                detected = run.reach(detect_sources(inputs, settings.detector))
            with run.stage("identify"):
                identified = run.reach(identify_stars(detected, camera, catalog, settings, ground.site))
            with run.stage("attitude"):
                oriented = run.reach(solve_orientation(identified))
                check_one_attitude(oriented)
            with run.stage("evidence"):
                measured = run.reach(measure_evidence(oriented, ground, settings))
            return run.finish(locate_measured(measured, settings, run.stage))
    except (BadInput, NoSolution) as cause:
        return run.refuse(cause)


def locate_measured(
    measured: Measured, settings: Settings, stage: Callable[[str], AbstractContextManager[object]] = nullcontext
) -> Located:
    """The position by the stars of `measured` and the light of the sky in its image, as `settings` ask for.

    It is found in two passes: roughly by the stars, which tells where the skyline stands; then by all that is measured
    there. The work is done in blocks of `stage`, which is given the name of each. Raises NoSolution of the localizer.
    """
    with stage("locate"):
        first = look_first(measured, settings.localizer)
    with stage("evidence"):
        second = look_at_skyline(first, settings)
    with stage("locate"):
        return fix_by_all(second, settings.localizer)


def locate_exposure(exposure: Exposure, settings: Settings | None = None) -> Located | Refused:
    """Position by `locate` with camera and terrain that `exposure` names, and `settings`; stage `read` is reading them.

    Raises BadInput (no_calibration, bad_calibration, bad_terrain) where one is not named or cannot be used.
    """
    start = time.perf_counter()
    camera, terrain = load_named(exposure)
    read_ms = 1e3 * (time.perf_counter() - start)
    return add_timing(locate(exposure, camera, terrain, load_catalog(), settings), read=read_ms)


def load_named(exposure: Exposure) -> tuple[Camera, Terrain]:
    """The camera and the terrain that `exposure` names.

    Raises BadInput (no_calibration, bad_calibration, bad_terrain) where one is not named or cannot be used.
    """
    if exposure.camera is None:
        raise BadInput("no_calibration", "no camera file is known: give -c FILE or a sidecar with camera")
    if exposure.terrain is None:
        raise BadInput("bad_terrain", "no terrain file is known: give -t FILE or a sidecar with terrain")
    return load_camera(exposure.camera), load_terrain(exposure.terrain)


def identify(
    exposure: Exposure, camera: Camera, catalog: StarCatalog, settings: Settings | None = None, site: Site | None = None
) -> Oriented | Refused:
    """Stars and attitude only. Without a time the `catalog` is taken at J2000.0, without aberration.

    `exposure` must have the image size of the `camera`; `settings` exchanges stages; `site` adds planets and, of the
    body that it is on, aberration and air. Without it (None) the site counts that the exposure's terrain has on the
    Earth.
    """
    settings = settings or Settings()
    inputs = Inputs(exposure=exposure, camera=camera, catalog_name=catalog.name)
    run = Run(inputs)
    try:
        with limited_time(settings.time_limit_s):
            check_inputs(inputs)
            known = site or site_on_earth(exposure)
            where = known if known is None else known.with_air(exposure.air)
            with run.stage("detect"):
                detected = run.reach(detect_sources(inputs, settings.detector))
            with run.stage("identify"):
                identified = run.reach(identify_stars(detected, camera, catalog, settings, where))
            with run.stage("attitude"):
                oriented = solve_orientation(identified)
            return run.finish(oriented)
    except (BadInput, NoSolution) as cause:
        return run.refuse(cause)


def identify_blind(
    exposure: Exposure,
    fov_rad: float | tuple[float, float],
    catalog: StarCatalog,
    settings: Settings | None = None,
    site: Site | None = None,
) -> Oriented | Refused:
    """Stars, attitude and lens of an `exposure` without a camera file, from an approximate field of view alone.

    `fov_rad` [rad], one to 10 % or the smallest and the largest, is the angle across the image's width below 100
    degrees, from there up that of the whole image circle. `catalog` is the list of stars; `settings` has the detector
    and the part of the sky. `site` is where the camera stands: with the time of the exposure the sky below the horizon
    is left out, and the lens does not contain the refraction. The lens found is the value's `camera`.
    """
    settings = settings or Settings()
    inputs = Inputs(exposure=exposure, catalog_name=catalog.name)
    run = Run(inputs)
    try:
        with limited_time(settings.time_limit_s):
            with run.stage("detect"):
                detected = run.reach(detect_sources(inputs, settings.detector))
            with run.stage("identify"):
                where = None if site is None else site.with_air(exposure.air)
                near_sky = settings.identifier.near_sky
                identified = run.reach(identify_unknown_lens(detected, fov_rad, catalog, near_sky, where))
            with run.stage("attitude"):
                oriented = solve_orientation(identified, has_file=False)
            return run.finish(oriented)
    except (BadInput, NoSolution) as cause:
        return run.refuse(cause)


def detect(exposure: Exposure, camera: Camera | None, settings: Settings | None = None) -> Detected | Refused:
    """Point sources of an `exposure`; `camera` (None: not known) gives fluxes in electrons, `settings` the detector."""
    inputs = Inputs(exposure=exposure, camera=camera)
    run = Run(inputs)
    try:
        with run.stage("detect"):
            detected = detect_sources(inputs, (settings or Settings()).detector)
        return run.finish(detected)
    except (BadInput, NoSolution) as cause:
        return run.refuse(cause)
