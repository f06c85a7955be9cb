"""From one image to the position: detect, identify, orient, measure, localize. Each stage returns a complete value."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from startrack.camera import Camera, load_camera
from startrack.catalog import StarCatalog, load_catalog
from startrack.chain.measurement import fix_position, measure_evidence, remeasure_near_skyline, sky_step_at
from startrack.chain.orientation import (
    check_inputs,
    check_one_attitude,
    detect_sources,
    identify_stars,
    identify_unknown_lens,
    site_on_earth,
    solve_orientation,
)  # fmt: skip
from startrack.chain.sky_refinement import measured_skyline, refine_by_sky_light
from startrack.chain.stages import Detected, Identified, Inputs, Located, Oriented, Refused, Settings
from startrack.core.errors import Reason
from startrack.core.time_limit import check_time, limited_time, stating_work
from startrack.core.types import BadInput, Exposure, NoSolution
from startrack.detection import find_damage
from startrack.evidence import check_single_skyline
from startrack.frames import Site
from startrack.localization import localizer_name
from startrack.terrain import Terrain, load_terrain

HIDDEN_BY_DAMAGE = {  # reasons that damage of the image causes too
    Reason.NOT_IDENTIFIED, Reason.INCONSISTENT_EVIDENCE, Reason.INSUFFICIENT_GEOMETRY, Reason.DAMAGED_IMAGE,
}  # fmt: skip
T = TypeVar("T", bound=Inputs)
R = TypeVar("R")


def locate(
    exposure: Exposure, camera: Camera, terrain: Terrain, catalog: StarCatalog, settings: Settings | None = None
) -> Located | Refused:
    """Position and attitude of the camera, or the reason why there is none.

    `exposure` must have a time and the image size of the `camera`, `terrain` a site; `catalog` is the list of stars.
    `settings` exchanges stages. Bad input of an image makes a refusal too: no image raises an exception.
    """
    settings = settings or Settings()
    run = Run(Inputs(
        exposure=exposure, camera=camera, terrain=terrain, catalog_name=catalog.name,
        localizer_name=localizer_name(settings.localizer), damage=find_damage(exposure, camera),
    ), settings.time_limit_s)  # fmt: skip

    def stages() -> Located:
        check_inputs(run.reached)
        ground = terrain.with_air(exposure.air)
        run.reached = replace(run.reached, terrain=ground)
        oriented = _orient(run, camera, settings, identify_stars, camera, catalog, settings, ground.site)
        run.time_stage("attitude", check_one_attitude, oriented)
        measured = run.run_stage("evidence", measure_evidence, oriented, ground, settings)
        first = replace(measured.evidence(), is_first_look=settings.evidence_sources != "stars")
        located = run.time_stage("locate", fix_position, measured, Located, settings.localizer, first)
        step = run.time_stage("evidence", sky_step_at, located)
        is_bright = step is not None and step.exceeds_noise
        if is_bright:
            located = run.time_stage("evidence", remeasure_near_skyline, located, step, settings.evidence)
        if located.damage is None:  # which changes the light of stars in part
            run.time_stage("locate", check_single_skyline, located.light, located.terrain, located.position_at_time_m)
        located = run.time_stage("locate", _refine, located, is_bright, settings)
        sky_mag = None if step is None else step.brightness_mag_arcsec2(camera, exposure.exposure_s)
        skyline = run.time_stage("locate", measured_skyline, located)
        return replace(located, sky_brightness_mag_arcsec2=sky_mag, skyline=skyline)

    return run.outcome(stages)


def _orient(
    run: Run, camera: Camera | None, settings: Settings, identify: Callable[..., Identified], *args: Any
) -> Oriented:  # fmt: skip
    """The stages up to the attitude; `identify` gets the sources and `args`."""
    detected = run.run_stage("detect", detect_sources, run.reached, camera, settings.detector)
    identified = run.run_stage("identify", identify, detected, *args)
    return run.run_stage("attitude", solve_orientation, identified, camera is not None)


def _refine(located: Located, is_newer: bool, settings: Settings) -> Located:
    """The position by all of the evidence that is asked for; `is_newer`: its stars were measured after the fix."""
    by_stars = settings.evidence_sources == "stars"
    if not by_stars:
        located = refine_by_sky_light(located, settings.localizer, settings.evidence_sources == "both")
    if located.sky is None and (is_newer or not by_stars):
        is_traced = not located.terrain.axisymmetric  # a round crater is searched again in no time
        support = located.fix.samples if is_traced and not located.fix.ambiguous else None
        return fix_position(located, Located, settings.localizer, replace(located.evidence(), support=support))
    return located


def locate_exposure(exposure: Exposure, settings: Settings | None = None) -> Located | Refused:
    """`locate` with the camera and the terrain that `exposure` names, and `settings`; stage `read` is reading them.

    Raises BadInput (no_calibration, bad_calibration, bad_terrain) where one is not named or cannot be used.
    """
    start = clock.perf_counter()
    camera, terrain = load_named(exposure)
    read_ms = 1e3 * (clock.perf_counter() - start)
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
    run = Run(Inputs(exposure=exposure, camera=camera, catalog_name=catalog.name), settings.time_limit_s)

    def stages() -> Oriented:
        check_inputs(run.reached)
        known = site or site_on_earth(exposure)
        where = known if known is None else known.with_air(exposure.air)
        return _orient(run, camera, settings, identify_stars, camera, catalog, settings, where)

    return run.outcome(stages)


def identify_blind(
    exposure: Exposure, fov_rad: float | Sequence[float], catalog: StarCatalog, settings: Settings | None = None
) -> Oriented | Refused:
    """Stars, attitude and lens of an `exposure` without a camera file, from an approximate field of view alone.

    `fov_rad` [rad], one or several that are tried in their order, is the angle across the image's width below 100
    degrees, from there up that of the whole image circle. `catalog` is the list of stars; `settings` has the detector
    and the part of the sky. The lens found is the value's `camera`.
    """
    settings, fovs_rad = settings or Settings(), np.atleast_1d(fov_rad)
    run = Run(Inputs(exposure=exposure, catalog_name=catalog.name), settings.time_limit_s)
    near_sky = settings.identifier.near_sky
    return run.outcome(lambda: _orient(run, None, settings, identify_unknown_lens, fovs_rad, catalog, near_sky))


def detect(exposure: Exposure, camera: Camera | None, settings: Settings | None = None) -> Detected | Refused:
    """Point sources of an `exposure`; `camera` (None: not known) gives fluxes in electrons, `settings` the detector."""
    run = Run(Inputs(exposure=exposure, camera=camera))
    detector = (settings or Settings()).detector
    return run.outcome(lambda: run.run_stage("detect", detect_sources, run.reached, camera, detector))


def add_timing(outcome: Any, **more_ms: float) -> Any:
    """The same `outcome` with `more_ms`, wall times [ms] by stage, added to its stages' times."""
    times = dict(outcome.timing_ms)
    for stage, ms in more_ms.items():
        times[stage] = times.get(stage, 0.0) + ms
    return replace(outcome, timing_ms=MappingProxyType(times))


