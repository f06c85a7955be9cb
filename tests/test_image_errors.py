"""Errors of the image lift the light of the sky above the skyline, and not the stars, which have hard edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from render_helpers import CRATER
from sky_helpers import PX_PER_RAD
from test_localization_refinement import PLACE, sky_rows, star_rows

from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Evidence, ImageErrors, NotLocated
from startrack.evidence import offset_terms
from startrack.evidence.sky_light import LEVELS
from startrack.localization import ExactPosterior, LinearErrors
from startrack.localization.likelihood.linear_errors import Lifts, list_seams
from startrack.localization.likelihood.shared_errors import SharedErrors
from startrack.localization.likelihood.skyline_model import SkylineModel

NATS = 60.0  # of a cell of the light
STARS = 4000  # within 1.1 degrees of the skyline: a frame to V 8
LEVEL_PX = 0.02  # sigma of the error that raises all light alike


def one_term(raised: Array, mean_px: float, sigma_px: float) -> ImageErrors:
    """One error of the image."""
    sigma_rad = np.full(SECTORS, 0.1 / PX_PER_RAD)
    return ImageErrors(raised[:, None] / PX_PER_RAD, np.array([mean_px]), np.array([[sigma_px**2]]), sigma_rad**2)


def lowered(light: Evidence, lift_rad: Array) -> Evidence:
    """The light without a lift (SECTORS,)."""
    return replace(light, elevation_rad=light.elevation_rad - np.repeat(lift_rad, LEVELS))


@pytest.mark.parametrize("wave", [0, 1])
@pytest.mark.parametrize("sigma_px", [0.02, 0.2])
def test_the_likelihood_is_the_integral_over_lifts_of_the_light(wave: int, sigma_px: float) -> None:
    rng = np.random.default_rng([41, wave])
    light, stars = sky_rows(PLACE, rng, NATS), star_rows(PLACE, rng, STARS)
    errors = one_term(np.cos(wave * MIDDLES_RAD), 0.7 * sigma_px, sigma_px)
    points = PLACE + rng.uniform(-3.0, 3.0, (12, 2))

    def log_likelihood(rows: Evidence, image: ImageErrors | None) -> Array:
        model = SkylineModel.of(CRATER, rows, PLACE, 30.0, SharedErrors.of(CRATER, None), image)
        return model.log_likelihood(points) + model.seen.log_offset

    sizes = np.linspace(-5.0, 5.0, 61)
    each = []
    for z in sizes:
        lift = errors.slopes_rad @ (errors.mean + z * sigma_px)
        each.append(log_likelihood(Evidence.concatenate(stars, lowered(light, lift)), None) - 0.5 * z * z)
    slow = np.logaddexp.reduce(each) + np.log((sizes[1] - sizes[0]) / np.sqrt(2 * np.pi))
    found = log_likelihood(Evidence.concatenate(stars, light), errors)
    assert np.ptp(slow) > 5.0
    assert found == pytest.approx(slow, abs=0.15)


def test_the_linear_model_of_lifts_waves_and_seams_is_that_of_all_heights() -> None:
    """Least squares with two heights a sector: the light's, and that of what is left."""
    rng = np.random.default_rng(42)
    lift, rise, seams = rng.normal(size=(SECTORS, 2)), rng.normal(size=(SECTORS, 3)), 2.0 * list_seams()[:, :1]
    of_light, of_stars = rng.uniform(0.5, 1.0, SECTORS), rng.uniform(0.1, 2.0, SECTORS)
    at_light, at_stars, other = rng.normal(size=(3, SECTORS))
    whole, mean = of_light + of_stars, np.r_[rng.normal(size=2), np.zeros(3)]
    together = (of_light * at_light + of_stars * at_stars) / whole
    linear = LinearErrors(
        np.hstack([lift * (of_light / whole)[:, None], rise]), mean, np.eye(5), np.eye(5), whole, 3, seams,
        Lifts(lift, of_light, at_light - together),
    )  # fmt: skip
    (risen,), lifts, _ = linear.fit(together[None], other[None])
    design = np.block([[lift, rise, seams], [np.zeros_like(lift), rise, seams]])
    weighted = design.T * np.r_[of_light, of_stars]
    found = np.linalg.solve(
        weighted @ design + np.eye(6), weighted @ np.r_[at_light - other, at_stars] + np.r_[mean, 0.0]
    )
    assert lifts is not None
    np.testing.assert_allclose(lifts[0], other + lift @ found[:2], atol=1e-9)
    np.testing.assert_allclose(risen, rise @ found[2:5] + seams @ found[5:], atol=1e-9)


@pytest.mark.slow
def test_positions_by_stars_and_light_agree_with_their_covariance() -> None:
    """Mean NEES 2 within 3.5 standard deviations: the light is lifted by errors drawn from their prior."""
    rng, nees, refused = np.random.default_rng(43), [], 0
    covariance = np.diag([LEVEL_PX, 2e-3, 2e-3, 1e-3, 1e-3]) ** 2
    variance_rad2 = np.full(SECTORS, (0.1 / PX_PER_RAD) ** 2)
    errors = ImageErrors(offset_terms(MIDDLES_RAD)[:, :5] / PX_PER_RAD, np.zeros(5), covariance, variance_rad2)
    for _ in range(40):
        raised = errors.slopes_rad @ rng.multivariate_normal(errors.mean, covariance)
        light, stars = lowered(sky_rows(PLACE, rng, 4.0), -raised), star_rows(PLACE, rng, STARS)
        wrong = rng.random(STARS) < 1.0 / (1.0 + np.exp(3.0))  # as llrs of 3 state
        stars = replace(stars, llr=np.where(wrong, -stars.llr, stars.llr), edge_sigma_rad=np.zeros(STARS))
        support = ExactPosterior()(replace(stars, is_first_look=True), CRATER).support
        rows = replace(Evidence.concatenate(light, stars), support=support, image_errors=errors)
        try:
            fix = ExactPosterior()(rows, CRATER)
        except NotLocated:
            refused += 1
            continue
        off = fix.position_enu_m[:2] - PLACE
        nees.append(float(off @ np.linalg.solve(fix.covariance_m2, off)))
    assert 1.1 < np.mean(nees) < 3.1
    assert refused <= 1
