"""How much higher the image shows the sky near the skyline, by the stars near it, the attitude and the lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from startrack.camera import Camera, load_camera
from startrack.core.types import Array
from startrack.evidence.star_offsets import (
    LEAST_SIGMA_PX,
    MODEL_SIGMA_PX,
    NIGHT_SIGMA_PX,
    TERMS,
    StarOffsets,
    measure_star_offsets,
    offset_terms,
)
from startrack.frames import R_from_rotvec, azel_from_rays, rays_from_azel

CAMERA = load_camera("fisheye-2048")
R_CAM_ENU = R_from_rotvec(np.radians([3.0, -2.0, 40.0])) @ np.diag([-1.0, -1.0, 1.0])
ATTITUDE_RAD2 = np.diag([4e-6, 4e-6, 9e-6]) ** 2
SIGMA_PX = 0.1
STARS = 3000


def horizon(azimuth_rad: Array) -> Array:
    return 0.18 + 0.03 * np.cos(azimuth_rad)


def directions(rng: np.random.Generator, n: int = STARS) -> Array:
    """Rays (n, 3) in enu up to 25 degrees above the horizontal plane."""
    return rays_from_azel(rng.uniform(0, 2 * np.pi, n), rng.uniform(0.0, 0.45, n))


def up_in_image(camera: Camera, rays_enu: Array) -> Array:
    """Unit vectors (n, 2) of growing elevation."""
    azimuth, elevation = azel_from_rays(rays_enu)
    ends = [camera.project_unlimited(rays_from_azel(azimuth, elevation + step) @ R_CAM_ENU.T) for step in (-1e-4, 1e-4)]
    return (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]).T)[:, None]


def offsets(rays_enu: Array, residual_px: Array, camera: Camera = CAMERA) -> StarOffsets:
    rays_cam = rays_enu @ R_CAM_ENU.T
    return measure_star_offsets(
        camera, R_CAM_ENU, ATTITUDE_RAD2, horizon, rays_cam, residual_px, np.full(len(rays_cam), SIGMA_PX**2)
    )


def planted(rng: np.random.Generator, terms_px: Array, n: int = STARS) -> tuple[Array, Array]:
    """Stars and residuals whose offset has these terms, with noise in both axes."""
    rays_enu = directions(rng, n)
    along = offset_terms(azel_from_rays(rays_enu)[0]) @ terms_px
    return rays_enu, along[:, None] * up_in_image(CAMERA, rays_enu) + SIGMA_PX * rng.normal(size=(n, 2))


def with_lens_error(sigma_px: float, *order: str) -> Camera:
    """The camera with independent errors of these parameters."""
    return replace(CAMERA, covariance=sigma_px**2 * np.eye(len(order)), covariance_order=order)


def nees(found: StarOffsets, true_px: Array) -> float:
    off = found.mean_px - true_px
    return float(off @ np.linalg.solve(found.covariance_px2, off))


@pytest.mark.parametrize(
    "terms_px",
    [
        [0.3, *8 * [0.0]],
        [0.0, 0.25, -0.1, *6 * [0.0]],
        [0.05, 0.1, 0.1, -0.2, 0.2, *4 * [0.0]],
        [*5 * [0.0], 0.1, -0.1, 0.2, 0.1],
    ],
    ids=["level", "one wave", "two waves", "waves three and four times around"],
)
def test_a_planted_offset_is_found_within_its_covariance(terms_px: list[float]) -> None:
    rng, found = np.random.default_rng(1), []
    for _ in range(20):
        found.append(offsets(*planted(rng, np.array(terms_px))))
    assert found[0].mean_px == pytest.approx(terms_px, abs=0.03)
    assert np.sqrt(np.diag(found[0].covariance_px2)).max() < 0.012
    assert np.mean([nees(one, np.array(terms_px)) for one in found]) == pytest.approx(TERMS, abs=3.0)


def test_without_an_offset_the_prior_is_kept() -> None:
    """A camera without errors: the residuals add nothing to what attitude and lens determine."""
    rng = np.random.default_rng(2)
    sigma = np.sqrt(np.diag(offsets(np.empty((0, 3)), np.empty((0, 2))).covariance_px2))
    assert (sigma >= LEAST_SIGMA_PX).all() and sigma.max() < 0.02
    for _ in range(10):
        found = offsets(*planted(rng, np.zeros(TERMS)))
        assert (np.abs(found.mean_px) < 4 * sigma).all()
        assert (np.diag(found.covariance_px2) <= np.square(sigma) * (1 + 1e-9)).all()


@pytest.mark.parametrize("stars", [0, 9])
def test_a_few_stars_change_nothing(stars: int) -> None:
    rng = np.random.default_rng(3)
    rays_enu = rays_from_azel(rng.uniform(0, 2 * np.pi, stars), rng.uniform(0.17, 0.2, stars))
    found = offsets(rays_enu, np.full((stars, 2), 0.2))
    assert np.array_equal(found.mean_px, np.zeros(TERMS))
    assert np.array_equal(found.covariance_px2, offsets(np.empty((0, 3)), np.empty((0, 2))).covariance_px2)


def test_stars_far_from_the_skyline_and_blends_do_not_count() -> None:
    rng = np.random.default_rng(4)
    rays_enu, residual = planted(rng, np.array([0.2, *8 * [0.0]]))
    azimuth, elevation = azel_from_rays(rays_enu)
    far = elevation - horizon(azimuth) > 100.0 / 652.0
    assert far.sum() > 500
    blend = rng.random(STARS) < 0.05
    other = np.where((far | blend)[:, None], residual + up_in_image(CAMERA, rays_enu) * 3.0, residual)
    found, plain = offsets(rays_enu, other), offsets(rays_enu[~blend], residual[~blend])
    assert found.mean_px == pytest.approx(plain.mean_px, abs=0.003)


def test_the_errors_of_attitude_and_lens_are_the_prior() -> None:
    """A tilt shows as one wave around the skyline, a wrong scale as a level."""
    none = np.empty((0, 3)), np.empty((0, 2))
    exact = offsets(*none).covariance_px2
    calibrated = exact + (NIGHT_SIGMA_PX**2 + MODEL_SIGMA_PX**2) * np.eye(TERMS)
    scaled = offsets(*none, camera=with_lens_error(0.2, "f")).covariance_px2 - calibrated
    angle = np.pi / 2 - 0.18
    # The attitude's refit cannot compensate a wrong scale.
    assert np.sqrt(scaled[0, 0]) == pytest.approx(0.2 * angle, rel=0.05)
    shifted = offsets(*none, camera=with_lens_error(0.3, "cx", "cy")).covariance_px2 - calibrated
    once = np.sqrt(shifted[1, 1] + shifted[2, 2])
    assert 0.02 < once < 0.3  # the refit compensates the most of it
    assert shifted[0, 0] < 0.1 * once**2
    tilted = exact - LEAST_SIGMA_PX**2 * np.eye(TERMS)
    assert np.sqrt(np.trace(tilted[1:3, 1:3])) == pytest.approx(652.0 * 4e-6 * np.sqrt(2.0), rel=0.1)


def test_lens_errors_from_the_prior_are_found_within_the_covariance() -> None:
    """Residuals of a lens whose parameters are wrong, the attitude refitted to the stars."""
    rng, found = np.random.default_rng(5), []
    order, sigma = ("f", "cx", "cy", "k1"), np.array([0.03, 0.1, 0.1, 6e-5])
    camera = replace(CAMERA, covariance=np.diag(sigma**2), covariance_order=order)
    at = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    skyline = rays_from_azel(at, horizon(at))
    for _ in range(30):
        f, cx, cy, k1 = sigma * rng.normal(size=4)
        true = replace(
            CAMERA, focal_px=(CAMERA.focal_px[0] + f, CAMERA.focal_px[1] + f),
            centre_px=(CAMERA.centre_px[0] + cx, CAMERA.centre_px[1] + cy),
            lens=replace(CAMERA.lens, k=(k1, 0.0, 0.0, 0.0)),
        )  # fmt: skip
        everywhere = rays_from_azel(rng.uniform(0, 2 * np.pi, STARS), np.arcsin(rng.uniform(0.02, 1.0, STARS)))

        def shift(rays_enu: Array, true: Camera = true) -> Array:
            rays_cam = rays_enu @ R_CAM_ENU.T
            return true.project_unlimited(rays_cam) - CAMERA.project_unlimited(rays_cam)

        by_rotation = CAMERA.jacobian_px_per_rad(everywhere @ R_CAM_ENU.T)
        turn = np.linalg.lstsq(by_rotation.reshape(-1, 3), shift(everywhere).ravel(), rcond=None)[0]
        rest = shift(everywhere) - by_rotation @ turn
        left = shift(skyline) - CAMERA.jacobian_px_per_rad(skyline @ R_CAM_ENU.T) @ turn
        terms = np.linalg.lstsq(
            offset_terms(at), np.einsum("ni,ni->n", left, up_in_image(CAMERA, skyline)), rcond=None
        )[0]
        got = offsets(everywhere, rest + SIGMA_PX * rng.normal(size=rest.shape), camera)
        by_model = MODEL_SIGMA_PX**2 * np.eye(TERMS)  # no error here
        found.append(nees(replace(got, covariance_px2=got.covariance_px2 - by_model), terms))
    assert 7.0 < np.mean(found) < 11.5  # 9 is exact
