"""The terrain protocol: the ground, by its horizon; the errors of its map and what its file states are values of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from startrack.core.obstacles import Obstacles
from startrack.core.types import Array, BadInput, Bools
from startrack.frames import Air, Site
from startrack.terrain.maps.projections import STEREOGRAPHIC, EarthProjection, Projection
from startrack.terrain.shape import GroundErrors

if TYPE_CHECKING:
    from startrack.terrain.io import GroundBrightness

Progress = Callable[[int, int], None]  # parts done, of how many
BOUNDS_ROUNDING_RAD = 1e-9  # by which a least horizon may exceed the greatest


@dataclass(frozen=True, kw_only=True)
class TerrainFile:
    """Facts that a terrain file states beside its ground and the errors of that."""

    paths: tuple[Path, ...] = ()  # files read beside it: what is made with the terrain depends on them
    obstacles: Obstacles | None = None  # that hide its skyline, scanned from about where the camera stands
    ground_brightness: GroundBrightness | None = None  # in pictures that are rendered; None: not stated


class Rim(NamedTuple):
    """A circular rim about the origin of a flat floor; of an uneven one the mean. The thesis's methods need it."""

    radius_m: float
    height_m: float  # above the camera


class Terrain(ABC):
    """Ground whose horizon hides stars. Positions are those of the CAMERA, east and north in enu [m].

    A terrain of your own is a subclass with three methods: `horizon_rad`, `horizon_bounds_rad` and `ground_m`. All
    other members have defaults, which describe exact ground that is known everywhere. Methods are elementwise over
    their broadcast arguments. The horizon is an elevation in enu [rad]; a star is visible where its elevation exceeds
    it.

    Arguments of the methods: `points_m` (..., 2) positions; `centres_m` (..., 2) and `half_m` (...) centres and half
    sides of boxes of positions; `centre_m` (2,) one position; `azimuths_rad` and `elevations_rad` (...) directions in
    enu; `azimuth_half_rad` half the width of a range of azimuths; `progress` a function of the parts done and of all.
    """

    name: str = "terrain"
    site: Site | None = None  # where enu stands; needed to locate images, not to localize rays
    camera_height_m: float = 0.0  # of the camera above the ground
    search_radius_m: float = 10_000.0  # the camera is within this horizontal distance of the origin
    errors: GroundErrors = GroundErrors()  # of the map; the default: none
    file: TerrainFile = TerrainFile()
    axisymmetric: bool = False  # whether a turn of the sky about the vertical only turns the position
    horizon_cost: float = 1.0  # of one horizon, beside one traced on a height map: the search has a budget of these
    rim: Rim | None = None  # of a crater, drawn on maps instead of the relief
    table_path: Path | None = None  # file of the table that `prepare` computes; None where it computes none

    @property
    def air(self) -> Air | None:
        """Air of its site; None where there is none, or no site."""
        return None if self.site is None else self.site.air

    def with_air(self, stated: Mapping[str, Any] | None) -> Self:
        """Copy of this ground under the air that is `stated`, see `Site.with_air`; None, or no site: itself."""
        if stated is None or self.site is None:
            return self
        return self.changed(site=self.site.with_air(stated))

    def changed(self, **values: Any) -> Self:
        """A copy with other `values` of attributes, which keeps all that this one has computed but its errors.

        Raises AttributeError for a property: it is computed, or another terrain's.
        """
        for name in values:
            if hasattr(getattr(type(self), name, None), "__set__"):
                raise AttributeError(f"{name} of a {type(self).__name__} is a property: it cannot be changed")
        other = copy(self)
        if isinstance(type(self).errors, cached_property):
            other.__dict__.pop("errors", None)  # they are computed anew
        other.__dict__.update(values)
        return other

    @property
    def reach_m(self) -> float:
        """Half side of the square that is searched: the search area and a margin to notice leaving it [m]."""
        return 1.25 * self.search_radius_m

    @property
    def projection(self) -> Projection | EarthProjection | None:
        """Projection of maps of this ground: stereographic about the origin; None where that is not on the Moon."""
        if self.site is None or self.site.body != "moon":
            return None
        return Projection(
            kind=STEREOGRAPHIC, latitude_rad=self.site.latitude_rad, longitude_rad=self.site.longitude_rad
        )

    @property
    def searched(self) -> tuple[float, float, float]:
        """The disk in which positions are searched: east and north of its middle, and its radius [m]."""
        return 0.0, 0.0, float(self.reach_m)

    @abstractmethod
    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation (...) [rad] seen from the points (..., 2) [m] at the azimuths (...) [rad]."""

    @abstractmethod
    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Least and greatest horizon (...), (...) [rad] over the boxes |dx|, |dy| <= half (...) [m].

        They hold for every allowed point of the box and for every azimuth within `azimuth_half_rad` of the given one.
        """

    @abstractmethod
    def ground_m(self, points_m: Array) -> Array:
        """Height (...) of the ground in enu [m] at the points (..., 2)."""

    def horizon_spread_rad(self, points_m: Array, half_m: float, azimuths_rad: Array) -> tuple[Array, Array]:
        """Middle and half width (...), (...) [rad] of the horizon over boxes: an estimate, where bounds are wide."""
        low, high = self.horizon_bounds_rad(points_m, np.array(half_m), azimuths_rad)
        return 0.5 * (low + high), 0.5 * (high - low)

    def allowed(self, points_m: Array) -> Bools:
        """Whether a camera could stand at the points (..., 2): known ground under open sky."""
        return np.asarray(np.hypot(points_m[..., 0], points_m[..., 1]) <= self.reach_m)

    def is_informative(self, azimuths_rad: Array, elevations_rad: Array) -> Bools:
        """Whether the terrain decides if the rays (...) are visible, from everywhere in the search area."""
        return np.ones(np.broadcast_shapes(np.shape(azimuths_rad), np.shape(elevations_rad)), dtype=bool)

    def unknown_below_rad(self, azimuths_rad: Array) -> Array:
        """Elevations (...) below which ground off the maps could stand at the azimuths (...), or -pi/2."""
        return np.full(np.shape(azimuths_rad), -np.pi / 2)

    def mask_reason(self, azimuths_rad: Array, elevations_rad: Array) -> NDArray[np.str_]:
        """Reason (n,) why rays (n,) are not informative; empty where they are."""
        return np.where(self.is_informative(azimuths_rad, elevations_rad), "", "ground off the map")

    def warnings(self) -> list[str]:
        """Warnings of what the ground does not cover and its file does not state: the same for every image."""
        return self.errors.warnings()

    def near(self, centre_m: Array, half_m: float, azimuths_rad: Array, across: int = 3) -> Terrain:
        """Terrain prepared for positions within `half_m` [m] of a centre (2,), at the azimuths (n,) [rad].

        The terrain itself where horizons cost little; else they may be interpolated between `across` x `across` points.
        """
        return self

    def with_steepness(self, steepness_1: float) -> Terrain:
        """Terrain with the same knowledge, whose errors are counted from a ground of this `steepness_1`.

        For grounds whose `errors.unknown_steepness_1` may differ from 0.
        """
        return self

    def with_shape(self, values: Array) -> Terrain:
        """Ground that has the errors `values` (k,), in the units of the k errors of its shape, exactly.

        For simulation: its horizon may cost much, and its bounds may be wide. Raises ValueError for another number of
        values.
        """
        if np.size(values):
            raise ValueError(f"with_shape: {np.size(values)} values for a terrain without errors of its shape")
        return self

    @property
    def is_prepared(self) -> bool:
        """Whether `prepare` has nothing left to do."""
        return True

    def prepare(self, progress: Progress | None = None) -> None:  # noqa: B027 - the default has nothing to do
        """Compute, once, the table that the first call of `horizon_bounds_rad` needs."""

    def discard_table(self) -> None:  # noqa: B027 - the default has nothing to discard
        """Discard the table of `prepare`, in memory and on disk."""

    def without_table(self) -> Terrain:
        """Copy of this ground whose `horizon_rad` is the same bits before and after `prepare`, in every process.

        A table tells a trace where to begin: it is quicker, and its last digits are others.
        """
        return self

    def facts(self) -> dict[str, Any]:
        """Facts about the ground that `startrack terrain show` prints, as JSON values; "kind" is one of them."""
        return {"kind": "other"}

    def costs_s(self) -> dict[str, float]:
        """Times [s] that work on this machine takes, measured on a part of it; {} where nothing takes long.

        "horizons" is the table that `prepare` computes, where it is not there; "frame" the position of an image.
        """
        return {}


