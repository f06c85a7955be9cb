"""The values that cross module borders (and, from errors.py, the exceptions).

Every value is frozen, keyword-only and shape-checked; its arrays are read-only. A stage returns a complete value
or raises `NoSolution`; there is no sentinel or half-filled result, NaN only where a field allows it (CONVENTIONS.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.errors import BadInput, NoSolution, NotIdentified, NotLocated, TooFewStars
from startrack.core.fix import (
    Clock,
    ClockError,
    Explored,
    Fix,
    Integrity,
    Mode,
    PositionPrior,
    Sectors,
    ShownError,
    UnstatedFact,
)
from startrack.core.obstacles import Obstacles
from startrack.core.values import Array, Bools, Ints, Rows, Value, array, rotation, vector

__all__ = [
    "Array", "Attitude", "BadInput", "Body", "Bools", "Centroids", "Clock", "ClockError", "Correction", "Detections",
    "Evidence", "Explored", "Exposure", "Fix", "Identification", "ImageErrors", "Integrity", "Ints", "Mask",
    "MeasuredSkyline", "Mode", "NoSolution", "NotIdentified", "NotLocated", "PositionPrior", "Rows", "Sectors",
    "ShownError", "Stars", "TooFewStars", "UnstatedFact", "Value", "array", "rotation", "vector",
]  # fmt: skip

Image = NDArray[np.float32]
# Beyond the zenith: the search for an error of the horizon shifts the rows, by three sigma at most.
MOST_ELEVATION_RAD = np.pi / 2 + 0.6
SECTORS = 240  # of azimuth, 1.5 degrees each: an obstacle on no map hides what is in one together
MIDDLES_RAD = (np.arange(SECTORS) + 0.5) * 2 * np.pi / SECTORS


def sector_of(azimuth_rad: Array) -> Ints:
    """Index (n,) of the sector of azimuth that holds each `azimuth_rad` (n,) [rad]."""
    return np.asarray((azimuth_rad * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS)


TIME_SIGMA_S = 1.0  # of the clock, where nothing is stated
MAX_PIXELS = 200_000_000  # contract: a larger image is refused from its header, before anything is decoded


@dataclass(frozen=True, kw_only=True, eq=False)
class Mask:
    """Pixels of an image that do not count; True means masked, as in numpy's masked arrays."""

    masked: NDArray[np.bool_]  # (H, W)
    sha256: str  # of its file, or of its values; of a union the hashes of its parts, joined by "+"; "": none is given
    dead_part: float = 0.0  # of the image, that shows no light: found in the image, not given

    def __post_init__(self) -> None:
        locked = np.array(self.masked, dtype=np.bool_)
        if locked.ndim != 2:
            raise ValueError(f"Mask.masked: {locked.ndim} dimensions, expected (H, W)")
        locked.flags.writeable = False
        object.__setattr__(self, "masked", locked)


@dataclass(frozen=True, kw_only=True, eq=False)
class Correction:
    """The correction of an exposure by a dark frame, a flat field, or both."""

    recorded_adu: NDArray[np.float32]  # (H, W) counts as the sensor recorded them: they show saturation and clipping
    mask: Mask | None  # pixels that cannot be corrected; None: all can
    sensitivity_1: NDArray[np.float32] | None  # (H, W) of the flat field, 1 at its median; None: no flat field
    scales_black: bool  # the black level was divided too, because without a dark frame it is not known
    dark_sha256: str | None  # of the file; None: no dark frame
    flat_sha256: str | None


