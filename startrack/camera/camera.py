"""The camera: a lens, a sensor and a mount. Rays to pixels and back."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from startrack.camera.decentring import Decentring
from startrack.camera.kannala_brandt import KannalaBrandt
from startrack.camera.lens import Lens
from startrack.core.types import Array, Bools, Mask
from startrack.frames import length_xy, off_axis_rad

# Body x (forward) = image top = -cam y, body y (left) = +cam x, body z (up) = +cam z: it looks at the zenith.
ZENITH_MOUNT_R_BODY_CAM = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

MIN_THROUGHPUT_1 = 0.05  # relative to the axis, up to the calibrated angle: no light for evidence below it (3.3 mag)


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Sensor and whole optics: from light to numbers."""

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
    decentring: Decentring = Decentring()  # noqa: RUF009 - frozen
    R_body_cam: Array = field(default_factory=lambda: ZENITH_MOUNT_R_BODY_CAM)
    sensor: Sensor | None = None
    covariance_order: tuple[str, ...] = ()
    covariance: Array | None = None
    mask: str | Mask | None = None  # path of the file, or the mask, of pixels that never show the sky

    @property
    def handed_focal_px(self) -> tuple[float, float]:
        """(fx, fy), fx negative if the image is mirrored."""
        return (-self.focal_px[0] if self.mirrored else self.focal_px[0]), self.focal_px[1]

    def project(self, rays_cam: Array) -> tuple[Array, Bools]:
        """Pixels (..., 2) of `rays_cam` (..., 3), and which of them (...) are inside the image circle and the frame."""
        rays_cam = np.asarray(rays_cam, dtype=np.float64)
        angle = off_axis_rad(rays_cam)
        imaged = angle <= min(self.max_angle_rad, self.lens.max_invertible_rad)
        px = self._pixels(rays_cam, angle, self.lens.rho(np.where(imaged, angle, 0.0)))
        x, y = px[..., 0], px[..., 1]
        within = (x >= -0.5) & (y >= -0.5) & (x <= self.size_px[0] - 0.5) & (y <= self.size_px[1] - 0.5)
        return px, imaged & within

    def project_unlimited(self, rays_cam: Array) -> Array:
        """Pixels (..., 2) of `rays_cam` (..., 3) by the lens's formula alone, also beyond the image circle."""
        rays_cam = np.asarray(rays_cam, dtype=np.float64)
        angle = off_axis_rad(rays_cam)
        return self._pixels(rays_cam, angle, self.lens.rho(angle))

    def _pixels(self, rays_cam: Array, angle_rad: Array, rho: Array) -> Array:
        off_axis = length_xy(rays_cam[..., 0], rays_cam[..., 1])
        per_off_axis = 1.0 / np.where(off_axis > 0, off_axis, 1.0)
        scale = rho * per_off_axis
        u, v = scale * rays_cam[..., 0], scale * rays_cam[..., 1]
        if self.decentring:
            shift = self.decentring.shift((angle_rad * per_off_axis)[..., None] * rays_cam[..., :2])
            u, v = u + shift[..., 0], v + shift[..., 1]
        fx, fy = self.handed_focal_px
        return np.stack([self.centre_px[0] + fx * u, self.centre_px[1] + fy * v], axis=-1)

    def unproject(self, px: Array) -> Array:
        """Unit rays_cam (..., 3) of the pixels `px` (..., 2): the exact inverse of `project`."""
        u, v = self.radial(px)
        rho = length_xy(u, v)
        angle = self.lens.angle_rad(rho)
        scale = np.sin(angle) / np.where(rho > 0, rho, 1.0)
        return np.stack([u * scale, v * scale, np.cos(angle)], axis=-1)

    def angle_rad(self, px: Array) -> Array:
        """Angle (...) off the axis [rad] of the pixels `px` (..., 2)."""
        return self.lens.angle_rad(length_xy(*self.radial(px)))

    def radial(self, px: Array) -> tuple[Array, Array]:
        """u, v = rho (cos b, sin b) of the pixels `px` (..., 2), decentring removed."""
        px = np.asarray(px, dtype=np.float64)
        fx, fy = self.handed_focal_px
        u, v = (px[..., 0] - self.centre_px[0]) / fx, (px[..., 1] - self.centre_px[1]) / fy
        if self.decentring:
            uv = self.decentring.remove(np.stack([u, v], axis=-1), self.lens.angle_rad)
            u, v = uv[..., 0], uv[..., 1]
        return u, v

    def jacobian_px_per_rad(self, rays_cam: Array) -> Array:
        """d px / d w (..., 2, 3) for a small rotation w of the unit `rays_cam` (..., 3): ray -> ray + w x ray.

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
        along = slope * z
        by_ray = np.stack(
            [
                np.stack([along * ux * ux + ratio * uy * uy, (along - ratio) * ux * uy, -slope * s * ux], axis=-1),
                np.stack([(along - ratio) * ux * uy, along * uy * uy + ratio * ux * ux, -slope * s * uy], axis=-1),
            ],
            axis=-2,
        )
        if self.decentring:
            by_ray = by_ray + self._decentred_by_ray(x, y, z, s, angle, ux, uy)
        zero = np.zeros_like(x)
        by_rotation = np.stack(
            [np.stack([zero, z, -y], axis=-1), np.stack([-z, zero, x], axis=-1), np.stack([y, -x, zero], axis=-1)],
            axis=-2,
        )
        return (by_ray @ by_rotation) * np.array(self.handed_focal_px)[:, None]

    def _decentred_by_ray(self, x: Array, y: Array, z: Array, s: Array, angle: Array, ux: Array, uy: Array) -> Array:
        """d shift / d ray (..., 2, 3): d(s, t) = u da + (a / sin a) v (v . d(x, y)), as for rho."""
        ratio = np.divide(angle, s, out=np.ones_like(s), where=s > 1e-12)
        by_angle = np.stack(
            [
                np.stack([z * ux * ux + ratio * uy * uy, (z - ratio) * ux * uy, -s * ux], axis=-1),
                np.stack([(z - ratio) * ux * uy, z * uy * uy + ratio * ux * ux, -s * uy], axis=-1),
            ],
            axis=-2,
        )
        return self.decentring.gradient(np.stack([angle * ux, angle * uy], axis=-1)) @ by_angle

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
        from startrack.camera.uncertainty import projection_covariance_px2

        variance_px2 = np.trace(projection_covariance_px2(self, rays_cam), axis1=-2, axis2=-1) / 2.0
        return np.sqrt(np.maximum(variance_px2, 0.0))  # below zero by rounding
