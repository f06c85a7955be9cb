"""Calibration from exposures: detection, identification, region growing, joint fit of all frames, acceptance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from startrack.applications.calibration.acceptance import Check, Checked, check_acceptance
from startrack.applications.calibration.below_horizon import horizon_checks
from startrack.applications.calibration.frame import Frame, load_frame, remove_static_sources
from startrack.applications.calibration.initial_camera import mirror_camera
from startrack.applications.calibration.obstruction import find_obstructions
from startrack.applications.calibration.photometry import KnownSensor, Photometry, measure_photometry
from startrack.applications.calibration.region_growing import JointFit, fit_frames, grow_from_matches
from startrack.applications.calibration.shared_errors import widen_covariance
from startrack.camera import Camera
from startrack.catalog import StarCatalog
from startrack.core.types import Array, BadInput, Bools, Exposure, Identification, NoSolution, NotIdentified
from startrack.frames import Site
from startrack.identification import Identifier, identify_unknown_lens

WIDE_FIELD_RAD = np.radians(100.0)  # from here up a field of view is that of the image circle
BRIGHTEST_IDENTIFIED = 100  # the region growing starts from the inner half of these stars
Progress = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class RefusedImage:
    """An image that the calibration does not use."""

    name: str
    reason: str
    message: str


@dataclass(frozen=True, kw_only=True)
class Calibration(Checked):
    """The camera, its fit, and its acceptance checks."""

    camera: Camera
    joint: JointFit
    checks: tuple[Check, ...]
    refused: tuple[RefusedImage, ...]
    site: Site | None
    false_alarm_probability: float  # the largest of the images' identifications
    photometry: Photometry
    obstructed: Bools | None  # (H, W) pixels proposed for the mask: no star is ever seen there; None: no such pixels


@dataclass
class _IdentifiedFrame:
    frame: Frame
    camera: Camera
    R_cam_icrs: Array
    stars: int


@dataclass
class _Run:
    catalog: StarCatalog
    start: Camera | None
    fov_rad: float  # as stated, or of `start`
    site: Site | None
    progress: Progress
    identified: list[_IdentifiedFrame] = field(default_factory=list)
    refused: list[RefusedImage] = field(default_factory=list)
    largest_false_alarm: float = 0.0


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
        site: on the Earth, for refraction and extinction; without it the lens contains the refraction.
        known_sensor: properties of the sensor that are known already.
        name: of the camera.
        progress: is called with a text at each step.

    A calibration that fails a check (`accepted` is False) must not be used.

    Raises:
        BadInput: no_time, size_mismatch, no_calibration.
        NotIdentified: the stars of no image are identified.
    """
    run = _Run(catalog, camera, _field_rad(camera, fov_rad), site, progress)
    frames = _frames(run, exposures)
    _identify_all(run, frames)
    joint, same = _fit_jointly(run)
    joint = widen_covariance(joint)
    fitted = replace(joint.fit.camera, name=name)
    fitted = replace(fitted, max_angle_rad=_max_angle_rad(fitted, camera, fov_rad))
    joint = replace(joint, fit=replace(joint.fit, camera=fitted))
    progress("measuring throughput and sensor")
    photometry = measure_photometry(joint, known_sensor or KnownSensor())
    mask = None if camera is None else camera.mask
    return Calibration(
        camera=replace(fitted, sensor=photometry.sensor, mask=mask),
        joint=joint,
        checks=(*horizon_checks(joint, catalog, site), *check_acceptance(joint)),
        refused=tuple(run.refused),
        site=site,
        false_alarm_probability=run.largest_false_alarm,
        photometry=photometry,
        obstructed=find_obstructions(joint, same) if mask is None else None,
    )


def _frames(run: _Run, exposures: Sequence[Exposure]) -> list[Frame]:
    frames: list[Frame] = []
    for exposure in exposures:
        if exposure.size_px != exposures[0].size_px or (run.start and exposure.size_px != run.start.size_px):
            wanted = (run.start or exposures[0]).size_px
            raise BadInput(
                "size_mismatch",
                f"{exposure.name} is {exposure.size_px[0]} x {exposure.size_px[1]} px, not {wanted[0]} x {wanted[1]}: "
                "one camera has one size",
            )
        run.progress(f"detecting stars in {exposure.name}")
        try:
            frames.append(load_frame(exposure, run.catalog, run.site, camera=run.start))
        except NoSolution as cause:
            run.refused.append(RefusedImage(name=exposure.name, reason=cause.reason, message=str(cause)))
    if not frames:
        raise NotIdentified(run.refused[0].message if run.refused else "no image was given", reason="no_stars")
    return frames


