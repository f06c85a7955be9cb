"""The contract of `Terrain` on every implementation: shipped ones, interpolators, wrappers, and a user's own class."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from startrack.chain import terrain_input
from startrack.core.types import Array, BadInput, Evidence
from startrack.frames import Site
from startrack.localization import ExactPosterior
from startrack.terrain import Cylinder, ForwardingTerrain, GroundErrors, Terrain, load_terrain
from startrack.terrain.cylinder import DeformedCrater
from startrack.terrain.shape import EXACT_WAVES

SITE = Site("moon", np.radians(-89.66), np.radians(129.78))
AZIMUTHS = np.linspace(0.01, 2 * np.pi, 12, endpoint=False)
TRACED_RAD = 3e-6  # to which traced horizons and their bounds meet; closed forms meet exactly
INTERPOLATED_RAD = 1e-4


class LevelHorizon(Terrain):
    """A user's own terrain with the three required methods: the same horizon at every position."""

    search_radius_m = 300.0

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        shape = np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))
        return np.full(shape, np.arctan(100 / 5000))

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        shapes = np.shape(centres_m)[:-1], np.shape(half_m), np.shape(azimuths_rad), np.shape(azimuth_half_rad)
        horizon = np.full(np.broadcast_shapes(*shapes), np.arctan(100 / 5000))
        return horizon, horizon

    def ground_m(self, points_m: Array) -> Array:
        return np.zeros(np.shape(points_m)[:-1])


class FacingWall(LevelHorizon):
    """At every azimuth a plane wall 150 m high that faces the camera, 1000 m from the origin."""

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        return np.arctan2(150.0, self.distance_m(points_m, azimuths_rad))

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        turn = np.minimum(azimuth_half_rad, np.pi / 2)
        off_origin = np.hypot(centres_m[..., 0], centres_m[..., 1])
        slack = np.sqrt(2.0) * np.asarray(half_m) + off_origin * (np.sin(turn) + 1 - np.cos(turn))
        distance = self.distance_m(centres_m, azimuths_rad)
        return np.arctan2(150.0, distance + slack), np.arctan2(150.0, distance - slack)

    def distance_m(self, points_m: Array, azimuths_rad: Array) -> Array:
        return np.asarray(1000 - points_m[..., 0] * np.sin(azimuths_rad) - points_m[..., 1] * np.cos(azimuths_rad))


class AttributeWrapper:
    """Not a subclass: every attribute is looked up in the terrain."""

    def __init__(self, whole: Terrain) -> None:
        self.whole = whole

    def __getattr__(self, name: str) -> Any:
        return getattr(self.whole, name)


class HalfATerrain:
    """A class with two of the three required methods, and no base class."""

    horizon_rad, ground_m = LevelHorizon.horizon_rad, LevelHorizon.ground_m


class Underived(HalfATerrain):
    """All three, but none of the other members."""

    horizon_bounds_rad = LevelHorizon.horizon_bounds_rad


@cache
def cylinder() -> Terrain:
    return Cylinder(name="pit", site=SITE, diameter_m=2000.0, depth_m=300.0, camera_height_m=1.0, search_radius_m=300.0)


@cache
def deformed_crater() -> Terrain:
    return DeformedCrater(
        site=SITE, diameter_m=2000.0, depth_m=300.0, camera_height_m=1.0, search_radius_m=300.0, ellipse_cos_1=0.01,
        rim_tilt_east_rad=0.02,
    )  # fmt: skip


@cache
def height_map() -> Terrain:
    return replace(
        load_terrain("shackleton-rendered"), search_radius_m=300.0, height_sigma_m=0.0, horizon_sigma_common_rad=0.0,
        waves_sigma_rad=EXACT_WAVES,
    )  # fmt: skip


MAKERS: dict[str, Callable[[], Any]] = {
    "cylinder": cylinder,
    "deformed crater": deformed_crater,
    "height map": height_map,
    "interpolator": lambda: height_map().near(np.array([20.0, -30.0]), 60.0, AZIMUTHS, 5),
    "forwarded cylinder": lambda: ForwardingTerrain(cylinder()),
    "forwarded height map": lambda: ForwardingTerrain(height_map()),
    "attributes of a cylinder": lambda: AttributeWrapper(cylinder()),
    "attributes of a height map": lambda: AttributeWrapper(height_map()),
    "a user's own": LevelHorizon,
    "a user's own that depends on position": FacingWall,
}
every_terrain = pytest.mark.parametrize("name", MAKERS)
MEMBERS = [name for name in dir(Terrain) if not name.startswith("_")]
WITHOUT_DEFAULT = (
    "site",
    "air",
    "projection",
    "rim",
    "table_path",
)  # None of a terrain that has none


def tolerance_rad(name: str) -> float:
    return {"interpolator": INTERPOLATED_RAD, "height map": TRACED_RAD}.get(name, TRACED_RAD)


