"""What a camera's pixels and field measure on the sky, worked out once per camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import Camera
from startrack.identification.weak_cache import KeptPerObject


@dataclass(frozen=True)
class Scale:
    """Angular sizes [rad] of a pixel, on the axis and the largest anywhere and in any direction; the field [sr]."""

    on_axis: float
    largest: float
    field_sr: float  # of the image circle, or of the frame where that is smaller
    part_of_circle: float  # that the frame shows

    @property
    def diameter_rad(self) -> float:
        """Of a flat disc of the field's size."""
        return float(np.sqrt(4 * self.field_sr / np.pi))

    @classmethod
    def of(cls, camera: Camera) -> Scale:
        """Measured on grids of angles and pixels."""
        axis = camera.unproject(np.array([camera.centre_px]))[0]
        off_axis = np.arctan2(np.hypot(axis[0], axis[1]), axis[2]) + 0.01
        angle = np.linspace(0.01, min(camera.max_angle_rad, camera.lens.max_invertible_rad) - 1e-3, 64)
        focal = min(camera.focal_px)
        radial, across = 1.0 / camera.lens.slope(angle), np.sin(angle) / camera.lens.rho(angle)
        largest = min(1.05 * float(np.maximum(radial, across).max() / focal), 3.0 / focal)
        field_sr = _field_sr(camera)
        circle_sr = 2 * np.pi * (1 - np.cos(camera.max_angle_rad))
        return cls(
            float(camera.mean_scale_rad_per_px(off_axis)), largest, field_sr, min(float(field_sr / circle_sr), 1.0)
        )


def _field_sr(camera: Camera) -> float:
    width, height = camera.size_px
    x, y = np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 33))
    angle = camera.angle_rad(np.stack([x, y], axis=-1))
    cell = width * height / angle.size
    lit = angle < camera.max_angle_rad
    return float(np.sum(camera.pixel_solid_angle_sr(angle[lit]) * cell))


scale_of = KeptPerObject(Scale.of)
