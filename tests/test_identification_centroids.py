"""Identification of a plain list of centroids in one call, in any order, with and without fluxes and a camera."""

from __future__ import annotations

import numpy as np
import pytest
from test_identification import ARCSEC, FISHEYE, NARROW, frame, random_positions, sky

from startrack.api.centroids import identify_centroids
from startrack.core.types import NotIdentified


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
    assert repr(found).startswith(f"<IdentifiedCentroids: {len(found.star)} stars, rms 0.") and len(repr(found)) < 80
    assert found.false_alarm_probability < 1e-20
    assert np.array_equal(found.hip, sky().hip[found.star])
    error = truth.R_cam_icrs @ found.attitude.R_cam_icrs.T
    off = np.array([error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]]) / 2
    assert off @ np.linalg.solve(found.attitude.covariance_rad2, off) < 25
    assert np.linalg.norm(off) < 60 * ARCSEC


def test_without_a_time_the_error_of_aberration_is_stated() -> None:
    truth = frame(FISHEYE, 2, limit=5.0, hidden=0.3)
    found = identify_centroids(truth.detections.xy_px, sigma_px=0.2, camera=FISHEYE)
    at_time = identify_centroids(truth.detections.xy_px, sigma_px=0.2, camera=FISHEYE, stars=sky())
    more = found.attitude.covariance_rad2 - found.attitude_fit.attitude.covariance_rad2
    np.testing.assert_allclose(more, (60 * ARCSEC) ** 2 * np.eye(3))
    assert at_time.attitude is at_time.attitude_fit.attitude


def test_without_fluxes_the_order_of_the_list_is_enough() -> None:
    truth = frame(FISHEYE, 2, limit=5.0, hidden=0.3)
    found = identify_centroids(truth.detections.xy_px, sigma_px=0.2, camera=FISHEYE)
    assert np.mean(truth.star[found.detection] == found.star) > 0.97
    assert len(found.detection) > 0.7 * np.count_nonzero(truth.star >= 0)


@pytest.mark.slow
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


WRONG_LISTS = {
    "three columns": (np.zeros((9, 3)), {}, r"shape \(9, 3\): give \(n, 2\)"),
    "one row of numbers": ([1.0, 2.0, 3.0], {}, r"shape \(3,\): give \(n, 2\)"),
    "rows of unequal length": ([[1.0, 2.0], [3.0]], {}, "rows of equal length"),
    "fluxes in a column": (np.zeros((9, 3)), {}, r"by their names, such as flux=table\[:, 2\]"),
    "texts": (["a.png", "b.png"], {}, "array of numbers"),
    "numbers as texts": ([["1", "2"], ["3", "4"]], {}, "each of them real; this is an array of <U1"),
    "complex numbers": (np.zeros((9, 2), complex), {}, "each of them real; this is an array of complex128"),
    "a generator": (((x, x) for x in range(9)), {}, "a list or an array of numbers, .* this is generator"),
    "complex fluxes": (np.zeros((9, 2)), {"flux": np.ones(9, complex)}, "flux= must be .* real"),
    "a size beside the camera": (np.zeros((9, 2)), {"size_px": (10, 10)}, "the camera has its own"),
    "a field beside the camera": (np.zeros((9, 2)), {"fov_rad": 3.0}, "the camera has its own"),
    "infinite": (np.full((9, 2), np.inf), {}, "must be finite"),
    "too few fluxes": (np.zeros((9, 2)), {"flux": np.ones(8)}, r"flux= has the shape \(8,\): .* each of the 9"),
    "too many errors": (np.zeros((9, 2)), {"sigma_px": np.ones(10)}, r"sigma_px= has the shape \(10,\)"),
    "errors of zero": (np.zeros((9, 2)), {"sigma_px": 0.0}, "sigma_px= must be above 0"),
}


@pytest.mark.parametrize("case", WRONG_LISTS)
def test_the_message_about_a_wrong_list_says_what_to_give(case) -> None:
    xy_px, more, message = WRONG_LISTS[case]
    with pytest.raises(ValueError, match=message):
        identify_centroids(xy_px, camera=FISHEYE, stars=sky(), **more)


@pytest.mark.parametrize("empty", [[], np.zeros((0, 2))], ids=["list", "array"])
def test_an_empty_list_has_too_few_stars(empty) -> None:
    with pytest.raises(NotIdentified, match="0 point sources: too few"):
        identify_centroids(empty, camera=FISHEYE, stars=sky())


@pytest.mark.parametrize("lens", [{"camera": FISHEYE}, {"fov_rad": 3.0, "size_px": FISHEYE.size_px}], ids=list)
def test_centroids_of_another_frame_are_named(lens) -> None:
    xy_px = random_positions(FISHEYE, 200, np.random.default_rng(6)) + 5000.0
    width, height = FISHEYE.size_px
    with pytest.raises(NotIdentified, match=f"none of the 200 centroids lies in the frame of {width} x {height} px"):
        identify_centroids(xy_px, stars=sky(), **lens)


def test_centroids_outside_the_image_circle_are_named() -> None:
    """In the corners of the frame the fisheye shows no sky."""
    xy_px = np.random.default_rng(7).uniform(0.0, 40.0, (50, 2))
    with pytest.raises(NotIdentified, match="only 0 of 50 point sources lie in the image circle of camera"):
        identify_centroids(xy_px, camera=FISHEYE, stars=sky())


def test_an_impossible_field_or_frame_is_named() -> None:
    xy_px = random_positions(FISHEYE, 40, np.random.default_rng(5))
    with pytest.raises(ValueError, match="fov_rad= is -3"):
        identify_centroids(xy_px, fov_rad=-3.0, size_px=(1024, 1024), stars=sky())
    with pytest.raises(ValueError, match="size_px= is"):
        identify_centroids(xy_px, fov_rad=3.0, size_px=(1024, 0), stars=sky())
    with pytest.raises(ValueError, match="size_px= is 1024: give width and height"):
        identify_centroids(xy_px, fov_rad=3.0, size_px=1024, stars=sky())  # type: ignore[arg-type]


@pytest.mark.parametrize("flux", [None, np.linspace(9.0, 1.0, 40)], ids=["none", "given"])
def test_a_refused_list_without_fluxes_is_said_to_count_as_sorted(flux) -> None:
    xy_px = random_positions(FISHEYE, 40, np.random.default_rng(8))
    with pytest.raises(NotIdentified) as refused:
        identify_centroids(xy_px, camera=FISHEYE, stars=sky(), flux=flux)
    assert ("counts as sorted, brightest first" in str(refused.value)) == (flux is None)