@every_terrain
@pytest.mark.parametrize(("half_m", "turn_rad"), [(0.0, 0.0), (2.0, 0.0), (40.0, 0.0), (20.0, 0.02), (150.0, 0.7)])
def test_bounds_hold_the_horizons_of_random_points_and_azimuths(name, half_m, turn_rad):
    terrain, rng = MAKERS[name](), np.random.default_rng(1)
    centres, azimuths = rng.uniform(-100, 100, (30, 2)), rng.choice(AZIMUTHS, 30)
    low, high = terrain.horizon_bounds_rad(centres, half_m, azimuths, turn_rad)
    assert low.shape == high.shape == (30,)
    points = centres[:, None] + half_m * np.concatenate(
        [rng.uniform(-1, 1, (30, 40, 2)), rng.choice([-1.0, 1.0], (30, 4, 2))], axis=1
    )
    turned = azimuths[:, None] + turn_rad * rng.uniform(-1, 1, (30, 44))
    horizon = terrain.horizon_rad(points, turned)
    allowed = np.asarray(terrain.allowed(points))
    assert allowed.mean() > 0.7
    assert np.all((low[:, None] - tolerance_rad(name) <= horizon) | ~allowed)
    assert np.all((horizon <= high[:, None] + tolerance_rad(name)) | ~allowed)


@every_terrain
def test_all_methods_broadcast(name):
    terrain, rng = MAKERS[name](), np.random.default_rng(2)
    points = rng.uniform(-50, 50, (4, 1, 2))
    horizon = terrain.horizon_rad(points, AZIMUTHS)
    assert horizon.shape == (4, 12)
    assert horizon.dtype == np.float64
    each = [[terrain.horizon_rad(p[0], np.array([a]))[0] for a in AZIMUTHS] for p in points]
    assert horizon == pytest.approx(np.array(each), abs=1e-12)
    low, high = terrain.horizon_bounds_rad(points, np.array(5.0), AZIMUTHS)
    assert low.shape == high.shape == (4, 12)
    assert np.all(low <= high)
    assert terrain.ground_m(points).shape == (4, 1)
    assert terrain.allowed(points).shape == (4, 1)
    assert terrain.errors.sigma_rad(points, AZIMUTHS).shape == (4, 12)
    assert terrain.errors.most_sigma_rad(points, 5.0, AZIMUTHS, 0.0).shape == (4, 12)
    assert terrain.is_informative(AZIMUTHS, np.full(12, 1.2)).shape == (12,)
    assert terrain.mask_reason(AZIMUTHS, np.full(12, 1.2)).tolist() == 12 * [""]
    assert terrain.horizon_rad(np.zeros((0, 2)), np.zeros(0)).shape == (0,)


@every_terrain
def test_every_member_exists_and_describes_the_ground(name):
    terrain = MAKERS[name]()
    for member in MEMBERS:
        assert getattr(terrain, member, None) is not None or member in WITHOUT_DEFAULT
    assert isinstance(terrain.name, str)
    assert terrain.search_radius_m == 300.0
    assert terrain.reach_m >= terrain.search_radius_m
    assert terrain.camera_height_m >= 0
    assert terrain.errors.common_sigma_rad == 0
    assert isinstance(terrain.axisymmetric, bool)
    assert all(error.sigma >= 0.0 and error.is_stated for error in terrain.errors.shape)
    assert terrain.errors.slopes_rad(np.zeros((4, 1, 2)), AZIMUTHS).shape == (len(terrain.errors.shape), 4, 12)
    assert isinstance(terrain.with_shape(np.zeros(len(terrain.errors.shape))), Terrain)
    assert terrain.warnings() == []
    assert isinstance(terrain.facts()["kind"], str)
    near = terrain.near(np.zeros(2), 20.0, AZIMUTHS)
    assert near.horizon_rad(np.zeros(2), AZIMUTHS) == pytest.approx(
        terrain.horizon_rad(np.zeros(2), AZIMUTHS), abs=INTERPOLATED_RAD
    )
    terrain.prepare()
    assert terrain.is_prepared


@pytest.mark.parametrize("whole", [cylinder, height_map])
@pytest.mark.parametrize("wrapper", [ForwardingTerrain, AttributeWrapper])
def test_a_wrapper_returns_the_values_of_the_terrain(whole, wrapper):
    terrain, rng = whole(), np.random.default_rng(3)
    wrapped = wrapper(terrain)
    points, azimuths = rng.uniform(-200, 200, (20, 2)), rng.uniform(0, 2 * np.pi, 20)
    values = [name for name in MEMBERS if not callable(getattr(terrain, name))]
    assert {"errors", "file", "reach_m", "site", "axisymmetric", "is_prepared"} <= set(values)
    for member in values:
        assert getattr(wrapped, member) == getattr(terrain, member), member
    assert np.array_equal(wrapped.horizon_rad(points, azimuths), terrain.horizon_rad(points, azimuths))
    for half in (3.0, 60.0):
        found, own = (t.horizon_bounds_rad(points, np.array(half), azimuths, 0.01) for t in (wrapped, terrain))
        assert np.array_equal(found, own)
    assert type(wrapped.near(points[0], 20.0, azimuths)) is type(terrain.near(points[0], 20.0, azimuths))


