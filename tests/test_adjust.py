"""Attitudes against SciPy's Wahba solver and against their own stated covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from startrack.camera import Camera, KannalaBrandt, Pinhole, with_update
from startrack.core.types import NotIdentified
from startrack.estimation.attitude import AttitudeFit, solve_attitude

ARCSEC = np.pi / 648_000
FISHEYE = Camera(
    name="fisheye", size_px=(2048, 2048), focal_px=(652.0, 652.0), centre_px=(1023.5, 1023.5),
    max_angle_rad=float(np.radians(92.5)), calibrated_angle_rad=1.6, lens=KannalaBrandt((-0.03, 0.002)),
)  # fmt: skip
NARROW = Camera(
    name="narrow", size_px=(1024, 1024), focal_px=(2900.0, 2900.0), centre_px=(511.5, 511.5),
    max_angle_rad=float(np.radians(15)), calibrated_angle_rad=1.0, lens=Pinhole(), mirrored=True,
)  # fmt: skip


def random_rays(n: int, rng: np.random.Generator) -> np.ndarray:
    rays = rng.normal(size=(n, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def draw_stars(
    camera: Camera, n: int, rng: np.random.Generator, unknown_px: float = 0.0, heavy: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Centroids (n, 2), their stated covariances, the stars' rays_icrs and the true R_cam_icrs.

    `unknown_px`: error of every centroid that the covariances do not contain; `heavy`: fraction of the stars with an
    error from Student's t distribution of two degrees of freedom, 0.6 px wide.
    """
    width, height = camera.size_px
    px = rng.uniform(0, [width - 1, height - 1], (4 * n, 2))
    px = px[camera.angle_rad(px) < 0.98 * camera.max_angle_rad][:n]
    R = Rotation.random(random_state=rng).as_matrix()
    sigma, stretch = np.exp(rng.uniform(np.log(0.03), np.log(0.4), n)), rng.uniform(0.8, 1.25, n)
    covariance = np.empty((n, 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = sigma**2 * stretch, sigma**2 / stretch
    covariance[:, 0, 1] = covariance[:, 1, 0] = 0.2 * sigma**2
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=(n, 2)))
    error += unknown_px * rng.normal(size=(n, 2))
    bad = rng.random(n) < heavy
    error[bad] += 0.6 * rng.standard_t(2, size=(int(bad.sum()), 2))
    return px + error, covariance, camera.unproject(px) @ R, R


def solve_draw(camera: Camera, seed: int, n: int, **errors: float) -> tuple[AttitudeFit, np.ndarray]:
    """The fit from a start 3 arcmin off, and the rotation vector (3,) from it to the truth."""
    rng = np.random.default_rng([seed, n])
    xy, covariance, rays, R = draw_stars(camera, n, rng, **errors)
    start = Rotation.from_rotvec(rng.normal(0, 1e-3, 3)).as_matrix() @ R
    fit = solve_attitude(camera, xy, covariance, rays, start)
    return fit, Rotation.from_matrix(R @ fit.attitude.R_cam_icrs.T).as_rotvec()


def mean_nees(camera: Camera, n: int, draws: int = 100, **errors: float) -> float:
    nees = []
    for seed in range(draws):
        try:
            fit, w = solve_draw(camera, seed, n, **errors)
        except NotIdentified:
            assert n < 10  # one or two random outliers leave too few stars
            continue
        nees.append(w @ np.linalg.solve(fit.attitude.covariance_rad2, w))
    assert len(nees) > 0.95 * draws
    return float(np.mean(nees))


@pytest.mark.parametrize("camera", [FISHEYE, NARROW], ids=lambda c: c.name)
def test_perfect_centroids_give_the_perfect_attitude(camera: Camera) -> None:
    rng = np.random.default_rng(2)
    width, height = camera.size_px
    px = rng.uniform(0, [width - 1, height - 1], (200, 2))
    px = px[camera.angle_rad(px) < camera.max_angle_rad][:50]
    R = Rotation.random(random_state=rng).as_matrix()
    start = Rotation.from_rotvec([2e-3, -1e-3, 3e-3]).as_matrix() @ R
    fit = solve_attitude(camera, px, np.tile(0.01 * np.eye(2), (50, 1, 1)), camera.unproject(px) @ R, start)
    assert np.linalg.norm(Rotation.from_matrix(R @ fit.attitude.R_cam_icrs.T).as_rotvec()) < 1e-6 * ARCSEC
    assert fit.used.all()
    assert fit.rms_px < 1e-9
    assert fit.extra_sigma_px < 2e-3
    assert fit.attitude.R_cam_icrs @ fit.attitude.R_cam_icrs.T == pytest.approx(np.eye(3), abs=1e-14)


@pytest.mark.parametrize("camera", [FISHEYE, NARROW], ids=lambda c: c.name)
@pytest.mark.parametrize("n", [4, 10, 30, 100, 500, 2000])
def test_the_covariance_is_right_where_the_centroids_are(camera: Camera, n: int) -> None:
    # 3 is right; the statistical error of 60 to 200 draws is 0.17 to 0.3, and the extra variance lowers it a little.
    assert 2.2 < mean_nees(camera, n, {4: 200, 10: 150, 2000: 40}.get(n, 60)) < (3.5 if n < 2000 else 3.8)


