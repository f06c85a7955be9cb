"""Evidence: forced photometry of painted stars, and calibrated log-likelihood ratios."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from render_helpers import FISHEYE, stars_at
from scipy.spatial.transform import Rotation
from scipy.special import expit
from scipy.stats import norm
from star_painter import cramer_rao, paint

from startrack.core.types import Body, Detections, SmoothImage, Stars
from startrack.detection.background import background_and_noise
from startrack.evidence import FluxScale, StarPhotometer, StarPhotometry, fit_flux_scale, flux_scale
from startrack.evidence.photometry import Photometry, Sources, half_width, measure
from startrack.evidence.star_photometer import CAP, visibility_llr
from startrack.frames import airmass, azel_from_rays

SIZE, VARIANCE, READ_NOISE = 1024, 100.0, 2.5
SCATTER = 0.05


def without_sources(
    image: np.ndarray, noise: np.ndarray, dead: np.ndarray | None = None, sigma_px: float = 1.0
) -> Detections:
    """An image (H, W) [e] on no background, with the noise of its pixels (H, W)."""
    none = np.zeros(0)
    return Detections(
        xy_px=np.zeros((0, 2)), covariance_px2=np.zeros((0, 2, 2)), flux_e=none, flux_sigma_e=none, snr=none,
        saturated=np.zeros(0, bool), psf_sigma_px=sigma_px, image_e=image,
        dead=np.zeros(image.shape, bool) if dead is None else dead,
        background=SmoothImage.of(np.zeros_like(noise)), noise=SmoothImage.of(noise),
    )  # fmt: skip


def add_noise(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Background-subtracted pixels [e] of the light on a background of the usual variance."""
    background = VARIANCE - READ_NOISE**2
    return (rng.poisson(light + background) - background + rng.normal(0, READ_NOISE, light.shape)).astype(np.float32)


@dataclass(frozen=True)
class Measured:
    """Stars (n), first stars of the pairs first, and their photometry."""

    expected: np.ndarray
    true: np.ndarray
    shines: np.ndarray
    light: Photometry
    firsts: int

    def z(self) -> np.ndarray:
        """Errors of the usable first stars over their stated standard deviations."""
        m = self.light
        sigma = np.sqrt(m.variance_e2 + m.own_shot * self.true + m.neighbour_variance_e2)
        return ((m.flux_e - self.true) / sigma)[: self.firsts][m.usable[: self.firsts]]

    def llr(self) -> np.ndarray:
        m = self.light
        hidden = m.variance_e2 + m.neighbour_variance_e2
        shining = hidden + m.own_shot * self.expected + np.square(SCATTER * self.expected)
        return visibility_llr(m.flux_e, self.expected, np.sqrt(hidden), np.sqrt(shining))


def measure_pairs(
    sigma: float, shining: float, *, rng: np.random.Generator, neighbours: tuple[float, float] | None = None,
    faintest: float = 30.0, brightest: float = 3000.0, spacing: int = 20,
) -> Measured:  # fmt: skip
    """Stars of which the part `shining` shines; each with a neighbour 1 to 4 sigma off that shines with the probability
    neighbours[0] and is thought to shine with the probability neighbours[1]."""
    grid = np.arange(14, SIZE - 14, spacing)
    xy = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2) + rng.uniform(-0.5, 0.5, (len(grid) ** 2, 2))
    n, thought = len(xy), np.full(len(xy), shining)
    part = np.full(n, shining)
    if neighbours is not None:
        turn, apart = rng.uniform(0, 2 * np.pi, n), sigma * rng.uniform(1, 4, n)
        xy = np.concatenate([xy, xy + apart[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)])
        part = np.concatenate([part, np.full(n, neighbours[0])])
        thought = np.concatenate([thought, np.full(n, neighbours[1])])
    expected = np.exp(rng.uniform(np.log(faintest), np.log(brightest), len(xy)))
    shines = rng.random(len(xy)) < part
    true = np.where(shines, expected * (1 + SCATTER * rng.normal(size=len(xy))), 0.0)
    image = np.zeros((SIZE, SIZE))
    paint(image, xy, true, sigma)
    sources = Sources(xy_px=xy, flux_e=expected, fraction_sigma=np.full(len(xy), SCATTER), visible=thought)
    noise = np.full((SIZE, SIZE), np.sqrt(VARIANCE), np.float32)
    light = measure(without_sources(add_noise(image, rng), noise, sigma_px=sigma), sources)
    return Measured(expected, true, shines, light, n)


