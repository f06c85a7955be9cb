"""The camera: a lens with its decentring, a sensor and a mount. Rays to pixels and back, and what its parameters do."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from startrack.camera.lens import Lens
from startrack.camera.lenses import KannalaBrandt
from startrack.core.obstacles import Obstacles
from startrack.core.types import Array, BadInput, Bools, Mask
from startrack.frames import length_xy

MAX_DECENTRING_STEPS = 30  # of the inversion
DECENTRING_TOLERANCE_1 = 1e-14  # in focal lengths
MIN_THROUGHPUT_1 = 0.05  # relative to the axis, up to the calibrated angle: no light for evidence below it (3.3 mag)
# Body x (forward) = image top = -cam y, body y (left) = +cam x, body z (up) = +cam z: it looks at the zenith.
ZENITH_MOUNT_R_BODY_CAM = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
REFRACTION_REMOVED, REFRACTION_CONTAINED = "taken out", "contained"  # of the Earth's air, in a lens
CAP_POINTS = 400  # of a cap
GOLDEN_ANGLE_RAD = np.pi * (3.0 - np.sqrt(5.0))
SQUARE_PIXEL_SIGMA_1 = 1e-7  # relative sigma of fx / fy where they are fitted as one: just enough for an inverse


@dataclass(frozen=True)
class Decentring:
    """Shift by a decentred lens: (du, dv) = (2 p1 s t + p2 (a^2 + 2 s^2), p1 (a^2 + 2 t^2) + 2 p2 s t) [focal lengths].

    (s, t) = a (cos b, sin b), a the angle off the axis [rad]; added to rho (cos b, sin b). Brown's tangential
    distortion on the angles of a fisheye, as in COLMAP's THIN_PRISM_FISHEYE.

    Source: Brown 1966, Photogrammetric Engineering 32, 444.
    """

    p1: float = 0.0
    p2: float = 0.0

    def __bool__(self) -> bool:
        return bool(self.p1 or self.p2)

    def shift(self, st: Array) -> Array:
        """Shift (du, dv) (..., 2) [focal lengths] at the angles `st` = (s, t) (..., 2) [rad]."""
        s, t = st[..., 0], st[..., 1]
        a2 = s * s + t * t
        return np.stack(
            [2 * self.p1 * s * t + self.p2 * (a2 + 2 * s * s), self.p1 * (a2 + 2 * t * t) + 2 * self.p2 * s * t],
            axis=-1,
        )

    def gradient(self, st: Array) -> Array:
        """Derivative d (du, dv) / d (s, t) (..., 2, 2), symmetric, at the angles `st` (..., 2) [rad]."""
        s, t = st[..., 0], st[..., 1]
        across = 2 * (self.p1 * s + self.p2 * t)
        return np.stack(
            [
                np.stack([2 * self.p1 * t + 6 * self.p2 * s, across], axis=-1),
                np.stack([across, 6 * self.p1 * t + 2 * self.p2 * s], axis=-1),
            ],
            axis=-2,
        )

    def remove(self, uv: Array, angle_rad: Callable[[Array], Array]) -> Array:
        """Points (u, v) (..., 2) without the shift, from points `uv` with it [focal lengths], by fixed-point steps.

        `angle_rad` inverts the radial law.
        """
        if not self:
            return uv
        wanted = uv.reshape(-1, 2)
        found, moving = wanted.copy(), np.arange(len(wanted))  # those near the law's turning point move longest
        for _ in range(MAX_DECENTRING_STEPS):
            centred = found[moving]
            rho = np.hypot(centred[:, 0], centred[:, 1])
            st = centred * (angle_rad(rho) / np.where(rho > 0, rho, 1.0))[:, None]
            found[moving] = wanted[moving] - self.shift(st)
            moving = moving[np.abs(found[moving] - centred).max(axis=1) >= DECENTRING_TOLERANCE_1]
            if not len(moving):
                break
        return found.reshape(uv.shape)


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Sensor and whole optics: what turns light into numbers."""

    zero_point_e_per_s: float  # electrons per second of a V = 0 star on the axis, whole PSF
    gain_e_per_adu: float = 1.0
    bias_adu: float = 0.0
    read_noise_e: float = 0.0
    dark_e_per_s: float = 0.0  # per pixel
    saturation_adu: float = 65535.0
    psf_sigma_px: float = 1.0  # Gaussian, before integration over the pixel
    vignetting: tuple[float, float] = (0.0, 0.0)

    def throughput(self, angle_rad: Array) -> Array:
        """Relative throughput max(1 + v1 a^2 + v2 a^4, 0) at the angles a = `angle_rad` off the axis, any shape."""
        a2 = np.square(angle_rad)
        return np.maximum(1.0 + a2 * (self.vignetting[0] + a2 * self.vignetting[1]), 0.0)

    def lowest_throughput(self, angle_rad: float) -> float:
        """Smallest value of 1 + v1 a^2 + v2 a^4 from the axis to `angle_rad`; negative where the polynomial is."""
        v1, v2 = self.vignetting
        ends = [0.0, angle_rad**2]
        if v2 and 0 < -v1 / (2 * v2) < ends[1]:  # a^2 at the polynomial's extremum
            ends.append(-v1 / (2 * v2))
        return min(1.0 + a2 * (v1 + a2 * v2) for a2 in ends)


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A lens in front of a sensor, with its mount on the rover.

    x_px = cx + fx rho(a) cos b, y_px = cy + fy rho(a) sin b, b = atan2(y_cam, x_cam); mirrored: x_px = cx - fx ...

    A decentred lens adds its shift to rho (cos b, sin b). Pixel (0, 0) is the centre of the top-left pixel. Rays past
    90 degrees (z_cam <= 0) are legal.
    """

    name: str
    size_px: tuple[int, int]  # (W, H)
    focal_px: tuple[float, float]  # fx, fy: pixels per radian on the axis
    centre_px: tuple[float, float]
    max_angle_rad: float  # edge of the image circle
    calibrated_angle_rad: float  # beyond this the lens is not known
    lens: Lens = KannalaBrandt()  # noqa: RUF009 - frozen
    mirrored: bool = False
    decentring: Decentring = Decentring()
    R_body_cam: Array = field(default_factory=lambda: ZENITH_MOUNT_R_BODY_CAM)
    sensor: Sensor | None = None
    covariance_order: tuple[str, ...] = ()
    covariance: Array | None = None
    refraction: str = ""  # of the Earth's air: "contained" in the lens, or "taken out"; empty: not known
    mask: str | Mask | None = None  # path of the file, or the mask, of pixels that never show the sky
    obstacles: str | Obstacles | None = None  # path of the file, or themselves, about the body: what hides the sky
    notes: tuple[str, ...] = ()  # on the file of another program: what was chosen there, derived or left out

    @property
    def handed_focal_px(self) -> tuple[float, float]:
        """Focal lengths fx and fy [px], fx negative if the image is mirrored."""
        return (-self.focal_px[0] if self.mirrored else self.focal_px[0]), self.focal_px[1]

    def project(self, rays_cam: Array) -> tuple[Array, Bools]:
        """Pixels (..., 2) of `rays_cam` (..., 3), and which of them (...) are inside the image circle and the frame."""
        rays_cam = np.asarray(rays_cam, dtype=np.float64)
        off_axis = length_xy(rays_cam[..., 0], rays_cam[..., 1])
        angle = np.arctan2(off_axis, rays_cam[..., 2])
        imaged = angle <= min(self.max_angle_rad, self.lens.max_invertible_rad)
        px = self._pixels(rays_cam, off_axis, angle, self.lens.rho(np.where(imaged, angle, 0.0)))
        x, y = px[..., 0], px[..., 1]
        within = (x >= -0.5) & (y >= -0.5) & (x <= self.size_px[0] - 0.5) & (y <= self.size_px[1] - 0.5)
        return px, imaged & within

    def project_unlimited(self, rays_cam: Array) -> Array:
        """Pixels (..., 2) of `rays_cam` (..., 3) by the lens's formula alone, also beyond the image circle."""
        rays_cam = np.asarray(rays_cam, dtype=np.float64)
        off_axis = length_xy(rays_cam[..., 0], rays_cam[..., 1])
        angle = np.arctan2(off_axis, rays_cam[..., 2])
        return self._pixels(rays_cam, off_axis, angle, self.lens.rho(angle))

    def _pixels(self, rays_cam: Array, off_axis: Array, angle_rad: Array, rho: Array) -> Array:
        """Pixels (..., 2) of `rays_cam` (..., 3) with the angle (...) [rad] off the axis and its radius `rho` (...)."""
        per_off_axis = 1.0 / np.where(off_axis > 0, off_axis, 1.0)
        scale = rho * per_off_axis
        u, v = scale * rays_cam[..., 0], scale * rays_cam[..., 1]
        if self.decentring:
            shift = self.decentring.shift((angle_rad * per_off_axis)[..., None] * rays_cam[..., :2])
            u, v = u + shift[..., 0], v + shift[..., 1]
        fx, fy = self.handed_focal_px
        px = np.empty((*u.shape, 2))
        px[..., 0], px[..., 1] = self.centre_px[0] + fx * u, self.centre_px[1] + fy * v
        return px

    def unproject(self, px: Array) -> Array:
        """Unit rays_cam (..., 3) of the pixels `px` (..., 2): the exact inverse of `project`."""
        u, v = self.radial(px)
        rho = length_xy(u, v)
        angle = self.lens.angle_rad(rho)
        scale = np.sin(angle) / np.where(rho > 0, rho, 1.0)
        rays = np.empty((*rho.shape, 3))
        rays[..., 0], rays[..., 1], rays[..., 2] = u * scale, v * scale, np.cos(angle)
        return rays

    def angle_rad(self, px: Array) -> Array:
        """Angle (...) off the axis [rad] of the pixels `px` (..., 2)."""
        return self.lens.angle_rad(length_xy(*self.radial(px)))

    def radial(self, px: Array) -> tuple[Array, Array]:
        """Image points u, v (...) [focal lengths] of pixels `px` (..., 2): rho (cos b, sin b), decentring removed."""
        px = np.asarray(px, dtype=np.float64)
        fx, fy = self.handed_focal_px
        u, v = (px[..., 0] - self.centre_px[0]) / fx, (px[..., 1] - self.centre_px[1]) / fy
        if self.decentring:
            uv = self.decentring.remove(np.stack([u, v], axis=-1), self.lens.angle_rad)
            u, v = uv[..., 0], uv[..., 1]
        return u, v

    def jacobian_px_per_rad(self, rays_cam: Array) -> Array:
        """Derivative d px / d w (..., 2, 3) by a rotation w of the unit `rays_cam` (..., 3): ray -> ray + w x ray.

        From x_px = cx + fx rho(a) u with u = (x, y) / s, s = sin a:  d(rho u) = u rho' da + (rho / s) v (v . d(x, y)),
        v across u, da = z u . d(x, y) - s dz.
        """
        rays_cam = np.asarray(rays_cam, dtype=np.float64)
        x, y, z = rays_cam[..., 0], rays_cam[..., 1], rays_cam[..., 2]
        s = length_xy(x, y)
        angle = np.arctan2(s, z)
        off_axis = s > 1e-12
        divisor = np.where(off_axis, s, 1.0)
        ux, uy = np.where(off_axis, x / divisor, 1.0), np.where(off_axis, y / divisor, 0.0)
        slope = self.lens.slope(angle)
        ratio = np.where(off_axis, self.lens.rho(angle) / divisor, slope)
        by_ray = _polar_by_ray(slope * z, ratio, slope * s, ux, uy)
        if self.decentring:  # d (s, t): as for rho, with rho = a
            ratio = np.divide(angle, s, out=np.ones_like(s), where=off_axis)
            gradient = np.moveaxis(self.decentring.gradient(np.stack([angle * ux, angle * uy], axis=-1)), -1, 0)
            of_angles = _polar_by_ray(z, ratio, s, ux, uy)
            by_ray = by_ray + sum(np.moveaxis(gradient[k], -1, 0)[:, None] * of_angles[k] for k in (0, 1))
        by_rotation = np.empty_like(by_ray)  # by_ray x ray
        for row, by_one, focal_px in zip(by_rotation, by_ray, self.handed_focal_px, strict=True):
            dx, dy, dz = focal_px * by_one
            row[0], row[1], row[2] = dz * y - dy * z, dx * z - dz * x, dy * x - dx * y
        return np.moveaxis(by_rotation, (0, 1), (-2, -1))

    def pixel_solid_angle_sr(self, angle_rad: Array) -> Array:
        """Solid angle [sr] of one pixel at the angles a = `angle_rad` off the axis, any shape.

        It is sin a / (rho rho' fx fy). Decentring (a part in a thousand) is neglected.
        """
        a = np.maximum(np.asarray(angle_rad, dtype=np.float64), 1e-9)
        return np.sin(a) / (self.lens.rho(a) * self.lens.slope(a) * self.focal_px[0] * self.focal_px[1])

    def mean_scale_rad_per_px(self, angle_rad: Array) -> Array:
        """Geometric-mean angular size [rad] of one pixel at the angles `angle_rad` off the axis, any shape."""
        return np.sqrt(self.pixel_solid_angle_sr(angle_rad))

    def projection_sigma_px(self, rays_cam: Array) -> Array:
        """Sigma per axis [px] (...) of the projected `rays_cam` (..., 3), from the covariance; 0 without one.

        The part that a rotation of the camera compensates is removed: the attitude, found with this camera, absorbs
        it. Beyond the calibrated angle it is the uncertainty of the fitted law, not of the real lens.
        """
        variance_px2 = np.trace(projection_covariance_px2(self, rays_cam), axis1=-2, axis2=-1) / 2.0
        return np.sqrt(np.maximum(variance_px2, 0.0))  # below zero by rounding


