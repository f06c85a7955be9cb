"""A calibration from exposures: detect, name the stars, grow inside out, fit all together, judge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from startrack.calibration.acceptance import Gate, Gated, gates
from startrack.calibration.frame import Frame, frame_of
from startrack.calibration.initial_camera import opposite
from startrack.calibration.photometry import Given, Photometry, photometry
from startrack.calibration.region_growing import Joint, grown, joint
from startrack.calibration.static_sources import without_fixed
from startrack.camera import Camera
from startrack.catalog import StarCatalog
from startrack.frames import Site
from startrack.identification import Identifier
from startrack.types import Array, BadInput, Exposure, Identification, NoSolution, NotIdentified

WIDE_FIELD_RAD = np.radians(100.0)  # from here up a field of view is that of the image circle
BRIGHTEST_NAMED = 100  # the inner half of them is what a fit grows from
Progress = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Refused:
    """An image that the calibration does without."""

    name: str
    reason: str
    message: str


@dataclass(frozen=True, kw_only=True)
class Calibration(Gated):
    """The lens, what it rests on and what was said against it."""

    camera: Camera
    joint: Joint
    gates: tuple[Gate, ...]
    refused: tuple[Refused, ...]
    site: Site | None
    false_alarm_probability: float  # the largest of the images' identifications
    photometry: Photometry | None = None


@dataclass
class _Named:
    frame: Frame
    camera: Camera
    R_cam_icrs: Array
    stars: int


@dataclass
class _Run:
    catalog: StarCatalog
    start: Camera | None
    fov_rad: float | None
    site: Site | None
    progress: Progress
    named: list[_Named] = field(default_factory=list)
    refused: list[Refused] = field(default_factory=list)
    worst_chance: float = 0.0


def calibrate(
    exposures: Sequence[Exposure],
    catalog: StarCatalog,
    *,
    camera: Camera | None = None,
    fov_rad: float | None = None,
    site: Site | None = None,
    given: Given | None = None,
    name: str = "camera",
    progress: Progress = lambda text: None,
) -> Calibration:
    """The camera of exposures of the open sky, from an approximate `camera` or from a rough field of view alone.

    `given`: what is known of the sensor already. `site`: on the Earth it lets refraction be taken out; without it the
    lens contains it. Raises BadInput (no_time, size_mismatch, no_calibration), NotIdentified where no image's stars
    are named. Look at `accepted`: a calibration that fails a gate must not be used.
    """
    if camera is None and fov_rad is None:
        raise BadInput("no_calibration", "give the field of view (--fov DEG) or an approximate camera file (-c)")
    run = _Run(catalog, camera, fov_rad, site, progress)
    frames = _frames(run, exposures)
    _name_all(run, frames)
    together = _together(run)
    fitted = replace(together.fit.camera, name=name)
    fitted = replace(fitted, max_angle_rad=_max_angle_rad(fitted, camera, fov_rad))
    together = replace(together, fit=replace(together.fit, camera=fitted))
    progress("measuring light and sensor")
    light = photometry(together, given or Given())
    return Calibration(
        camera=replace(fitted, sensor=light.sensor),
        joint=together,
        gates=gates(together),
        refused=tuple(run.refused),
        site=site,
        false_alarm_probability=run.worst_chance,
        photometry=light,
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
            frames.append(frame_of(exposure, run.catalog, run.site))
        except NoSolution as cause:
            run.refused.append(Refused(name=exposure.name, reason=cause.reason, message=str(cause)))
    if not frames:
        raise NotIdentified(run.refused[0].message if run.refused else "no image was given", reason="no_stars")
    return frames


def _name_all(run: _Run, frames: list[Frame]) -> None:
    """Name the stars of every frame; what fails is tried again with the lens that the others gave."""
    waiting: list[tuple[Frame, NoSolution]] = []
    for frame in frames:
        try:
            _name(run, frame)
        except NoSolution as cause:
            waiting.append((frame, cause))
    for frame, refusal in waiting:
        try:
            if not run.named:
                raise refusal
            _name(run, frame)
        except NoSolution as cause:
            run.refused.append(Refused(name=frame.name, reason=cause.reason, message=str(cause)))
    if not run.named:
        raise NotIdentified(
            f"no image's stars could be named ({run.refused[0].message}). Take pictures of the clear, dark night sky, "
            "in focus, with the camera still and at least a hundred stars in view",
            reason=run.refused[0].reason,
        )


def _name(run: _Run, frame: Frame) -> None:
    run.progress(f"naming the stars of {frame.name}")
    camera, found = _identified(run, frame)
    R = found.R_cam_icrs
    if not run.named:
        run.progress(f"following the lens outwards in {frame.name}")
        camera, R = grown(frame, camera, R, found.star, found.detection)
    run.worst_chance = max(run.worst_chance, found.false_alarm_probability)
    run.named.append(_Named(frame, camera, R, len(found)))


def _identified(run: _Run, frame: Frame) -> tuple[Camera, Identification]:
    """Camera and identification: by the lens of the frames before, else the approximate one, else from nothing."""
    known = max(run.named, key=lambda n: n.stars).camera if run.named else run.start
    refusal: NotIdentified | None = None
    if known is not None:
        try:
            return by_camera(known, frame)
        except NotIdentified as cause:
            refusal = cause
    if refusal is not None and run.named:
        raise refusal
    from startrack.identification.unknown_lens import identify_blind

    # An approximate camera whose lens is of another kind still says how wide the field is.
    fov_rad = run.fov_rad if run.fov_rad is not None else _field_rad(run.start)
    solution = identify_blind(frame.detections, frame.size_px, fov_rad, frame.sky.stars)
    return solution.camera, solution.identification


def _field_rad(camera: Camera | None) -> float:
    """Field of view as `fov_rad` means it: of the image circle where that is wide, else across the frame's width."""
    assert camera is not None
    if 2.0 * camera.max_angle_rad >= WIDE_FIELD_RAD:
        return 2.0 * camera.max_angle_rad
    width, height = camera.size_px
    sides = np.array([[-0.5, (height - 1) / 2], [width - 0.5, (height - 1) / 2]])
    return float(min(np.sum(camera.angle_rad(sides)), 0.99 * WIDE_FIELD_RAD))


