"""Narrow fields of unknown width: the votes of triangles, distorted lenses, and refusals."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from test_unknown_lens import SIZE, detections, lens_camera, picture, sky

from startrack.camera import KannalaBrandt, Pinhole
from startrack.core.types import Detections
from startrack.identification import unknown_lens
from startrack.identification.similar_triangles import shape_index
from startrack.identification.triangles import triangles
from startrack.identification.unknown_lens import LOG_FALSE_ALARM, identify_unknown_lens
from startrack.identification.verify_unknown_lens import VerifiedLens


def search(seen: Detections, fov: float) -> tuple[unknown_lens._Search, Iterator[VerifiedLens]]:
    found = unknown_lens._Search(seen, SIZE, (0.9 * np.radians(fov), 1.1 * np.radians(fov)), sky(), None, None)
    return found, (lens for lens, _ in found.lenses())


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("wrong_by", [0.91, 1.0, 1.09])
@pytest.mark.parametrize("seed", [3, 4])
def test_the_first_view_voted_for_is_right(seed: int, wrong_by: float, mirrored: bool) -> None:
    camera = lens_camera(Pinhole(), 16, 700, mirrored=mirrored)
    seen, truth, R = picture(camera, seed=seed, limit=7.0, hidden=0.2)
    looking, lenses = search(seen, 16 * wrong_by)
    found = next(lenses)
    assert looking.hypotheses.tried < 40_000
    assert found.log_p < LOG_FALSE_ALARM
    assert found.camera.mirrored == mirrored
    assert found.camera.focal_px[0] == pytest.approx(camera.focal_px[0], rel=1e-3)
    assert np.mean(truth[found.detection] == found.star) >= 0.98
    assert np.trace(found.R_cam_icrs.T @ R) > 3 - 1e-7


@pytest.mark.parametrize("bend_px", [-12.0, 12.0])
def test_a_distorted_narrow_lens_is_not_fitted_as_a_pinhole(bend_px: float) -> None:
    half = np.radians(15)
    focal = 700 / np.tan(half)
    bend = bend_px / focal / half**3
    lens = KannalaBrandt((1 / 3 + bend, 2 / 15, 17 / 315, 62 / 2835))
    camera = lens_camera(lens, 30, 700 + bend_px)
    seen, truth, R = picture(camera, seed=5, limit=6.5, hidden=0.0)
    found = identify_unknown_lens(seen, SIZE, np.radians(30), sky())
    names = found.identification
    assert np.mean(truth[names.detection] == names.star) >= 0.98
    assert found.camera.lens.model == "kannala_brandt"
    px, inside = camera.project(sky().rays_icrs[:5000] @ R.T)
    again, also = found.camera.project(sky().rays_icrs[:5000] @ names.R_cam_icrs.T)
    known = inside & also & (found.camera.angle_rad(px) < found.camera.calibrated_angle_rad)
    assert known.sum() > 40
    assert np.linalg.norm(px - again, axis=1)[known].max() < 0.7


@pytest.mark.parametrize("seed", range(6))
def test_noise_with_or_without_clumps_is_far_from_acceptance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(20, 600))
    heaps = rng.uniform(0, 1, (max(n // 12, 2), 2)) * SIZE
    xy = (
        heaps[rng.integers(0, len(heaps), n)] + rng.normal(0, 60, (n, 2))
        if seed % 2
        else rng.uniform(0, 1, (n, 2)) * SIZE
    )
    noise = detections(np.clip(xy, 0, np.array(SIZE) - 1), 100 * np.sort(rng.pareto(1.5, n) + 1)[::-1])
    looking, lenses = search(noise, 14)
    assert all(found.log_p > -12 for found in lenses)
    assert looking.hypotheses.tried > 1000


def test_similar_triangles_equal_those_of_an_exhaustive_comparison() -> None:
    rng = np.random.default_rng(1)
    rays = rng.normal(size=(150, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    index = shape_index(triangles(rays, 0.9), shape_tolerance=0.02)
    image = triangles(rays[:40], 1.0)
    left, right = index.candidates(image, log_spread=0.13)
    sides, others = image.sides_rad[:, None], index.triangles.sides_rad[None]
    ratio = np.abs(sides[..., :2] / sides[..., 2:] - others[..., :2] / others[..., 2:]).max(axis=2)
    expected = np.nonzero((ratio < 0.02) & (np.abs(np.log(sides[..., 2] / others[..., 2])) < 0.13))
    assert len(left) > 500
    assert set(zip(left.tolist(), right.tolist(), strict=True)) == set(
        zip(*(e.tolist() for e in expected), strict=True)
    )