def _polar_by_ray(along: Array, across: Array, down: Array, ux: Array, uy: Array) -> Array:
    """Derivative (2, 3, ...) of r u by the ray, u = (ux, uy): `along` u, `across` it, and -`down` u along the axis."""
    mixed = (along - across) * ux * uy
    return np.array([
        [along * ux * ux + across * uy * uy, mixed, -down * ux],
        [mixed, along * uy * uy + across * ux * ux, -down * uy],
    ])  # fmt: skip


def lens_jacobian(camera: Camera, rays_cam: Array, order: tuple[str, ...]) -> Array:
    """Derivatives d px / d parameter (..., 2, m) at `rays_cam` (..., 3), for the m parameters of `camera` in `order`.

    Names: f (both focal lengths, their ratio kept), fx, fy, cx, cy, those of the lens (k1 to k4), and p1 and p2 of the
    decentring [px per px, or px per 1]. Raises ValueError for a name that the lens does not have.
    """
    rays_cam = np.asarray(rays_cam, dtype=np.float64)
    off_axis = np.hypot(rays_cam[..., 0], rays_cam[..., 1])
    angle = np.arctan2(off_axis, rays_cam[..., 2])
    per_off_axis = np.divide(1.0, off_axis, out=np.zeros_like(off_axis), where=off_axis > 0)
    u = rays_cam[..., 0] * per_off_axis, rays_cam[..., 1] * per_off_axis
    st = np.stack([angle * u[0], angle * u[1]], axis=-1)
    rho, shift = camera.lens.rho(angle), camera.decentring.shift(st)
    uv = rho * u[0] + shift[..., 0], rho * u[1] + shift[..., 1]  # image point [focal lengths]
    handed_px, sign, (fx, fy) = camera.handed_focal_px, -1.0 if camera.mirrored else 1.0, camera.focal_px
    by_name = {
        "f": (sign * uv[0], fy / fx * uv[1]), "fx": (sign * uv[0], 0.0), "fy": (0.0, uv[1]), "cx": (1.0, 0.0),
        "cy": (0.0, 1.0),
    }  # fmt: skip
    jacobian = np.empty((len(order), 2, *angle.shape))
    for column, name in zip(jacobian, order, strict=True):
        if name in by_name:
            column[0], column[1] = by_name[name]
            continue
        if name in ("p1", "p2"):
            du, dv = np.moveaxis(Decentring(float(name == "p1"), float(name == "p2")).shift(st), -1, 0)
        else:
            radial = camera.lens.derivative(name, angle)
            du, dv = radial * u[0], radial * u[1]
        column[0], column[1] = handed_px[0] * du, handed_px[1] * dv
    return np.moveaxis(jacobian, (0, 1), (-1, -2))


