"""Identification of a plain list of centroids in one call, in any order, with and without fluxes and a camera."""

from __future__ import annotations

import numpy as np
import pytest
from test_identification import ARCSEC, FISHEYE, NARROW, frame, random_positions, sky

from startrack.identification import identify_centroids
from startrack.types import NotIdentified


@pytest.mark.parametrize("camera", [FISHEYE, NARROW], ids=lambda camera: camera.name)
def test_a_list_in_any_order_is_identified(camera) -> None:
    truth = frame(camera, 1, limit=8.0 if camera is NARROW else 5.5, hidden=0.0)
    d, order = truth.detections, np.random.default_rng(2).permutation(len(truth.star))
    found = identify_centroids(
        d.xy_px[order], flux=d.flux_e[order], sigma_px=0.2, saturated=d.saturated[order], camera=camera, stars=sky()
    )
    assert np.mean(truth.star[order][found.detection] == found.star) > 0.995
    assert len(found.detection) > 0.75 * np.count_nonzero(truth.star >= 0)
    assert found.camera is camera
    assert found.false_alarm_probability < 1e-20
    assert np.array_equal(found.hip, sky().hip[found.star])
    error = truth.R_cam_icrs @ found.attitude.R_cam_icrs.T
    off = np.array([error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]]) / 2
    assert off @ np.linalg.solve(found.attitude.covariance_rad2, off) < 25
    assert np.linalg.norm(off) < 60 * ARCSEC


def test_without_fluxes_the_order_of_the_list_is_enough() -> None:
    truth = frame(FISHEYE, 2, limit=5.0, hidden=0.3)
    found = identify_centroids(truth.detections.xy_px, sigma_px=0.2, camera=FISHEYE)
    assert np.mean(truth.star[found.detection] == found.star) > 0.97
    assert len(found.detection) > 0.7 * np.count_nonzero(truth.star >= 0)


@pytest.mark.parametrize("known", [True, False], ids=["fluxes", "order"])
def test_a_field_of_view_is_enough(known: bool) -> None:
    truth = frame(NARROW, 3, limit=7.5, hidden=0.0)
    fov_rad = 2 * np.arctan(0.5 * NARROW.size_px[0] / NARROW.focal_px[0])
    found = identify_centroids(
        truth.detections.xy_px, flux=truth.detections.flux_e if known else None, fov_rad=1.05 * fov_rad,
        size_px=NARROW.size_px, stars=sky(),
    )  # fmt: skip
    assert np.mean(truth.star[found.detection] == found.star) > 0.97
    assert found.camera.focal_px[0] == pytest.approx(NARROW.focal_px[0], rel=1e-3)
    assert found.camera.covariance is not None


@pytest.mark.parametrize("known", [True, False], ids=["fluxes", "order"])
def test_random_centroids_are_refused(known: bool) -> None:
    rng = np.random.default_rng(4)
    xy = random_positions(FISHEYE, 80, rng)
    with pytest.raises(NotIdentified, match="chance"):
        identify_centroids(xy, flux=rng.pareto(1.5, len(xy)) if known else None, camera=FISHEYE, stars=sky())


def test_a_call_without_camera_or_field_says_what_is_missing() -> None:
    with pytest.raises(ValueError, match="fov_rad"):
        identify_centroids(np.zeros((10, 2)))
