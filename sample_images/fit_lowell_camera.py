"""Fit the camera file of the Lowell photograph, calib/lowell-ldt.toml: `python sample_images/fit_lowell_camera.py`.

Matched stars (their pixels, and their directions with the atmosphere's refraction) give centre, focal length and
k1..k4: first with a robust loss, then plainly without the rows that are clearly wrong. An approximate camera, from one
frame: nothing is known of the lens beyond the stars' 82 degrees off axis, and nothing of the sensor (no [sensor]).
"""

import csv
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from startrack.camera import Camera, KannalaBrandt, save_camera
from startrack.frames import R_from_rotvec, rays_from_azel, wahba

ROOT = Path(__file__).resolve().parent.parent
STARS = ROOT / "tests/data/lowell-2018-08-06-stars.csv"
CAMERA = ROOT / "calib/lowell-ldt.toml"
HEAD = """# The all-sky camera of the Lowell Discovery Telescope, from one photograph of 2018-08-06: approximate.
# Made by sample_images/fit_lowell_camera.py from {used} of {given} matched stars; rms {rms:.2f} px per axis.
"""
START = (330.0, 695.5, 519.5, 0.0, 0.0, 0.0, 0.0)  # focal length, centre of the frame, k1..k4
STEP = (0.01, 0.01, 0.01, 1.0, 1.0, 1.0, 0.01, 0.01, 0.01, 0.01)  # of turn, focal length, centre, k
WRONG_ROW_PX = 2.0


def camera(focal_px: float, x_px: float, y_px: float, *k: float) -> Camera:
    """The camera of the fitted numbers; 90 degrees is where the lens's picture of the horizon ends."""
    return Camera(
        name="lowell-ldt",
        size_px=(1392, 1040),
        focal_px=(focal_px, focal_px),
        centre_px=(x_px, y_px),
        max_angle_rad=np.radians(90.0),
        calibrated_angle_rad=np.radians(82.0),
        lens=KannalaBrandt(k),
    )


def read_stars(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Rays (n, 3) in enu as the atmosphere shows them, and pixels (n, 2)."""
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    azimuth, altitude, x, y = (
        np.array([float(row[key]) for row in rows]) for key in ("az_deg", "alt_deg_refracted", "x_px", "y_px")
    )
    return rays_from_azel(np.radians(azimuth), np.radians(altitude)), np.stack([x, y], axis=1)


def fit(rays_enu: np.ndarray, px: np.ndarray) -> tuple[Camera, np.ndarray]:
    """The camera, and the distance [px] (n,) of each star from where it should be."""
    R_cam_enu = wahba(camera(*START).unproject(px), rays_enu, np.ones(len(px)))

    def miss(p: np.ndarray) -> np.ndarray:
        return camera(*p[3:]).project(rays_enu @ (R_from_rotvec(p[:3]) @ R_cam_enu).T)[0] - px

    robust = least_squares(
        lambda p: miss(p).ravel(), (0.0, 0.0, 0.0, *START), loss="soft_l1", f_scale=0.5, x_scale=STEP
    )
    right = np.linalg.norm(miss(robust.x), axis=1) < WRONG_ROW_PX
    plain = least_squares(lambda p: miss(p)[right].ravel(), robust.x, x_scale=STEP)
    return camera(*np.round(plain.x[3:], 7).tolist()), np.linalg.norm(miss(plain.x), axis=1)


def main() -> None:
    """Write the camera file."""
    rays_enu, px = read_stars(STARS)
    fitted, distance = fit(rays_enu, px)
    right = distance < WRONG_ROW_PX
    save_camera(fitted, CAMERA)
    head = HEAD.format(used=right.sum(), given=len(px), rms=np.sqrt(np.mean(distance[right] ** 2) / 2))
    CAMERA.write_text(head + CAMERA.read_text(encoding="utf-8"), encoding="utf-8")


if __name__ == "__main__":
    main()