def require_not_mirrored(camera: Camera) -> None:
    """Raise BadInput (bad_calibration) for a mirrored `camera`, which files of other programs cannot hold."""
    if camera.mirrored:
        raise BadInput(
            "bad_calibration",
            "the camera is mirrored, which no other program's format can express: flip the images left to right and "
            "calibrate those",
        )


def cap_grid(angle_rad: float, points: int = CAP_POINTS) -> Array:
    """Rays (`points`, 3) spread evenly in solid angle over the cap within `angle_rad` of the axis."""
    i = np.arange(points) + 0.5
    z = 1.0 - (1.0 - np.cos(angle_rad)) * i / points
    r = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    return np.stack([r * np.cos(GOLDEN_ANGLE_RAD * i), r * np.sin(GOLDEN_ANGLE_RAD * i), z], axis=-1)


def difference_px(one: Camera, other: Camera, rays_cam: Array) -> Array:
    """Pixels (n, 2) of `other` minus those of `one` at `rays_cam` (n, 3), the best rotation between them removed."""
    change = (other.project_unlimited(rays_cam) - one.project_unlimited(rays_cam)).reshape(-1)
    by_rotation = one.jacobian_px_per_rad(rays_cam).reshape(-1, 3)
    rest = change - by_rotation @ np.linalg.lstsq(by_rotation, change, rcond=None)[0]
    return np.asarray(rest.reshape(-1, 2), dtype=np.float64)