@dataclass(frozen=True, kw_only=True)
class Exposure(Value):
    """An image with the facts that travel with it."""

    pixels_adu: NDArray[np.float32]  # (H, W) [ADU]; a sensor's 16 bits fit float32 exactly
    name: str = ""  # stem of the file's name
    path: str = ""  # as given by the user
    time_utc: datetime | None = None  # mid-exposure, timezone-aware UTC; None when unknown
    time_sigma_s: float = TIME_SIGMA_S  # standard deviation of the clock's error
    time_sigma_is_stated: bool = False  # by the user or a file; made true where it is not the default
    exposure_s: float | None = None
    camera: str | None = None  # resolved path or shipped name of the camera file
    terrain: str | None = None  # resolved path or shipped name of the terrain file
    air: Mapping[str, object] | None = None  # what is stated of the air over the site, by key of `frames.AIR_KEYS`
    mask: str | Mask | None = None  # resolved path of the mask's file, or the mask; None: every pixel counts
    obstacles: str | Obstacles | None = None  # resolved path of their file, or themselves: what hides the ground
    saturation_adu: float | None = None  # largest value the file's type can hold, None for float images
    sha256: str = ""
    warnings: tuple[str, ...] = ()
    header_site_rad: tuple[float, float] | None = None  # latitude and longitude that the header states; only compared
    row_order: str = ""  # ROWORDER of the header, TOP-DOWN or BOTTOM-UP; the rows are those of the file all the same
    correction: Correction | None = None  # by dark frame and flat field; None: `pixels_adu` are the recorded counts

    def __post_init__(self) -> None:
        p = np.asarray(self.pixels_adu, dtype=np.float32)
        if p.ndim != 2:
            raise ValueError(f"Exposure.pixels_adu: {p.ndim} dimensions, expected (H, W)")
        if p.flags.writeable:
            p = p.view()
            p.flags.writeable = False
        object.__setattr__(self, "pixels_adu", p)
        if self.time_sigma_s != TIME_SIGMA_S:
            object.__setattr__(self, "time_sigma_is_stated", True)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the image [px]."""
        return self.pixels_adu.shape[1], self.pixels_adu.shape[0]

    @property
    def recorded_adu(self) -> NDArray[np.float32]:
        """Counts (H, W) [ADU] before dark frame and flat field."""
        return self.pixels_adu if self.correction is None else self.correction.recorded_adu


@dataclass(frozen=True)
class SmoothImage:
    """An image (H, W) that is linear between the middles of blocks of `side` rows; above and below them constant."""

    rows: Image  # (n, W): the values in the middle of each block
    side: int
    height: int

    @classmethod
    def of(cls, image: Image) -> SmoothImage:
        """Smooth image that equals any `image` (H, W): each of its rows is kept."""
        return cls(image, 1, len(image))

    @classmethod
    def from_blocks(cls, values: NDArray[Any], side: int, shape: tuple[int, ...]) -> SmoothImage:
        """Smooth image (H, W) of this `shape`, linear between the middles of square blocks with `values` (n, m)."""
        import cv2

        size = values.shape[1] * side, values.shape[0]
        wide: Any = cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)
        return cls(np.ascontiguousarray(wide[:, : shape[1]]), side, shape[0])

    def whole(self) -> Image:
        """Whole image (H, W), pixel by pixel."""
        import cv2

        size = self.rows.shape[1], len(self.rows) * self.side
        full: Any = cv2.resize(self.rows, size, interpolation=cv2.INTER_LINEAR)
        return full[: self.height]

    def at(self, row: Any, column: Any) -> Image:
        """Values (...) of the image at the whole pixels `row`, `column`; the indices are broadcast."""
        above = np.clip((row + 0.5) / self.side - 0.5, 0.0, len(self.rows) - 1)
        low = above.astype(np.int64)
        part = (above - low).astype(np.float32)
        high = np.minimum(low + 1, len(self.rows) - 1)
        return np.asarray(self.rows[low, column] * (1 - part) + self.rows[high, column] * part)


@dataclass(frozen=True, kw_only=True)
class Centroids(Rows):
    """Positions and brightness of point sources, brightest first: what identification needs of them."""

    xy_px: Array = array("n", 2)
    covariance_px2: Array = array("n", 2, 2)
    flux_e: Array = array("n")  # whole-PSF flux [electrons, or ADU when the gain is unknown]
    snr: Array = array("n")  # matched-filter signal-to-noise ratio
    saturated: Bools = array("n", dtype=np.bool_)
    psf_sigma_px: float  # Gaussian PSF before integration over the pixel, as used
    brightness_sigma_mag: float = 0.0  # added to each star's sigma; infinite where only the order is known


@dataclass(frozen=True, kw_only=True)
class Detections(Centroids):
    """Point sources found in an exposure, brightest first, with the images that they were measured against."""

    flux_sigma_e: Array = array("n")
    image_e: NDArray[np.float32]  # (H, W) the exposure [e], pedestal included
    dead: NDArray[np.bool_]  # (H, W) saturated and masked pixels
    background: SmoothImage  # [e], pedestal included
    noise: SmoothImage  # of one pixel [e]
    mask: Mask | None = None  # of camera and image together; masked pixels of `image_e` hold their surroundings

    @cached_property
    def background_e(self) -> Image:
        """The background (H, W) [e], pixel by pixel."""
        return self.background.whole()

    @cached_property
    def noise_e(self) -> Image:
        """The noise (H, W) of one pixel [e]."""
        return self.noise.whole()


@dataclass(frozen=True)
class ImageCircle:
    """Disc of the frame that a fisheye lens illuminates."""

    centre_px: tuple[float, float]
    radius_px: float


@dataclass(frozen=True, kw_only=True)
class Stars(Rows):
    """Catalogue stars as seen at one time and position: proper motion and aberration applied."""

    catalog_id: NDArray[np.str_] = array("n", dtype=np.str_)  # such as "HIP 123"
    hip: Ints = array("n", dtype=np.int64)  # 0 where the star has no Hipparcos number
    rays_icrs: Array = array("n", 3)  # apparent directions
    v_mag: Array = array("n")
    v_sigma_mag: Array = array("n")  # catalogue, colour, variability, unresolved companions


@dataclass(frozen=True, kw_only=True)
class Body(Value):
    """A planet, the Earth, the Sun or the Moon as a light source."""

    name: str
    ray_icrs: Array = vector()  # apparent direction (light time and aberration applied)
    v_mag: float


@dataclass(frozen=True, kw_only=True)
class Attitude(Value):
    """Rotation of the camera with the covariance of small rotations about the camera's own axes."""

    R_cam_icrs: Array = rotation()
    covariance_rad2: Array = array(3, 3)  # of the rotation vector w about cam x, y, z: R_true = exp(w) R


