"""What an unknown lens may be before any star is known: its law, focal length and centre.

The laws are a family of one parameter: all ideal fisheyes, the pinhole, and the laws between them. Focal length and
centre follow from the field of view and the frame, or from the image circle of a fisheye lens, whose edge shows in the
background of the frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera, Lens
from startrack.core.types import Array

UNKNOWN_LENS = "unknown"  # name of a camera that no file states
PINHOLE = 1.0  # shape
LINEAR_SHAPE = 1e-4  # below this the law is the equidistant one
STEEPEST_RAD = 1.55  # of the argument of sine or tangent
STEEPEST_SINE = float(np.sin(STEEPEST_RAD))
WIDEST_SHAPE = 1.2  # of a fit
SHAPE_STEP = 1e-6  # for the numerical derivative by the shape
WIDE_SHAPES = (-0.35, 0.25, -0.8, 0.7)
MIDDLE_SHAPES = (PINHOLE, 0.4, -0.4)
CIRCLES = (0.5, 0.62, 0.42, 0.78, 1.0)  # radius of the image circle over the frame's shorter side
SEEN_CIRCLES = (1.0, 1.25)  # radius at half the field over that of the visible disc: a dome may hide the horizon
REDUCED_SIDE_PX = 160  # longer side of the reduced background
EDGE_POINTS = 72  # in which the edge is looked for
LARGEST_OFFSET_1 = 0.1  # of the centre from the frame's, over the shorter side
SMALLEST_RADIUS_1, LARGEST_RADIUS_1 = 0.28, 0.62  # over the frame's shorter side
RING_1 = 0.05  # of the radius: distance of the rings inside and outside the edge
DISC_STEP_PX = 2.0
MIN_CONTRAST_1 = 0.2  # median over the directions; moonlit photographs with trees reach 0.3
MIN_SEEN_1 = 0.5  # of the directions that lie in the frame
DARKEST_PERCENTILE = 0.5


@dataclass(frozen=True)
class LensGuess:
    """A lens of the family; its focal length is uncertain by the size tolerance of the patterns."""

    focal_px: float
    shape: float
    centre_px: tuple[float, float]


def unknown_camera(
    size_px: tuple[int, int], focal_px: float, centre_px: tuple[float, float], lens: Lens, mirrored: bool
) -> Camera:
    """A camera of a frame (W, H), as wide as its lens."""
    widest = lens.max_invertible_rad
    return Camera(
        name=UNKNOWN_LENS, size_px=size_px, focal_px=(focal_px, focal_px), centre_px=centre_px, max_angle_rad=widest,
        calibrated_angle_rad=widest, lens=lens, mirrored=mirrored,
    )  # fmt: skip


def guess_lenses(size_px: tuple[int, int], fov_rad: float, shapes: tuple[float, ...]) -> list[LensGuess]:
    """Lenses of these shapes with a field of view across the width of a frame (W, H), centred on it."""
    width, height = size_px
    centre_px = ((width - 1) / 2, (height - 1) / 2)
    return [LensGuess(width / 2 / float(family_radius(np.array(fov_rad / 2), q)), q, centre_px) for q in shapes]


def guess_fisheyes(size_px: tuple[int, int], fov_rad: float, circle: ImageCircle | None) -> list[LensGuess]:
    """Fisheye lenses, likelier ones first: as large as the visible `circle` or somewhat larger, or by the frame."""
    width, height = size_px
    if circle is not None:
        centre_px, circles_px = circle.centre_px, [c * circle.radius_px for c in SEEN_CIRCLES]
    else:
        centre_px = ((width - 1) / 2, (height - 1) / 2)
        circles_px = [c * min(size_px) for c in CIRCLES if c * min(size_px) < 0.56 * np.hypot(width, height)]
    return [
        LensGuess(circle_px / float(family_radius(np.array(fov_rad / 2), shape)), shape, centre_px)
        for circle_px in circles_px
        for shape in WIDE_SHAPES
        if abs(shape) * fov_rad / 2 < np.radians(80.0)
    ]


def family_radius(angle_rad: Array, shape: float) -> Array:
    """Radius [focal lengths] at the angles: sin(|q| a) / |q| for q < 0, a for q = 0, tan(q a) / q for q > 0.

    Orthographic is q = -1, equisolid -1/2, equidistant 0, stereographic 1/2, pinhole 1; real lenses lie between.
    """
    q = abs(shape)
    if q < LINEAR_SHAPE:
        return angle_rad
    x = np.minimum(q * angle_rad, STEEPEST_RAD)
    return (np.sin(x) if shape < 0 else np.tan(x)) / q


def family_angle(radius_focal: Array, shape: float) -> Array:
    """Inverse of `family_radius` [rad]; the steepest angle where the radius is outside the image circle."""
    q = abs(shape)
    if q < LINEAR_SHAPE:
        return radius_focal
    x = q * radius_focal
    return (np.arcsin(np.minimum(x, STEEPEST_SINE)) if shape < 0 else np.arctan(x)) / q


@dataclass(frozen=True)
class RadialFamily(Lens):
    """A lens of the family; used only during identification, not in camera files."""

    model: ClassVar[str] = "radial_family"
    label: ClassVar[str] = "one-parameter family"
    parameter_names: ClassVar[tuple[str, ...]] = ("shape",)

    shape: float

    @property
    def max_invertible_rad(self) -> float:  # type: ignore[override]
        """Angle up to which the radius rises [rad]."""
        return float(min(np.pi, STEEPEST_RAD / max(abs(self.shape), LINEAR_SHAPE)))

    def rho(self, angle_rad: Array) -> Array:
        """Radius [focal lengths] at the angles off the axis [rad]."""
        return family_radius(np.asarray(angle_rad, dtype=np.float64), self.shape)

    def slope(self, angle_rad: Array) -> Array:
        """d rho / d angle [1/rad]."""
        x = np.minimum(abs(self.shape) * np.asarray(angle_rad, dtype=np.float64), STEEPEST_RAD)
        return np.cos(x) if self.shape < 0 else 1.0 / np.square(np.cos(x))

    def angle_rad(self, rho: Array) -> Array:
        """Angle off the axis [rad] at the radii [focal lengths]."""
        return family_angle(np.asarray(rho, dtype=np.float64), self.shape)

    def derivative(self, name: str, angle_rad: Array) -> Array:
        """d rho / d shape at the angles off the axis [rad]."""
        above, below = (family_radius(angle_rad, self.shape + step) for step in (SHAPE_STEP, -SHAPE_STEP))
        return (above - below) / (2 * SHAPE_STEP)

    def with_update(self, step: Mapping[str, float]) -> RadialFamily:
        """The lens with `step` added to its shape, kept within the family."""
        return RadialFamily(float(np.clip(self.shape + step.get("shape", 0.0), -WIDEST_SHAPE, WIDEST_SHAPE)))


@dataclass(frozen=True)
class ImageCircle:
    """Disc of the frame that the lens illuminates."""

    centre_px: tuple[float, float]
    radius_px: float


def image_circle(background: NDArray[Any]) -> ImageCircle | None:
    """The bright disc in a background (H, W); None without a clear edge, or where the frame lies within the disc.

    It is the disc with the largest median contrast (bright - dark) / (bright + dark - 2 darkest) across its edge, of
    which walls and trees may hide almost half.
    """
    import cv2

    height, width = background.shape
    if min(height, width) < REDUCED_SIDE_PX // 4:
        return None
    scale = max(height, width) / REDUCED_SIDE_PX
    shape = max(round(width / scale), 1), max(round(height / scale), 1)
    small = np.asarray(cv2.resize(background.astype(np.float32), shape, interpolation=cv2.INTER_AREA), dtype=np.float32)
    small -= np.percentile(small, DARKEST_PERCENTILE)
    if float(small.max()) <= 0.0:
        return None
    middle, shorter = 0.5 * (np.array(shape) - 1), min(shape)
    radii = np.arange(SMALLEST_RADIUS_1 * shorter, LARGEST_RADIUS_1 * shorter, DISC_STEP_PX)
    best = _best_disc(small, middle, LARGEST_OFFSET_1 * shorter, radii, DISC_STEP_PX)
    if best is None:
        return None
    radii = best[1] + np.arange(-DISC_STEP_PX, DISC_STEP_PX + 0.1, 0.5)
    best = _best_disc(small, best[0], DISC_STEP_PX, radii, 0.5)
    if best is None or best[2] < MIN_CONTRAST_1:
        return None
    (x, y), radius, _ = best
    return ImageCircle((float((x + 0.5) * scale - 0.5), float((y + 0.5) * scale - 0.5)), radius * scale)


def _best_disc(
    image: NDArray[Any], middle: Array, offset: float, radii: Array, step: float
) -> tuple[Array, float, float] | None:
    """Centre, radius and median contrast of the best disc of these radii, its centre up to `offset` from `middle`."""
    direction = np.arange(EDGE_POINTS) * 2 * np.pi / EDGE_POINTS
    around = np.stack([np.cos(direction), np.sin(direction)], axis=1)
    shift = np.arange(-offset, offset + 0.5 * step, step)
    centres = middle + np.stack(np.meshgrid(shift, shift), axis=-1).reshape(-1, 2)
    # A faint reflection in the dark is no edge.
    bright = max(float(np.median(image[image > np.median(image)])), 1e-6)
    best = None
    for radius in radii:
        inner, _ = _sample(image, centres[:, None] + (1 - RING_1) * radius * around)
        outer, seen = _sample(image, centres[:, None] + (1 + RING_1) * radius * around)
        contrast = np.where(seen, (inner - outer) / np.maximum(inner + outer, bright), np.nan)
        enough = seen.mean(axis=1) >= MIN_SEEN_1
        if not enough.any():
            continue
        median = np.nanmedian(contrast[enough], axis=1) * np.sqrt(seen[enough].mean(axis=1))
        i = int(np.argmax(median))
        if best is None or median[i] > best[2]:
            best = (centres[enough][i], float(radius), float(median[i]))
    return best


def _sample(image: NDArray[Any], xy_px: Array) -> tuple[Array, Any]:
    """Values of the nearest pixels, at least 0, and whether the positions lie in the image."""
    column, row = np.rint(xy_px).astype(np.int64).transpose(2, 0, 1)
    seen = (column >= 0) & (row >= 0) & (column < image.shape[1]) & (row < image.shape[0])
    values = image[np.clip(row, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)]
    return np.maximum(values, 0.0), seen
