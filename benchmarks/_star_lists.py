"""Star lists for the identification benchmark: catalogue stars at a random attitude, noise, false stars, an order.

Two stars within CLOSE_PX are blended: the list holds them once, under the brighter one's name.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from startrack.camera import Camera
from startrack.core.types import Centroids, Stars

CLOSE_PX = 3.0
SCATTER_MAG = 0.1
ZERO_MAG = 18.0  # of one electron


@dataclass(frozen=True)
class StarList:
    """Detections, brightest first, and the truth about them."""

    xy_px: np.ndarray  # (n, 2)
    v_mag: np.ndarray  # (n,) measured
    star: np.ndarray  # (n,) index of the catalogue star, -1 for a false one
    R_cam_icrs: np.ndarray
    noise_px: float

    def detections(self) -> Centroids:
        """The list as the package's identifier takes it."""
        n, flux = len(self.xy_px), 10 ** (-0.4 * (self.v_mag - ZERO_MAG))
        return Centroids(
            xy_px=self.xy_px, covariance_px2=np.tile(self.noise_px**2 * np.eye(2), (n, 1, 1)), flux_e=flux,
            snr=flux / np.sqrt(flux + 1e8), saturated=np.zeros(n, dtype=bool), psf_sigma_px=1.0,
        )  # fmt: skip


@dataclass(frozen=True)
class Trouble:
    """Disturbances of a list."""

    hidden: float = 0.0  # part of the stars, on one side of the field
    scatter_mag: float = SCATTER_MAG
    strangers: int = 0  # sources brighter than any star: planets, lamps, hot pixels
    mirrored: bool = False  # the image is a mirror image, contrary to the camera: no answer is right


def star_list(
    camera: Camera, stars: Stars, true: int, false: int, noise_px: float, trouble: Trouble = Trouble(), *,
    rng: np.random.Generator,
) -> StarList:  # fmt: skip
    """The `true` brightest stars in view and `false` random ones as bright as they are."""
    R = Rotation.random(random_state=rng).as_matrix()
    px, inside = camera.project(stars.rays_icrs @ R.T)
    seen = np.flatnonzero(inside)
    if trouble.hidden:
        side = (px[seen] - camera.centre_px) @ rng.normal(size=2)
        seen = seen[side > np.quantile(side, trouble.hidden)]
    seen = seen[: 3 * true + 20]  # the stars are sorted, brightest first
    pairs = cKDTree(px[seen]).query_pairs(CLOSE_PX, output_type="ndarray")
    star = np.delete(seen, pairs.max(axis=1) if len(pairs) else [])[:true]
    strange = random_positions(camera, false + trouble.strangers, rng=rng)
    v = stars.v_mag[star] + rng.normal(0, trouble.scatter_mag, len(star))
    like = v if true else 6 + np.log(rng.random(false)) / 1.08  # the magnitudes of a real sky
    v = np.concatenate([v, rng.choice(like, false), like.min() - 2 * rng.random(trouble.strangers)])
    order = np.argsort(v)
    xy = np.concatenate([px[star] + rng.normal(0, noise_px, (len(star), 2)), strange])
    truth = np.concatenate([star, np.full(len(strange), -1)])
    if trouble.mirrored:
        xy[:, 0] = 2 * camera.centre_px[0] - xy[:, 0]
        truth[:] = -1
    return StarList(xy[order], v[order], truth[order], R, noise_px)


def random_positions(camera: Camera, n: int, *, rng: np.random.Generator) -> np.ndarray:
    """Random positions (n, 2) within the frame and the image circle."""
    xy = rng.uniform(0, np.array(camera.size_px) - 1, (3 * n + 20, 2))
    return xy[camera.angle_rad(xy) < camera.max_angle_rad][:n]
