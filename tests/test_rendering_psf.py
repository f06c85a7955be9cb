"""The renderer's PSF against integrals by photutils and SciPy."""

import numpy as np
import pytest
from render_helpers import centroid_px

from startrack.rendering.sources import INVISIBLE_E_PER_PX, splat


def one_star(x, y, flux=1e5, sigma=1.0, shape=(41, 43)):
    image = np.zeros(shape)
    splat(image, np.array([[x, y]]), np.array([flux]), sigma)
    return image


@pytest.mark.parametrize("sigma", [0.35, 0.7, 1.0, 2.3])
def test_every_pixel_against_photutils(sigma):
    psf = pytest.importorskip("photutils.psf")
    x0, y0, flux = 20.31, 19.84, 1e5
    model = psf.CircularGaussianSigmaPRF(flux=flux, x_0=x0, y_0=y0, sigma=sigma)
    y, x = np.indices((41, 43))
    np.testing.assert_allclose(one_star(x0, y0, flux, sigma), model(x, y), atol=2 * INVISIBLE_E_PER_PX)


def test_a_pixel_against_numerical_integration():
    x0, y0 = 20.31, 19.84
    fine = (np.arange(400) + 0.5) / 400 - 0.5
    for x, y in [(20, 20), (21, 19), (23, 22)]:
        density = np.exp(-0.5 * ((x + fine - x0) ** 2 + (y + fine[:, None] - y0) ** 2)) / (2 * np.pi)
        assert one_star(x0, y0)[y, x] / 1e5 == pytest.approx(density.mean(), rel=1e-5)


@pytest.mark.parametrize("flux", [2.0, 100.0, 1e4, 1e9])
def test_flux_is_conserved_down_to_what_is_invisible(flux):
    lost = flux - one_star(20.5, 20.3, flux).sum()
    assert 0 <= lost < 0.3  # electrons, in all pixels together, whatever the flux


def test_centroid_of_a_noiseless_star_is_where_it_was_put():
    rng = np.random.default_rng(1)
    for x, y in rng.uniform(15, 25, (20, 2)):
        np.testing.assert_allclose(centroid_px(one_star(x, y)), [x, y], atol=1e-4)


def test_a_star_off_the_frame_leaves_its_wing_and_nothing_wraps():
    whole = one_star(20.0, 20.0, shape=(41, 41))
    cut = one_star(-1.0, 20.0, shape=(41, 41))
    np.testing.assert_allclose(cut[:, :5], whole[:, 21:26], atol=1e-9)
    assert cut[:, 20:].sum() == 0
    assert one_star(-50.0, 20.0).sum() == 0


def test_many_stars_are_the_sum_of_each():
    rng = np.random.default_rng(2)
    xy, flux = rng.uniform(0, 40, (300, 2)), 10 ** rng.uniform(0, 6, 300)
    together = np.zeros((41, 43))
    splat(together, xy, flux, 1.1)
    np.testing.assert_allclose(together, sum(one_star(*p, f, 1.1) for p, f in zip(xy, flux, strict=True)), rtol=1e-9)