@pytest.mark.parametrize(
    ("shining", "neighbours"),
    [(1.0, None), (0.0, None), (0.0, (1.0, 1.0)), (1.0, (1.0, 1.0)), (0.0, (0.5, 0.5)), (1.0, (0.5, 0.5))],
    ids=["shining", "hidden", "hidden beside a star", "beside a star", "hidden beside who knows", "beside who knows"],
)
@pytest.mark.parametrize("sigma", [0.7, 1.0, 1.5])
def test_photometry_is_unbiased_and_its_variance_right(
    sigma: float, shining: float, neighbours: tuple[float, float] | None
) -> None:
    got = measure_pairs(sigma, shining, rng=np.random.default_rng(1), neighbours=neighbours)
    z = got.z()
    assert len(z) > 0.97 * got.firsts
    assert abs(z.mean()) < 0.07  # 2500 stars: 3.5 of its own standard deviations
    assert z.std() == pytest.approx(1.0, abs=0.05)
    assert np.abs(z).max() < 5.0
    if shining:
        bright = got.light.usable[: got.firsts] & (got.expected[: got.firsts] > 1000)
        ratio = got.light.flux_e[: got.firsts][bright] / got.true[: got.firsts][bright]
        assert np.median(ratio) == pytest.approx(1.0, abs=0.006)


@pytest.mark.parametrize("sigma", [0.7, 1.0, 1.5])
def test_photometry_is_near_the_cramer_rao_bound(sigma: float) -> None:
    """Variance of hidden stars against the Cramer-Rao bound with known position and free level."""
    got = measure_pairs(sigma, 0.0, rng=np.random.default_rng(2))
    p = cramer_rao(np.zeros(2), 1e-6, sigma, VARIANCE)  # no flux: position and flux are not correlated
    bound = p[2, 2]
    assert np.median(got.light.variance_e2) < 1.25 * bound  # the stamp is small: the level adds to the variance
    assert np.median(got.light.variance_e2) > 0.97 * bound


@pytest.mark.parametrize("neighbours", [None, (0.5, 0.5)], ids=["alone", "beside who knows"])
def test_ratios_are_calibrated(neighbours: tuple[float, float] | None) -> None:
    """Of the stars with ratio l, as many shine as the logistic of l says (half of all do)."""
    rng = np.random.default_rng(3)
    llr, shines = [], []
    for _ in range(3):
        got = measure_pairs(
            1.0, 0.5, rng=rng, neighbours=neighbours, faintest=10, brightest=600, spacing=20 if neighbours else 15
        )
        use = got.light.usable[: got.firsts]
        llr.append(got.llr()[: got.firsts][use])
        shines.append(got.shines[: got.firsts][use])
    ratio, yes = np.concatenate(llr), np.concatenate(shines)
    for low, high in ((-4, -3), (-3, -2), (-2, -1), (-1, -0.3), (-0.3, 0.3), (0.3, 1), (1, 2), (2, 3), (3, 4)):
        some = (ratio >= low) & (ratio < high)
        p = expit(ratio[some])
        assert some.sum() >= 100
        assert abs(yes[some].sum() - p.sum()) < 3.5 * np.sqrt(np.sum(p * (1 - p))), (low, high)
    # Beyond, the ratios are capped for outliers: never overconfident.
    for sure, wrong in ((ratio > 4, ~yes), (ratio < -4, yes)):
        p = expit(-np.abs(ratio[sure])).sum()
        assert np.count_nonzero(wrong[sure]) <= p + 3.5 * np.sqrt(p)


