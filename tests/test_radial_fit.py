"""The compiled fit of a lens of one bend against a general minimizer, and on exact matches."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from startrack.estimation.radial_fit import (
    HALF_WEIGHT_CHI2,
    angle_of,
    fit_radial,
    largest_angle_rad,
    project_radial,
    radius_of,
)

SIZE, SIGMA_PX = (1024, 768), 1.0
MATCHES, WRONG = 60, 6
ALL, NOTHING = np.ones(5, bool), np.full(5, 1e9)
LENSES = {  # bend, largest angle, focal length [px]
    "narrow": (0.38, 0.17, 2900.0), "stereographic": (1 / 12, 1.5, 300.0), "equidistant": (0.0, 1.6, 300.0),
    "equisolid": (-1 / 24, 1.6, 340.0), "orthographic": (-1 / 6, 1.4, 400.0),
}  # fmt: skip


def pixels(rays, R, lens, mirror):
    """As the definition."""
    cam = rays @ R.T
    off_axis = np.arctan2(np.hypot(cam[:, 0], cam[:, 1]), cam[:, 2])
    around = np.arctan2(cam[:, 1], cam[:, 0])
    fx, fy = np.exp(lens[0] + 0.5 * lens[1]), np.exp(lens[0] - 0.5 * lens[1])
    unit = np.stack([mirror * fx * np.cos(around), fy * np.sin(around)], axis=1)
    return lens[3:] + radius_of(off_axis, lens[2])[:, None] * unit


def scene(name, mirror=1.0):
    bend, widest, focal_px = LENSES[name]
    rng = np.random.default_rng(8)
    R = Rotation.random(rng=rng).as_matrix()
    angle, around = widest * np.sqrt(rng.random(MATCHES)), rng.uniform(0, 2 * np.pi, MATCHES)
    cam = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=1)
    lens = np.array([np.log(focal_px), 0.07, bend, 520.0, 370.0])
    turned = Rotation.from_rotvec(rng.normal(0, 0.02 * widest, 3)).as_matrix() @ R
    return R, cam @ R, lens, pixels(cam @ R, R, lens, mirror), turned, rng


@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize("name", LENSES)
def test_exact_matches_give_the_lens(name, mirror):
    R, rays, lens, xy, turned, _ = scene(name, mirror)
    found = lens + np.array([0.02, -0.05, 0.02, 0.0, 0.0])
    free = ALL.copy()
    if name == "narrow":  # its centre looks like a rotation
        free[3:] = False
    else:
        found += [0.0, 0.0, 0.0, 4.0, -3.0]
    fit_radial(xy, rays, mirror, SIGMA_PX, 60, free, lens, NOTHING, turned, found)
    np.testing.assert_allclose(found, lens, atol=1e-6)
    np.testing.assert_allclose(turned, R, atol=1e-8)
    px, inside = project_radial(rays, turned, found, mirror, *SIZE)
    np.testing.assert_allclose(px, xy, atol=1e-4)
    in_frame = (xy >= -0.5).all(axis=1) & (xy <= np.array(SIZE) - 0.5).all(axis=1)
    assert np.array_equal(inside, in_frame)


@pytest.mark.parametrize("name", LENSES)
def test_it_finds_the_least_loss_among_wrong_matches(name):
    _, rays, lens, xy, turned, rng = scene(name)
    xy = xy + rng.normal(0, 0.3, (MATCHES, 2))
    xy[:WRONG] += rng.uniform(-8, 8, (WRONG, 2))
    found, sigma = lens.copy(), np.array([0.1, 0.1, 0.1, 0.06, 0.06])
    fit_radial(xy, rays, 1.0, SIGMA_PX, 80, ALL, lens, sigma, turned, found)
    unit = np.array([1.0, 1.0, 1.0, np.exp(found[0]), np.exp(found[0])])

    def loss(step):
        R = Rotation.from_rotvec(1e-3 * step[5:]).as_matrix() @ turned
        now = found + 1e-3 * unit * step[:5]
        left = xy - pixels(rays, R, now, 1.0)
        known = np.square((now - lens) / unit / sigma).sum() * SIGMA_PX**2
        return HALF_WEIGHT_CHI2 * np.log1p((left**2).sum(axis=1) / SIGMA_PX**2 / HALF_WEIGHT_CHI2).sum() + known

    best = minimize(loss, np.zeros(8), method="BFGS", options={"gtol": 1e-6})
    assert loss(np.zeros(8)) <= best.fun + 1e-4


def test_few_or_equal_stars_leave_the_numbers_finite():
    _, rays, lens, xy, turned, _ = scene("narrow")
    same = np.repeat(rays[:1], 5, axis=0)
    fit_radial(np.repeat(xy[:1], 5, axis=0), same, 1.0, SIGMA_PX, 5, ALL, lens, NOTHING, turned, lens)
    assert np.isfinite(turned).all() and np.isfinite(lens).all()


@pytest.mark.parametrize("bend", [-1 / 6, -1 / 24, 0.0, 1 / 12, 1 / 3])
def test_the_angle_is_the_inverse_of_the_radius(bend):
    angle = np.linspace(0, 0.99 * largest_angle_rad(bend), 50)
    np.testing.assert_allclose(angle_of(radius_of(angle, bend), bend), angle, atol=1e-9)
    small = np.array([0.05])
    np.testing.assert_allclose(radius_of(small, bend), small + bend * small**3, atol=1e-6)
