"""A detector that returns positions and fluxes alone: what is completed is what the project's own detector measures."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from page_helpers import ROOT

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import Settings, identify
from startrack.core.types import Mask, TooFewStars
from startrack.detection import Detector, PositionDetector
from startrack.exposure import read_exposure

CAMERA = load_camera("fisheye-2048")
GAIN = CAMERA.sensor.gain_e_per_adu


@pytest.fixture(scope="module")
def exposure():
    return read_exposure(ROOT / "sample_images/near-wall.png")


@pytest.fixture(scope="module")
def own(exposure):
    return Detector()(exposure, CAMERA)


def test_the_rest_is_that_of_the_own_detector(exposure, own):
    order = np.random.default_rng(1).permutation(len(own.snr))  # any order is sorted
    found = PositionDetector(lambda _: (own.xy_px[order], own.flux_e[order] / GAIN))(exposure, CAMERA)
    np.testing.assert_array_equal(found.xy_px, own.xy_px)
    np.testing.assert_allclose(found.flux_e, own.flux_e)
    assert found.psf_sigma_px == pytest.approx(own.psf_sigma_px, rel=0.02)
    # Of a matched filter that knows background and place: a tenth less than of a fit of both.
    assert 0.85 < np.median(found.flux_sigma_e / own.flux_sigma_e) < 1.0
    assert 0.75 < np.median(found.covariance_px2[:, 0, 0] / own.covariance_px2[:, 0, 0]) < 1.0
    np.testing.assert_array_equal(found.saturated, own.saturated)
    np.testing.assert_allclose(found.noise_e.mean(), own.noise_e.mean(), rtol=0.05)
    stated = PositionDetector(lambda _: (own.xy_px, own.flux_e), sigma_px=0.4)(exposure, CAMERA)
    np.testing.assert_allclose(stated.covariance_px2[:, 1, 1], 0.16)


def test_an_image_is_identified_by_it(exposure, own):
    settings = Settings(detector=PositionDetector(lambda _: (own.xy_px[:300].tolist(), own.flux_e[:300])))
    result = identify(exposure, CAMERA, load_catalog(), settings)
    assert result.status == "ok" and len(result.identification) > 200


def test_masked_sources_are_left_out(exposure, own):
    masked = np.zeros(exposure.pixels_adu.shape, dtype=bool)
    masked[:, :1024] = True
    half = replace(exposure, mask=Mask(masked=masked, sha256=""))
    found = PositionDetector(lambda _: (own.xy_px, own.flux_e))(half, CAMERA)
    assert 0 < len(found.snr) < len(own.snr) and found.xy_px[:, 0].min() > 1023.5


WRONG = [
    (lambda _: None, "find() returned NoneType: it must return (xy_px, flux_adu)"),
    (lambda _: ([[1.0, 2.0, 3.0]], [1.0]), "arrays (1, 3) and (1,): they must be (n, 2) and (n,)"),
    (lambda _: ([[1.0, 2.0]], [1.0, 2.0]), "arrays (1, 2) and (2,)"),
    (lambda _: ([[1.0, 2.0], [9.0, 5000.0]], [1.0, 2.0]), "1 of 2 sources outside the frame"),
    (lambda _: ([[1.0, np.nan]], [1.0]), "outside the frame, or no numbers; the first: 1, nan, 1"),
    (lambda _: ([[1.0, 2.0]], [-3.0]), "a flux that is not above 0; the first: 1, 2, -3"),
]


@pytest.mark.parametrize(("find", "cause"), WRONG, ids=range(len(WRONG)))
def test_what_is_wrong_is_stated(find, cause, exposure):
    with pytest.raises(ValueError, match=re.escape(cause)):
        PositionDetector(find)(exposure)


def test_no_source_and_no_detections_are_named(exposure):
    with pytest.raises(TooFewStars, match="the detector found no point source"):
        PositionDetector(lambda _: ([], []))(exposure)
    with pytest.raises(TypeError, match=r"the detector returned tuple, not Detections: put .* into startrack"):
        identify(exposure, CAMERA, load_catalog(), Settings(detector=lambda exposure, camera: ([], [])))