def test_the_ratio_is_that_of_the_stated_densities() -> None:
    flux, expected, hidden, shining = 40.0, 60.0, 20.0, 25.0
    anything = 1 / (2 * expected + 10 * hidden)
    shines = 0.998 * norm.pdf(flux, expected, shining) + 0.002 * norm.pdf(flux, 0, hidden) + 0.001 * anything
    hides = 0.999 * norm.pdf(flux, 0, hidden) + 0.001 * anything
    got = visibility_llr(*(np.array([v]) for v in (flux, expected, hidden, shining)))
    assert got[0] == pytest.approx(np.log(shines / hides), rel=1e-9)


def test_the_ratio_rises_with_the_flux_and_is_capped() -> None:
    flux = np.linspace(-100, 400, 501)
    ratio = visibility_llr(flux, np.full(501, 200.0), np.full(501, 20.0), np.full(501, 30.0))
    assert np.all(np.diff(ratio[(flux >= 20) & (flux <= 200)]) > 0)
    assert np.abs(ratio).max() <= CAP
    assert ratio[flux == 200][0] > 6
    assert ratio[flux == 0][0] == pytest.approx(np.log(2e-3), abs=0.5)  # a star may be missing for other reasons
    # A flux a hundred times that of the star, or one far below the wall's, is evidence of neither.
    odd = visibility_llr(np.array([2e4, -500.0]), np.full(2, 200.0), np.full(2, 20.0), np.full(2, 30.0))
    assert np.all(np.abs(odd) < 1.0)


def test_a_star_far_below_the_noise_has_no_evidence() -> None:
    ratio = visibility_llr(np.array([-30.0, 0.0, 30.0]), np.full(3, 0.01), np.full(3, 20.0), np.full(3, 20.0))
    assert np.abs(ratio).max() < 0.01


@pytest.mark.parametrize("excess", [100.0, 1000.0, 20_000.0])
@pytest.mark.parametrize("flux", [50.0, 400.0, 5000.0])
def test_a_hot_pixel_near_a_star_is_masked(flux: float, excess: float) -> None:
    rng = np.random.default_rng(4)
    grid = np.arange(14, SIZE - 14, 20)
    xy = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2) + rng.uniform(-0.5, 0.5, (len(grid) ** 2, 2))
    expected = np.full(len(xy), flux)
    image = np.zeros((SIZE, SIZE))
    paint(image, xy[::2], expected[::2], 1.0)  # every other star shines
    image = add_noise(image, rng)
    spot = np.rint(xy).astype(int) + rng.integers(-3, 4, xy.shape)
    image[spot[:, 1], spot[:, 0]] += excess
    sources = Sources(xy_px=xy, flux_e=expected, fraction_sigma=np.full(len(xy), 0.05), visible=np.full(len(xy), 0.5))
    light = measure(without_sources(image, np.full((SIZE, SIZE), 10.0, np.float32)), sources)
    true = np.where(np.arange(len(xy)) % 2 == 0, flux, 0.0)
    z = (light.flux_e - true) / np.sqrt(light.variance_e2 + light.own_shot * true)
    assert light.usable.mean() > 0.97
    assert np.mean(np.abs(z[light.usable]) > 5) < 0.005
    assert z[light.usable].std() < 1.15  # ten sigma at the centre of a star may count as its flux


@pytest.mark.parametrize("step_sigmas", [15.0, 100.0])
def test_stars_beside_the_end_of_a_bright_sky_are_unbiased(step_sigmas: float) -> None:
    """The background bends over its blocks beside a sharp edge, and the image does not."""
    rng, sigma, middle, radius = np.random.default_rng(5), 0.7, SIZE / 2 + 0.3, 350.0
    y, x = np.mgrid[:SIZE, :SIZE]
    light = VARIANCE + step_sigmas * np.sqrt(VARIANCE) * norm.cdf((radius - np.hypot(x - middle, y - middle)) / sigma)
    image = rng.normal(light, np.sqrt(light)).astype(np.float32)
    background, noise = background_and_noise(image, 1.0, sigma)
    detections = replace(without_sources(image, noise.whole(), sigma_px=sigma), background=background)
    for above_px in (rng.uniform(5.0, 20.0, 4000), rng.uniform(-20.0, -5.0, 4000)):
        turn = rng.uniform(0.0, 2 * np.pi, 4000)
        xy = middle + (radius - above_px)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        nothing = np.zeros(len(xy))
        found = measure(detections, Sources(xy_px=xy, flux_e=nothing, fraction_sigma=nothing, visible=nothing))
        assert found.usable.mean() > 0.97
        z = (found.flux_e / np.sqrt(found.variance_e2))[found.usable]
        assert abs(z.mean()) < 0.1  # 0.02 by chance; with the background as it is 0.4
        assert z.std() < 1.1


