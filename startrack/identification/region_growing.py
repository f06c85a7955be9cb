"""Growth of a lens hypothesis: from the triangle where it fits to the whole field; the view of a narrow field."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera, Pinhole, default_lens, lens_kinds
from startrack.core.types import Array, Bools, Ints
from startrack.estimation.adjust import Prior, Scheme, State, adjust, cauchy_loss
from startrack.estimation.false_alarm import log_p_value_bound
from startrack.estimation.match import match_mutual
from startrack.estimation.normal_equations import observations_of_image
from startrack.estimation.pinhole_fit import HALF_WEIGHT_CHI2, fit_pinhole
from startrack.identification.attitude_search import INLIER_PX
from startrack.identification.lens_guesses import unknown_camera

REGION_ROUNDS = 2  # of matching and fitting within a stage
FEWEST = 5  # matches
GATE_OVER_SIGMA = 4.0  # the gate over the sigma of the loss
MATCH_LOSS = cauchy_loss(HALF_WEIGHT_CHI2)
LENGTH_SIGMAS = {"f": 0.1, "fy": 0.1, "cx": 0.06, "cy": 0.06}  # prior sigmas in focal lengths; "fy": of fy - fx
# Of the family, of the polynomial, and of decentring, which also describes refraction that differs over a narrow field.
PRIOR_SIGMAS = {"shape": 0.5, "k1": 0.1, "k2": 0.1, "k3": 0.05, "k4": 0.02, "p1": 0.002, "p2": 0.002}
STARS_PER_DETECTION = 1.5
SAME_RADIUS_1 = 1e-12  # relative difference of the radii of lenses that are the same
TANGENT = (1 / 3, 2 / 15, 17 / 315, 62 / 2835)  # series of tan a beyond a: to 1e-7 up to 20 degrees
WHOLE_LENS = ("f", "fy", "shape", "cx", "cy")
FIT = Scheme(loss=MATCH_LOSS, steps=4, settled_px=1e-3)


@dataclass(frozen=True)
class GrowthStage:
    """One step of the growth: which stars take part, the gate, and the fitted parameters."""

    radius_rad: float  # about the triangle of the hypothesis
    gate_rad: float
    detections: int  # brightest that take part
    free: tuple[str, ...]  # lens parameters that are fitted with the attitude
    most_log_p: float  # log p-value bound above which the hypothesis is given up


WIDE_STAGES = (
    GrowthStage(np.radians(45.0), np.radians(2.0), 60, ("f",), 0.0),
    GrowthStage(np.radians(70.0), np.radians(2.0), 60, WHOLE_LENS, -3.0),
    GrowthStage(np.pi, np.radians(2.0), 80, WHOLE_LENS, -6.0),
    GrowthStage(np.pi, np.radians(1.0), 120, WHOLE_LENS, -10.0),
    GrowthStage(np.pi, np.radians(0.6), 200, WHOLE_LENS, -14.0),
)


@dataclass(frozen=True)
class LensHypothesis:
    """A camera with a lens of the family and an attitude, good near the direction `middle_cam`."""

    camera: Camera
    R_cam_icrs: Array  # (3, 3)
    middle_cam: Array  # (3,)
    log_p: float


def grow(
    hypothesis: LensHypothesis, xy_px: Array, rays_icrs: Array, stages: tuple[GrowthStage, ...]
) -> tuple[Camera, Array, int] | None:
    """Camera, attitude and number of matches after all stages; None where the hypothesis is given up.

    The detections (n, 2) and the stars (m, 3) are sorted, brightest first.
    """
    camera, R = hypothesis.camera, hypothesis.R_cam_icrs
    middle_icrs = hypothesis.middle_cam @ R
    for stage in stages:
        some = xy_px[: stage.detections]
        for _ in range(REGION_ROUNDS):
            gate_px = max(stage.gate_rad * camera.focal_px[0], INLIER_PX)
            near = (middle_icrs, stage.radius_rad)
            detection, star, predicted = match_in_view(camera, R, some, rays_icrs, gate_px, near)
            if len(star) < FEWEST:
                return None
            camera, R, distance = fit_camera(
                camera, R, some[detection], rays_icrs[star], stage.free, gate_px / GATE_OVER_SIGMA, hypothesis.camera
            )
        # The detections' density in the rectangle between their 5th and 95th percentiles.
        area_px2 = float(np.prod(np.ptp(np.percentile(some, (5, 95), axis=0), axis=0)) / 0.81) + 1.0
        if log_p_value_bound(distance, gate_px, predicted, len(some) / area_px2) > stage.most_log_p:
            return None
    return camera, R, len(star)


def match_in_view(
    camera: Camera, R: Array, xy_px: Array, rays_icrs: Array, gate_px: float, near: tuple[Array, float] | None = None
) -> tuple[Ints, Ints, int]:
    """Mutually nearest (detection, star) within the gate, and the number of stars predicted.

    About as many of the brightest stars in view take part as there are detections (n, 2). `near`: only stars about
    this direction (3,) in ICRS, up to this angle [rad].
    """
    wanted = int(STARS_PER_DETECTION * len(xy_px)) + 5
    count = wanted
    while True:
        count *= 4
        some = np.flatnonzero(camera.project(rays_icrs[:count] @ R.T)[1])[:wanted]
        if len(some) == wanted or count >= len(rays_icrs):
            break
    if near is not None:
        some = some[rays_icrs[some] @ near[0] > np.cos(near[1])]
    if not len(some):
        return some, some, 0
    detection, star = match_mutual(xy_px, camera.project(rays_icrs[some] @ R.T)[0], gate_px)
    return detection, some[star], len(some)


def fit_camera(
    camera: Camera, R: Array, xy_px: Array, rays_icrs: Array, free: tuple[str, ...], sigma_px: float, prior: Camera
) -> tuple[Camera, Array, Array]:
    """Camera and attitude fitted to matches (n, 2) and (n, 3), some of them wrong; and the distances left (n,) [px].

    `sigma_px`: scale of the loss. `prior`: the camera before any fit.
    """
    n = len(xy_px)
    points = observations_of_image(xy_px, np.tile(sigma_px**2 * np.eye(2), (n, 1, 1)), rays_icrs)
    found = adjust(State(camera=camera, R_cam_icrs=R[None]), points, free, FIT, prior=prior_of(camera, prior, free))
    return found.state.camera, found.state.R_cam_icrs[0], np.linalg.norm(found.residual_px, axis=1)


def prior_of(camera: Camera, prior: Camera, free: tuple[str, ...]) -> Prior:
    """Prior of the free parameters: expected at the camera `prior`, the adjustment starting at `camera`."""
    sigma = PRIOR_SIGMAS | {name: part * prior.focal_px[0] for name, part in LENGTH_SIGMAS.items()}
    now, expected = (
        {
            "f": c.focal_px[0], "fy": c.focal_px[1] - c.focal_px[0], "cx": c.centre_px[0], "cy": c.centre_px[1],
            "p1": c.decentring.p1, "p2": c.decentring.p2, **c.lens.parameters,
        }
        for c in (camera, prior)
    )  # fmt: skip
    return Prior(np.array([sigma[n] for n in free]), np.array([expected[n] - now[n] for n in free]))


def with_file_lens(camera: Camera, size: int, widest_rad: float) -> Camera:
    """The camera with its family lens replaced by one of camera files.

    A lens of fixed shape if it has the same radii up to `widest_rad`, else the default one, with the
    `size` coefficients that fit them best.
    """
    a = np.linspace(0.02, min(widest_rad, 0.98 * camera.lens.max_invertible_rad), 200)
    rho = camera.lens.rho(a)
    for kind in lens_kinds().values():
        if not kind.parameter_names and np.allclose(kind().rho(a), rho, rtol=SAME_RADIUS_1, atol=0.0):
            return replace(camera, lens=kind())
    lens, scale = default_lens().fit_curve(a, rho, size)
    fx, fy = camera.focal_px
    return replace(camera, lens=lens, focal_px=(scale * fx, scale * fy))


@dataclass(frozen=True)
class PinholeView:
    """Attitude, focal length and one distortion term of a narrow field's frame (W, H), the axis in its centre."""

    R_cam_icrs: Array
    focal_px: float
    mirrored: bool
    size_px: tuple[int, int]
    distortion: float  # of the radius [focal lengths] per cube of the angle off the axis, beyond the tangent

    @property
    def centre_px(self) -> Array:
        """(2,)"""
        return 0.5 * (np.array(self.size_px) - 1.0)

    def project(self, rays_icrs: Array) -> tuple[Array, Bools]:
        """Pixels (n, 2) of rays (n, 3) less than 90 degrees off the axis, and which lie in the frame."""
        cam = rays_icrs @ self.R_cam_icrs.T
        plane = cam[:, :2] / np.maximum(cam[:, 2], 1e-6)[:, None]
        focal_px = np.array([-self.focal_px if self.mirrored else self.focal_px, self.focal_px])
        ratio = np.ones(len(plane))  # of the radius to that of a pinhole
        if self.distortion:
            radius = np.sqrt(np.einsum("ni,ni->n", plane, plane))
            ratio += self.distortion * (np.arctan(radius) ** 3 / np.maximum(radius, 1e-12))
        px = np.asarray(plane * ratio[:, None] * focal_px + self.centre_px)
        half = 0.5 * np.array(self.size_px)
        return px, (np.abs(px - self.centre_px) <= half).all(axis=1) & (cam[:, 2] > 0)

    def fit(self, xy_px: Array, rays_icrs: Array, sigma_px: float, distorted: bool, steps: int = 1) -> PinholeView:
        """The view fitted to the stars (n, 3) at the pixels (n, 2), some of them wrong, with a loss of this scale.

        `distorted`: whether the lens may differ from a pinhole.
        """
        R, lens = self.R_cam_icrs.copy(), np.array([self.focal_px, self.distortion])
        mirror = -1.0 if self.mirrored else 1.0
        fit_pinhole(xy_px, rays_icrs, self.centre_px, mirror, sigma_px, steps, distorted, R, lens)
        return replace(self, R_cam_icrs=R, focal_px=float(lens[0]), distortion=float(lens[1]))

    def camera(self) -> Camera:
        """The camera, as wide as its frame."""
        tangent = (TANGENT[0] + self.distortion, *TANGENT[1:])
        lens = default_lens()(tangent) if self.distortion else Pinhole()
        x, y = self.centre_px.tolist()
        camera = unknown_camera(self.size_px, self.focal_px, (x, y), lens, self.mirrored)
        corner = float(camera.angle_rad(np.array([-0.5, -0.5])))
        return replace(camera, max_angle_rad=corner, calibrated_angle_rad=corner)