class Run:
    """One exposure on its way through the stages: the last complete value, and the wall time of each stage.

    `limit_s` is that of the processor time of all stages; None: the one of a block around, if any.
    """

    def __init__(self, inputs: Inputs, limit_s: float | None = None) -> None:
        self.reached, self.limit_s = inputs, limit_s
        self._timing_ms: dict[str, float] = {}

    def time_stage(self, stage: str, function: Callable[..., R], *args: Any) -> R:
        """The result of `function(*args)`, its time added to that of the `stage`."""
        start = clock.perf_counter()
        try:
            with stating_work(lambda: f"it was at the stage {stage}"):
                check_time()
                return function(*args)
        finally:
            self._timing_ms[stage] = self._timing_ms.get(stage, 0.0) + 1e3 * (clock.perf_counter() - start)

    def run_stage(self, stage: str, function: Callable[..., T], *args: Any) -> T:
        """The same as `time_stage`, for a function that returns the next complete value."""
        value = self.time_stage(stage, function, *args)
        self.reached = value
        return value

    def outcome(self, stages: Callable[[], T]) -> T | Refused:
        """The value that `stages` return, with their times, or the refusal with the last complete value.

        Of a damaged image its damage may be the reason.
        """
        try:
            with limited_time(self.limit_s):
                value = stages()
            return replace(value, timing_ms=MappingProxyType(self._timing_ms))
        except (BadInput, NoSolution) as cause:
            damage = self.reached.damage if cause.reason in HIDDEN_BY_DAMAGE else None
            return Refused(
                reason=cause.reason if damage is None else Reason.DAMAGED_IMAGE,
                message=str(cause) if damage is None else f"{damage.message} ({cause})",
                reached=self.reached,
                timing_ms=MappingProxyType(self._timing_ms),
            )
