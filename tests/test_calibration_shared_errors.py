"""Errors that the stars of a region share: the covariance of a lens against lenses of other nights."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_calibration_fit import CENTRE_PX, FOCAL_PX, ROUGH, simulate_frames

from startrack.applications.calibration import fit_lens, observations
from startrack.applications.calibration.shared_errors import FLOOR_PX, birge_ratio, nights, widen_covariance
from startrack.applications.calibration.verify import CHANGED_SIGMAS
from startrack.camera import Camera, cap_grid, difference_px, projection_covariance_px2
from startrack.core.types import Array
from startrack.estimation.frame_matching import JointFit

SIGMA_PX, STARS = 0.15, 500
FIRST_NIGHT = datetime(2030, 6, 1, 22, tzinfo=UTC)


def bend(xy_px: Array, rms_px: float, rng: np.random.Generator) -> Array:
    """Pixels displaced by a smooth random field of second and third order."""
    u, v = ((xy_px - CENTRE_PX) / (FOCAL_PX * np.pi / 2)).T
    terms = np.stack([u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=1)
    field = terms @ rng.normal(size=(terms.shape[1], 2))
    return np.asarray(xy_px + field * rms_px / np.sqrt(np.mean(np.sum(np.square(field - field.mean(axis=0)), axis=1))))


def calibrate_nights(count: int, frames: int, flex_px: float, seed: int) -> JointFit:
    """The joint fit of `frames` images in each of so many nights; the lens bends anew in every night."""
    xy, rays, R = simulate_frames("kannala_brandt", count * frames, STARS, SIGMA_PX, seed)
    if flex_px:
        for night in range(count):
            for k in range(night * frames, (night + 1) * frames):
                xy[k] = bend(xy[k], flex_px, np.random.default_rng(1000 * seed + night))
    points = observations(xy, rays, SIGMA_PX**2)
    times = [FIRST_NIGHT + timedelta(days=k // frames, minutes=10 * (k % frames)) for k in range(count * frames)]
    fit = fit_lens(ROUGH, Rotation.from_rotvec([0.001, -0.002, 0.003]).as_matrix() @ R, points)
    images: Any = tuple(SimpleNamespace(time_utc=time) for time in times)
    return JointFit(frames=images, matches=(), points=points, fit=fit, gate_px=2.0)


def rms_sigma_px(*cameras: Camera) -> float:
    rays = cap_grid(min(camera.calibrated_angle_rad for camera in cameras))
    variance = sum(projection_covariance_px2(camera, rays) for camera in cameras)
    return float(np.sqrt(np.mean(np.trace(cast("Array", variance), axis1=1, axis2=2))))


def changes_in_sigmas(flex_px: float, *, widened: bool) -> Array:
    """RMS change of the projection from two nights of three images to a third night of one, over its sigma."""
    ratios = []
    for seed in range(20):
        fits = calibrate_nights(2, 3, flex_px, 2 * seed), calibrate_nights(1, 1, flex_px, 2 * seed + 1)
        old, new = ((widen_covariance(fit) if widened else fit).fit.camera for fit in fits)
        rays = cap_grid(min(old.calibrated_angle_rad, new.calibrated_angle_rad))
        change_px = np.sqrt(np.mean(np.sum(np.square(difference_px(old, new, rays)), axis=1)))
        ratios.append(change_px / rms_sigma_px(old, new))
    return np.array(ratios)


@pytest.mark.slow
def test_with_a_flex_from_night_to_night_the_sigma_of_a_change_is_sound() -> None:
    """The field bends by 0.06 px, as between the nights of the sample photographs."""
    before, after = (changes_in_sigmas(0.06, widened=widened) for widened in (False, True))
    assert np.mean(before > CHANGED_SIGMAS) > 0.3
    assert np.mean(after > CHANGED_SIGMAS) == 0.0
    assert 0.5 < np.sqrt(np.mean(np.square(after))) < 1.5


@pytest.mark.slow
def test_clean_frames_get_the_floor_and_nothing_else() -> None:
    ratios = []
    for seed in range(20):
        joint = calibrate_nights(2, 2, 0.0, seed)
        wide = widen_covariance(joint)
        ratios.append(wide.birge_ratio)
        if wide.birge_ratio == 1.0:
            narrow_px = rms_sigma_px(joint.fit.camera)
            assert rms_sigma_px(wide.fit.camera) == pytest.approx(np.hypot(narrow_px, FLOOR_PX), rel=1e-6)
    assert np.mean(np.array(ratios) == 1.0) >= 0.9


def test_the_birge_ratio_grows_with_the_flex() -> None:
    one_group = np.zeros(1, dtype=np.int64)
    joints = [calibrate_nights(1, 1, flex_px, 3) for flex_px in (0.0, 0.5, 1.0)]
    clean, bent, twice = (birge_ratio(joint.fit, joint.points, one_group) for joint in joints)
    assert clean == 1.0 < 1.2 < bent < twice


def test_exposures_six_hours_apart_are_of_different_nights() -> None:
    joint = calibrate_nights(3, 2, 0.0, 1)
    assert nights(joint).tolist() == [0, 0, 1, 1, 2, 2]