class ForwardingTerrain(Terrain):
    """A terrain with every attribute and method of another one, `whole`; subclasses replace some of them."""

    changed = Terrain.changed

    def __init__(self, whole: Terrain) -> None:
        self.whole = whole

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Elevation (...) [rad] of the horizon of `whole` from points at azimuths."""
        return self.whole.horizon_rad(points_m, azimuths_rad)

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Least and greatest horizon (...), (...) [rad] of `whole` over boxes."""
        return self.whole.horizon_bounds_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)

    def ground_m(self, points_m: Array) -> Array:
        """Height (...) [m] in enu of the ground of `whole`."""
        return self.whole.ground_m(points_m)

    def without_table(self) -> Terrain:
        """Copy of this terrain about `whole` without its table."""
        return self.changed(whole=self.whole.without_table())

    def with_air(self, stated: Mapping[str, Any] | None) -> Self:
        """Copy of this terrain about `whole` under the air that is `stated`."""
        return self.changed(whole=self.whole.with_air(stated))

    def with_steepness(self, steepness_1: float) -> Terrain:
        """Copy of this terrain about `whole` of this `steepness_1`."""
        return self.changed(whole=self.whole.with_steepness(steepness_1))


def _forward(name: str) -> Any:
    """Property that gives the attribute `name` of `whole`."""
    return property(lambda self: getattr(self.whole, name))


