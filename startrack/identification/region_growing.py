"""From a rough attitude and lens to an exact one: outwards from where they fit, and deeper as they fit better."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera, KannalaBrandt, Lens, Pinhole
from startrack.frames import R_from_rotvec
from startrack.identification.radial_lens_family import PINHOLE, Family
from startrack.types import Array, Ints

STEPS = 3  # of Gauss-Newton for one set of matches
ROUNDS = 2  # of matching again within a stage
NUDGE = 1e-6
FEWEST = 5
SMALLEST_GATE_PX = 1.5
SHAPE_SIGMA = 0.5  # prior of the family's shape number
SCALE_SIGMA = 0.1  # of the focal length's logarithm
CENTRE_SIGMA = 0.06  # of the centre, in focal lengths
K_SIGMA = (0.1, 0.1, 0.05, 0.02)  # of the polynomial's coefficients, about those of the family's lens
STARS_PER_DETECTION = 1.5


@dataclass(frozen=True)
class Stage:
    """One step of growing: which stars take part, how far off they may be, and what is fitted."""

    reach_rad: float  # from the triangle that began it
    gate_rad: float
    detections: int  # brightest that take part
    free: tuple[str, ...]  # beyond the rotation
    log_limit: float  # chance of as many pairs in the inner half of the gate, above which it is given up


WIDE = (
    Stage(np.radians(45.0), np.radians(2.0), 60, ("scale",), 0.0),
    Stage(np.radians(70.0), np.radians(2.0), 60, ("scale", "shape", "centre"), -3.0),
    Stage(np.pi, np.radians(2.0), 80, ("scale", "shape", "centre"), -6.0),
    Stage(np.pi, np.radians(1.0), 120, ("scale", "shape", "centre"), -10.0),
    Stage(np.pi, np.radians(0.6), 200, ("scale", "shape", "centre"), -14.0),
)


@dataclass(frozen=True)
class Start:
    """A hypothesis: camera (lens of the family) and attitude, good near the direction `middle_cam`."""

    camera: Camera
    R_cam_icrs: Array  # (3, 3)
    middle_cam: Array  # (3,)
    log_chance: float


@dataclass(frozen=True)
class Grown:
    """Camera and attitude with the pairs that they rest on."""

    camera: Camera
    R_cam_icrs: Array
    detection: Ints
    star: Ints
    distance_px: Array


def grow(start: Start, xy_px: Array, rays_icrs: Array, stages: tuple[Stage, ...] = WIDE) -> Grown | None:
    """The start after all stages; None where it dies. Detections (n, 2) and stars (m, 3) are brightest first."""
    camera, R = start.camera, start.R_cam_icrs
    middle_icrs = start.middle_cam @ R
    grown = None
    for stage in stages:
        for _ in range(ROUNDS):
            gate_px = max(stage.gate_rad * camera.focal_px[0], SMALLEST_GATE_PX)
            near = (middle_icrs, stage.reach_rad)
            detection, star, tried = mutual_pairs(camera, R, xy_px[: stage.detections], rays_icrs, gate_px, near)
            if len(star) < FEWEST:
                return None
            camera, R, distance = fit(
                camera, R, xy_px[detection], rays_icrs[star], stage.free, sigma_px=gate_px / 4, prior=start.camera
            )
            grown = Grown(camera, R, detection, star, distance)
        if _log_chance(distance, gate_px, tried, xy_px[: stage.detections]) > stage.log_limit:
            return None
    return grown


def mutual_pairs(
    camera: Camera, R: Array, xy_px: Array, rays_icrs: Array, gate_px: float, near: tuple[Array, float] | None = None
) -> tuple[Ints, Ints, int]:
    """Mutually nearest (detection, star) within the gate, and how many stars were asked for.

    Of the brightest stars in view, about as many as detections.

    `near`: only stars about this direction (3,) in ICRS, up to this angle [rad].
    """
    from scipy.spatial import cKDTree

    some = _brightest_in_view(camera, R, rays_icrs, int(STARS_PER_DETECTION * len(xy_px)) + 5)
    if near is not None:
        some = some[rays_icrs[some] @ near[0] > np.cos(near[1])]
    if not len(some):
        return some, some, 0
    px, _ = camera.project(rays_icrs[some] @ R.T)
    distance, nearest = cKDTree(xy_px).query(px, distance_upper_bound=gate_px)
    _, back = cKDTree(px).query(xy_px, distance_upper_bound=gate_px)
    hit = np.flatnonzero(np.isfinite(distance))
    keep = back[nearest[hit]] == hit
    return nearest[hit][keep].astype(np.int64), some[hit][keep], len(some)


def _log_chance(distance_px: Array, gate_px: float, stars: int, xy_px: Array) -> float:
    """About log P that chance brings as many of the stars within half the gate of a detection (n, 2)."""
    area = float(np.prod(np.ptp(np.percentile(xy_px, (5, 95), axis=0), axis=0)) / 0.81) + 1.0
    expected = max(stars * min(len(xy_px) * np.pi * (0.5 * gate_px) ** 2 / area, 1.0), 1e-6)
    hits = int(np.count_nonzero(distance_px < 0.5 * gate_px))
    return 0.0 if hits <= expected else float(hits - expected - hits * np.log(hits / expected))


def _brightest_in_view(camera: Camera, R: Array, rays_icrs: Array, wanted: int) -> Ints:
    """Indices of the brightest stars within the frame."""
    count = 4 * wanted
    while True:
        _, inside = camera.project(rays_icrs[:count] @ R.T)
        seen = np.flatnonzero(inside)
        if len(seen) >= wanted or count >= len(rays_icrs):
            return seen[:wanted]
        count *= 4


def fit(
    camera: Camera, R: Array, xy_px: Array, rays_icrs: Array, free: tuple[str, ...], sigma_px: float,
    prior: Camera, priors: bool = True,
) -> tuple[Camera, Array, Array]:  # fmt: skip
    """Camera and attitude that bring the stars (n, 3) onto the pixels (n, 2), and the distances left (n,) [px].

    Gauss-Newton with weights 1 / (1 + (d / 2 sigma)^2) (Cauchy's): wrong pairs lose their pull. `free` names what is
    fitted besides the rotation: scale, shape, centre, k.
    """
    moved = _mover(camera, R, free)
    n_free = len(_zeros(camera, free))
    pull = _prior(camera, prior, free) if priors else (np.zeros(n_free), np.zeros(n_free))
    p = np.zeros(n_free)
    for _ in range(STEPS):
        base, jacobian = _base_and_jacobian(moved, p, R, rays_icrs, free)
        residual = xy_px - base
        weight = 1.0 / (1.0 + np.sum(residual**2, axis=1) / (2 * sigma_px) ** 2) / sigma_px**2
        weighted = jacobian * weight[:, None, None]
        normal = np.einsum("nia,nib->ab", weighted, jacobian) + np.diag(pull[0])
        right = np.einsum("nia,ni->a", weighted, residual) + pull[0] * (pull[1] - p)
        step, *_ = np.linalg.lstsq(normal, right, rcond=1e-13)
        p = p + np.clip(step, -0.2, 0.2)
        if np.abs(step).max() < 1e-8:
            break
    camera, R = moved(p)
    return camera, R, np.linalg.norm(xy_px - _predicted(camera, R, rays_icrs), axis=1)


def _base_and_jacobian(
    moved: Callable[[Array], tuple[Camera, Array]], p: Array, R: Array, rays_icrs: Array, free: tuple[str, ...]
) -> tuple[Array, Array]:
    """Pixels (n, 2) of the stars and their derivatives (n, 2, parameters); R is the attitude of p = 0.

    One projection gives those of the rotation; scale and centre need none, only the lens's shape does.
    """
    camera, turned = moved(p)
    nudged = [R_from_rotvec(p[:3] + NUDGE * axis) @ R for axis in np.eye(3)]
    rays = rays_icrs @ np.stack([turned, *nudged]).transpose(0, 2, 1)
    px, _ = camera.project(rays)
    base = px[0]
    jacobian = np.empty((*base.shape, len(p)))
    jacobian[..., :3] = (px[1:] - base).transpose(1, 2, 0) / NUDGE
    at = 3
    for name in free:
        if name == "scale":
            jacobian[..., at] = base - camera.centre_px
            at += 1
        elif name == "centre":
            unmoved = moved(np.zeros(len(p)))[0].focal_px[0]  # the unit in which the centre moves
            jacobian[..., at : at + 2] = unmoved * np.eye(2)
            at += 2
        else:
            for _ in range(1 if name == "shape" else len(camera.lens.k)):
                q = p.copy()
                q[at] += NUDGE
                jacobian[..., at] = (moved(q)[0].project(rays[0])[0] - base) / NUDGE
                at += 1
    return base, jacobian


def _predicted(camera: Camera, R: Array, rays_icrs: Array) -> Array:
    return camera.project(rays_icrs @ R.T)[0]


def _zeros(camera: Camera, free: tuple[str, ...]) -> Array:
    sizes = {"scale": 1, "shape": 1, "centre": 2, "k": len(camera.lens.k)}
    return np.zeros(3 + sum(sizes[name] for name in free))


def _mover(camera: Camera, R: Array, free: tuple[str, ...]) -> Callable[[Array], tuple[Camera, Array]]:
    """A function of the parameters: rotation vector, then what is free, all dimensionless and zero at the start."""

    def moved(p: Array) -> tuple[Camera, Array]:
        rest = list(p[3:])
        focal, centre, lens = camera.focal_px[0], camera.centre_px, camera.lens
        for name in free:
            if name == "scale":
                focal = focal * float(np.exp(rest.pop(0)))
            elif name == "shape":
                lens = Family(float(np.clip(_shape(lens) + rest.pop(0), -1.2, 1.2)))
            elif name == "centre":
                centre = (centre[0] + rest.pop(0) * camera.focal_px[0], centre[1] + rest.pop(0) * camera.focal_px[0])
            else:
                lens = KannalaBrandt(tuple(k + rest.pop(0) for k in lens.k))
        return replace(camera, focal_px=(focal, focal), centre_px=centre, lens=lens), R_from_rotvec(p[:3]) @ R

    return moved


def _shape(lens: Lens) -> float:
    """Shape number of a lens of the family: no other has one to be fitted."""
    assert isinstance(lens, Family)
    return lens.shape


def _prior(camera: Camera, prior: Camera, free: tuple[str, ...]) -> tuple[Array, Array]:
    """Weights and values (relative to the start) of what is known beforehand of the free parameters."""
    weight, value = [0.0] * 3, [0.0] * 3
    for name in free:
        if name == "scale":
            weight.append(SCALE_SIGMA**-2)
            value.append(float(np.log(prior.focal_px[0] / camera.focal_px[0])))
        elif name == "shape":
            weight.append(SHAPE_SIGMA**-2)
            value.append(_shape(prior.lens) - _shape(camera.lens))
        elif name == "centre":
            weight += [CENTRE_SIGMA**-2] * 2
            value += [(a - b) / camera.focal_px[0] for a, b in zip(prior.centre_px, camera.centre_px, strict=True)]
        else:
            weight += [s**-2 for s in K_SIGMA[: len(camera.lens.k)]]
            value += [a - b for a, b in zip(prior.lens.k, camera.lens.k, strict=True)]
    return np.array(weight), np.array(value)


def as_polynomial(camera: Camera, order: int, widest_rad: float) -> Camera:
    """The camera with its family lens written as a Kannala-Brandt lens of `order` coefficients (or a pinhole)."""
    lens: Lens = camera.lens
    if getattr(lens, "shape", None) == PINHOLE:
        return replace(camera, lens=Pinhole())
    a = np.linspace(0.02, min(widest_rad, 0.98 * lens.max_invertible_rad), 200)
    powers = a[:, None] ** (2 * np.arange(order + 1) + 1)
    c, *_ = np.linalg.lstsq(powers, lens.rho(a), rcond=None)
    focal = camera.focal_px[0] * float(c[0])
    return replace(camera, lens=KannalaBrandt(tuple((c[1:] / c[0]).tolist())), focal_px=(focal, focal))