def test_saturated_stamps_are_unusable() -> None:
    dead = np.zeros((100, 100), bool)
    dead[48:53, 48:53] = True
    sources = Sources(
        xy_px=np.array([[50.0, 50.0], [30.0, 30.0]]), flux_e=np.full(2, 500.0), fraction_sigma=np.zeros(2),
        visible=np.full(2, 0.5),
    )  # fmt: skip
    light = measure(
        without_sources(np.zeros((100, 100), np.float32), np.full((100, 100), 10.0, np.float32), dead), sources
    )
    assert light.usable.tolist() == [False, True]
    assert all(np.isfinite(getattr(light, name)).all() for name in Photometry.__dataclass_fields__)


# The whole of it on a small frame: enu and icrs are the same, the camera looks at the zenith.
CAMERA = replace(FISHEYE, calibrated_angle_rad=float(np.radians(80.0)))
R_CAM_ENU = CAMERA.R_body_cam.T @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
BACKGROUND_E = np.float32(94.0)
SCALE = FluxScale(zero_mag=11.6, scatter=0.03, stars=100)


def random_stars(n: int, rng: np.random.Generator, v_mag: Any = None) -> Stars:
    z = rng.uniform(-0.1, 1, n)
    turn = rng.uniform(0, 2 * np.pi, n)
    rays = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    return stars_at(rays, np.sort(rng.uniform(1, 6, n)) if v_mag is None else v_mag)


def frame(stars: Stars, shines: np.ndarray, rng: np.random.Generator) -> Detections:
    """Pixels [e] of stars over a background, which is known."""
    px, inside = CAMERA.project(stars.rays_icrs @ R_CAM_ENU.T)
    light = np.zeros((512, 512))
    on = inside & shines
    paint(light, px[on], 10 ** (-0.4 * (stars.v_mag[on] - SCALE.zero_mag)), 1.0)
    found = without_sources(add_noise(light, rng) + BACKGROUND_E, np.full((512, 512), 10.0, np.float32))
    return replace(found, background=SmoothImage.of(np.full((512, 512), BACKGROUND_E)))


def measure_frame(
    stars: Stars, shines: np.ndarray, rng: np.random.Generator, dead: np.ndarray | None = None, **how: Any
) -> StarPhotometry:
    detections = frame(stars, shines, rng)
    detections = detections if dead is None else replace(detections, dead=dead)
    settings: dict[str, Any] = {"bodies": [], "position_sigma_px": 0.05} | how
    return StarPhotometer()(
        detections, CAMERA, stars, settings["bodies"], R_CAM_ENU, np.eye(3), SCALE, settings["position_sigma_px"]
    )


