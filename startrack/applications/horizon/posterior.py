"""Posterior of the skyline's elevation in every column of azimuth: stars, steps of light, and neighbouring columns.

A hidden Markov chain around the compass. The skyline's elevation changes from column to column by a Laplace
distribution, sometimes a wide one (a tree), and sometimes it jumps anywhere (a dome). The ground is darker than the sky
above it, or brighter, or hardly either; that too changes rarely from column to column. The stars say which side is sky.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.applications.horizon.columns import AZIMUTH_COLUMNS, GRID_STEP_RAD, LOWEST_RAD, column_of, elevations_rad
from startrack.applications.horizon.skylight import MIN_SIGNIFICANCE, Steps
from startrack.core.runner import map_in_threads
from startrack.core.types import Array, Evidence
from startrack.kernels.library import kernel

CHANGES_RAD = np.radians(np.array([0.02, 0.12, 0.8]))  # Laplace scales of the change between columns: hill, wood, tree
CHANGE_WEIGHTS = (0.55, 0.25, 0.18)
JUMP_WEIGHT = 1.0 - sum(CHANGE_WEIGHTS)  # a dome, a mast: any elevation
# Kinds of ground by its light beside the sky's: darker, brighter (in moonlight or lamplight), hardly either. Their
# shares, the probability that the kind alone is drawn anew from column to column (a jump draws it too: both together
# every 7.8 degrees), and that the skyline itself is among a column's steps.
KINDS, SWITCH_1, SHOWN_PROBABILITY = (0.7, 0.1, 0.2), 1 / 80, (0.75, 0.75, 0.5)
WEAKEST_CONTRAST, FAINT_CONTRAST = 0.25, 0.1  # usual skylines have more than the first; scale of a faint one's
NEAR_EDGE_RAD = np.radians(0.3)  # a step this near to an edge is the edge
NOISE_PER_RAD = np.degrees(2.2)  # density of the weakest steps, which are noise
SKY_PER_RAD = np.degrees(0.08)  # density of steps in the sky (clouds, reflections)
# Below a step in the sky is sky, hardly darker. Sizes of the logarithm of the brightness below over that above, of 14
# pictures of one camera: 9,671 dark steps in the sky have a mean of 0.23, 2,059 at the skyline 1.02, sigma 0.54. Of
# three pictures of another camera: 0.27; 1.18, sigma 0.60.
SKY_LOG_SCALE, GROUND_LOG_RATIO, GROUND_LOG_SIGMA = 0.23, 1.0, 0.55
# Above a step at which the light rises downwards is sky, nearly as bright as the brightest sky above, or dark ground: a
# ridge before lit ground or haze. Logarithms of the brightest sky over the light above such steps, of the same 14
# pictures: 3,784 steps in the sky have a mean size of 0.20, 878 below the skyline a mean of 1.31, sigma 0.61.
SKY_DIMMING, GROUND_DIMMING, GROUND_DIMMING_SIGMA = 0.20, 1.31, 0.61
RARE_PER_RAD = np.degrees(3e-4)  # of sharp ones in the sky: wires, halos of bright stars
ROOF_PER_RAD = np.degrees(0.03)  # density of strong ones: a roof or a tree before a faint ridge
GROUND_PER_RAD, GROUND_CONTRAST = np.degrees(0.3), 0.15  # density of steps below the skyline, and their scale
SPURIOUS_PROBABILITY = 0.01  # of light at a hidden star: leaves with gaps, hot pixels
MOST_MISSING = 0.999  # probability that a visible star is not seen
LOW_MISSING, LOW_SCALE_RAD = 0.4, np.radians(3.0)  # near the horizon: haze dims stars more than the fit
HIGH_RAD = np.radians(6.0)  # scale of the skyline's elevation where it begins anew
LEAST_LLR = 0.25  # rows below it are left out
STAR_EDGE_SIGMAS = 5.0
OUTLIER_PROBABILITY = 1e-4  # of a column whose evidence means nothing


def skyline_prior() -> Array:
    """Probabilities (n,) of the elevations of a skyline: high ones are rare."""
    prior = np.exp(-np.maximum(elevations_rad(), 0.0) / HIGH_RAD)
    return np.asarray(prior / prior.sum())


def star_log_likelihood(rays: Evidence, missing: float) -> Array:
    """Log-likelihood (AZIMUTH_COLUMNS, n) of the stars' rows at each elevation of the skyline.

    `missing`: probability that a visible star is not seen (cloud).
    """
    from scipy.special import ndtr

    n = len(elevations_rad())
    rays, limited = limited_rows(rays, missing)
    column = column_of(rays.azimuth_rad)
    edge_rad = float(rays.edge_sigma_rad.max(initial=GRID_STEP_RAD))
    half = int(np.ceil(STAR_EDGE_SIGMAS * edge_rad / GRID_STEP_RAD))
    first = np.rint((rays.elevation_rad - LOWEST_RAD) / GRID_STEP_RAD).astype(int) - half
    # Below its window a star is visible, above it hidden: a step; within it the profile of the edge.
    steps = np.zeros((AZIMUTH_COLUMNS, n + 1))
    np.add.at(steps, (column, np.zeros_like(column)), limited)
    np.add.at(steps, (column, np.clip(first, 0, n)), -limited)
    total = np.cumsum(steps[:, :n], axis=1)
    at = first[:, None] + np.arange(2 * half + 1)
    z = (rays.elevation_rad[:, None] - (LOWEST_RAD + GRID_STEP_RAD * at)) / edge_rad
    profile = np.log1p(ndtr(z) * np.expm1(limited)[:, None])
    inside = (at >= 0) & (at < n)
    np.add.at(total.reshape(-1), (column[:, None] * n + at)[inside], profile[inside])
    return total


def limited_rows(rays: Evidence, missing: float) -> tuple[Evidence, Array]:
    """The rows of stars that say something, and their log-likelihood ratios (m,) limited as `limit_llr` does.

    `missing`: probability that a visible star is not seen (cloud); near the horizon it is larger.
    """
    low = missing + LOW_MISSING * np.exp(-np.maximum(rays.elevation_rad, 0.0) / LOW_SCALE_RAD)
    limited = limit_llr(rays.llr, np.minimum(low, MOST_MISSING), SPURIOUS_PROBABILITY)
    use = (np.abs(limited) > LEAST_LLR) & (rays.elevation_rad > LOWEST_RAD)
    use &= rays.elevation_rad < elevations_rad()[-1]
    return rays.take(use), limited[use]


def limit_llr(llr: Array, missing: Array, spurious: float) -> Array:
    """Log-likelihood ratios (n,) with the probabilities of a visible star not seen, and of a hidden one seen."""
    from scipy.special import expit

    seen, unseen = expit(llr), expit(-llr)
    return np.asarray(np.log(((1 - missing) * seen + missing * unseen) / (spurious * seen + (1 - spurious) * unseen)))


def sky_likelihood_ratio(log_ratio: Array) -> Array:
    """Likelihood ratio (...) of a step within the sky to one at the skyline, by the light below it over that above.

    `log_ratio` (...): the logarithm of light below over light above.
    """
    size = np.abs(log_ratio)
    in_sky = np.exp(-size / SKY_LOG_SCALE) / SKY_LOG_SCALE
    z = (size - GROUND_LOG_RATIO) / GROUND_LOG_SIGMA
    return np.asarray(in_sky * np.sqrt(2.0 * np.pi) * GROUND_LOG_SIGMA * np.exp(0.5 * np.square(z)))


def sky_above_ratio(contrast: Array, dimming: Array) -> Array:
    """Likelihood ratio (n,) of sky right above a step to ground there, by the light above steps that rise downwards.

    It is 1 at most: ground may be as bright as the sky. `contrast` and `dimming` (n,) are those of `Steps`.
    """
    sky = np.exp(-np.abs(dimming) / SKY_DIMMING) / (2.0 * SKY_DIMMING)
    z = (dimming - GROUND_DIMMING) / GROUND_DIMMING_SIGMA
    ratio = sky * np.sqrt(2.0 * np.pi) * GROUND_DIMMING_SIGMA * np.exp(0.5 * np.square(z))
    return np.where(contrast > 0, np.minimum(ratio, 1.0), 1.0)


def _noise_density(steps: Steps) -> Array:
    """Density (n,) [1/rad] of noise that looks like each of the steps."""
    return np.asarray(NOISE_PER_RAD * np.exp(-0.5 * (np.square(steps.significance) - MIN_SIGNIFICANCE**2)))


def _skyline_likelihoods(contrast: Array) -> tuple[Array, Array, Array]:
    """Likelihood (n,) of contrasts at the skyline of each of the KINDS, beside a usual one."""
    size = np.abs(contrast)
    usual = np.minimum(size / WEAKEST_CONTRAST, 1.0) ** 2
    return usual * (contrast < 0), usual * (contrast > 0), np.exp(-size / FAINT_CONTRAST) / (2.0 * FAINT_CONTRAST)


def steps_at(steps: Steps, skyline_rad: Array) -> Steps:
    """Steps at a skyline (AZIMUTH_COLUMNS,) [rad] that are more likely its own, of any kind, than noise.

    White noise has such steps at 1 of 100 bins, and steps within NEAR_EDGE_RAD at 17.
    """
    off = steps.elevation_rad - skyline_rad[steps.column]
    of_kind = zip(SHOWN_PROBABILITY, _skyline_likelihoods(steps.contrast), strict=True)
    own = np.max([shown * likelihood for shown, likelihood in of_kind], axis=0)
    here = np.exp(-0.5 * np.square(off / steps.sigma_rad)) / (np.sqrt(2.0 * np.pi) * steps.sigma_rad)
    return steps.take((np.abs(off) < NEAR_EDGE_RAD) & (own * here > _noise_density(steps)))


def add_step_log_likelihood(total: NDArray[np.float32], steps: Steps, temper: float) -> None:
    """Add the log-likelihood of an image's steps of light, times `temper`, to `total` (KINDS, AZIMUTH_COLUMNS, n).

    It is that of each kind of ground: darker than the sky above it, brighter, or hardly either.
    """
    noise, contrast = _noise_density(steps), np.abs(steps.contrast)
    usual = np.minimum(contrast / WEAKEST_CONTRAST, 1.0) ** 2
    above = sky_above_ratio(steps.contrast, steps.dimming)
    edges = SKY_PER_RAD * usual * sky_likelihood_ratio(steps.log_ratio) + RARE_PER_RAD
    in_sky = noise + edges
    in_ground = noise + GROUND_PER_RAD * np.exp(-contrast / GROUND_CONTRAST) + ROOF_PER_RAD
    passed = 0.5 * np.log(in_sky / in_ground) + np.log((noise + above * edges) / in_sky)
    order = np.argsort(steps.column, kind="stable")
    rows = steps.column, steps.elevation_rad, steps.sigma_rad, passed
    column, elevation, sigma, passed = (one[order] for one in rows)
    of_kind = zip(SHOWN_PROBABILITY, _skyline_likelihoods(steps.contrast), strict=True)
    for kind, (shown, likelihood) in enumerate(of_kind):
        weight = (above * shown * likelihood / in_ground)[order]
        add_steps(
            temper, LOWEST_RAD, GRID_STEP_RAD, column, elevation, sigma, weight, passed, 1 - shown,
            np.empty(total.shape[-1]), total[kind],
        )  # fmt: skip


def combine_columns(log_likelihood: NDArray[np.floating[Any]]) -> tuple[Array, Array]:
    """Means and standard deviations [rad] of each column by log-likelihoods (KINDS, AZIMUTH_COLUMNS, n)."""
    likelihood = np.exp(log_likelihood - log_likelihood.max(axis=(0, 2), keepdims=True)).astype(np.float32)
    likelihood = likelihood / likelihood.mean(axis=(0, 2), keepdims=True) + np.float32(OUTLIER_PROBABILITY)
    change = np.exp(-GRID_STEP_RAD / CHANGES_RAD), np.array(CHANGE_WEIGHTS), JUMP_WEIGHT, skyline_prior()
    kinds = np.array(KINDS), SWITCH_1
    ahead, behind = map_in_threads(lambda forward: pass_messages(likelihood, forward, *change, *kinds), (True, False))
    posterior = (ahead * behind * likelihood).sum(axis=0, dtype=np.float64)
    posterior /= posterior.sum(axis=1, keepdims=True)
    elevation = elevations_rad()
    mean = posterior @ elevation
    variance = np.maximum(posterior @ np.square(elevation) - np.square(mean), 0.0)
    return mean, np.sqrt(variance)


def pass_messages(
    likelihood: NDArray[np.float32], forward: bool, ratio: Array, weight: Array, jump: float, landing: Array,
    part: Array, renew: float,
) -> NDArray[np.float32]:  # fmt: skip
    """Messages (kinds, columns, n) that reach each column: what those before it say, or, not `forward`, those after it.

    The product of both with the `likelihood` (kinds, columns, n) is the posterior of kind and elevation, to a factor in
    each column. Between columns a kind and an elevation change by one matrix: the elevation by three Laplace
    distributions that fall by `ratio` (3,) per sample, with the sums `weight` (3,), within the n samples. With the
    probability `renew` the kind is drawn anew from the shares `part` (kinds,), and so are, with the probability `jump`,
    kind and elevation, this by the probabilities `landing` (n,). Backward messages go through the transposed matrix.
    """
    found = np.empty_like(likelihood)
    scratch = np.empty((len(part) + 6, len(landing)))
    _pass_messages(likelihood, forward, ratio, weight, jump, landing, part, renew, scratch, found)
    return found


# Adds the log-likelihoods of steps of light (k,), sorted by column, times `temper` to `total` (columns, n). A skyline
# at a step has the likelihood `weight`, one above it the factor exp(`passed`), one that shows no step `nothing`.
add_steps = kernel(
    "add_steps", "temper: float64", "lowest: float64", "step: float64", "column: int64[k]", "place: float64[k]",
    "sigma: float64[k]", "weight: float64[k]", "passed: float64[k]", "nothing: float64", "mixture: out float64[n]",
    "total: out float32[columns, n]",
)  # fmt: skip
_pass_messages = kernel(
    "pass_messages", "likelihood: float32[kinds, columns, n]", "forward: bool", "ratio: float64[3]",
    "weight: float64[3]", "jump: float64", "landing: float64[n]", "part: float64[kinds]", "renew: float64",
    "scratch: out float64[kinds + 6, n]", "found: out float32[kinds, columns, n]",
)  # fmt: skip