@dataclass(frozen=True, kw_only=True)
class Identification(Rows):
    """Pairs of a detection and a catalogue star, one-to-one, with the attitude at which they match."""

    detection: Ints = array("n", dtype=np.int64)  # index into Detections
    star: Ints = array("n", dtype=np.int64)  # index into Stars
    R_cam_icrs: Array = rotation()  # attitude at which the matches were verified
    false_alarm_probability: float  # that a sky of random detections would be accepted as well matched
    unexplained: int  # significant detections that no catalogue star explains


@dataclass(frozen=True, eq=False)
class ImageErrors:
    """Errors of attitude and lens: they raise the skyline that the sky's light shows, not that of the stars.

    Arrays over sectors of azimuth begin at north and go eastward.
    """

    slopes_rad: Array  # (sectors, j) rise of that skyline by one unit of each
    mean: Array  # (j,)
    covariance: Array  # (j, j)
    variance_rad2: Array  # (sectors,) of the skyline by the light of the sky alone; infinite where it shows none
    reference: Array = field(default_factory=lambda: np.zeros(0))  # (j,) likely ones; not given: the mean

    def __post_init__(self) -> None:
        if not len(self.reference):
            object.__setattr__(self, "reference", self.mean)


@dataclass(frozen=True, kw_only=True)
class Evidence(Rows):
    """Rays, each with a log-likelihood ratio l: visible sky against hidden by the terrain.

    Rows may come from stars, from pixels of the diffuse sky, and from several exposures. With V the fraction of the
    ray above the horizon (a step, or Phi((elevation - horizon) / sigma)) a row contributes
    log(V e^l + 1 - V) for a point source, and l V + c V (1 - V) / 2 for extended light, c = `extended_nats`.

    `edge_sigma_rad` and `extended_nats` may each be one number for all rows. Raises ValueError for arrays of different
    lengths, numbers that are not finite, elevations that are no angles in radians, and negative sigmas or light.
    """

    azimuth_rad: Array = array("n")  # in enu
    elevation_rad: Array = array("n")  # in enu
    llr: Array = array("n")  # natural logarithm; 0 carries no information
    edge_sigma_rad: Array = array("n", default=0.0)  # width of the edge: uncertainty of the elevation, or the PSF
    extended_nats: Array = array("n", default=0.0)  # (light / noise)^2 of extended light; 0: a point source
    clock: Clock | None = None  # one for all rows; None: the time is exact
    near: PositionPrior | None = None  # of the camera's position; None: anywhere in the search area
    image_errors: ImageErrors | None = None  # of the rows of extended light; None: these are exact
    support: Explored | None = None  # points of an earlier fix from much the same rows; None: the area is searched
    # A fix by more rows of the image follows: this one has fewer points, no times that a stated clock excludes, and no
    # check of its files or its integrity.
    is_first_look: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(np.isfinite(getattr(self, name)).all() for name in self._columns()):
            raise ValueError("Evidence holds an infinite number")
        if not len(self):
            return
        highest = max(self.elevation_rad.max(), -self.elevation_rad.min())
        if highest > MOST_ELEVATION_RAD:
            raise ValueError(f"Evidence.elevation_rad: {highest:g} is beyond pi/2, the zenith: is it in radians?")
        for name in ("edge_sigma_rad", "extended_nats"):
            least = getattr(self, name).min()
            if least < 0:
                raise ValueError(f"Evidence.{name}: {least:g} is negative")
        if not 0.0 <= self.azimuth_rad.min() <= self.azimuth_rad.max() < 2 * np.pi:
            wrapped = np.mod(self.azimuth_rad, 2 * np.pi)
            wrapped.flags.writeable = False
            object.__setattr__(self, "azimuth_rad", wrapped)

    @classmethod
    def concatenate(cls, *parts: Evidence, **shared: Any) -> Evidence:
        """Evidence with the rows of all `parts`, of several sources or exposures.

        `clock`, `near`, `image_errors` and `support` are each the first that is given.
        """
        for name in ("clock", "near", "image_errors", "support"):
            shared[name] = next((getattr(part, name) for part in parts if getattr(part, name) is not None), None)
        return super().concatenate(*parts, **shared)


@dataclass(frozen=True, kw_only=True)
class MeasuredSkyline(Rows):
    """A skyline measured in photographs: apparent elevations, refraction included, at azimuths in enu.

    Where its source is "varies" it differs between the photographs (a dome, a branch), and the highest edge is there.
    """

    azimuth_rad: Array = array("n")
    elevation_rad: Array = array("n", may_be_nan=True)  # nan where unknown
    sigma_rad: Array = array("n")  # infinite where unknown
    source: NDArray[np.str_] = array("n", dtype=np.str_)  # "stars", "sky light", "both"; "varies"; "" where unknown
    cloud_probability: Array = array("n", default=0.0)  # that the edge is a cloud's, before a lower skyline

    @property
    def known(self) -> Bools:
        """Whether the elevation is known at each azimuth (n,)."""
        return np.isfinite(self.elevation_rad)