def _identify_all(run: _Run, frames: list[Frame]) -> None:
    """Identify the stars of every frame; failures are tried again with the lens of the others."""
    waiting: list[tuple[Frame, NoSolution]] = []
    for frame in frames:
        try:
            _identify(run, frame)
        except NoSolution as cause:
            waiting.append((frame, cause))
    for frame, refusal in waiting:
        try:
            if not run.identified:
                raise refusal
            _identify(run, frame)
        except NoSolution as cause:
            run.refused.append(RefusedImage(name=frame.name, reason=cause.reason, message=str(cause)))
    if not run.identified:
        raise NotIdentified(
            f"the stars of no image could be identified ({run.refused[0].message}). Take pictures of the clear, dark "
            "night sky, in focus, with the camera still and at least a hundred stars in view"
            + ("" if run.site is None else "; check the site (signs) and the time"),
            reason=run.refused[0].reason,
        )


def _identify(run: _Run, frame: Frame) -> None:
    run.progress(f"identifying the stars of {frame.name}")
    camera, found = _first_identification(run, frame)
    R = found.R_cam_icrs
    if not run.identified:
        run.progress(f"growing the lens outwards in {frame.name}")
        camera, R = grow_from_matches(frame, camera, R, found.star, found.detection)
    run.largest_false_alarm = max(run.largest_false_alarm, found.false_alarm_probability)
    run.identified.append(_IdentifiedFrame(frame, camera, R, len(found)))


def _first_identification(run: _Run, frame: Frame) -> tuple[Camera, Identification]:
    """Camera and identification: with the lens of earlier frames, else the approximate one, else without a lens."""
    known = max(run.identified, key=lambda n: n.stars).camera if run.identified else run.start
    refusal: NotIdentified | None = None
    if known is not None:
        try:
            return identify_with(known, frame)
        except NotIdentified as cause:
            refusal = cause
    if refusal is not None and run.identified:
        raise refusal
    # An approximate camera with another kind of lens still gives the field of view.
    solution = identify_unknown_lens(frame.sources, frame.size_px, run.fov_rad, frame.sky.stars)
    return solution.camera, solution.identification


def _field_rad(camera: Camera | None, fov_rad: float | None) -> float:
    """`fov_rad`, or the approximate camera's: of the image circle where that is wide, else across the frame's width.

    Raises BadInput no_calibration where there is neither.
    """
    if fov_rad is not None:
        return fov_rad
    if camera is None:
        raise BadInput("no_calibration", "give the field of view (--fov DEG) or an approximate camera file (-c)")
    if 2.0 * camera.max_angle_rad >= WIDE_FIELD_RAD:
        return 2.0 * camera.max_angle_rad
    width, height = camera.size_px
    sides = np.array([[-0.5, (height - 1) / 2], [width - 0.5, (height - 1) / 2]])
    return float(min(np.sum(camera.angle_rad(sides)), 0.99 * WIDE_FIELD_RAD))


def identify_with(camera: Camera, frame: Frame) -> tuple[Camera, Identification]:
    """Bright stars identified with an approximate camera or with its mirror image. Raises NotIdentified."""
    identifier = Identifier(whole_field=False)
    try:
        found = identifier(frame.sources, camera, frame.sky.stars)
    except NotIdentified as cause:
        if cause.reason != "mirrored":
            raise
        camera = mirror_camera(camera)
        found = identifier(frame.sources, camera, frame.sky.stars)
    # Where the lens is wrong by pixels, faint stars are confused with their neighbours, above all far off the axis.
    # Sources are sorted by brightness.
    bright = np.argsort(found.detection)[:BRIGHTEST_IDENTIFIED]
    angle = camera.angle_rad(frame.sources.xy_px[found.detection[bright]])
    sure = np.sort(bright[angle <= np.median(angle)])
    return camera, replace(found, detection=found.detection[sure], star=found.star[sure])


def _fit_jointly(run: _Run) -> tuple[JointFit, tuple[Frame, ...]]:
    """The joint fit without static sources, and its frames with them; images of the other handedness are left out."""
    lead = max(run.identified, key=lambda n: n.stars)
    same = [n for n in run.identified if n.camera.mirrored == lead.camera.mirrored]
    for other in run.identified:
        if other not in same:
            text = "it is the mirror image of the others: one camera has one handedness"
            run.refused.append(RefusedImage(name=other.frame.name, reason="mirrored", message=text))
    R = np.stack([n.R_cam_icrs for n in same])
    run.progress("fitting the lens to all images")
    frames = tuple(n.frame for n in same)
    return fit_frames(remove_static_sources(frames, R), lead.camera, R), frames


def _max_angle_rad(fitted: Camera, start: Camera | None, fov_rad: float | None) -> float:
    """Edge of the image circle: as given, else the frame's corner; at most the turning point of the polynomial."""
    width, height = fitted.size_px
    corners = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]])
    edge = float(np.max(fitted.angle_rad(corners)))
    if start is not None:
        edge = start.max_angle_rad
    elif fov_rad is not None and fov_rad >= WIDE_FIELD_RAD:
        edge = 0.5 * fov_rad
    return float(max(min(edge, fitted.lens.max_invertible_rad), fitted.calibrated_angle_rad))