def test_every_star_in_view_gets_a_ratio() -> None:
    rng = np.random.default_rng(5)
    stars = random_stars(1500, rng)
    shines = stars.rays_icrs[:, 0] > 0  # a wall in the west
    light = measure_frame(stars, shines, rng)
    _, inside = CAMERA.project(stars.rays_icrs @ R_CAM_ENU.T)
    assert set(light.star.tolist()) == set(np.flatnonzero(inside & (stars.v_mag < 8)).tolist())
    azimuth, elevation = azel_from_rays(stars.rays_icrs[light.star])
    assert light.azimuth_rad == pytest.approx(azimuth)
    assert light.elevation_rad == pytest.approx(elevation)
    flux = 10 ** (-0.4 * (stars.v_mag[light.star] - SCALE.zero_mag))
    assert light.expected_e == pytest.approx(flux)
    use = light.usable
    truly = shines[light.star]
    strong = use & (flux > 300)  # SNR above 7
    assert strong.sum() > 300
    assert np.mean((light.llr > 0)[strong] == truly[strong]) > 0.99
    assert np.abs(light.llr).max() <= CAP
    z = ((light.flux_e - np.where(truly, flux, 0)) / np.hypot(light.sigma_e, np.sqrt(np.where(truly, flux, 0))))[use]
    assert np.median(np.abs(z)) * 1.4826 == pytest.approx(1.0, abs=0.1)
    rays = light.evidence()
    assert len(rays) == use.sum()
    assert np.array_equal(rays.llr, light.llr[use])
    assert np.all(rays.edge_sigma_rad == 0)


def test_why_stars_cannot_be_used() -> None:
    rng = np.random.default_rng(6)
    stars = random_stars(2500, rng)
    venus = Body(name="Venus", ray_icrs=stars.rays_icrs[20], v_mag=-4.0)
    px, inside = CAMERA.project(stars.rays_icrs @ R_CAM_ENU.T)
    dead = np.zeros((512, 512), bool)
    x, y = np.rint(px[inside & (stars.rays_icrs[:, 2] > 0.5)][7]).astype(int)
    dead[y - 3 : y + 4, x - 3 : x + 4] = True
    light = measure_frame(stars, np.ones(len(stars), bool), rng, dead, bodies=[venus])
    cause = {int(s): str(c) for s, c in zip(light.star, light.cause, strict=True)}
    assert cause[20] == "beside Venus"
    beside = [s for s, c in cause.items() if c == "beside Venus"]
    assert np.hypot(*(px[beside] - px[20]).T).max() < 8.0
    near = np.hypot(*(px[light.star] - [x, y]).T) < 1.0
    assert set(light.cause[near]) == {"bad pixels"}
    angle = np.arccos(stars.rays_icrs[light.star][:, 2])
    beyond = angle > CAMERA.calibrated_angle_rad
    assert beyond.sum() > 50
    assert not light.usable[beyond].any()
    assert set(light.cause[angle < np.radians(79)]) == {"", "beside Venus", "bad pixels"}
    assert np.all(light.llr[~light.usable] == 0)
    assert len(light.evidence()) == light.usable.sum()


def test_stars_at_the_frame_edge_are_left_out() -> None:
    rng = np.random.default_rng(7)
    edge = half_width(1.0) + 1.0
    px = np.array([[255.0, 400.0], [255.0, edge], [255.0, edge - 2]])
    narrow = replace(CAMERA, size_px=(512, 512), focal_px=(500.0, 500.0))  # the frame cuts the circle
    stars = stars_at(narrow.unproject(px), np.array([3.0, 3.1, 3.2]))
    detections = frame(stars, np.zeros(3, bool), rng)
    light = StarPhotometer()(detections, narrow, stars, [], np.eye(3), np.eye(3), SCALE, 0.05)
    assert light.cause.tolist() == ["", "", "off the frame"]


def test_one_lonely_star_and_none_at_all() -> None:
    rng = np.random.default_rng(8)
    lonely = measure_frame(stars_at([[0.0, 0.3, 0.95]], [3.0]), np.ones(1, bool), rng)
    assert lonely.llr[0] > 6
    below = measure_frame(stars_at([[0.0, 0.0, -1.0]], [3.0]), np.ones(1, bool), rng)
    assert len(below.star) == len(below.evidence()) == 0


