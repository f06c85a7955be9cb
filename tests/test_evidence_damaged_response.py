"""Positions from damaged frames: evidence measured on the frame itself, or a refusal that names the damage."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from startrack.catalog import load_catalog
from startrack.chain import Outcome, pipeline
from startrack.output import result_dict

EVERY_CHI2_2DOF = 18.4  # 99.99 %


def locate_damaged(located: Any, pixels: Any) -> Outcome:
    known = located.result
    exposure = replace(known.exposure, pixels_adu=np.rint(pixels).astype(np.float32))
    return pipeline.locate(exposure, known.camera, known.terrain, load_catalog().brighter_than(7.0))


def damage_of(pixels: Any, kind: str) -> Any:
    if kind == "clipped":
        return np.clip(pixels - np.median(pixels), 0, None)
    if kind == "Gaussian":
        return cv2.GaussianBlur(pixels, (0, 0), 0.8)
    return cv2.medianBlur(pixels.astype(np.uint16), 3)


@pytest.mark.parametrize("kind", ["clipped", "Gaussian", "median"])
def test_a_damaged_frame_gives_the_position_with_honest_errors(located: Any, kind: str) -> None:
    result = locate_damaged(located, damage_of(located.result.exposure.pixels_adu, kind))
    assert result.status == "ok", result.message
    error, fix = result.fix.position_enu_m[:2] - located.truth.position_enu_m[:2], result.fix
    assert error @ np.linalg.solve(fix.covariance_m2, error) < EVERY_CHI2_2DOF
    assert np.hypot(*error) < fix.radius999_m < 150.0
    assert result_dict(result)["evidence"]["damage"] == result.damage.cause
    assert result.damage.message in result.warnings


def test_the_corrected_evidence_is_calibrated(located: Any) -> None:
    pixels = located.result.exposure.pixels_adu
    found = locate_damaged(located, damage_of(pixels, "clipped")).photometry
    horizon = located.result.terrain.horizon_rad(located.truth.position_enu_m[None, :2], found.azimuth_rad)
    hidden = found.usable & (found.elevation_rad < horizon - np.radians(2)) & (found.elevation_rad > 0)
    z = found.flux_e[hidden] / found.sigma_e[hidden]
    assert abs(np.median(z)) < 0.15
    assert 0.6 < np.std(np.clip(z, -4, 4)) < 1.2  # below 1: most pixels of this wall hold one value


def test_a_frame_without_noise_is_refused_as_damaged(located: Any) -> None:
    pixels = located.result.exposure.pixels_adu
    cut = np.median(pixels) + 25 * np.median(np.abs(pixels - np.median(pixels)))
    result = locate_damaged(located, np.where(pixels > cut, pixels, 0.0))
    assert (result.status, result.reason) == ("refused", "damaged_image")
    assert "the noise is lost" in result.message and "\n" not in result.message
