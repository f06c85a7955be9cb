"""The compiled fit of a narrow field's view against a general minimizer, and on exact matches."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from startrack.estimation.pinhole_fit import HALF_WEIGHT_CHI2, fit_pinhole

CENTRE_PX, FOCAL_PX, DISTORTION, SIGMA_PX = np.array([511.5, 383.5]), 2900.0, 0.04, 1.0
MATCHES, WRONG = 60, 6


def pixels(rays, R, focal_px, distortion, mirror):
    """As the definition: the radius is the tangent of the angle, and a part of its cube more."""
    cam = rays @ R.T
    off_axis = np.arctan2(np.hypot(cam[:, 0], cam[:, 1]), cam[:, 2])
    radius = focal_px * (np.tan(off_axis) + distortion * off_axis**3)
    around = np.arctan2(cam[:, 1], cam[:, 0])
    return CENTRE_PX + radius[:, None] * np.stack([mirror * np.cos(around), np.sin(around)], axis=1)


def scene(mirror):
    rng = np.random.default_rng(8)
    R = Rotation.random(rng=rng).as_matrix()
    angle, around = 0.17 * np.sqrt(rng.random(MATCHES)), rng.uniform(0, 2 * np.pi, MATCHES)
    cam = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=1)
    start = Rotation.from_rotvec(rng.normal(0, 3e-3, 3)).as_matrix() @ R
    return R, cam @ R, start, rng


@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize("is_distorted", [False, True])
def test_exact_matches_give_the_view(mirror, is_distorted):
    R, rays, start, _ = scene(mirror)
    distortion = DISTORTION if is_distorted else 0.0
    lens = np.array([0.98 * FOCAL_PX, 0.0])
    xy = pixels(rays, R, FOCAL_PX, distortion, mirror)
    fit_pinhole(xy, rays, CENTRE_PX, mirror, SIGMA_PX, 30, is_distorted, start, lens)
    np.testing.assert_allclose(start, R, atol=1e-9)
    np.testing.assert_allclose(lens, [FOCAL_PX, distortion], rtol=1e-8, atol=1e-9)


def test_it_finds_the_least_loss_among_wrong_matches():
    R, rays, start, rng = scene(1.0)
    xy = pixels(rays, R, FOCAL_PX, DISTORTION, 1.0) + rng.normal(0, 0.3, (MATCHES, 2))
    xy[:WRONG] += rng.uniform(-8, 8, (WRONG, 2))
    lens = np.array([FOCAL_PX, 0.0])
    fit_pinhole(xy, rays, CENTRE_PX, 1.0, SIGMA_PX, 60, True, start, lens)

    def loss(step):
        turned = Rotation.from_rotvec(1e-4 * step[2:]).as_matrix() @ start
        left = xy - pixels(rays, turned, lens[0] * np.exp(1e-4 * step[0]), lens[1] + 1e-3 * step[1], 1.0)
        return np.log1p((left**2).sum(axis=1) / SIGMA_PX**2 / HALF_WEIGHT_CHI2).sum()

    best = minimize(loss, np.zeros(5), method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-12, "maxfev": 20_000})
    assert loss(np.zeros(5)) <= best.fun + 1e-6
    assert abs(lens[0] / FOCAL_PX - 1) < 1e-3


def test_few_or_equal_stars_leave_the_numbers_finite():
    R, rays, start, _ = scene(1.0)
    lens = np.array([FOCAL_PX, 0.0])
    same = np.repeat(rays[:1], 5, axis=0)
    fit_pinhole(pixels(same, R, FOCAL_PX, 0.0, 1.0), same, CENTRE_PX, 1.0, SIGMA_PX, 5, True, start, lens)
    assert np.isfinite(start).all() and np.isfinite(lens).all()