for _name in set(vars(Terrain)) - set(vars(ForwardingTerrain)):
    if not _name.startswith("_"):
        setattr(ForwardingTerrain, _name, _forward(_name))


def with_refraction_error(ground: Terrain, error_1: float) -> Terrain:
    """The `ground` below stars whose refraction is larger than that of its air, relatively by `error_1`."""
    return ground if error_1 == 0.0 or ground.air is None else MisrefractedGround(ground, error_1)


class MisrefractedGround(ForwardingTerrain):
    """The terrain `whole`, without errors of its shape, in directions of stars that its `air` alone refracts."""

    near, with_shape = Terrain.near, Terrain.with_shape

    def __init__(self, whole: Terrain, error_1: float) -> None:
        super().__init__(whole)
        self._error_1 = error_1

    def _lowered_rad(self, horizon_rad: Array) -> Array:
        """Elevations (...) [rad] of the `horizon_rad` (...) less the error of the refraction there."""
        air = self.whole.air
        return np.asarray(horizon_rad if air is None else horizon_rad - self._error_1 * air.lift_rad(horizon_rad))

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Elevation (...) [rad] of the horizon less the error of the refraction; see `Terrain`."""
        return self._lowered_rad(self.whole.horizon_rad(points_m, azimuths_rad))

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Least and greatest horizon [rad] over boxes, from those of `whole`; see `Terrain`."""
        low, high = self.whole.horizon_bounds_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)
        return self._lowered_rad(low), self._lowered_rad(high)

    def horizon_spread_rad(self, points_m: Array, half_m: float, azimuths_rad: Array) -> tuple[Array, Array]:
        """Middle (...) [rad] of this ground's horizon over boxes, and half width of that of `whole`; see `Terrain`."""
        middle, half = self.whole.horizon_spread_rad(points_m, half_m, azimuths_rad)
        return self._lowered_rad(middle), half