def by_camera(camera: Camera, frame: Frame) -> tuple[Camera, Identification]:
    """The bright stars that an approximate camera, or its mirror image, names. Raises NotIdentified."""
    identifier = Identifier(whole_field=False)
    try:
        found = identifier(frame.detections, camera, frame.sky.stars)
    except NotIdentified as cause:
        if cause.reason != "mirrored":
            raise
        camera = opposite(camera)
        found = identifier(frame.detections, camera, frame.sky.stars)
    # Where the lens is pixels off, faint stars take their neighbours' names, most of all far off the axis. Detections
    # are sorted by brightness.
    bright = np.argsort(found.detection)[:BRIGHTEST_NAMED]
    angle = camera.angle_rad(frame.detections.xy_px[found.detection[bright]])
    sure = np.sort(bright[angle <= np.median(angle)])
    return camera, replace(found, detection=found.detection[sure], star=found.star[sure])


def _together(run: _Run) -> Joint:
    """The joint fit, without sources that stay in place while the sky turns, and without images that contradict."""
    lead = max(run.named, key=lambda n: n.stars)
    same = [n for n in run.named if n.camera.mirrored == lead.camera.mirrored]
    for other in run.named:
        if other not in same:
            text = "it is the mirror image of the others: one camera has one handedness"
            run.refused.append(Refused(name=other.frame.name, reason="mirrored", message=text))
    R = np.stack([n.R_cam_icrs for n in same])
    run.progress("fitting the lens to all images")
    return joint(without_fixed(tuple(n.frame for n in same), R), lead.camera, R)


def _max_angle_rad(fitted: Camera, start: Camera | None, fov_rad: float | None) -> float:
    """Edge of the image circle: as given, else the frame's corner; never beyond where the polynomial turns."""
    width, height = fitted.size_px
    corners = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]])
    edge = float(np.max(fitted.angle_rad(corners)))
    if start is not None:
        edge = start.max_angle_rad
    elif fov_rad is not None and fov_rad >= WIDE_FIELD_RAD:
        edge = 0.5 * fov_rad
    return float(max(min(edge, fitted.lens.max_invertible_rad), fitted.calibrated_angle_rad))
