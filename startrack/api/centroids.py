"""Identification of a plain list of centroids in one call."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from startrack.camera import Camera
from startrack.core import STAR_COUNT_SLOPE
from startrack.core.errors import Reason
from startrack.core.types import Array, Attitude, Centroids, Identification, Ints, NotIdentified, Stars
from startrack.estimation.attitude import AttitudeFit, solve_attitude
from startrack.estimation.lens_correction import solve_with_misfit
from startrack.identification import Identifier, identify_unknown_lens

DEFAULT_SIGMA_PX = 0.3  # centroid error per axis where none is given


@dataclass(frozen=True, kw_only=True)
class IdentifiedCentroids:
    """Matches, attitude and camera of a list of centroids."""

    identification: Identification  # its `detection` counts the centroids in the order given
    stars: Stars  # the catalogue to which its `star` refers
    camera: Camera  # as given, or found (name "unknown", with covariance)
    attitude_fit: AttitudeFit
    has_time: bool  # whether `stars` are those at the time of the exposure

    def __repr__(self) -> str:
        """Text of the number of stars, the residual and the camera: the arrays fill pages."""
        rms_px = self.attitude_fit.rms_px
        return f"<IdentifiedCentroids: {len(self.star)} stars, rms {rms_px:.3f} px, camera {self.camera.name!r}>"

    @property
    def attitude(self) -> Attitude:
        """Attitude R_cam_icrs with its covariance; without a time, with the error that this adds."""
        return self.attitude_fit.attitude_of(has_time=self.has_time)

    @property
    def detection(self) -> Ints:
        """Indices (n,) of the identified centroids."""
        return self.identification.detection

    @property
    def star(self) -> Ints:
        """Indices (n,) in `stars` of the stars of the identified centroids."""
        return self.identification.star

    @property
    def hip(self) -> Ints:
        """Hipparcos numbers (n,) of the stars, 0 where there is none."""
        return self.stars.hip[self.identification.star]

    @property
    def false_alarm_probability(self) -> float:
        """Probability that random centroids would be accepted as well matched."""
        return self.identification.false_alarm_probability


def identify_centroids(
    xy_px: ArrayLike,
    *,
    camera: Camera | None = None,
    fov_rad: float | None = None,
    size_px: tuple[int, int] | None = None,
    flux: ArrayLike | None = None,
    sigma_px: ArrayLike | None = None,
    saturated: ArrayLike | None = None,
    psf_sigma_px: float = 1.0,
    stars: Stars | None = None,
    identifier: Identifier | None = None,
    near_R_cam_icrs: Array | None = None,
) -> IdentifiedCentroids:
    """Identify the stars in a list of centroids, with a camera or from a field of view alone.

    Args:
        xy_px: centroids (n, 2); (0, 0) is the centre of the top-left pixel, x right, y down.
        camera: the calibrated camera; None: the lens is found too, and `fov_rad` and `size_px` are needed.
        fov_rad: field of view to about 10 %, not with `camera`. Below 100 degrees the angle across the frame's width,
            from there up that of the image circle.
        size_px: width and height of the frame, not with `camera`.
        flux: (n,) in any linear unit. None: the brightness is not known and the list is sorted, brightest first.
        sigma_px: centroid error per axis, one number or (n,); None: 0.3 px.
        saturated: (n,) True where the flux is a lower limit; None: nowhere.
        psf_sigma_px: width of the stars; nearer stars than three times this share one centroid.
        stars: catalogue at the time of the exposure, brightest first; None: Hipparcos at J2000.0, without aberration.
        identifier: settings of the identification with a camera; without one its `near_sky` alone counts.
        near_R_cam_icrs: a rough attitude (3, 3) of a `camera`, near which the stars are sought first.

    Raises:
        ValueError: neither a camera, nor a field of view with the frame's size, or both; or arrays of a wrong shape or
            type.
        NotIdentified: the stars are not identified; its `reason` is "mirrored" for the mirror image of a known camera.
    """
    has_time = stars is not None
    if stars is None:
        from startrack.catalog import load_catalog

        stars = load_catalog().at(None, None)
    has_file = camera is not None
    sources, order = sorted_centroids(xy_px, flux, sigma_px, saturated, psf_sigma_px)
    with _stating_order(flux is None):
        if camera is not None:
            if fov_rad is not None or size_px is not None:
                raise ValueError("with camera= neither a field of view nor size_px= is given: the camera has its own")
            _require_in_frame(sources.xy_px, camera.size_px)
            found = (identifier or Identifier())(sources, camera, stars, near_R_cam_icrs)
        elif fov_rad is not None and size_px is not None:
            _require_in_frame(sources.xy_px, size_px)
            near_sky = None if identifier is None else identifier.near_sky
            solution = identify_unknown_lens(sources, size_px, fov_rad, stars, near_sky=near_sky)
            camera, found = solution.camera, solution.identification
        else:
            raise ValueError("give a camera, or fov_rad= with size_px=")
    matches = (
        camera, sources.xy_px[found.detection], sources.covariance_px2[found.detection], stars.rays_icrs[found.star],
        found.R_cam_icrs,
    )  # fmt: skip
    camera, fit = (camera, solve_attitude(*matches)) if has_file else solve_with_misfit(*matches)
    found = Identification(
        detection=order[found.detection], star=found.star, R_cam_icrs=fit.attitude.R_cam_icrs,
        false_alarm_probability=found.false_alarm_probability, unexplained=found.unexplained,
    )  # fmt: skip
    return IdentifiedCentroids(identification=found, stars=stars, camera=camera, attitude_fit=fit, has_time=has_time)


@contextmanager
def _stating_order(is_assumed: bool) -> Iterator[None]:
    """Context in which a refusal also states that the order of the centroids is assumed, if it is."""
    try:
        yield
    except NotIdentified as cause:
        if is_assumed and cause.reason != Reason.MIRRORED:
            order = "no fluxes are given, and the list counts as sorted, brightest first: if it is not, sort it"
            cause.args = (f"{cause}; {order}, or give flux=",)
        raise


def sorted_centroids(
    xy_px: ArrayLike, flux: ArrayLike | None, sigma_px: ArrayLike | None, saturated: ArrayLike | None,
    psf_sigma_px: float,
) -> tuple[Centroids, Ints]:  # fmt: skip
    """Centroids, brightest first, and their indices (n,) in the given order. Raises ValueError.

    Without fluxes each rank has the magnitude at which a typical sky has as many stars, and the brightness takes no
    part in the matches.
    """
    xy = _real_numbers("the centroids", xy_px)
    xy = xy.reshape(0, 2) if xy.shape == (0,) else xy
    if xy.ndim != 2 or xy.shape[1] != 2:
        more = ", and further columns by their names, such as flux=table[:, 2]" if xy.shape[1:] in ((3,), (4,)) else ""
        more = " (the transposed array)" if xy.ndim == 2 and len(xy) == 2 else more
        raise ValueError(f"the centroids have the shape {xy.shape}: give (n, 2), x and y [px] of each{more}")
    n = len(xy)
    if flux is None:
        order, brightness_sigma_mag = np.arange(n, dtype=np.int64), np.inf
        light = np.exp(-np.log(10.0) * 0.4 / STAR_COUNT_SLOPE * np.log(np.arange(1, n + 1)))
    else:
        light, brightness_sigma_mag = _one_each("flux", flux, n), 0.0
        order = np.argsort(-light, kind="stable")
    sigma = _one_each("sigma_px", DEFAULT_SIGMA_PX if sigma_px is None else sigma_px, n)
    if (sigma <= 0).any():
        raise ValueError("sigma_px= must be above 0")
    clipped = _one_each("saturated", False if saturated is None else saturated, n).astype(bool)
    return Centroids(
        xy_px=xy[order],
        covariance_px2=np.square(sigma[order])[:, None, None] * np.eye(2),
        flux_e=light[order],
        snr=np.full(n, np.inf),
        saturated=clipped[order],
        psf_sigma_px=psf_sigma_px,
        brightness_sigma_mag=brightness_sigma_mag,
    ), order


def _require_in_frame(xy_px: Array, size_px: Any) -> None:
    """Raise NotIdentified where there are centroids (n, 2), but none in the frame of `size_px` (W, H).

    Raises ValueError for a size that is no pair of numbers of at least 1.
    """
    try:
        width, height = size_px
        possible = width >= 1 and height >= 1
    except (TypeError, ValueError):
        possible = False
    if not possible:
        raise ValueError(f"size_px= is {size_px!r}: give width and height [px]")
    in_frame = np.all((xy_px >= -0.5) & (xy_px <= np.array([width, height]) - 0.5), axis=1)
    if len(xy_px) and not in_frame.any():
        raise NotIdentified(
            f"none of the {len(xy_px)} centroids lies in the frame of {width} x {height} px: give x and y in "
            "px of this frame, from the centre of its top-left pixel",
            detected=0,
        )


def _one_each(name: str, values: ArrayLike, n: int) -> Array:
    """The values as an array (n,); one number is that of all centroids. Raises ValueError."""
    given = _real_numbers(f"{name}=", values)
    if given.shape not in ((), (n,)):
        raise ValueError(f"{name}= has the shape {given.shape}: give one number for each of the {n} centroids")
    return np.broadcast_to(given, n)


def _real_numbers(name: str, values: ArrayLike) -> Array:
    """The values as an array. Raises ValueError where they are not real numbers, or not finite."""
    try:
        given = np.asarray(values)
    except (TypeError, ValueError) as cause:
        raise ValueError(f"{name} must be an array of numbers, rows of equal length") from cause
    if given.dtype.kind not in "biuf":
        kind = type(values).__name__ if given.ndim == 0 else f"an array of {given.dtype}"
        raise ValueError(f"{name} must be a list or an array of numbers, each of them real; this is {kind}")
    if not np.isfinite(given).all():
        raise ValueError(f"{name} must be finite: leave out what was not measured")
    return given.astype(np.float64)
