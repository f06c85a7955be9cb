"""Lenses from matched directions, against truth that is written out here and not taken from the package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from startrack.applications.calibration import fit_lens, initial_state, observations
from startrack.camera import (
    Camera,
    Decentring,
    KannalaBrandt,
    camera_from_dict,
    camera_to_dict,
    lens_jacobian,
    with_update,
)
from startrack.core.types import NotIdentified

FOCAL_PX, SIZE_PX = 652.0, (2048, 2048)
CENTRE_PX = np.array([1019.0, 1031.5])
LAWS = {
    "equidistant": lambda a: a,
    "equisolid": lambda a: 2 * np.sin(a / 2),
    "stereographic": lambda a: 2 * np.tan(a / 2),
    "orthographic": np.sin,
    "kannala_brandt": lambda a: a + 0.06 * a**3 - 0.03 * a**5 + 0.006 * a**7 - 0.0005 * a**9,
}
TOP_DEG = {"orthographic": 80.0}
ROUGH = Camera(
    name="rough", size_px=SIZE_PX, focal_px=(640.0, 640.0), centre_px=(1023.5, 1023.5),
    max_angle_rad=np.pi / 2, calibrated_angle_rad=np.pi / 2,
)  # fmt: skip


def pixels(rho, rays, mirrored=False, aspect=1.0, p=(0.0, 0.0)):
    s = np.hypot(rays[:, 0], rays[:, 1])
    a = np.arctan2(s, rays[:, 2])
    e = rays[:, :2] / s[:, None]
    q = a[:, None] * e
    bend = np.stack(
        [
            2 * p[0] * q[:, 0] * q[:, 1] + p[1] * (a**2 + 2 * q[:, 0] ** 2),
            p[0] * (a**2 + 2 * q[:, 1] ** 2) + 2 * p[1] * q[:, 0] * q[:, 1],
        ],
        axis=1,
    )
    return CENTRE_PX + FOCAL_PX * np.array([-1 if mirrored else 1, aspect]) * (rho(a)[:, None] * e + bend)


def even_rays(top_deg, count, rng):
    z, b = rng.uniform(np.cos(np.radians(top_deg)), 1, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(b), np.sqrt(1 - z * z) * np.sin(b), z], axis=1)


def simulate_frames(law, frames, stars, sigma_px, seed, top_deg=None, **kind):
    """Pixels, directions and attitudes, image by image."""
    rng = np.random.default_rng(seed)
    seen = [even_rays(top_deg or TOP_DEG.get(law, 90.0), stars, rng) for _ in range(frames)]
    R = Rotation.random(frames, random_state=seed).as_matrix()
    xy = [pixels(LAWS[law], rays, **kind) + rng.normal(0, sigma_px, (stars, 2)) for rays in seen]
    return xy, [rays @ r for rays, r in zip(seen, R, strict=True)], R


def fit_simulated(law, frames, stars, sigma_px, seed, square=False, **kind):
    xy, rays, R = simulate_frames(law, frames, stars, sigma_px, seed, **kind)
    return fit_lens(
        ROUGH,
        Rotation.from_rotvec([0.01, -0.008, 0.012]).as_matrix() @ R,
        observations(xy, rays, sigma_px**2),
        square=square,
    )


def map_error_px(camera, law, **kind):
    """RMS over solid angle to the calibrated angle, the best rotation removed by trying rotations."""
    rays = even_rays(np.degrees(camera.calibrated_angle_rad), 3000, np.random.default_rng(0))
    miss = (camera.project_unlimited(rays) - pixels(LAWS[law], rays, **kind)).ravel()
    step = 1e-6
    by_rotation = np.stack(
        [(camera.project_unlimited(Rotation.from_rotvec(w).apply(rays)) - camera.project_unlimited(rays)).ravel() / step
         for w in step * np.eye(3)], axis=1,
    )  # fmt: skip
    miss -= by_rotation @ np.linalg.lstsq(by_rotation, miss, rcond=None)[0]
    return np.sqrt(2 * np.mean(miss**2))


@pytest.mark.parametrize("law", LAWS)
def test_one_frame_of_100_stars(law):
    errors = [map_error_px(fit_simulated(law, 1, 100, 0.2, seed).camera, law) for seed in range(5)]
    assert np.median(errors) <= 0.07
    assert max(errors) < 0.15


@pytest.mark.parametrize("law", ["equisolid", "kannala_brandt"])
def test_twenty_frames_of_300_stars(law):
    fit = fit_simulated(law, 20, 300, 0.1, 3)
    assert map_error_px(fit.camera, law) <= 0.015
    assert fit.held_out_rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.05)
    assert np.degrees(fit.camera.calibrated_angle_rad) == pytest.approx(89.5, abs=0.7)


@pytest.mark.parametrize("law", ["equidistant", "stereographic", "orthographic"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_from_matches_alone_of_which_a_fifth_is_wrong(law, mirrored):
    xy, rays, _ = simulate_frames(law, 1, 100, 0.2, 11, mirrored=mirrored)
    rng = np.random.default_rng(1)
    xy[0][:10] = rng.uniform(0, 2047, (10, 2))
    xy[0][10:20] += rng.uniform(-12, 12, (10, 2))
    points = observations(xy, rays)  # without the centroids' errors
    start = initial_state(points, SIZE_PX)
    fit = fit_lens(start.camera, start.R_cam_icrs, points)
    assert fit.camera.mirrored == mirrored
    assert map_error_px(fit.camera, law, mirrored=mirrored) <= 0.1
    assert fit.used[20:].all()
    assert fit.used[:10].sum() == 0
    assert fit.extra_sigma_px == pytest.approx(0.2, rel=0.25)


def test_the_covariance_is_as_large_as_the_errors():
    """Map error in units of its stated sigma, over 20 frames; fx and fy of square pixels are one unknown."""
    total, freedom = 0.0, 0
    rays = even_rays(88, 1500, np.random.default_rng(0))
    for seed in range(20):
        camera = fit_simulated("kannala_brandt", 1, 100, 0.2, seed).camera
        assert camera.focal_px[0] == camera.focal_px[1]
        order = camera.covariance_order
        by_rotation = camera.jacobian_px_per_rad(rays).reshape(-1, 3)
        lens = lens_jacobian(camera, rays, order).reshape(-1, len(order))
        miss = (camera.project_unlimited(rays) - pixels(LAWS["kannala_brandt"], rays)).ravel()
        lens, miss = (v - by_rotation @ np.linalg.lstsq(by_rotation, v, rcond=None)[0] for v in (lens, miss))
        lens = np.concatenate([lens[:, :1] + lens[:, 1:2], lens[:, 2:]], axis=1)
        covariance = np.delete(np.delete(camera.covariance, 1, 0), 1, 1)
        u, s, _ = np.linalg.svd(lens @ np.linalg.cholesky(covariance), full_matrices=False)
        total, freedom = total + np.sum((u.T @ miss / s) ** 2), freedom + len(s)
    assert total / freedom == pytest.approx(1.0, abs=0.3)


def test_the_map_sigma_is_the_spread_of_the_maps():
    rays = even_rays(85, 400, np.random.default_rng(4))
    fits = [fit_simulated("equisolid", 1, 150, 0.2, seed).camera for seed in range(12)]
    stated = np.mean([np.mean(camera.projection_sigma_px(rays) ** 2) for camera in fits])
    seen = np.mean(
        [0.5 * map_error_px(replace(c, calibrated_angle_rad=np.radians(85)), "equisolid") ** 2 for c in fits]
    )
    assert np.sqrt(seen) == pytest.approx(np.sqrt(stated), rel=0.3)


def test_stars_inside_60_degrees_calibrate_60_degrees():
    camera = fit_simulated("equisolid", 1, 300, 0.2, 5, top_deg=60.0).camera
    assert np.degrees(camera.calibrated_angle_rad) == pytest.approx(59.5, abs=1.0)
    edge = np.array([[np.sin(a), 0, np.cos(a)] for a in np.radians([59, 80, 90])])
    inside, beyond, far = camera.projection_sigma_px(edge)
    assert inside < 0.15 < beyond < far  # the error beyond is stated too


def test_a_few_stars_beyond_a_gap_do_not_stretch_the_calibrated_angle():
    xy, rays, R = simulate_frames("equisolid", 1, 300, 0.2, 5, top_deg=50.0)
    far = even_rays(89, 4000, np.random.default_rng(2))
    far = far[far[:, 2] < np.cos(np.radians(86))][:6]
    xy[0], rays[0] = np.concatenate([xy[0], pixels(LAWS["equisolid"], far)]), np.concatenate([rays[0], far @ R[0]])
    camera = fit_lens(ROUGH, R, observations(xy, rays, 0.04)).camera
    assert np.degrees(camera.calibrated_angle_rad) == pytest.approx(50, abs=1)


def test_square_pixels_stay_square_and_others_are_found():
    assert (
        fit_simulated("equisolid", 4, 200, 0.1, 6).camera.focal_px[0]
        == fit_simulated("equisolid", 4, 200, 0.1, 6).camera.focal_px[1]
    )
    fx, fy = fit_simulated("equisolid", 4, 200, 0.1, 6, aspect=1.002).camera.focal_px
    assert fy / fx == pytest.approx(1.002, abs=1e-4)


def test_a_decentred_lens_is_found_and_its_file_read_back():
    p = (3e-4, -8e-4)
    fit = fit_simulated("equisolid", 4, 200, 0.1, 7, p=p)
    camera = fit.camera
    assert (camera.decentring.p1, camera.decentring.p2) == pytest.approx(p, abs=2e-5)
    assert map_error_px(camera, "equisolid", p=p) < 0.03
    bare = replace(camera, decentring=Decentring())
    centred = fit_simulated(
        "equisolid", 4, 200, 0.1, 7, p=p, square=True
    )  # what a reader who ignores the key could have had
    assert map_error_px(bare, "equisolid", p=p) < 1.25 * map_error_px(centred.camera, "equisolid", p=p)
    assert centred.held_out_rms_px > 5 * fit.held_out_rms_px
    again = camera_from_dict(camera_to_dict(camera))
    rays = even_rays(85, 200, np.random.default_rng(1))
    np.testing.assert_array_equal(again.project(rays)[0], camera.project(rays)[0])
    np.testing.assert_allclose(again.unproject(again.project(rays)[0]), rays, atol=1e-12)
    np.testing.assert_array_equal(again.covariance, camera.covariance)


def test_derivatives_of_a_decentred_mirrored_lens():
    camera = Camera(
        name="bent", size_px=SIZE_PX, focal_px=(652.0, 650.0), centre_px=(1020.0, 1030.0), max_angle_rad=1.7,
        calibrated_angle_rad=1.6, lens=KannalaBrandt((0.01, -0.002, 0.001)), mirrored=True,
        decentring=Decentring(3e-4, -8e-4),
    )  # fmt: skip
    rays, step = even_rays(95, 200, np.random.default_rng(3)), 1e-6
    order = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "f")

    def pixels_after(name: str, by: float) -> np.ndarray:
        return with_update(camera, {name: by}).project_unlimited(rays)

    numeric = [(pixels_after(name, step) - pixels_after(name, -step)) / (2 * step) for name in order]
    np.testing.assert_allclose(lens_jacobian(camera, rays, order), np.stack(numeric, axis=-1), atol=2e-6)
    shifted = [
        (
            camera.project(Rotation.from_rotvec(w).apply(rays))[0]
            - camera.project(Rotation.from_rotvec(-w).apply(rays))[0]
        )
        / (2 * step)
        for w in step * np.eye(3)
    ]
    np.testing.assert_allclose(camera.jacobian_px_per_rad(rays), np.stack(shifted, axis=-1), atol=2e-6)


def test_narrow_fields_get_a_pinhole_or_a_short_polynomial():
    rng = np.random.default_rng(8)
    rays = even_rays(6.0, 150, rng)
    R = Rotation.random(random_state=1).as_matrix()
    xy = CENTRE_PX + 8000.0 * rays[:, :2] / rays[:, 2:] + rng.normal(0, 0.1, (150, 2))
    points = observations([xy], [rays @ R], 0.01)
    start = initial_state(points, SIZE_PX)
    camera = fit_lens(start.camera, start.R_cam_icrs, points).camera
    assert camera.focal_px[0] == pytest.approx(8000, rel=2e-3)
    assert camera.lens.model == "pinhole" or len(camera.lens.k) <= 2
    assert np.degrees(camera.calibrated_angle_rad) == pytest.approx(6.0, abs=0.2)


def test_matches_that_agree_on_nothing_are_refused():
    rng = np.random.default_rng(9)
    points = observations([rng.uniform(0, 2047, (60, 2))], [even_rays(90, 60, rng)], 0.04)
    start = initial_state(points, SIZE_PX)
    fit_px = None
    try:
        fit_px = fit_lens(start.camera, start.R_cam_icrs, points).held_out_rms_px
    except NotIdentified:
        return
    assert fit_px > 50  # and the gates refuse it


def test_too_few_matches_are_refused():
    xy, rays, R = simulate_frames("equidistant", 1, 11, 0.2, 1)
    with pytest.raises(NotIdentified, match="11 matched stars"):
        fit_lens(ROUGH, R, observations(xy, rays, 0.04))
