"""Stars that differ from the Gaussian PSF: trails of an undersampled lens, among hot pixels."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.special import ndtr

from startrack.core.types import Exposure
from startrack.detection import Detector

SIZE = 512
SIGMA_PX = 0.6


def pixel_gaussian(xy, flux, sigma_px=SIGMA_PX):
    """A frame (SIZE, SIZE) with Gaussian stars integrated over the pixels."""
    frame = np.zeros((SIZE, SIZE))
    for (x, y), f in zip(xy, flux, strict=True):
        i, j = round(x), round(y)
        at = np.arange(-8, 9)
        px = np.diff(ndtr((np.append(at, 9) - 0.5 + i - x) / sigma_px))
        py = np.diff(ndtr((np.append(at, 9) - 0.5 + j - y) / sigma_px))
        frame[j - 8 : j + 9, i - 8 : i + 9] += f * np.outer(py, px)
    return frame


def trail_stars(xy, flux, length_px, steps=15):
    """The same stars, each drawn along a line whose direction changes over the frame."""
    direction = np.pi * xy[:, 0] / SIZE
    along = np.stack([np.cos(direction), np.sin(direction)], axis=1)
    shifts = np.linspace(-0.5, 0.5, steps) * length_px
    return sum(pixel_gaussian(xy + s * along, flux / steps) for s in shifts)


@pytest.mark.parametrize("length_px", [0.0, 1.5, 2.2])
def test_bright_trailed_stars_are_stars_and_hot_pixels_are_not(length_px):
    rng = np.random.default_rng(5)
    xy = rng.uniform(20, SIZE - 20, (90, 2))
    xy = xy[cKDTree(xy).query(xy, k=2)[0][:, 1] > 12]
    flux = np.geomspace(2e3, 3e5, len(xy))
    hot = rng.integers(20, SIZE - 20, (150, 2))
    hot = hot[cKDTree(xy).query(hot)[0] > 10]
    frame = 2400 + trail_stars(xy, flux, length_px) + rng.normal(0, 40, (SIZE, SIZE))
    frame[hot[:, 1], hot[:, 0]] += rng.uniform(1e3, 5e4, len(hot))
    found = Detector()(Exposure(pixels_adu=np.clip(frame, 0, 65535).round(), saturation_adu=65535.0))

    distance, _ = cKDTree(found.xy_px).query(xy)
    assert np.count_nonzero(distance < 0.3) >= 0.95 * len(xy)
    distance, _ = cKDTree(found.xy_px).query(hot)
    assert np.count_nonzero(distance < 1.0) <= 0.03 * len(hot)


def test_a_bright_star_of_a_real_lens_clipped_in_two_pixels_is_found():
    """Its wings are wider than the Gaussian of unsaturated stars; it must not be rejected for that."""
    rng = np.random.default_rng(8)
    xy = rng.uniform(20, SIZE - 20, (120, 2))
    xy = xy[cKDTree(xy).query(xy, k=2)[0][:, 1] > 14]
    flux = np.geomspace(1.5e3, 9e4, len(xy))
    at = np.arange(3)
    flux[at] = 3.4e5
    xy[at] = np.round(xy[at]) + np.array([[0.0, 0.5], [0.05, 0.45], [0.45, 0.0]])
    frame = 2000 + pixel_gaussian(xy, 0.8 * flux, 0.5) + pixel_gaussian(xy, 0.2 * flux, 1.1)
    frame += rng.normal(0, 90, (SIZE, SIZE))
    found = Detector()(Exposure(pixels_adu=np.clip(frame, 0, 65535).round(), saturation_adu=65535.0))
    distance, nearest = cKDTree(found.xy_px).query(xy)
    assert distance[at].max() < 0.2
    assert found.saturated[nearest[at]].all()
    assert np.abs(found.flux_e[nearest[at]] / 3.4e5 - 1).max() < 0.35  # the saturated part is estimated from the wings
    assert np.count_nonzero(cKDTree(xy).query(found.xy_px)[0] > 3) <= 2
