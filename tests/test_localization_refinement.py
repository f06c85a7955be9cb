"""A fix refined by the light of the sky: the linear fit, the profiles of sectors, the posterior near a position."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from localization_helpers import slow_scores
from render_helpers import CRATER
from scipy.special import ndtr
from sky_helpers import EDGE_PX, PX_PER_RAD

from startrack.evidence.sky_checks import MIN_SECTORS
from startrack.evidence.sky_levels import SECTORS
from startrack.evidence.sky_light import HEIGHT_PX, LEVELS, MIDDLES_RAD
from startrack.evidence.star_offsets import offset_terms
from startrack.localization import SkylineFit
from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.refinement import horizon_slopes, refine_fix
from startrack.localization.sector_likelihood import row_contribution
from startrack.localization.sky_profiles import SkyProfiles
from startrack.localization.skyline_fit import MAX_DROPPED, SharedErrors, fit_skyline
from startrack.terrain import ForwardingTerrain
from startrack.types import Array, Evidence, Fix, Mode, NotLocated

PLACE = np.array([3000.0, -2000.0])
SLOPES = horizon_slopes(CRATER, PLACE, MIDDLES_RAD) * PX_PER_RAD  # px/m
PRIOR_M, PRIOR_M2 = np.array([0.5, -1.0]), np.array([[9.0, 2.0], [2.0, 16.0]])
SIGMA_PX = 0.1


def shared_errors() -> SharedErrors:
    """Five terms of the image, and one of the terrain."""
    rng = np.random.default_rng(1)
    mix = rng.normal(size=(6, 6))
    covariance = 1e-3 * (mix @ mix.T + 6 * np.eye(6))
    raised = np.concatenate([offset_terms(MIDDLES_RAD), np.full((SECTORS, 1), 1.3)], axis=1)
    return SharedErrors(raised, 0.02 * rng.normal(size=6), covariance, np.arange(6) == 5)


def shifts(rng: np.random.Generator, errors: SharedErrors, sigma_px: Array | float = SIGMA_PX) -> tuple[Array, Array]:
    """Shifts (SECTORS,) of a skyline by a step of the position and shared errors from their priors, and the step."""
    step = rng.multivariate_normal(PRIOR_M, PRIOR_M2)
    values = rng.multivariate_normal(errors.mean, errors.covariance)
    return SLOPES @ step + errors.raised_px @ values + sigma_px * rng.normal(size=SECTORS), step


def fit(shift_px: Array, variance_px2: Array, errors: SharedErrors) -> SkylineFit:
    found = fit_skyline(shift_px, variance_px2, SLOPES, errors, PRIOR_M, PRIOR_M2, min_sectors=MIN_SECTORS)
    assert found is not None
    return found


def slow_fit(shift_px: Array, variance_px2: Array, errors: SharedErrors, used: Array) -> tuple[Array, Array]:
    """Step and shared errors with their covariance: least squares with the prior as further rows."""
    design = np.concatenate([SLOPES, errors.raised_px], axis=1)[used] / np.sqrt(variance_px2[used])[:, None]
    right = (shift_px / np.sqrt(variance_px2))[used]
    prior = np.zeros((8, 8))
    prior[:2, :2], prior[2:, 2:] = PRIOR_M2, errors.covariance
    whiten = np.linalg.inv(np.linalg.cholesky(prior))
    rows = np.concatenate([design, whiten])
    solution = np.linalg.lstsq(
        rows, np.concatenate([right, whiten @ np.concatenate([PRIOR_M, errors.mean])]), rcond=None
    )[0]
    return solution, np.linalg.inv(rows.T @ rows)


def test_the_fit_is_that_of_least_squares() -> None:
    rng, errors = np.random.default_rng(2), shared_errors()
    sigma = rng.uniform(0.05, 0.4, SECTORS)
    variance = np.where(np.arange(SECTORS) % 7 == 0, np.inf, np.square(sigma))
    shift, _ = shifts(rng, errors, sigma)
    found = fit(shift, variance, errors)
    assert np.array_equal(found.used, np.isfinite(variance))
    solution, covariance = slow_fit(shift, variance, errors, found.used)
    assert found.step_m == pytest.approx(solution[:2], rel=1e-8)
    assert found.shared == pytest.approx(solution[2:], rel=1e-7)
    assert found.covariance == pytest.approx(covariance, rel=1e-6)
    residual = shift - SLOPES @ solution[:2] - errors.raised_px @ solution[2:]
    assert found.residual_px == pytest.approx(residual, abs=1e-9)
    assert found.chi2 == pytest.approx(np.mean((residual**2 / variance)[found.used]))
    assert found.raised_px(of_terrain=True) == pytest.approx(1.3 * np.full(SECTORS, solution[7]))
    assert found.raised_px(of_terrain=False) == pytest.approx(offset_terms(MIDDLES_RAD) @ solution[2:7])


def test_steps_agree_with_their_covariance() -> None:
    rng, errors, nees = np.random.default_rng(3), shared_errors(), []
    for _ in range(200):
        shift, step = shifts(rng, errors)
        found = fit(shift, np.full(SECTORS, SIGMA_PX**2), errors)
        off = found.step_m - step
        nees.append(off @ np.linalg.solve(found.covariance[:2, :2], off))
    assert np.mean(nees) == pytest.approx(2.0, abs=0.5)  # 3.5 standard deviations


def test_the_step_depends_on_the_shared_errors_as_stated() -> None:
    rng, errors = np.random.default_rng(4), shared_errors()
    shift, variance = shifts(rng, errors)[0], np.full(SECTORS, SIGMA_PX**2)
    found = fit(shift, variance, errors)
    known = replace(errors, mean=found.shared, covariance=1e-12 * np.eye(6))
    at = fit(shift, variance, known).step_m
    assert at == pytest.approx(found.step_m, abs=1e-4)
    for k in range(6):
        moved = fit(shift, variance, replace(known, mean=found.shared + 0.01 * np.eye(6)[k])).step_m - at
        assert moved == pytest.approx(0.01 * found.step_by_shared[:, k], abs=1e-5)


@pytest.mark.parametrize(("first", "width"), [(20, 1), (100, 4), (236, 8), (60, 30)])
@pytest.mark.parametrize("raised_px", [0.5, -1.0, 3.0])
def test_sectors_that_show_something_else_are_left_out(first: int, width: int, raised_px: float) -> None:
    rng, errors = np.random.default_rng([5, first]), shared_errors()
    wrong = (first + np.arange(width)) % SECTORS
    shift, _ = shifts(rng, errors)
    shift[wrong] += raised_px * (2.0 if width == 1 else 1.0)
    variance = np.full(SECTORS, SIGMA_PX**2)
    found = fit(shift, variance, errors)
    assert not found.used[wrong].any()
    assert np.count_nonzero(~found.used) <= width + 12
    assert found.chi2 < 1.3
    assert found.step_m == pytest.approx(slow_fit(shift, variance, errors, found.used)[0][:2], rel=1e-7)


def test_a_skyline_that_fits_is_used_whole() -> None:
    rng, errors = np.random.default_rng(6), shared_errors()
    used = [fit(shifts(rng, errors)[0], np.full(SECTORS, SIGMA_PX**2), errors).used for _ in range(50)]
    assert np.mean(used) > 0.995


def test_errors_that_neighbouring_sectors_share_are_an_excess() -> None:
    """Ten waves around the circle, as large as the noise of one sector."""
    rng, errors, variance = np.random.default_rng(15), shared_errors(), np.full(SECTORS, SIGMA_PX**2)
    excess = [fit(shifts(rng, errors)[0], variance, errors).excess for _ in range(60)]
    assert np.count_nonzero(np.array(excess) > 1.0) <= 3
    assert max(excess) < 2.0
    rough = fit(shifts(rng, errors)[0] + SIGMA_PX * np.cos(10 * MIDDLES_RAD), variance, errors)
    assert rough.used.all() and rough.chi2 < 1.8
    assert 2.0 < rough.excess < 8.0  # at most 1 + 8 / 2 in eight sectors, less what varies within them


def test_no_fit_where_too_much_contradicts_or_too_little_is_seen() -> None:
    rng, errors = np.random.default_rng(7), shared_errors()
    shift, variance = shifts(rng, errors)[0], np.full(SECTORS, SIGMA_PX**2)
    few = np.where(np.arange(SECTORS) < 59, variance, np.inf)
    assert fit_skyline(shift, few, SLOPES, errors, PRIOR_M, PRIOR_M2, min_sectors=MIN_SECTORS) is None
    another = shift + rng.uniform(-3, 3, SECTORS)
    assert fit_skyline(another, variance, SLOPES, errors, PRIOR_M, PRIOR_M2, min_sectors=MIN_SECTORS) is None
    half = shift.copy()
    half[: int((MAX_DROPPED + 0.08) * SECTORS)] += rng.uniform(1, 3, int((MAX_DROPPED + 0.08) * SECTORS))
    assert fit_skyline(half, variance, SLOPES, errors, PRIOR_M, PRIOR_M2, min_sectors=MIN_SECTORS) is None


def sky_rows(
    position_m: Array, rng: np.random.Generator, nats: float, predicted_m: Array = PLACE, map_rad: float = 0.0
) -> Evidence:
    """Cells of the sky's light about the skyline that is predicted, seen from a position: c is `nats` for each cell.

    `map_rad` is the sigma of an error of the horizon in each sector.
    """
    height = (np.arange(LEVELS) - LEVELS // 2) * HEIGHT_PX / PX_PER_RAD
    predicted = CRATER.horizon_rad(predicted_m[None], MIDDLES_RAD)
    true = CRATER.horizon_rad(position_m[None], MIDDLES_RAD) + map_rad * rng.normal(size=SECTORS)
    elevation = predicted[:, None] + height
    fraction = ndtr((elevation - true[:, None]) * PX_PER_RAD / EDGE_PX) + rng.normal(size=elevation.shape) / np.sqrt(
        nats
    )
    return Evidence(
        azimuth_rad=np.repeat(MIDDLES_RAD, LEVELS), elevation_rad=elevation.ravel(),
        llr=(nats * (fraction - 0.5)).ravel(), extended_nats=nats, edge_sigma_rad=EDGE_PX / PX_PER_RAD,
    )  # fmt: skip


def star_rows(position_m: Array, rng: np.random.Generator, rays: int) -> Evidence:
    """Stars near the skyline."""
    azimuth = rng.uniform(0, 2 * np.pi, rays)
    horizon = CRATER.horizon_rad(position_m[None], azimuth)
    elevation = horizon + rng.uniform(-0.02, 0.02, rays)
    return Evidence(
        azimuth_rad=azimuth, elevation_rad=elevation, llr=np.where(elevation > horizon, 3.0, -3.0),
        edge_sigma_rad=0.1 / PX_PER_RAD,
    )  # fmt: skip


def slow_profile(rows: Evidence, which: Array, horizon_rad: Array) -> Array:
    """Sums (n,) of l V + c V (1 - V) / 2 at horizons (n,)."""
    sigmas = (rows.elevation_rad[which] - horizon_rad[:, None]) / rows.edge_sigma_rad[which]
    visible = ndtr(sigmas)
    value = visible * (rows.llr[which] + 0.5 * rows.extended_nats[which] * (1.0 - visible))
    kernel = [row_contribution(rows.llr[k], rows.extended_nats[k], sigmas[0, j], 0) for j, k in enumerate(which)]
    assert value[0] == pytest.approx(kernel, abs=2e-6 * rows.extended_nats.max())
    return value.sum(axis=1)


def profile_sums(profiles: SkyProfiles, horizon_rad: Array) -> Array:
    """The profiles (n, m) at horizons (n, m), each in a sector of its own."""
    sums = np.zeros_like(horizon_rad)
    profiles.add_sums(horizon_rad, np.arange(horizon_rad.shape[1]), sums)
    return sums


@pytest.mark.parametrize("nats", [1.0, 50.0, 1500.0])
def test_profiles_are_the_sums_of_their_rows(nats: float) -> None:
    rng = np.random.default_rng(8)
    stars, sky = star_rows(PLACE, rng, 30), sky_rows(PLACE, rng, nats)
    mixed = Evidence.concatenate(stars, sky).take(rng.permutation(30 + len(sky)))
    rows = np.flatnonzero(mixed.extended_nats > 0)
    profiles = SkyProfiles.from_rows(mixed, rows, np.zeros(len(mixed)))
    azimuth = mixed.azimuth_rad[profiles.row]
    assert azimuth == pytest.approx(MIDDLES_RAD)
    middle = CRATER.horizon_rad(PLACE[None], azimuth)
    horizon = middle + np.concatenate([rng.uniform(-20, 20, (60, SECTORS)), [[-400.0] * SECTORS]]) / PX_PER_RAD
    found = profile_sums(profiles, horizon)
    for k in range(0, SECTORS, 30):
        which = np.flatnonzero((mixed.extended_nats > 0) & (mixed.azimuth_rad == azimuth[k]))
        assert found[:, k] == pytest.approx(slow_profile(mixed, which, horizon[:, k]), abs=3e-5 * nats + 5e-5)


@pytest.mark.parametrize("nats", [1.0, 50.0, 1500.0])
@pytest.mark.parametrize("map_px", [0.1, 0.4, 2.0])
def test_profiles_are_averaged_over_an_error_of_the_map(nats: float, map_px: float) -> None:
    rng = np.random.default_rng(9)
    sky = sky_rows(PLACE, rng, nats)
    profiles = SkyProfiles.from_rows(sky, np.arange(len(sky)), np.full(len(sky), map_px / PX_PER_RAD))
    middle = CRATER.horizon_rad(PLACE[None], MIDDLES_RAD)
    shift_px = np.linspace(-2.5, 2.5, 41) * np.hypot(map_px, 0.1)
    found = profile_sums(profiles, middle + shift_px[:, None] / PX_PER_RAD)
    errors_px = np.linspace(-6 * map_px, 6 * map_px, 6001)
    weight = np.exp(-0.5 * np.square(errors_px / map_px))
    for k in range(0, SECTORS, 48):
        which = np.flatnonzero(sky.azimuth_rad == MIDDLES_RAD[k])
        all_px = (shift_px[:, None] + errors_px).ravel()
        log = slow_profile(sky, which, middle[k] + all_px / PX_PER_RAD).reshape(41, -1)
        expected = np.log(np.exp(log - log.max()) @ weight / weight.sum()) + log.max()
        likely = expected > expected.max() - 3.0
        assert found[likely, k] == pytest.approx(expected[likely], abs=0.05)
        assert found[:, k] == pytest.approx(expected, abs=0.5)


class RoughMap(ForwardingTerrain):
    """A crater whose horizon has an error in each direction."""

    hard_edges = False

    def horizon_sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        return np.full(np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad)), 0.4 / PX_PER_RAD)


def test_scores_near_a_position_are_those_of_all_rows() -> None:
    rng = np.random.default_rng(10)
    rows = Evidence.concatenate(sky_rows(PLACE, rng, 60.0), star_rows(PLACE, rng, 300))
    rows = rows.take(rng.permutation(len(rows)))
    whole = PositionLikelihood.from_evidence(rows, CRATER)
    points = PLACE + rng.uniform(-20, 20, (60, 2))
    found = whole.near(PLACE, 30.0, across=5).scores(points)
    expected = slow_scores(points, rows, CRATER, whole.sectors)
    assert found == pytest.approx(expected, abs=0.2)
    assert found - found[0] == pytest.approx(expected - expected[0], abs=0.03)
    assert np.ptp(expected) > 50.0
    lowered = whole.near(PLACE, 30.0, 0.01)
    moved = lowered.scores(points, lowered.evidence.elevation_rad - 1.5e-3)
    lower = replace(rows, elevation_rad=rows.elevation_rad - 1.5e-3)
    assert moved == pytest.approx(slow_scores(points, lower, CRATER, whole.sectors), abs=0.2)


def test_scores_on_a_map_with_errors_average_over_them() -> None:
    """Sectors with one error each, without floors: the sum over the profiles, each averaged by itself."""
    rng, terrain = np.random.default_rng(11), RoughMap(CRATER)
    rows = sky_rows(PLACE, rng, 60.0, map_rad=0.4 / PX_PER_RAD)
    whole = PositionLikelihood.from_evidence(rows, terrain, epsilon=0.0)
    points = PLACE + rng.uniform(-25, 25, (5, 2))
    found = whole.near(PLACE, 30.0).scores(points)
    errors = np.linspace(-2.4, 2.4, 481)
    weight = np.exp(-0.5 * np.square(errors / 0.4))
    expected = np.full(len(points), -whole.sectors.ceiling.sum())
    for k, azimuth in enumerate(MIDDLES_RAD):
        horizon = CRATER.horizon_rad(points, azimuth)[:, None] + errors / PX_PER_RAD
        log = slow_profile(rows, LEVELS * k + np.arange(LEVELS), horizon.ravel()).reshape(len(points), -1)
        top = log.max(axis=1, keepdims=True)
        expected += np.log(np.exp(log - top) @ weight / weight.sum()) + top[:, 0]
    assert found == pytest.approx(expected, abs=0.3)
    assert np.ptp(expected) > 10.0


def fix_at(position_m: Array) -> Fix:
    """A fix by the stars."""
    return Fix(
        position_enu_m=np.append(position_m, 1.5), covariance_m2=9.0 * np.eye(2), radius95_m=8.0, radius999_m=12.0,
        modes=(Mode(east_m=position_m[0], north_m=position_m[1], weight=1.0),), ambiguous=False,
        dropped_probability=1e-7, search="proven",
    )  # fmt: skip


def posterior_on_a_grid(rows: Evidence, middle_m: Array, reach_m: float) -> tuple[Array, Array]:
    """Mean and covariance of the posterior by a plain sum over a fine grid."""
    line = np.linspace(-reach_m, reach_m, 61)
    points = middle_m + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    score = slow_scores(points, rows, CRATER, PositionLikelihood.from_evidence(rows, CRATER).sectors)
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    mean = weight @ points
    return mean, (points - mean).T @ ((points - mean) * weight[:, None])


@pytest.mark.parametrize(("nats", "wrong"), [(60.0, 1.0), (60.0, 0.25), (60.0, 30.0), (1500.0, 1.0)])
def test_the_refined_posterior_is_that_of_a_plain_sum(nats: float, wrong: float) -> None:
    """Also where the expected covariance is too small or too large by the factor `wrong`."""
    rng = np.random.default_rng([12, int(nats)])
    true = PLACE + np.array([1.0, -2.0])
    rows = Evidence.concatenate(sky_rows(true, rng, nats), star_rows(true, rng, 100))
    weight = np.sum(SLOPES[:, :, None] * SLOPES[:, None] * nats * 0.28 / EDGE_PX / HEIGHT_PX, axis=0)
    expected = np.linalg.inv(weight)
    mean, covariance = posterior_on_a_grid(rows, true, 6 * np.sqrt(np.linalg.eigvalsh(expected)[1]))
    fix = refine_fix(rows, fix_at(PLACE), CRATER, true, wrong * expected, np.zeros((2, 2)), 1e-4)
    sigma = np.sqrt(np.trace(covariance))
    assert np.linalg.norm(fix.position_enu_m[:2] - mean) < 0.05 * sigma
    assert fix.covariance_m2 == pytest.approx(covariance, abs=0.06 * sigma**2)
    assert 1.2 < fix.radius95_m / np.sqrt(np.linalg.eigvalsh(covariance)[1]) < 2.6
    assert (fix.search, fix.dropped_probability, fix.ambiguous) == ("proven", 1e-7, False)
    assert fix.horizon_error_rad == 1e-4


def test_shared_errors_smear_the_refined_posterior() -> None:
    rng = np.random.default_rng(13)
    rows = sky_rows(PLACE, rng, 60.0)
    smear = np.array([[4.0, -1.5], [-1.5, 2.0]])
    sharp, smeared = (
        refine_fix(rows, fix_at(PLACE), CRATER, PLACE, 0.3 * np.eye(2), part * smear, 0.0) for part in (0.0, 1.0)
    )
    assert smeared.covariance_m2 - sharp.covariance_m2 == pytest.approx(smear, rel=0.1, abs=0.1)
    assert smeared.position_enu_m == pytest.approx(sharp.position_enu_m, abs=0.05)
    assert smeared.radius95_m > 1.5 * sharp.radius95_m


def test_a_refined_posterior_without_a_place_to_stand_is_refused() -> None:
    rows = sky_rows(PLACE, np.random.default_rng(14), 60.0)
    small = replace(CRATER, search_radius_m=1000.0)
    with pytest.raises(NotLocated):
        refine_fix(rows, fix_at(PLACE), small, PLACE, np.eye(2), np.zeros((2, 2)), 0.0)


def test_slopes_of_the_horizon() -> None:
    """On the axis of a cylinder: tan H = depth / radius, and one metre towards the wall shortens the distance."""
    slopes = horizon_slopes(CRATER, np.zeros(2), MIDDLES_RAD)
    wall = CRATER.depth_m - CRATER.camera_height_m
    expected = wall / (CRATER.radius_m**2 + wall**2)
    assert slopes == pytest.approx(
        expected * np.stack([np.sin(MIDDLES_RAD), np.cos(MIDDLES_RAD)], axis=1), rel=1e-3, abs=1e-3 * expected
    )