def require_terrain(given: Any) -> Terrain:
    """The `given` object, if it is a terrain: of a class derived from Terrain, or with every member of one.

    The one check of the members of a user's object; `require_bounds` and `require_horizons` check the values. All other
    code relies on the protocol. Raises BadInput (bad_terrain) that names the required methods which are missing.
    """
    members = [name for name in dir(Terrain) if not name.startswith("_")]
    if all(hasattr(type(given), name) or hasattr(given, name) for name in members):
        return given  # type: ignore[no-any-return]
    if isinstance(given, str):
        raise BadInput("bad_terrain", f"{given!r} is a text, no terrain: give startrack.load_terrain({given!r})")
    missing = [name for name in sorted(Terrain.__abstractmethods__) if not hasattr(given, name)]
    lacks = f" (it has no {', '.join(missing)})" if missing else ""
    raise BadInput(
        "bad_terrain",
        f"{type(given).__name__} is no terrain{lacks}: give a file, a name, or an object of a class derived from "
        "startrack.Terrain",
    )


def require_site(terrain: Terrain) -> Site:
    """The site of a `terrain`. Raises BadInput (bad_terrain) where it has none."""
    if terrain.site is None:
        raise BadInput("bad_terrain", f"terrain {terrain.name} has no site: its sky is not known")
    return terrain.site


def require_place(terrain: Terrain, east_m: float, north_m: float) -> None:
    """Raise BadInput (bad_terrain), with the range allowed, where no camera can stand on a `terrain`.

    The place is `east_m` and `north_m` of the origin [m].
    """
    if terrain.allowed(np.array([[east_m, north_m]]))[0]:
        return
    away_m, radius_m = float(np.hypot(east_m, north_m)), min(terrain.search_radius_m, terrain.reach_m)
    place = f"E {east_m:g} m, N {north_m:g} m"
    if away_m > radius_m:
        raise BadInput(
            "bad_terrain",
            f"{place} is {away_m:.0f} m from the origin of {terrain.name}: give a place within its search area, "
            f"{radius_m:g} m about the origin",
        )
    raise BadInput(
        "bad_terrain", f"{terrain.name}: no camera can stand at {place} (a steep slope, or the wall): give another"
    )


def require_bounds(terrain: Terrain, low_rad: Array, high_rad: Array) -> None:
    """Raise BadInput (bad_terrain) unless what `horizon_bounds_rad` of a `terrain` gave are bounds.

    `low_rad` and `high_rad` (...): the least and greatest horizons. The search asks for those of the whole search area
    first, so that an error in a user's terrain is named before it misleads the search.
    """
    wrong, fault = ~(low_rad <= high_rad + BOUNDS_ROUNDING_RAD), "least horizons above the greatest"
    if not wrong.any():
        return
    nan = np.isnan(low_rad) | np.isnan(high_rad)
    if nan.any():
        wrong, fault = nan, "NaN"
    _refuse(terrain, "horizon_bounds_rad", fault, wrong, "sectors of boxes")


def require_horizons(terrain: Terrain, points_m: Array, horizon_rad: Array) -> None:
    """Raise BadInput (bad_terrain) unless a `terrain` gave finite horizons wherever a camera can stand.

    `points_m` (..., 2) are the positions, `horizon_rad` (...) what `horizon_rad` gave there.
    """
    if not np.isfinite(horizon_rad).all():
        wrong = ~np.isfinite(horizon_rad) & np.asarray(terrain.allowed(points_m))
        _refuse(terrain, "horizon_rad", "NaN or infinity", wrong, "rays from ground on which a camera can stand")


def _refuse(terrain: Terrain, method: str, fault: str, wrong: Bools, what: str) -> None:
    """Raise BadInput (bad_terrain) if any value of a method is wrong."""
    if wrong.any():
        raise BadInput(
            "bad_terrain",
            f"terrain {terrain.name!r} ({type(terrain).__name__}): {method} gives {fault} for "
            f"{np.count_nonzero(wrong)} of {wrong.size} {what}",
        )