@pytest.mark.parametrize(("n", "most"), [(6, 6.5), (20, 4.5), (60, 3.6), (300, 3.6)])
def test_unstated_errors_are_estimated_from_the_scatter(n: int, most: float) -> None:
    """0.15 px of lens error beyond centroid errors of 0.03 to 0.4 px; six stars hardly determine it."""
    assert 2.3 < mean_nees(FISHEYE, n, 60, unknown_px=0.15) < most
    if n == 300:
        extra = [solve_draw(FISHEYE, seed, n, unknown_px=0.15)[0].extra_sigma_px for seed in range(10)]
        assert np.median(extra) == pytest.approx(0.15, rel=0.1)


@pytest.mark.parametrize(("n", "heavy"), [(10, 0.1), (10, 0.3), (30, 0.3), (150, 0.1), (150, 0.3)])
def test_heavy_tails_do_not_make_it_overconfident(n: int, heavy: float) -> None:
    assert mean_nees(FISHEYE, n, 60, heavy=heavy) < 4.0


def test_gross_outliers_are_rejected_without_bias() -> None:
    rng = np.random.default_rng(3)
    xy, covariance, rays, R = draw_stars(FISHEYE, 100, rng)
    wrong = rng.permutation(100)[:15]
    xy[wrong] += rng.choice([-1, 1], (15, 2)) * rng.uniform(4, 12, (15, 2))
    fit = solve_attitude(FISHEYE, xy, covariance, rays, R)
    assert not fit.used[wrong].any()
    assert fit.used.sum() >= 82
    w = Rotation.from_matrix(R @ fit.attitude.R_cam_icrs.T).as_rotvec()
    assert w @ np.linalg.solve(fit.attitude.covariance_rad2, w) < 12
    # theory: about s / sqrt(n) per axis, here some 0.07 px of 316 arcsec over sqrt(85)
    assert np.linalg.norm(w) < 10 * ARCSEC


def test_sigma_falls_with_the_number_of_stars_and_roll_is_weak_in_a_narrow_field() -> None:
    def sigmas(camera: Camera, n: int) -> np.ndarray:
        fits = [solve_draw(camera, seed, n)[0] for seed in range(20)]
        return np.sqrt(np.mean([np.diag(f.attitude.covariance_rad2) for f in fits], axis=0)) / ARCSEC

    few, many = sigmas(FISHEYE, 25), sigmas(FISHEYE, 400)
    assert few / many == pytest.approx(4.0, rel=0.4)  # 25 stars scatter
    narrow = sigmas(NARROW, 25)
    assert narrow[2] > 5 * narrow[:2].max()  # about the boresight: roll is poorly determined in a field of 20 degrees


def test_equal_errors_give_the_textbook_sigma() -> None:
    """100 stars, 0.1 px each: the information matrix written out by SciPy's numerical derivative."""
    from scipy.optimize import approx_fprime

    rng = np.random.default_rng(4)
    px = rng.uniform(200, 1800, (100, 2))
    px = px[FISHEYE.angle_rad(px) < 1.4]
    rays = FISHEYE.unproject(px)
    covariance = np.tile(0.01 * np.eye(2), (len(px), 1, 1))
    errors = 0.1 * rng.normal(size=px.shape)
    fit = solve_attitude(FISHEYE, px + errors, covariance, rays, np.eye(3))

    def pixels(vector: np.ndarray) -> np.ndarray:
        return FISHEYE.project(Rotation.from_rotvec(vector).apply(rays))[0].ravel()

    slope = approx_fprime(np.zeros(3), pixels, 1e-7)
    expected = np.sqrt(np.diag(np.linalg.inv(slope.T @ slope / 0.01)))
    assert np.sqrt(np.diag(fit.attitude.covariance_rad2)) == pytest.approx(expected, rel=0.12)


def test_fewer_than_three_stars_is_refused() -> None:
    xy, covariance, rays, R = draw_stars(FISHEYE, 2, np.random.default_rng(5))
    with pytest.raises(NotIdentified, match="fewer than 3") as caught:
        solve_attitude(FISHEYE, xy, covariance, rays, R)
    assert caught.value.reason == "not_identified"
    assert caught.value.evidence["matched"] == 2


def test_stated_lens_errors_are_in_the_covariance() -> None:
    """Lenses drawn from the file's covariance: the scatter of the residuals does not contain the attitude error."""
    order = ("fx", "fy", "cx", "cy", "k1")
    spread = np.diag([0.5, 0.5, 1.0, 1.0, 2e-4]) @ np.array(
        [[1, 0.999, 0, 0, -0.9], [0.999, 1, 0, 0, -0.9], [0, 0, 1, 0.2, 0], [0, 0, 0.2, 1, 0], [-0.9, -0.9, 0, 0, 1]]
    )
    covariance = spread @ np.diag([0.5, 0.5, 1.0, 1.0, 2e-4])
    nees, blind = [], []
    for seed in range(60):
        rng = np.random.default_rng([seed, 11])
        xy, centroids, rays, R = draw_stars(FISHEYE, 150, rng)
        error = dict(zip(order, rng.multivariate_normal(np.zeros(5), covariance), strict=True))
        stated = replace(with_update(FISHEYE, error), covariance_order=order, covariance=covariance)
        for camera, found in ((stated, nees), (replace(stated, covariance=None), blind)):
            attitude = solve_attitude(camera, xy, centroids, rays, R).attitude
            w = Rotation.from_matrix(R @ attitude.R_cam_icrs.T).as_rotvec()
            found.append(w @ np.linalg.solve(attitude.covariance_rad2, w))
    assert 2.2 < np.mean(nees) < 4.0  # 3 expected, 0.32 its spread
    assert np.mean(blind) > 100
