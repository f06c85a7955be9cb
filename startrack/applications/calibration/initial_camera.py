"""Initial camera from matched stars alone: focal length, kind of lens, handedness and attitudes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from startrack.camera import Camera, lens_kinds
from startrack.core.types import Array, NotIdentified
from startrack.estimation.adjust import State
from startrack.estimation.normal_equations import Observations
from startrack.frames import angle_between_rad, wahba

PAIR_STARS = 80  # of an image, whose pairs give the focal length
NEAR_PAIRS_QUANTILE = 0.3
FOCAL_FACTORS = np.geomspace(0.6, 1.7, 23)
ATTITUDE_ROUNDS = 8
IMAGES_TRIED = 3
OUTLIER_RAD = np.radians(4.0)  # larger errors of a ray count as this one
SMALLEST_TOLERANCE_RAD = 1e-4


def initial_state(points: Observations, size_px: tuple[int, int]) -> State:
    """The best of many simple cameras with the axis in the middle of the frame, with its attitudes.

    `points` are the observations of a frame of `size_px` (W, H). Up to half of the matches may be wrong. Raises
    NotIdentified without observations.
    """
    if not len(points):
        raise NotIdentified("a calibration needs matched stars")
    some = points_of_fullest_images(points)
    cameras = simple_cameras(_focal_px(some), size_px)
    best = min(cameras, key=lambda camera: float(np.sum(_fit_rays(camera, some)[1])))
    return State(camera=best, R_cam_icrs=fit_attitudes(best, points))


def points_of_fullest_images(points: Observations) -> Observations:
    """The observations of the images that have most."""
    most = np.argsort(-np.bincount(points.image), kind="stable")[:IMAGES_TRIED]
    return points.take(np.isin(points.image, most))


def simple_cameras(focal_px: float, size_px: tuple[int, int]) -> Iterator[Camera]:
    """Cameras of all kinds of lenses, focal lengths about `focal_px` and handednesses, for a frame of `size_px`."""
    for kind in lens_kinds().values():
        for lens in kind.typical_shapes():
            for factor in FOCAL_FACTORS:
                for mirrored in (False, True):
                    yield Camera(
                        name="initial",
                        size_px=size_px,
                        focal_px=(focal_px * factor, focal_px * factor),
                        centre_px=((size_px[0] - 1) / 2, (size_px[1] - 1) / 2),
                        max_angle_rad=min(np.pi, lens.max_invertible_rad),
                        calibrated_angle_rad=min(np.pi / 2, lens.max_invertible_rad),
                        lens=lens,
                        mirrored=mirrored,
                    )


def fit_attitudes(camera: Camera, points: Observations) -> Array:
    """R_cam_icrs (images, 3, 3), robustly weighted; identity where an image has no observations."""
    return _fit_rays(camera, points)[0]


def _focal_px(points: Observations) -> float:
    """Pixels per radian from the distances of near pairs, which depend on neither centre nor attitude."""
    ratios = []
    for i in np.unique(points.image):
        own = points.take(points.image == i)
        own = own.take(np.linspace(0, len(own) - 1, min(len(own), PAIR_STARS)).astype(int))
        a, b = np.triu_indices(len(own), 1)
        angle = angle_between_rad(own.rays_icrs[a], own.rays_icrs[b])
        near = angle <= np.quantile(angle, NEAR_PAIRS_QUANTILE) if len(angle) else np.zeros(0, dtype=bool)
        near &= angle > 0
        ratios.append(np.linalg.norm(own.xy_px[a] - own.xy_px[b], axis=1)[near] / angle[near])
    ratio = np.concatenate(ratios)
    if not len(ratio):
        raise NotIdentified("a calibration needs at least two matched stars in one image")
    return float(np.median(ratio))


def _fit_rays(camera: Camera, points: Observations) -> tuple[Array, Array]:
    """Attitudes (images, 3, 3), and the squared errors (n,) of the rays [rad^2], at most OUTLIER_RAD squared."""
    rays = camera.unproject(points.xy_px)
    R = np.tile(np.eye(3), (points.images, 1, 1))
    squared_error = np.empty(len(points))
    for i in np.unique(points.image):
        own = np.flatnonzero(points.image == i)
        weight = np.ones(len(own))
        for _ in range(ATTITUDE_ROUNDS):
            R[i] = wahba(rays[own], points.rays_icrs[own], weight)
            squared = np.sum(np.square(rays[own] - points.rays_icrs[own] @ R[i].T), axis=1)
            tolerance = max(float(np.sqrt(np.median(squared))), SMALLEST_TOLERANCE_RAD)
            weight = 1.0 / (1.0 + squared / tolerance**2) ** 2
        squared_error[own] = np.minimum(squared, OUTLIER_RAD**2)
    return R, squared_error
