"""A first camera from matched stars alone: focal length, kind of lens, handedness and attitudes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from startrack.calibration.observations import Observations
from startrack.calibration.solve import State
from startrack.camera import Camera, KannalaBrandt, Lens, Pinhole
from startrack.frames import angle_between_rad, wahba
from startrack.types import Array, Ints, NotIdentified

PAIRS_OF = 80
NEAR_PAIRS = 0.3
STRETCHES = np.geomspace(0.6, 1.7, 23)
# Equidistant, equisolid, stereographic and orthographic as polynomials: good enough to begin with.
LENSES: tuple[Lens, ...] = (
    KannalaBrandt(),
    KannalaBrandt((-1 / 24,)),
    KannalaBrandt((1 / 12, 1 / 120)),
    KannalaBrandt((-1 / 6, 1 / 120)),
    Pinhole(),
)
ROUNDS = 8
IMAGES_TRIED = 3
WRONG_RAD = np.radians(4.0)  # a ray this far off does not count
FIRST_TOLERANCE_RAD = np.radians(1.0)


def first_state(points: Observations, size_px: tuple[int, int]) -> State:
    """The best of many simple cameras in the middle of the frame, both handednesses tried, with its attitudes.

    Wrong matches do not matter as long as they are fewer than half. Raises NotIdentified without any points.
    """
    if not len(points):
        raise NotIdentified("no matched stars to begin a calibration with")
    some = points.take(np.isin(points.image, _fullest_images(points)))
    best: tuple[float, Camera] | None = None
    for camera in _cameras(_focal_px(some), size_px):
        score = float(np.sum(_misses(camera, some)[1]))
        if best is None or score < best[0]:
            best = (score, camera)
    assert best is not None
    return State(camera=best[1], R_cam_icrs=_misses(best[1], points)[0])


def opposite(camera: Camera) -> Camera:
    """The camera of the mirror image."""
    return replace(camera, mirrored=not camera.mirrored)


def attitudes(camera: Camera, points: Observations) -> Array:
    """R_cam_icrs (images, 3, 3) by robustly weighted rotations; identity where an image has no points."""
    return _misses(camera, points)[0]


def _cameras(focal_px: float, size_px: tuple[int, int]) -> Iterator[Camera]:
    width, height = size_px
    for lens in LENSES:
        for stretch in STRETCHES:
            for mirrored in (False, True):
                yield Camera(
                    name="first guess",
                    size_px=size_px,
                    focal_px=(focal_px * stretch, focal_px * stretch),
                    centre_px=((width - 1) / 2, (height - 1) / 2),
                    max_angle_rad=min(np.pi, lens.max_invertible_rad),
                    calibrated_angle_rad=min(np.pi / 2, lens.max_invertible_rad),
                    lens=lens,
                    mirrored=mirrored,
                )


def _fullest_images(points: Observations) -> Ints:
    return np.argsort(-np.bincount(points.image), kind="stable")[:IMAGES_TRIED]


def _focal_px(points: Observations) -> float:
    """Pixels per radian, from the distances of near pairs: neither the centre nor an attitude is needed."""
    ratios = []
    for i in np.unique(points.image):
        own = points.take(points.image == i)
        own = own.take(np.linspace(0, len(own) - 1, min(len(own), PAIRS_OF)).astype(int))
        a, b = np.triu_indices(len(own), 1)
        angle = angle_between_rad(own.rays_icrs[a], own.rays_icrs[b])
        near = angle <= np.quantile(angle, NEAR_PAIRS) if len(angle) else np.zeros(0, dtype=bool)
        near &= angle > 0
        ratios.append(np.linalg.norm(own.xy_px[a] - own.xy_px[b], axis=1)[near] / angle[near])
    ratio = np.concatenate(ratios)
    if not len(ratio):
        raise NotIdentified("a calibration needs at least two matched stars in one image")
    return float(np.median(ratio))


def _misses(camera: Camera, points: Observations) -> tuple[Array, Array]:
    """Attitudes (images, 3, 3), and the squared distances (n,) of the rays [rad^2], cut off at WRONG_RAD."""
    rays = camera.unproject(points.xy_px)
    R = np.tile(np.eye(3), (points.images, 1, 1))
    missed = np.empty(len(points))
    for i in np.unique(points.image):
        own = np.flatnonzero(points.image == i)
        weight, tolerance = np.ones(len(own)), FIRST_TOLERANCE_RAD
        for _ in range(ROUNDS):
            R[i] = wahba(rays[own], points.rays_icrs[own], weight)
            squared = np.sum(np.square(rays[own] - points.rays_icrs[own] @ R[i].T), axis=1)
            tolerance = max(float(np.sqrt(np.median(squared))), 1e-4)
            weight = 1.0 / (1.0 + squared / tolerance**2) ** 2
        missed[own] = np.minimum(squared, WRONG_RAD**2)
    return R, missed