def compensating_rotation(camera: Camera, order: tuple[str, ...]) -> Array:
    """Rotation (3, m) of the camera [rad per parameter] that best compensates a change of each parameter in `order`.

    Least squares over the calibrated cap, evenly in solid angle. An image's attitude is found with the same camera, so
    that this part of a lens error does not reach a prediction.
    """
    grid = cap_grid(camera.calibrated_angle_rad)
    rotation = camera.jacobian_px_per_rad(grid).reshape(-1, 3)
    lens = lens_jacobian(camera, grid, order).reshape(-1, len(order))
    return np.asarray(-np.linalg.lstsq(rotation, lens, rcond=None)[0], dtype=np.float64)


def projection_covariance_px2(camera: Camera, rays_cam: Array) -> Array:
    """Covariance (..., 2, 2) [px^2] of the `rays_cam` (..., 3) that a `camera` projects, best rotation removed.

    It is 0 where the camera's covariance is not known.
    """
    rays_cam = np.asarray(rays_cam, dtype=np.float64)
    if camera.covariance is None:
        return np.zeros((*rays_cam.shape[:-1], 2, 2))
    order = camera.covariance_order
    jacobian = lens_jacobian(camera, rays_cam, order)
    jacobian = jacobian + camera.jacobian_px_per_rad(rays_cam) @ compensating_rotation(camera, order)
    return jacobian @ camera.covariance @ np.swapaxes(jacobian, -1, -2)


