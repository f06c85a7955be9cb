"""The point-spread function against scipy's quadrature and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import dblquad
from scipy.stats import multivariate_normal, norm

from startrack.psf import filter_kernel, noise_area_px, pixel_profile, stamp_radius


@pytest.mark.parametrize("sigma", [0.4, 0.7, 1.0, 2.5])
def test_profile_is_the_gaussian_integrated_over_each_pixel(sigma: float) -> None:
    offsets = np.array([-1.3, -0.5, 0.0, 0.2, 0.5, 2.0])
    profile, _ = pixel_profile(offsets, sigma, 6)
    j = np.arange(-6, 7)
    expected = norm.cdf(j + 0.5, offsets[:, None], sigma) - norm.cdf(j - 0.5, offsets[:, None], sigma)
    assert profile == pytest.approx(expected, abs=1e-14)


def test_the_product_of_two_profiles_is_the_star_on_the_sensor() -> None:
    x, y, sigma = 0.3, -0.4, 0.9
    px, _ = pixel_profile(np.array([x]), sigma, 4)
    py, _ = pixel_profile(np.array([y]), sigma, 4)
    star = multivariate_normal([x, y], sigma**2 * np.eye(2))
    for i, j in ((0, 0), (1, -1), (-2, 0)):
        light, _ = dblquad(lambda b, a: star.pdf([a, b]), i - 0.5, i + 0.5, j - 0.5, j + 0.5, epsabs=1e-9)
        assert px[0, 4 + i] * py[0, 4 + j] == pytest.approx(light, abs=1e-8)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0])
def test_the_derivative_is_with_respect_to_the_offset(sigma: float) -> None:
    offsets, step = np.linspace(-1, 1, 9), 1e-6
    _, slope = pixel_profile(offsets, sigma, 8)
    difference = (pixel_profile(offsets + step, sigma, 8)[0] - pixel_profile(offsets - step, sigma, 8)[0]) / (2 * step)
    assert slope == pytest.approx(difference, abs=1e-9)


def test_each_star_may_have_its_own_width() -> None:
    both, _ = pixel_profile(np.zeros(2), np.array([0.7, 1.4]), 3)
    assert np.array_equal(both[0], pixel_profile(np.zeros(1), 0.7, 3)[0][0])
    assert np.array_equal(both[1], pixel_profile(np.zeros(1), 1.4, 3)[0][0])


@pytest.mark.parametrize("sigma", [0.3, 0.7, 1.0, 1.5, 4.0])
def test_the_stamp_holds_the_flux_and_the_kernel_is_symmetric(sigma: float) -> None:
    kernel = filter_kernel(sigma)
    assert len(kernel) == 2 * stamp_radius(sigma) + 1 >= 5
    assert kernel.dtype == np.float32
    assert np.array_equal(kernel, kernel[::-1])
    assert 0.995 <= kernel.sum() ** 2 <= 1.0 + 1e-6


def test_noise_area_is_that_of_a_matched_filter() -> None:
    assert noise_area_px(4.0) == pytest.approx(4 * np.pi * 4.0**2, rel=0.02)  # wide: 4 pi sigma^2
    assert noise_area_px(0.1) == pytest.approx(1.0, rel=1e-3)  # all light in one pixel
    # Independent of any formula: the scatter of matched-filter fluxes of pure noise.
    rng = np.random.default_rng(1)
    p = np.outer(*2 * [filter_kernel(1.0).astype(float)])
    fluxes = (rng.normal(0, 1, (20_000, p.size)) @ p.ravel()) / np.sum(p**2)
    assert fluxes.var() == pytest.approx(noise_area_px(1.0), rel=0.03)
