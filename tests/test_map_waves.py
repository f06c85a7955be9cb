"""Waves of a map's horizon error over azimuth: the closed form, the posterior, and exposures that share them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from localization_helpers import locate_or_refuse

from startrack.applications.tracking.frame_estimate import FIRST_WAVE, estimate_frame, waves_at
from startrack.applications.tracking.track_errors import TrackErrors
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Evidence
from startrack.estimation.observations import Steps
from startrack.estimation.trajectory import smooth
from startrack.localization import ExactPosterior, LinearErrors
from startrack.localization.likelihood.linear_errors import list_seams
from startrack.localization.likelihood.neighbourhood import Neighbourhood, SectorRows
from startrack.localization.likelihood.shared_errors import SharedErrors
from startrack.terrain import HeightMap, Terrain, load_terrain
from startrack.terrain.shape import EXACT_WAVES, WAVES

SIGMA_RAD = tuple(np.radians(0.012) / m**0.5 for m in range(1, 9))
AT_M = np.array([60.0, -40.0])


def floor() -> HeightMap:
    """The middle of Shackleton's floor, whose map has errors of its posts."""
    whole = load_terrain("shackleton-rendered")
    assert isinstance(whole, HeightMap)
    return replace(whole, search_radius_m=300.0, height_sigma_m=1.0, horizon_sigma_common_rad=0.0)


def errors_of(rng: np.random.Generator, count: int = 3) -> LinearErrors:
    """Of a few waves, seen by sectors of different weights."""
    rise = np.column_stack([np.cos(m * MIDDLES_RAD) for m in range(1, count + 1)])
    covariance = np.diag([1e-6, 4e-6, 9e-6][:count])
    return LinearErrors(
        rise,
        np.zeros(len(covariance)),
        covariance,
        covariance,
        rng.uniform(0.0, 2e5, SECTORS),
        count,
        np.zeros((SECTORS, 0)),
    )