def test_a_forwarding_terrain_passes_every_member_on():
    own = set(vars(ForwardingTerrain))
    assert set(MEMBERS) <= own


@pytest.mark.parametrize("sigma_m", [0.0, 2.0])
def test_the_posts_of_height_maps_make_the_horizon_err(sigma_m):
    terrain = replace(height_map(), height_sigma_m=sigma_m)
    sigma = terrain.errors.sigma_rad(np.zeros(2), AZIMUTHS)
    assert sigma.any() == (sigma_m > 0.0)
    assert terrain.errors.height_sigma_m == sigma_m
    assert terrain.errors.most_sigma_rad(np.zeros(2), 50.0, AZIMUTHS, 0.01) == pytest.approx(sigma, rel=0.5)


def evidence_from(terrain: Terrain, position_m: Array) -> Evidence:
    """Rays above and below the horizon of a position (2,)."""
    rng = np.random.default_rng(4)
    azimuth = rng.uniform(0, 2 * np.pi, 1500)
    above = rng.uniform(-0.05, 0.05, 1500)
    return Evidence(
        azimuth_rad=azimuth, elevation_rad=terrain.horizon_rad(position_m, azimuth) + above,
        llr=np.where(above > 0, 3.0, -3.0), edge_sigma_rad=np.zeros(1500),
    )  # fmt: skip


def test_a_users_own_terrain_is_searched():
    terrain, position_m = FacingWall(), np.array([80.0, -120.0])
    fix = ExactPosterior()(evidence_from(terrain, position_m), terrain)
    assert np.hypot(*(fix.position_enu_m[:2] - position_m)) < fix.radius999_m < 20.0


def test_a_users_own_errors_stay_under_other_air():
    terrain = FacingWall()
    terrain.site = Site("earth", np.radians(46.0), np.radians(9.0), 1600.0)
    terrain.errors = GroundErrors()
    other = terrain.with_air({"pressure_hpa": 700.0})
    assert other.errors is terrain.errors and other.air != terrain.air


def test_what_a_wrapper_takes_from_its_terrain_cannot_be_changed_in_it():
    with pytest.raises(AttributeError, match="name of a ForwardingTerrain is a property"):
        ForwardingTerrain(FacingWall()).changed(name="other")


class NaNHorizon(FacingWall):
    """Its bounds are right; of its horizons those to the east are NaN."""

    name = "broken"

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        right = super().horizon_rad(points_m, azimuths_rad)
        return np.where(np.sin(azimuths_rad) > 0.5, np.nan, right)


class NaNBounds(NaNHorizon):
    """Its bounds are NaN as well."""

    def horizon_bounds_rad(self, *box: Any) -> tuple[Array, Array]:
        low, high = super().horizon_bounds_rad(*box)
        return low * np.nan, high * np.nan


class SwappedBounds(FacingWall):
    """The greatest horizon before the least."""

    name = "broken"

    def horizon_bounds_rad(self, *box: Any) -> tuple[Array, Array]:
        low, high = super().horizon_bounds_rad(*box)
        return high, low


@pytest.mark.parametrize("common_sigma_rad", [0.0, 1e-3])
@pytest.mark.parametrize(
    ("broken", "fault"),
    [
        (NaNHorizon, r"'broken' \(NaNHorizon\): horizon_rad gives NaN or infinity for \d+ of \d+ rays"),
        (NaNBounds, r"'broken' \(NaNBounds\): horizon_bounds_rad gives NaN for"),
        (SwappedBounds, r"'broken' \(SwappedBounds\): horizon_bounds_rad gives least horizons above the greatest"),
    ],
)
def test_an_error_in_a_users_terrain_is_named_by_its_method(broken, fault, common_sigma_rad):
    terrain = broken()
    terrain.errors = GroundErrors()
    terrain.errors.common_sigma_rad = common_sigma_rad
    with pytest.raises(BadInput, match=fault) as caught:
        ExactPosterior()(evidence_from(FacingWall(), np.array([80.0, -120.0])), terrain)
    assert caught.value.reason == "bad_terrain"


def test_what_is_no_terrain_is_refused_by_the_methods_it_lacks():
    assert terrain_input(cylinder(), None) is cylinder()
    wrapped = AttributeWrapper(cylinder())
    assert terrain_input(wrapped, None) is wrapped
    with pytest.raises(BadInput, match=r"it has no horizon_bounds_rad\): .* derived from startrack\.Terrain"):
        terrain_input(HalfATerrain(), None)
    with pytest.raises(BadInput, match=r"Underived is no terrain: .* derived from startrack\.Terrain"):
        terrain_input(Underived(), None)
    with pytest.raises(BadInput, match="ground_m, horizon_bounds_rad, horizon_rad"):
        terrain_input(7, None)
