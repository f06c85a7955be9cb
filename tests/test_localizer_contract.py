"""The contract of every localizer of LOCALIZERS: its errors, honest covariances and circles, maps, and refusals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from localization_helpers import TERRAIN, perfect_list, random_position, sky
from map_helpers import basin

from startrack.core.types import Array, BadInput, Evidence, Fix, NotLocated
from startrack.localization import LOCALIZERS, WITHOUT_POSTERIOR, Localizer, has_posterior

LISTS = 40
KNOWN_ERRORS_M = {"posterior": (28.0, 120.0), "pseudo-gradient": (40.0, 200.0), "hull": (750.0, 1500.0)}  # mean, most
METHODS = {name: kind() for name, kind in LOCALIZERS.items()}
pytestmark = pytest.mark.usefixtures("own_cache")


@cache
def fixes_of(name: str) -> list[tuple[Array, Fix]]:
    """True positions and the fixes by a localizer on the thesis's perfect lists."""
    found = []
    for seed in range(LISTS):
        rng = np.random.default_rng(seed)
        at = random_position(rng)
        found.append((at, METHODS[name](perfect_list(rng, at), TERRAIN)))
    return found


def check_errors(fixes: Sequence[tuple[Array, Fix]], mean_m: float, most_m: float) -> None:
    """The fixes are complete, and their errors are at most these in the mean and each."""
    errors = [np.linalg.norm(fix.position_enu_m[:2] - at) for at, fix in fixes]
    for _, fix in fixes:
        assert fix.position_enu_m[2] == TERRAIN.camera_height_m
        assert sum(mode.weight for mode in fix.modes) == pytest.approx(1.0)
        assert not fix.ambiguous
    assert np.mean(errors) < mean_m
    assert np.max(errors) < most_m


def check_honesty(fixes: Sequence[tuple[Array, Fix]]) -> None:
    """Covariances and circles are neither too small nor too large. Bounds are 3 sigma of the count, of 40."""
    nees, in_half, in_95, in_999 = [], [], [], []
    for at, fix in fixes:
        assert np.linalg.eigvalsh(fix.covariance_m2).min() > 0
        assert 0 < fix.radius95_m < fix.radius999_m
        off = fix.position_enu_m[:2] - at
        error = np.linalg.norm(off)
        nees.append(off @ np.linalg.solve(fix.covariance_m2, off))
        in_half.append(error < fix.radius95_m / 2)
        in_95.append(error < fix.radius95_m)
        in_999.append(error < fix.radius999_m)
    assert 1.2 < np.mean(nees) < 2.9  # 2 +- 0.3
    assert np.mean(in_half) < 0.78  # 0.53 +- 0.08
    assert np.mean(in_95) > 0.85
    assert np.all(in_999)


def check_silence(fixes: Sequence[tuple[Array, Fix]]) -> None:
    """A method without a posterior states nothing of it."""
    for _, fix in fixes:
        assert fix.search == "approximate"
        assert np.isinf([*fix.covariance_m2.ravel(), fix.radius95_m, fix.radius999_m]).all()


def test_every_localizer_states_its_errors() -> None:
    assert set(KNOWN_ERRORS_M) == set(LOCALIZERS)


@pytest.mark.parametrize("name", LOCALIZERS)
def test_contract_of_every_localizer(name: str) -> None:
    check_errors(fixes_of(name), *KNOWN_ERRORS_M[name])
    assert has_posterior(METHODS[name]) == (name not in WITHOUT_POSTERIOR)
    check = check_honesty if has_posterior(METHODS[name]) else check_silence
    check(fixes_of(name))


def shifted(fix: Fix) -> Fix:
    """By 500 m, in a covariance of 600 m."""
    far = fix.position_enu_m + np.array([300.0, 400.0, 0.0])
    return replace(fix, position_enu_m=far, covariance_m2=600.0**2 * np.eye(2))


def exchanged(fix: Fix) -> Fix:
    """East and north."""
    return replace(fix, position_enu_m=fix.position_enu_m[[1, 0, 2]])


def on_the_ground(fix: Fix) -> Fix:
    """Without the camera's height."""
    return replace(fix, position_enu_m=fix.position_enu_m * [1.0, 1.0, 0.0])


def scaled(circles: float, sigmas: float) -> Callable[[Fix], Fix]:
    """With circles and sigmas of so many times the size."""

    def wrong(fix: Fix) -> Fix:
        covariance = sigmas**2 * fix.covariance_m2
        radii = {"radius95_m": circles * fix.radius95_m, "radius999_m": circles * fix.radius999_m}
        return replace(fix, covariance_m2=covariance, **radii)

    return wrong


@pytest.mark.parametrize("wrong", [exchanged, on_the_ground])
def test_wrong_positions_break_the_contract(wrong: Callable[[Fix], Fix]) -> None:
    with pytest.raises(AssertionError):
        check_errors([(at, wrong(fix)) for at, fix in fixes_of("posterior")], *KNOWN_ERRORS_M["hull"])


@pytest.mark.parametrize("wrong", [shifted, scaled(1, 1.5), scaled(1, 0.7), scaled(2, 1), scaled(0.6, 1)])
def test_dishonest_errors_break_the_contract(wrong: Callable[[Fix], Fix]) -> None:
    fixes = [(at, wrong(fix)) for at, fix in fixes_of("posterior")]
    check_errors(fixes, *KNOWN_ERRORS_M["hull"])
    with pytest.raises(AssertionError):
        check_honesty(fixes)


@pytest.mark.parametrize("name", LOCALIZERS)
def test_a_height_map_is_located_within_the_circle_or_refused(name: str) -> None:
    ground = basin(height_sigma_m=1.0)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        at = rng.uniform(-200.0, 200.0, 2)
        azimuth, elevation = sky(rng, 1500)
        seen = elevation > ground.horizon_rad(at[None], azimuth)
        evidence = Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=np.where(seen, 12.0, -12.0))
        if name in WITHOUT_POSTERIOR:
            with pytest.raises(BadInput, match="this method needs a"):
                METHODS[name](evidence, ground)
            continue
        fix = METHODS[name](evidence, ground)
        assert np.linalg.norm(fix.position_enu_m[:2] - at) < fix.radius999_m < 40.0
        height = ground.ground_m(fix.position_enu_m[None, :2])[0] + ground.camera_height_m
        assert fix.position_enu_m[2] == pytest.approx(height)


@pytest.mark.parametrize("name", LOCALIZERS)
def test_empty_evidence_is_refused_by_every_localizer(name: str) -> None:
    none = np.zeros(0)
    with pytest.raises(NotLocated):
        METHODS[name](Evidence(azimuth_rad=none, elevation_rad=none, llr=none, edge_sigma_rad=none), TERRAIN)


@pytest.mark.parametrize("name", LOCALIZERS)
@pytest.mark.parametrize(
    ("given", "message"),
    [("shackleton-thesis", r"give startrack.load_terrain\('shackleton-thesis'\)"), (None, "NoneType is no terrain")],
)
def test_what_is_no_terrain_is_refused_by_every_localizer(name: str, given: Any, message: str) -> None:
    method: Localizer = METHODS[name]
    with pytest.raises(BadInput, match=message) as caught:
        method(perfect_list(np.random.default_rng(0), np.zeros(2), 100), given)
    assert caught.value.reason == "bad_terrain"