def test_the_closed_form_is_the_integral():
    """Against a sum over a fine grid of both errors."""
    rng = np.random.default_rng(1)
    linear = errors_of(rng, 2)
    left = rng.normal(0.0, 3e-3, SECTORS)
    (risen,), _, log = linear.fit(left[None])
    errors = np.linalg.lstsq(linear.rise_rad, risen)[0][None]

    def log_likelihood(values: Array) -> Array:
        return -0.5 * np.square(left - values @ linear.rise_rad.T) @ linear.weight

    axes = [np.linspace(-4 * s, 4 * s, 535) for s in (1e-3, 2e-3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    prior = -0.5 * np.square(grid / [1e-3, 2e-3]).sum(axis=1) - np.log(2 * np.pi * 1e-3 * 2e-3)
    cell = float(np.prod([a[1] - a[0] for a in axes]))
    slow = np.logaddexp.reduce(log_likelihood(grid) + prior) + np.log(cell)
    assert log_likelihood(errors)[0] + log[0] == pytest.approx(slow, abs=1e-3)
    assert grid[np.argmax(log_likelihood(grid) + prior)] == pytest.approx(errors[0], abs=2e-5)


def test_the_integral_over_seams_is_a_sum_over_their_ends_and_sizes():
    """Two waves are eliminated as noise that sectors share; the size of each seam is summed over a fine grid."""
    rng = np.random.default_rng(2)
    waves, seams = errors_of(rng, 2), 1.4e-3 * list_seams()[:, rng.choice(1128, 20, replace=False)]
    linear = replace(waves, seams_rad=seams)
    left = rng.normal(0.0, 3e-3, SECTORS) + 2.0 * seams[:, 7]
    (risen,), _, (log,) = linear.fit(left[None])
    noise = np.diag(1.0 / waves.weight) + waves.rise_rad @ waves.covariance @ waves.rise_rad.T
    sizes = np.linspace(-8.0, 8.0, 4001)
    each = np.linalg.inv(noise)
    off = left @ each @ left - 2 * np.multiply.outer(left @ each @ seams, sizes)
    off += np.multiply.outer(np.einsum("sc,st,tc->c", seams, each, seams), np.square(sizes))
    slow = np.logaddexp.reduce(-0.5 * (off + np.square(sizes)).ravel())
    slow += np.log((sizes[1] - sizes[0]) / np.sqrt(2 * np.pi) / 20)
    slow -= 0.5 * np.linalg.slogdet(noise * waves.weight)[1]
    assert log - 0.5 * np.square(left - risen) @ waves.weight == pytest.approx(slow, abs=1e-3)
    assert np.corrcoef(risen, seams[:, 7])[0, 1] > 0.9


def rays_at(ground: Terrain, rng: np.random.Generator, count: int = 4000) -> Evidence:
    """Rays near the horizon of `ground` at AT_M, visible or hidden, each with 3 nats."""
    azimuth = rng.uniform(0.0, 2 * np.pi, count)
    horizon = np.asarray(ground.horizon_rad(AT_M[None], azimuth)).ravel()
    above = rng.uniform(-0.003, 0.003, count)
    return Evidence(
        azimuth_rad=azimuth, elevation_rad=horizon + above, llr=np.where(above > 0.0, 3.0, -3.0),
        edge_sigma_rad=np.full(count, 2e-4),
    )  # fmt: skip


def drawn(stated: HeightMap, rng: np.random.Generator) -> Terrain:
    """The ground below AT_M: the map with waves as stated and no other error."""
    values = np.array([rng.normal() * one.sigma if one.wave else 0.0 for one in stated.errors.shape])
    return stated.with_shape(values)


def test_sectors_whose_rows_show_nothing_tell_of_no_wave():
    """The window's own height and variance stand there in place of a height that is seen."""
    terrain, rng = replace(floor(), waves_sigma_rad=SIGMA_RAD), np.random.default_rng(6)
    rows = rays_at(terrain, rng)
    rows = rows.take(np.flatnonzero(rows.azimuth_rad < np.pi))
    seen = SectorRows(Neighbourhood(terrain, AT_M, 0.0), rows)
    linear = LinearErrors.of(seen, SharedErrors.of(terrain, None), "", np.ones(SECTORS))
    unseen = np.pi < MIDDLES_RAD
    left = np.stack([seen.moments.mean_rad, np.where(unseen, np.radians(5.0), seen.moments.mean_rad)])
    (risen, other), _, log = linear.fit(left)
    assert linear.weight[~unseen].min() > 0.0 and np.abs(risen).max() > np.radians(1e-3)
    assert other == pytest.approx(risen, abs=1e-9) and log[1] == pytest.approx(log[0], abs=1e-3)


@pytest.mark.slow
def test_the_circle_holds_what_waves_do():
    stated = replace(floor(), waves_sigma_rad=SIGMA_RAD)
    exact = replace(stated, waves_sigma_rad=EXACT_WAVES)
    nees, without = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        rows = rays_at(drawn(stated, rng), rng)
        for terrain, found in (stated, nees), (exact, without):
            fix, reason = locate_or_refuse(rows, terrain)
            assert fix is not None or terrain is exact, reason
            if fix is None:
                continue
            off = fix.position_enu_m[:2] - AT_M
            found.append(off @ np.linalg.solve(fix.covariance_m2, off))
    assert len(nees) == 10 and 0.7 < np.mean(nees) < 4.0
    assert len(without) < 10 or np.mean(without) > 3 * np.mean(nees)


def test_silent_files_name_the_waves():
    silent = replace(floor(), waves_sigma_rad=None)
    fix = ExactPosterior()(rays_at(silent, np.random.default_rng(3)), silent)
    widened = {one.fact: one.radius999_m_if_exact for one in fix.unstated}
    assert widened[WAVES.key] < fix.radius999_m


def test_exposures_of_one_place_share_the_waves():
    """Six of them state hardly less than one; with exact waves they state less than a half of it."""
    stated = replace(floor(), waves_sigma_rad=SIGMA_RAD)
    sizes = {}
    for terrain in stated, replace(stated, waves_sigma_rad=EXACT_WAVES):
        errors = TrackErrors.of(terrain, None)
        frames = [
            estimate_frame(rays_at(stated, np.random.default_rng(k)), terrain, errors, AT_M, np.eye(2))
            for k in range(6)
        ]
        still = Steps(np.zeros((5, 2)), np.full(5, 1e-3))
        one = smooth(frames[:1], Steps.unknown(1)).covariance_m2[0]
        every = smooth(frames, still).covariance_m2[-1]
        sizes[terrain.waves_sigma_rad == EXACT_WAVES] = np.sqrt(np.trace(every) / np.trace(one))
    assert sizes[False] > 0.8 and sizes[True] < 0.6


def halves(sigma_m: float | None) -> HeightMap:
    """The floor with a map of its east, as far as 500 m off, above one of everything."""
    whole = floor()
    one = whole.maps[0]
    _, column = one.row_column(whole.site.latitude_rad, whole.site.longitude_rad)
    east = np.arange(one.heights_m.shape[1]) > column + 2
    part = replace(one, heights_m=np.where(east, one.heights_m, np.nan).astype(np.float32))
    return replace(whole, maps=(part, one), height_sigma_m=0.0, map_offset_sigma_m=sigma_m)


def test_slopes_of_an_offset_are_the_differences_of_the_horizon():
    terrain, azimuth = halves(1.0), np.linspace(0.1, 6.2, 40)
    names = [one.name for one in terrain.errors.shape]
    at = names.index("map_2_offset_m")
    for place in AT_M, AT_M - 300.0:
        slopes = terrain.errors.slopes_rad(place, azimuth)[at]
        risen = terrain.with_shape(3.0 * (np.arange(len(names)) == at))
        change = (risen.horizon_rad(place, azimuth) - terrain.horizon_rad(place, azimuth)) / 3.0
        assert change == pytest.approx(slopes, abs=0.02 * np.abs(slopes).max())
        assert 10 < np.count_nonzero(slopes) < 30


def test_an_offset_between_two_maps_of_a_file_is_found():
    silent, rng = halves(None), np.random.default_rng(5)
    values = np.array([15.0 if one.name == "map_2_offset_m" else 0.0 for one in silent.errors.shape])
    rows = rays_at(silent.with_shape(values), rng)
    fix = ExactPosterior()(rows, silent)
    assert np.linalg.norm(fix.position_enu_m[:2] - AT_M) < fix.radius999_m
    shown = {one.name: (one.value, one.sigma) for one in fix.shown}
    mean, sigma = shown["map_2_offset_m"]
    assert abs(mean - 15.0) < 4.0 * sigma
    found, reason = locate_or_refuse(rows, halves(0.01))
    assert found is None and reason == "inconsistent_evidence"


def test_waves_of_places_far_apart_are_independent():
    terrain = replace(floor(), waves_sigma_rad=SIGMA_RAD)
    linear = errors_of(np.random.default_rng(2))

    def common(apart_m: float) -> float:
        """Correlation of wave 1 at two places."""
        (one, rise), (other, rise_there) = (
            waves_at(AT_M + np.array([x, 0.0]), terrain, linear) for x in (0.0, apart_m)
        )
        of = {int(n): r for n, r in zip(one, rise[0], strict=True) if (n - FIRST_WAVE) % 3 == 0}
        parts = [of.get(int(n), 0.0) * r for n, r in zip(other, rise_there[0], strict=True)]
        return float(np.sum(parts)) / float(np.square(list(of.values())).sum())

    assert common(0.0) == pytest.approx(1.0)
    assert common(0.05 * terrain.errors.crest_distance_m) > 0.9
    assert common(20.0 * terrain.errors.crest_distance_m) == 0.0
