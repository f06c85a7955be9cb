"""Calibration from exposures: detection, identification, region growing, joint fit of all frames, acceptance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from startrack.applications.calibration.acceptance import (
    SMALLEST_FRACTION,
    CheckedCamera,
    RefusedImage,
    check_acceptance,
    horizon_checks,
)
from startrack.applications.calibration.initial_states import field_of_view_rad, largest_angle_rad
from startrack.applications.calibration.sensor import KnownSensor, Photometry, measure_photometry
from startrack.applications.calibration.shared_errors import widen_covariance
from startrack.applications.calibration.static_parts import find_obstructions, remove_static_sources
from startrack.camera import REFRACTION_CONTAINED, REFRACTION_REMOVED, Camera
from startrack.catalog import StarCatalog
from startrack.chain import stating_sky
from startrack.core.limits import stating_work
from startrack.core.runner import map_in_threads
from startrack.core.types import Array, BadInput, Bools, Exposure, Identification, NotIdentified, TooFewStars
from startrack.detection import Detector
from startrack.estimation.fixed_camera import find_disagreeing
from startrack.estimation.frame_matching import (
    FINAL_ROUNDS,
    Frame,
    JointFit,
    fit_frames,
    frame_of,
    grow_from_matches,
    require_body,
    require_time,
)
from startrack.exposure import combine_masks, with_facts
from startrack.frames import Site
from startrack.identification import Identifier, identify_unknown_lens

BRIGHTEST_IDENTIFIED = 100  # the region growing starts from the inner half of these stars
Progress = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Calibration(CheckedCamera):
    """The camera, its fit, and its acceptance checks."""

    joint: JointFit
    site: Site | None
    false_alarm_probability: float  # the largest of the images' identifications
    photometry: Photometry
    obstructed: Bools | None  # (H, W) dark pixels proposed for the mask: no star is ever seen there; None: none
    no_mask_because: str  # why the pictures cannot show such pixels

    @property
    def is_free_of_refraction(self) -> bool:
        """Whether the lens does not contain the refraction of the air."""
        return all(frame.sky.includes_refraction for frame in self.joint.frames)


class _IdentifiedFrame(NamedTuple):
    """Frame with a camera and an attitude by its identified stars."""

    frame: Frame
    camera: Camera
    R_cam_icrs: Array
    found: Identification


@dataclass
class _Run:
    """State of a calibration: its settings, the identified frames and the images left out."""

    catalog: StarCatalog
    start: Camera | None
    fov_rad: float  # as stated, or of `start`
    site: Site | None
    progress: Progress
    identified: list[_IdentifiedFrame] = field(default_factory=list)
    refused: list[RefusedImage] = field(default_factory=list)

    @property
    def lead(self) -> _IdentifiedFrame:
        """The frame with the most identified stars."""
        return max(self.identified, key=lambda one: len(one.found))

    def refuse(self, image: str, cause: TooFewStars | NotIdentified) -> None:
        """Leave out the image of this name because of a `cause`."""
        self.refused.append(RefusedImage(name=image, reason=cause.reason, message=str(cause)))


def calibrate(
    exposures: Sequence[Exposure],
    catalog: StarCatalog,
    *,
    camera: Camera | None = None,
    fov_rad: float | None = None,
    site: Site | None = None,
    known_sensor: KnownSensor | None = None,
    name: str = "camera",
    progress: Progress = lambda text: None,
) -> Calibration:
    """Calibrate a camera with exposures of the open night sky.

    Args:
        exposures: pictures of one camera, each with its mid-exposure time.
        catalog: stars.
        camera: approximate camera; None: `fov_rad` is needed.
        fov_rad: field of view to about 10 %. Below 100 degrees the angle across the frame's width, from there up that
            of the image circle.
        site: place on Earth, for refraction and extinction; without it the lens contains refraction. Pictures that
            a wrong time turns about the celestial pole against most others are left out.
        known_sensor: properties of the sensor that are known already.
        name: name of the camera.
        progress: is called with a text at each step.

    A calibration that fails a check (`accepted` is False) must not be used.

    Raises:
        BadInput: no_time, size_mismatch, no_calibration.
        NotIdentified: the stars of no image are identified, or no majority agrees about the times and the site.
    """
    run = _Run(catalog, camera, field_of_view_rad(camera, fov_rad), site, progress)
    with stating_work(lambda: f"the stars of {len(run.identified)} of {len(exposures)} images were identified"):
        _identify_all(run, _frames(run, exposures))
        joint, same = _fit_jointly(run)
        joint = widen_covariance(joint)
    fitted = replace(
        joint.fit.camera, name=name, max_angle_rad=largest_angle_rad(joint.fit.camera, camera, fov_rad),
        refraction=REFRACTION_CONTAINED if site is None else "" if site.air is None else REFRACTION_REMOVED,
    )  # fmt: skip
    joint = replace(joint, fit=replace(joint.fit, camera=fitted))
    progress("measuring throughput and sensor")
    photometry = measure_photometry(joint, known_sensor or KnownSensor())
    mask = None if camera is None else camera.mask
    stated_adu = None if known_sensor is None else known_sensor.bias_adu
    level_adu = photometry.properties.bias_adu if stated_adu is None else stated_adu
    obstructed, no_mask_because = find_obstructions(joint, same, level_adu) if mask is None else (None, "")
    return Calibration(
        camera=replace(fitted, sensor=photometry.sensor, mask=mask),
        joint=joint,
        checks=(*horizon_checks(joint, catalog, site), *check_acceptance(joint)),
        refused=tuple(run.refused),
        site=site,
        false_alarm_probability=max(one.found.false_alarm_probability for one in run.identified),
        photometry=photometry,
        obstructed=obstructed,
        no_mask_because=no_mask_because,
    )


def count_steps(images: int) -> int:
    """Number of calls of `progress` that `calibrate` makes for so many `images`, if none is left out after the fit."""
    return 2 * images + FINAL_ROUNDS + 1


def load_frame(exposure: Exposure, catalog: StarCatalog, site: Site | None, camera: Camera | None = None) -> Frame:
    """Detect the sources outside the masks of exposure and `camera`, and compute the sky at the exposure's time.

    Raises BadInput (no_time, bad_terrain of another body, or a mask that cannot be used), TooFewStars.
    """
    require_time(exposure)
    require_body(exposure, site)
    if camera is not None:
        exposure = with_facts(exposure, mask=combine_masks(exposure.mask, camera.mask, exposure.size_px))
    with stating_sky(exposure):
        return frame_of(exposure, Detector()(exposure, None), catalog, site)


def _frames(run: _Run, exposures: Sequence[Exposure]) -> list[Frame]:
    """Frames of the `exposures` with their sources. Raises BadInput (size_mismatch), NotIdentified without any."""

    def load(exposure: Exposure) -> Frame | TooFewStars:
        wanted = (run.start or exposures[0]).size_px
        if exposure.size_px != wanted:
            raise BadInput(
                "size_mismatch",
                f"{exposure.name} is {exposure.size_px[0]} x {exposure.size_px[1]} px, not {wanted[0]} x {wanted[1]}: "
                "one camera has one size",
            )
        try:
            return load_frame(exposure, run.catalog, run.site, camera=run.start)
        except TooFewStars as cause:
            return cause

    frames: list[Frame] = []
    for exposure, found in zip(exposures, map_in_threads(load, exposures), strict=True):
        run.progress(f"detecting stars in {exposure.name}")
        if isinstance(found, TooFewStars):
            run.refuse(exposure.name, found)
        else:
            frames.append(found)
    if not frames:
        raise NotIdentified(run.refused[0].message if run.refused else "no image was given", reason="no_stars")
    return frames


def _identify_all(run: _Run, frames: list[Frame]) -> None:
    """Identify the stars of every frame: the lens of the first that can be is the start for all others."""
    waiting: list[tuple[Frame, NotIdentified]] = []
    coming = iter(frames)
    for frame in coming:
        try:
            run.identified.append(_identify_first(run, frame))
            break
        except NotIdentified as cause:
            waiting.append((frame, cause))
    if not run.identified:
        for frame, refusal in waiting:
            run.refuse(frame.exposure.name, refusal)
        raise NotIdentified(
            f"the stars of no image could be identified ({run.refused[0].message}). A calibration takes pictures of "
            "the clear, dark night sky, in focus, with the camera still and at least a hundred stars in view",
            reason=run.refused[0].reason,
        )

    def identify(frame: Frame) -> _IdentifiedFrame | NotIdentified:
        try:
            with _stating_sky_of(frame, run, run.identified[0].camera):
                camera, found = identify_with_camera(run.identified[0].camera, frame)
        except NotIdentified as cause:
            return cause
        return _IdentifiedFrame(frame, camera, found.R_cam_icrs, found)

    others = [*coming, *(frame for frame, _ in waiting)]
    for frame, outcome in zip(others, map_in_threads(identify, others), strict=True):
        run.progress(f"identifying the stars of {frame.exposure.name}")
        if isinstance(outcome, NotIdentified):
            run.refuse(frame.exposure.name, outcome)
        else:
            run.identified.append(outcome)


def _identify_first(run: _Run, frame: Frame) -> _IdentifiedFrame:
    """The `frame` identified with the approximate lens, else without one, its lens grown outwards."""
    run.progress(f"identifying the stars of {frame.exposure.name}")
    camera, found = run.start, None
    if camera is not None:
        with suppress(NotIdentified):
            camera, found = identify_with_camera(camera, frame)
    if camera is None or found is None:  # an approximate camera with another kind of lens still gives the field of view
        with _stating_sky_of(frame, run):
            solution = identify_unknown_lens(frame.sources, frame.exposure.size_px, run.fov_rad, frame.sky.stars)
        camera, found = solution.camera, solution.identification
    camera, R = grow_from_matches(frame, camera, found.R_cam_icrs, found.star, found.detection)
    return _IdentifiedFrame(frame, camera, R, found)


def _stating_sky_of(frame: Frame, run: _Run, camera: Camera | None = None) -> AbstractContextManager[None]:
    """Context in which a refusal of a `frame`, with a `camera` or a field of view alone, states its sky, too."""
    more = "" if run.site is None else "; check the site (signs) and the time"
    return stating_sky(frame.exposure, frame.sources, camera, run.catalog.v_mag, fov_rad=run.fov_rad, more=more)


def identify_with_camera(camera: Camera, frame: Frame) -> tuple[Camera, Identification]:
    """Bright stars identified with an approximate camera or with its mirror image. Raises NotIdentified."""
    identifier = Identifier(whole_field=False)
    try:
        found = identifier(frame.sources, camera, frame.sky.stars)
    except NotIdentified as cause:
        if cause.reason != "mirrored":
            raise
        camera = replace(camera, mirrored=not camera.mirrored)
        found = identifier(frame.sources, camera, frame.sky.stars)
    # Where the lens is wrong by pixels, faint stars are confused with their neighbours, above all far off the axis.
    # Sources are sorted by brightness.
    bright = np.argsort(found.detection)[:BRIGHTEST_IDENTIFIED]
    angle = camera.angle_rad(frame.sources.xy_px[found.detection[bright]])
    sure = np.sort(bright[angle <= np.median(angle)])
    return camera, replace(found, detection=found.detection[sure], star=found.star[sure])


def _fit_jointly(run: _Run) -> tuple[JointFit, tuple[Frame, ...]]:
    """The joint fit without static sources, and its frames with them."""
    camera, same = run.lead.camera, list[_IdentifiedFrame]()
    for one in run.identified:
        if one.camera.mirrored == camera.mirrored:
            same.append(one)
        else:
            text = "it is the mirror image of the others: one camera has one handedness"
            run.refuse(one.frame.exposure.name, NotIdentified(text, reason="mirrored"))
    R = np.stack([one.R_cam_icrs for one in same])
    frames = tuple(one.frame for one in same)
    joint = fit_frames(remove_static_sources(frames, R), camera, R, run.progress)
    wrong = _why_wrong(run.site, joint)
    for k, text in wrong.items():
        run.refuse(same[k].frame.exposure.name, NotIdentified(text, "inconsistent_evidence"))
    if not wrong:
        return joint, frames
    run.identified = [one for k, one in enumerate(same) if k not in wrong]
    return _fit_jointly(run)


def _why_wrong(site: Site | None, joint: JointFit) -> dict[int, str]:
    """Reasons why frames of the joint fit, by their index, must be left out; none where all would be."""
    wrong = {
        k: (
            f"{100 * matched.fraction:.0f} % of its bright sources are stars, or of its bright stars sources, the "
            f"larger, and {100 * SMALLEST_FRACTION:.0f} % is the least: it shows cloud or lamps, or its lens or "
            "time is another"
        )
        for k, matched in enumerate(joint.matches) if matched.fraction < SMALLEST_FRACTION
    }  # fmt: skip
    if wrong or site is None:
        return wrong if len(wrong) < len(joint.matches) else {}  # the checks refuse all of them
    try:
        return find_disagreeing([one.exposure for one in joint.frames], joint.fit.R_cam_icrs, site, may_move=True)
    except BadInput as cause:  # no majority
        raise NotIdentified(str(cause), "inconsistent_evidence") from cause