def with_update(camera: Camera, step: Mapping[str, float]) -> Camera:
    """Copy of the `camera` with `step` added to its parameters, by name; parameters that are not named stay."""
    fx, fy = camera.focal_px
    scale = 1.0 + step.get("f", 0.0) / fx
    p1, p2 = camera.decentring.p1 + step.get("p1", 0.0), camera.decentring.p2 + step.get("p2", 0.0)
    return replace(
        camera,
        focal_px=(float(fx * scale + step.get("fx", 0.0)), float(fy * scale + step.get("fy", 0.0))),
        centre_px=(float(camera.centre_px[0] + step.get("cx", 0.0)), float(camera.centre_px[1] + step.get("cy", 0.0))),
        lens=camera.lens.with_update(step),
        decentring=Decentring(float(p1), float(p2)),
    )


def with_covariance(camera: Camera, free: tuple[str, ...], covariance: Array) -> Camera:
    """Copy of `camera` with the `covariance` (m, m) of `free` parameters; f becomes fx and fy; fy may be free too."""
    if free[0] == "fx":
        return replace(camera, covariance_order=free, covariance=0.5 * (covariance + covariance.T))
    names = ("fx", "fy", *(name for name in free if name not in ("f", "fy")))
    by_free = np.array([[float(name == one) for one in free] for name in names])  # d names / d free
    by_free[0, 0], by_free[1, 0] = 1.0, camera.focal_px[1] / camera.focal_px[0]
    wide = by_free @ covariance @ by_free.T
    # With fx / fy exactly known the matrix would be singular, and no use as a weight.
    wide[[0, 1], [0, 1]] += 0.5 * (SQUARE_PIXEL_SIGMA_1 * camera.focal_px[0]) ** 2
    return replace(camera, covariance_order=names, covariance=0.5 * (wide + wide.T))
