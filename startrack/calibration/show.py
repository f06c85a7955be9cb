"""What a camera file says, for people."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.camera import Camera, camera_to_dict
from startrack.types import Array

STEPS = 10


def facts(camera: Camera) -> dict[str, Any]:
    """The file's keys, and the map by angle: radius, scale, and sigma where the file has a covariance."""
    angle = np.linspace(0.0, camera.calibrated_angle_rad, STEPS)
    radius, scale, sigma = by_angle(camera, angle)
    rows = [
        {
            "angle_deg": float(np.degrees(a)),
            "radius_px": float(r),
            "arcmin_per_px": float(s),
            "map_sigma_px": None if camera.covariance is None else float(e),
        }
        for a, r, s, e in zip(angle, radius, scale, sigma, strict=True)
    ]
    return {"camera": camera_to_dict(camera), "map": rows}


def by_angle(camera: Camera, angle_rad: Array) -> tuple[Array, Array, Array]:
    """Radius [px], scale [arcmin / px] and map sigma per axis [px], each (n,), at the angles (n,) off the axis.

    Sigma is the RMS over eight directions.
    """
    turn = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
    rays = np.stack(
        [
            np.sin(angle_rad)[:, None] * np.cos(turn),
            np.sin(angle_rad)[:, None] * np.sin(turn),
            np.cos(angle_rad)[:, None] * np.ones_like(turn),
        ],
        axis=-1,
    )
    sigma = np.sqrt(np.mean(np.square(camera.projection_sigma_px(rays)), axis=1))
    radius = np.sqrt(np.prod(camera.focal_px)) * camera.lens.rho(angle_rad)
    return radius, np.degrees(camera.mean_scale_rad_per_px(np.maximum(angle_rad, 1e-6))) * 60.0, sigma


def camera_text(camera: Camera) -> str:
    """Several lines."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    lines = [
        f"{camera.name}: {camera.lens.model}, {camera.size_px[0]} x {camera.size_px[1]} px"
        + (", mirrored" if camera.mirrored else ""),
        f"  focal length {fx:.3f}, {fy:.3f} px/rad; centre {cx:.3f}, {cy:.3f} px"
        + "".join(f"; {name} {value:.6g}" for name, value in camera.lens.parameters.items())
        + (f"; decentring {camera.decentring.p1:.3g}, {camera.decentring.p2:.3g}" if camera.decentring else ""),
        f"  image circle to {np.degrees(camera.max_angle_rad):.2f}°, calibrated to "
        f"{np.degrees(camera.calibrated_angle_rad):.2f}°; "
        + ("no covariance" if camera.covariance is None else "with covariance"),
        "  angle °   radius px   arcmin/px   map sigma px",
    ]
    for row in facts(camera)["map"]:
        sigma = "-" if row["map_sigma_px"] is None else f"{row['map_sigma_px']:.3f}"
        lines.append(f"  {row['angle_deg']:7.2f} {row['radius_px']:11.2f} {row['arcmin_per_px']:11.3f} {sigma:>14}")
    if camera.sensor is not None:
        lines += ["  sensor:", *(f"    {key} = {value}" for key, value in vars(camera.sensor).items())]
    else:
        lines.append("  sensor: not known")
    return "\n".join(lines)