def test_uncertain_stars_have_weaker_evidence_when_missing() -> None:
    """A variable star that is not detected may be at its minimum."""
    rng = np.random.default_rng(9)
    rays = random_stars(300, rng).rays_icrs
    rays = rays[(rays[:, 2] > 0.3) & (rays[:, 2] < 0.95)]
    steady = stars_at(rays, np.full(len(rays), 4.0))
    variable = replace(steady, v_sigma_mag=np.full(len(rays), 0.5))
    hidden = np.zeros(len(rays), bool)
    sure = measure_frame(steady, hidden, np.random.default_rng(10)).llr
    unsure = measure_frame(variable, hidden, np.random.default_rng(10)).llr
    assert np.median(sure) < -5
    assert np.median(unsure) > 0.75 * np.median(sure)


def scale_from(v_mag: np.ndarray, flux: np.ndarray, *, xy: np.ndarray | None = None) -> FluxScale:
    xy = np.random.default_rng(11).uniform(60, 450, (len(v_mag), 2)) if xy is None else xy
    return fit_flux_scale(flux, np.sqrt(flux + 1250), v_mag, CAMERA.unproject(xy), CAMERA)


def test_the_scale_is_found_with_its_scatter() -> None:
    rng = np.random.default_rng(12)
    v = rng.uniform(1, 5, 600)
    flux = 10 ** (-0.4 * (v - 13.0)) * np.exp(0.08 * rng.normal(size=600))
    flux += np.sqrt(flux + 1250) * rng.normal(size=600)
    scale = scale_from(v, flux)
    assert scale.zero_mag == pytest.approx(13.0, abs=0.015)
    assert scale.scatter == pytest.approx(0.08, abs=0.02)
    assert scale.response is None
    odd = flux.copy()
    odd[::10] *= 3  # every tenth is a variable star or a wrong name
    assert scale_from(v, odd).zero_mag == pytest.approx(13.0, abs=0.03)


def test_an_even_image_seldom_shows_an_uneven_throughput() -> None:
    uneven = 0
    for seed in range(100):
        rng = np.random.default_rng([14, seed])
        v, xy = rng.uniform(1, 4, 200), rng.uniform(60, 450, (200, 2))
        flux = 10 ** (-0.4 * (v - 13.0)) * np.exp(0.05 * rng.normal(size=200))
        uneven += scale_from(v, flux, xy=xy).response is not None
    assert uneven <= 5


@pytest.mark.parametrize(
    "loss",
    [
        lambda rays: 0.2 * np.arccos(rays[:, 2]) ** 2,  # vignetting
        lambda rays: 0.4 * rays[:, 0],  # a dirty side
        lambda rays: 0.5 * np.exp(-0.5 * np.sum(np.square(rays - [0.6, 0.2, 0.77]), axis=1) / 0.3**2),  # a thin cloud
    ],
)
def test_unstated_throughput_is_estimated_and_applied(loss: Any) -> None:
    rng = np.random.default_rng(13)
    v, rays = rng.uniform(1, 4, 700), CAMERA.unproject(rng.uniform(60, 450, (700, 2)))
    flux = 10 ** (-0.4 * (v - 13.0)) * np.exp(-loss(rays) + 0.04 * rng.normal(size=700))
    scale = fit_flux_scale(flux, np.sqrt(flux), v, rays, CAMERA)
    at = CAMERA.unproject(rng.uniform(100, 410, (300, 2)))
    expected, sigma = scale.expect(np.full(300, 3.0), at, CAMERA)
    off = np.log(expected / (1e4 * np.exp(-loss(at))))
    assert np.sqrt(np.mean(off**2)) < 0.04
    assert np.all(sigma < 0.1)


def test_extinction_is_estimated_from_the_stars_beside_the_throughput() -> None:
    rng = np.random.default_rng(15)
    v, rays = rng.uniform(1, 4, 600), CAMERA.unproject(rng.uniform(60, 450, (600, 2)))
    air = airmass(np.arcsin(rays @ [0.5, 0.0, np.sqrt(0.75)]))  # the camera is tilted by 30 degrees
    use = (air > 0) & (air < 8)
    v, rays, air = v[use], rays[use], air[use]
    flux = 10 ** (-0.4 * (v + 0.28 * air - 13.0)) * np.exp(0.3 * rays[:, 1] + 0.04 * rng.normal(size=len(v)))
    scale = fit_flux_scale(flux, np.sqrt(flux), v, rays, CAMERA, air)
    assert scale.response is not None
    assert scale.response[-1] == pytest.approx(0.28, abs=0.03)
    few = fit_flux_scale(flux[:3], np.sqrt(flux[:3]), v[:3], rays[:3], CAMERA, air[:3])
    assert few.response is not None
    assert few.response[-1] == pytest.approx(0.2, abs=0.15)  # as in clear air


