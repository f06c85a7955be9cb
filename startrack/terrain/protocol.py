"""The terrain protocol: elevation of the horizon at a position, and its bounds over a box of positions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from copy import copy
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from startrack.core.obstacles import Obstacles
from startrack.core.types import Array, Bools, Ints
from startrack.frames import Air, Site
from startrack.terrain.earth_projection import EarthProjection
from startrack.terrain.ground_brightness import GroundBrightness
from startrack.terrain.projection import STEREOGRAPHIC, Projection
from startrack.terrain.shape import ShapeError

Progress = Callable[[int, int], None]  # parts done, of how many
NO_POST = -1


class ExpectedCrests(NamedTuple):
    """The skyline at n azimuths of ground whose posts err, by the moments of its elevation."""

    rise_rad: Array  # (n,) mean, above the map's
    own_sigma_rad: Array  # (n,) of the part that follows no post
    post: Ints  # (n, k) in the numbering of a terrain; NO_POST where fewer count
    rad_per_m: Array  # (n, k) mean rise with the height of each


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
    height_sigma_m: float = 0.0  # standard deviation of the height of a post, independent of the others
    search_radius_m: float = 10_000.0  # the camera is within this horizontal distance of the origin
    common_sigma_rad: float = 0.0  # standard deviation of an error of the horizon that all azimuths and positions share
    hard_edges: bool = True  # whether the horizon is exact: `horizon_sigma_rad` is zero everywhere
    finest_m: float = 0.05  # half side of the smallest box of positions that the ground distinguishes
    axisymmetric: bool = False  # whether a turn of the sky about the vertical only turns the position
    horizon_cost: float = 1.0  # of one horizon, beside one traced on a height map: the search has a budget of these
    shape_errors: tuple[ShapeError, ...] = ()  # errors that all azimuths share, those that are stated as zero too
    crest_distance_m: float = 10_000.0  # of the skyline from about the origin: over it waves of the map's error change
    unknown_steepness_1: float = 0.0  # relative sigma of the horizon's tangent, where a search must find it; 0: known
    steepness_1: float = 1.0  # the horizon's tangent that errors are counted from, over that of the stated shape
    rim_radius_m: float | None = None  # of a circular rim about the origin, drawn on maps instead of the relief
    table_path: Path | None = None  # file of the table that `prepare` computes; None where it computes none
    unstated_errors: tuple[str, ...] = ()  # keys of errors that the terrain file leaves out: they count as zero
    obstacles: Obstacles | None = None  # that hide its skyline, scanned from about where the camera stands
    ground_brightness: GroundBrightness | None = None  # in pictures that are rendered; None: not stated
    files: tuple[Path, ...] = ()  # that it was read from, beside the terrain file: what is made with it depends on them

    @property
    def air(self) -> Air | None:
        """That of its site; None where there is none, or no site."""
        return None if self.site is None else self.site.air

    def with_air(self, stated: Mapping[str, Any] | None) -> Self:
        """The same ground under the air that is `stated`, see `Site.with_air`; None, or no site: itself."""
        if stated is None or self.site is None:
            return self
        other = copy(self)
        other.__dict__["site"] = self.site.with_air(stated)
        other.__dict__.pop("shape_errors", None)  # of a class that keeps them
        return other

    @property
    def reach_m(self) -> float:
        """Half side of the square that is searched: the search area and a margin to notice leaving it [m]."""
        return 1.25 * self.search_radius_m

    @property
    def projection(self) -> Projection | EarthProjection | None:
        """That of maps of this ground: stereographic about the origin. None where that is not on the Moon."""
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

    def horizon_sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Standard deviation (...) of the horizon [rad] from the errors of the map; independent between azimuths."""
        return np.zeros(np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad)))

    def max_horizon_sigma_rad(
        self, centres_m: Array, half_m: float, azimuths_rad: Array, azimuth_half_rad: float
    ) -> Array:
        """The largest `horizon_sigma_rad` (...) over boxes and azimuths, as in `horizon_bounds_rad`."""
        return np.zeros(np.broadcast_shapes(np.shape(centres_m)[:-1], np.shape(azimuths_rad)))

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

    def ends_at(self, point_m: Array, azimuths_rad: Array) -> Bools:
        """Whether ground off the maps could stand above the horizon seen from `point_m` (2,) at the azimuths (n,)."""
        horizon = np.ravel(self.horizon_rad(np.asarray(point_m)[None], azimuths_rad))
        return np.asarray(self.unknown_below_rad(azimuths_rad) > horizon)

    def mask_reason(self, azimuths_rad: Array, elevations_rad: Array) -> NDArray[np.str_]:
        """Why rays (n,) are not informative; empty where they are."""
        return np.where(self.is_informative(azimuths_rad, elevations_rad), "", "ground off the map")

    def masked_sectors(self) -> list[str]:
        """One line of text per range of azimuths that is not informative."""
        return []

    def error_warnings(self) -> list[str]:
        """One line of text if the terrain file leaves out errors: the ground then counts as exact."""
        return []

    def warnings(self) -> list[str]:
        """What the ground does not cover, and what its file does not state: the same for every image."""
        return [*self.masked_sectors(), *self.error_warnings()]

    def expected_crests(self, point_m: Array, azimuths_rad: Array) -> ExpectedCrests | None:
        """The skyline seen from `point_m` (2,) at the azimuths (n,), with all errors of posts; None without such."""
        return None

    def crest_posts(self, point_m: Array, azimuths_rad: Array) -> Ints:
        """The posts (n,) nearest to the map's crests seen from `point_m` (2,) at the azimuths (n,); NO_POST of none."""
        return np.full(len(azimuths_rad), NO_POST)

    def ground_posts(self, point_m: Array, azimuths_rad: Array) -> tuple[Ints, Array]:
        """The posts (n, k) of the ground below a camera at `point_m` (2,), and by how much each lowers the horizon.

        The latter is (n, k), negative, at the azimuths (n,) [rad/m].
        """
        return np.zeros((len(azimuths_rad), 0), dtype=np.int64), np.zeros((len(azimuths_rad), 0))

    def post_positions_m(self, posts: Ints) -> Array:
        """East, north and up (n, 3) in enu of the posts with these numbers (n,)."""
        return np.zeros((len(posts), 3))

    def near(self, centre_m: Array, half_m: float, azimuths_rad: Array, across: int = 3) -> Terrain:
        """The same ground, prepared for positions within `half_m` of a centre (2,), at the azimuths (n,).

        The terrain itself where horizons cost little; else they may be interpolated between `across` x `across` points.
        """
        return self

    def shape_slopes_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Change (k, ...) [rad] of the horizon by one unit of each of the k `shape_errors`, to first order.

        Seen from the points (..., 2) [m] at the azimuths (...) [rad].
        """
        return np.zeros((0, *np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))))

    def with_steepness(self, steepness_1: float) -> Terrain:
        """The same knowledge of a ground, its errors counted from one of this `steepness_1`.

        For grounds whose `unknown_steepness_1` may differ from 0.
        """
        return self

    def with_shape(self, values: Array) -> Terrain:
        """The ground that has the errors `values` (k,), in the units of the k `shape_errors`, exactly.

        For simulation: its horizon may cost much, and its bounds may be wide. Raises ValueError for another number of
        values.
        """
        if np.size(values):
            raise ValueError(f"with_shape: {np.size(values)} values for a terrain without errors of its shape")
        return self

    def visible_disks(self, azimuths_rad: Array, elevations_rad: Array) -> tuple[Array, float] | None:
        """Centres (n, 2) and radius [m] of the disks of ground from which the rays (n,) are visible.

        None where the visible ground of a ray is not a disk of one radius for all rays.
        """
        return None

    @property
    def is_prepared(self) -> bool:
        """Whether `prepare` has nothing left to do."""
        return True

    def prepare(self, progress: Progress | None = None) -> None:  # noqa: B027 - the default has nothing to do
        """Compute, once, the table that the first call of `horizon_bounds_rad` needs."""

    def discard_table(self) -> None:  # noqa: B027 - the default has nothing to discard
        """Discard the table of `prepare`, in memory and on disk."""

    def without_table(self) -> Terrain:
        """The same ground with a `horizon_rad` that is the same bits before and after `prepare`, in every process.

        A table tells a trace where to begin: it is quicker, and its last digits are others.
        """
        return self

    def facts(self) -> dict[str, Any]:
        """Facts about the ground that `startrack terrain show` prints, as JSON values; "kind" is one of them."""
        return {"kind": "other"}

    def costs_s(self) -> dict[str, float]:
        """About how long work on this machine takes [s], measured on a part of it; {} where nothing takes long.

        "horizons" is the table that `prepare` computes, where it is not there; "frame" the position of an image.
        """
        return {}


class ForwardingTerrain(Terrain):
    """A terrain with every attribute and method of another one, `whole`; subclasses replace some of them."""

    def __init__(self, whole: Terrain) -> None:
        self.whole = whole

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """As of `whole`."""
        return self.whole.horizon_rad(points_m, azimuths_rad)

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """As of `whole`."""
        return self.whole.horizon_bounds_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)

    def ground_m(self, points_m: Array) -> Array:
        """As of `whole`."""
        return self.whole.ground_m(points_m)

    def without_table(self) -> Terrain:
        """A copy of this one, about `whole` without its table."""
        return self._about(self.whole.without_table())

    def with_air(self, stated: Mapping[str, Any] | None) -> Self:
        """A copy of this one, about `whole` under the air that is `stated`."""
        return self._about(self.whole.with_air(stated))

    def with_steepness(self, steepness_1: float) -> Terrain:
        """A copy of this one, about `whole` of this `steepness_1`."""
        return self._about(self.whole.with_steepness(steepness_1))

    def _about(self, whole: Terrain) -> Self:
        other = copy(self)
        other.__dict__["whole"] = whole
        return other


def _forward(name: str) -> Any:
    return property(lambda self: getattr(self.whole, name))


for _name in set(vars(Terrain)) - set(vars(ForwardingTerrain)):
    if not _name.startswith("_"):
        setattr(ForwardingTerrain, _name, _forward(_name))