@pytest.mark.parametrize("n", [1, 3, 6])
def test_a_few_stars_give_a_scale_too(n: int) -> None:
    v = np.linspace(2, 3, n)
    assert scale_from(v, 10 ** (-0.4 * (v - 13.0))).zero_mag == pytest.approx(13.0, abs=0.01)


def test_the_scale_is_that_of_stars_measured_at_their_predicted_pixels(located: Any) -> None:
    known = located.result
    found = known.identification
    truth = 2.5 * np.log10(known.camera.sensor.zero_point_e_per_s * known.exposure.exposure_s)
    matches, R = (found.detection, found.star), known.attitude_fit.attitude.R_cam_icrs
    assert flux_scale(known.detections, known.camera, known.stars, matches, R).zero_mag == pytest.approx(
        truth, abs=0.03
    )
    off = replace(known.camera, centre_px=tuple(np.add(known.camera.centre_px, [0.7, 0.0]).tolist()))
    shifted = flux_scale(known.detections, off, known.stars, matches, R)
    lost = np.exp(-(0.7**2) / (4 * known.detections.psf_sigma_px**2))  # of the light in a profile that is misplaced
    assert shifted.zero_mag == pytest.approx(truth + 2.5 * np.log10(lost), abs=0.05)


def test_evidence_of_a_rendered_crater(located: Any) -> None:
    """The pipeline's evidence against the renderer's truth: large ratios are right, all are calibrated."""
    light, truth = located.result.photometry, located.truth
    stars = located.result.stars
    hidden = dict(zip(truth.sources.catalog_id.tolist(), truth.hidden.tolist(), strict=True))
    names = stars.catalog_id[light.star]
    known = light.usable & np.array([name in hidden for name in names])
    shines = np.array([not hidden.get(name, True) for name in names])[known]
    llr = light.llr[known]
    assert known.sum() > 2000
    assert np.mean(shines[llr > 4]) > 0.985
    assert np.mean(~shines[llr < -4]) > 0.985
    # Log-likelihood of the truth, if ratios were probabilities from even odds: at least as good as stated.
    p = expit(np.where(shines, llr, -llr))
    assert np.mean(np.log(p)) > np.mean(p_log_p(llr)) - 3 * np.std(np.log(p)) / np.sqrt(len(p))
    z = light.flux_e[known][~shines] / light.sigma_e[known][~shines]
    assert abs(np.median(z)) < 0.1
    assert 1.4826 * np.median(np.abs(z - np.median(z))) == pytest.approx(1.0, abs=0.1)


def p_log_p(llr: np.ndarray) -> np.ndarray:
    """Expected log-likelihood of calibrated ratios."""
    p = expit(llr)
    return p * np.log(p) + (1 - p) * np.log1p(-p)


def test_evidence_does_not_depend_on_where_north_is() -> None:
    rng = np.random.default_rng(14)
    stars = random_stars(400, rng)
    detections = frame(stars, np.ones(400, bool), rng)
    turn = Rotation.from_euler("z", 40, degrees=True).as_matrix()  # enu turned against icrs
    plain = StarPhotometer()(detections, CAMERA, stars, [], R_CAM_ENU, np.eye(3), SCALE, 0.05)
    turned = StarPhotometer()(detections, CAMERA, stars, [], R_CAM_ENU, turn, SCALE, 0.05)
    assert np.array_equal(plain.llr, turned.llr)
    assert turned.elevation_rad == pytest.approx(plain.elevation_rad, abs=1e-12)
    assert np.radians(40) == pytest.approx((plain.azimuth_rad - turned.azimuth_rad) % (2 * np.pi), abs=1e-9)
