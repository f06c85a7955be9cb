"""Height maps as terrain: traced ground, the errors of its horizon, and azimuths that give no evidence."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.statistics import NORMAL_CDF
from startrack.core.types import MIDDLES_RAD, Array, Bools, Ints
from startrack.kernels.library import kernel
from startrack.terrain import shape
from startrack.terrain.derived_maps import DeformedMap, HorizonInterpolator
from startrack.terrain.ground import cell_posts, number_of_maps, post_positions
from startrack.terrain.horizon_table import AZIMUTH_BINS, HorizonSigma
from startrack.terrain.map_ends import circular_runs, facts_of_ends, unknown_elevations_rad
from startrack.terrain.protocol import ExpectedCrests, Terrain
from startrack.terrain.refracted import refraction_errors, refraction_slopes_rad, with_refraction_error
from startrack.terrain.table_cache import load_table
from startrack.terrain.traced_map import TracedMap

COMMON_PER_POST = 3.0
POSTS = 64  # that the skyline of one ray follows; in crests.c too
NUDGE_M = 0.05  # nearer crests count as so far away
BETWEEN_POSTS = 2.0 / 3.0  # RMS over a cell of the bilinear mean of independent errors at four posts, in that of one
GLARE, OFF_MAP = "glare of a lit rim", "ground off the map"
Sectors = tuple[tuple[float, float], ...]  # azimuth ranges [rad], each from the first eastward to the second


@dataclass(frozen=True, eq=False, kw_only=True)
class HeightMap(TracedMap):
    """Height maps and what is known of their errors: see `TracedMap` for the ground, `Terrain` for the methods."""

    height_sigma_m: float = Terrain.height_sigma_m  # of single posts, independent of each other
    horizon_sigma_common_rad: float | None = None  # of an error that all azimuths share; None: see common_sigma_rad
    stretch_sigma_1: float | None = shape.EXACT  # of the factor of tan H, less 1; None: not stated, see `terrain.shape`
    vertical_sigma_rad: float | None = shape.EXACT  # of a tilt of the whole map, of each of two axes
    waves_sigma_rad: tuple[float, ...] | None = shape.EXACT_WAVES  # of waves 1 to 8 of the horizon's error over azimuth
    map_offset_sigma_m: float | None = shape.EXACT  # of the heights of each further map against the first one
    camera_height_sigma_m: float | None = shape.EXACT
    terrestrial_refraction_sigma_1: float | None = shape.EXACT
    most_slope_rad: float = np.pi / 2  # a rover does not stand on steeper ground
    glare_rad: Sectors = ()  # lit by the Sun: no evidence there
    unstated_errors: tuple[str, ...] = ()

    @property
    def hard_edges(self) -> bool:  # type: ignore[override]
        """Whether single posts have no error: the horizon of a point is then exact, but for a common error."""
        return self.height_sigma_m == 0

    @cached_property
    def common_sigma_rad(self) -> float:  # type: ignore[override]
        """Standard deviation [rad] of the crests' common error at their median distance, with the camera's ground's.

        If it is not known, three times the horizon's sigma from `height_sigma_m`: crests clipped by the grid of posts
        stand too low by some such amount all around.
        """
        if not self.height_sigma_m and not self.horizon_sigma_common_rad:
            return 0.0
        own, known = self.post_rad, self.horizon_sigma_common_rad
        return float(np.hypot(own, COMMON_PER_POST * own if known is None else known))

    @cached_property
    def post_rad(self) -> float:
        """What the error of single posts makes of the horizon [rad]: the median over search area and azimuth."""
        if not self.height_sigma_m:
            return 0.0
        cells = np.hypot(*self.square.centres_m.T) < self.search_radius_m
        return float(np.median(self._sigma.blocks_rad[0].reshape(-1, AZIMUTH_BINS)[cells]))

    @cached_property
    def crest_distance_m(self) -> float:  # type: ignore[override]
        """The median over azimuth, from the origin [m]."""
        return float(np.median(self.horizons(np.zeros(2), MIDDLES_RAD)[1]))

    @cached_property
    def shape_errors(self) -> tuple[shape.ShapeError, ...]:  # type: ignore[override]
        """Bias, stretch, tilt, waves, offsets of maps, camera, refraction. The bias needs the table of horizons.

        The camera stands as much too high as the ground between four posts is.
        """
        return (
            *shape.BIAS.shape_errors(self.common_sigma_rad), *shape.STRETCH.shape_errors(self.stretch_sigma_1),
            *shape.vertical_fact(self.site.body).shape_errors(self.vertical_sigma_rad),
            *shape.wave_errors(self.waves_sigma_rad, 0.0 if self.waves_sigma_rad else self.post_rad),
            *replace(shape.OFFSETS, errors=shape.offset_names(len(self.maps))).shape_errors(self.map_offset_sigma_m),
            *shape.CAMERA_ERROR.shape_errors(self.camera_height_sigma_m, beside=BETWEEN_POSTS * self.height_sigma_m),
            *shape.REFRACTION.shape_errors(self.terrestrial_refraction_sigma_1), *refraction_errors(self.air),
        )  # fmt: skip

    def shape_slopes_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """From the traced horizon and the distance of its crest; see `Terrain`.

        The bias and the waves are errors of the crests' heights, see `crest_share`. Of a tilt the change of elevation
        alone: that of azimuth moves the skyline by its slope times tan H times the tilt, which is left out.
        """
        tan, distance, _ = self.horizons(points_m, azimuths_rad)
        flat = 1.0 / (1.0 + np.square(tan))  # cos^2 H
        by_crest = self.crest_share(tan, distance)
        waves = {name: by_crest * wave for name, wave in shape.wave_slopes_rad(azimuths_rad).items()}
        slopes = {
            "bias_rad": by_crest, "stretch_1": tan * flat, "vertical_east_rad": np.sin(azimuths_rad),
            "vertical_north_rad": np.cos(azimuths_rad), "camera_height_m": -flat / np.maximum(distance, NUDGE_M),
            "terrestrial_refraction_1": distance / (2 * self.ground.radius_m) * flat,
            **waves, **self._offset_slopes_rad(points_m, azimuths_rad, tan, distance),
        }  # fmt: skip
        return shape.select_slopes(
            self.shape_errors, slopes | refraction_slopes_rad(self.air, np.arctan(tan)), np.shape(tan)
        )

    def _offset_slopes_rad(self, points_m: Array, azimuths_rad: Array, tan: Array, distance: Array) -> dict[str, Array]:
        """Rise (...) of the horizon by a metre of each further map, below its crests less below the camera."""
        if len(self.maps) == 1:
            return {}
        away = distance[..., None] * np.stack([np.sin(azimuths_rad), np.cos(azimuths_rad)], axis=-1)
        camera_up_m = np.asarray(self.ground_m(points_m))
        crest_m = np.concatenate([points_m + away, (camera_up_m + tan * distance)[..., None]], axis=-1)
        camera_m = np.concatenate([points_m, camera_up_m[..., None]], axis=-1)
        of_crest, of_camera = (
            number_of_maps(self.site, self.maps, at.reshape(-1, 3)).reshape(at.shape[:-1]) for at in (crest_m, camera_m)
        )
        per_m = 1.0 / ((1.0 + np.square(tan)) * distance)
        names = shape.offset_names(len(self.maps))
        return {name: per_m * (1.0 * (of_crest == k) - (of_camera == k)) for k, name in enumerate(names, 1)}

    def with_shape(self, values: Array) -> Terrain:
        """The ground with these errors; see `Terrain`."""
        errors = shape.errors_by_name(self.shape_errors, values)
        offsets_m = [errors.pop(name, 0.0) for name in shape.offset_names(len(self.maps))]
        refraction_1 = errors.pop("refraction_1", 0.0)
        whole = self
        if any(offsets_m):
            risen = zip(self.maps, [0.0, *offsets_m], strict=True)
            maps = (replace(one, heights_m=one.heights_m + np.float32(rise)) for one, rise in risen)
            whole = replace(self, maps=tuple(maps))
        return with_refraction_error(DeformedMap(whole, **errors), refraction_1)

    def horizon_sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """From the height of the single post that makes the horizon: sigma cos^2 H / its distance."""
        if self.height_sigma_m == 0:
            return super().horizon_sigma_rad(points_m, azimuths_rad)
        return self._sigma.sigma_rad(points_m, azimuths_rad)

    def max_horizon_sigma_rad(
        self, centres_m: Array, half_m: float, azimuths_rad: Array, azimuth_half_rad: float
    ) -> Array:
        """The largest `horizon_sigma_rad` (n,) over boxes and azimuths."""
        if self.height_sigma_m == 0:
            return super().max_horizon_sigma_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)
        return self._sigma.max_sigma_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)

    @cached_property
    def _sigma(self) -> HorizonSigma:
        return HorizonSigma(self.table, self.height_sigma_m)

    def discard_table(self) -> None:
        """Remove the table of horizons from memory and disk."""
        super().discard_table()
        self.__dict__.pop("_sigma", None)

    def allowed(self, points_m: Array) -> Bools:
        """Whether the points (..., 2) are within reach and not too steep."""
        inside = super().allowed(np.asarray(points_m))
        if self.most_slope_rad >= np.pi / 2:
            return inside
        return np.asarray(inside & (self.slope_rad(points_m) <= self.most_slope_rad))

    def is_informative(self, azimuths_rad: Array, elevations_rad: Array) -> Bools:
        """Whether the map decides if the rays (...) are visible: outside glare, and above unmapped ground."""
        self.prepare()  # which knows them
        above = np.asarray(elevations_rad) > self.unknown_below_rad(azimuths_rad)
        return np.asarray(above & ~are_in_sectors(azimuths_rad, self.glare_rad))

    def unknown_below_rad(self, azimuths_rad: Array) -> Array:
        """The same from everywhere in the search area; see `Terrain`."""
        b = np.floor(np.asarray(azimuths_rad) / (2 * np.pi) * AZIMUTH_BINS).astype(np.int64) % AZIMUTH_BINS
        return np.asarray(self.unknown_rad[b])

    def mask_reason(self, azimuths_rad: Array, elevations_rad: Array) -> NDArray[np.str_]:
        """Why rays (n,) are not informative; empty where they are."""
        reason = np.where(self.is_informative(azimuths_rad, elevations_rad), "", OFF_MAP)
        return np.where((reason != "") & are_in_sectors(azimuths_rad, self.glare_rad), GLARE, reason)

    def masked_sectors(self) -> list[str]:
        """One line of text per range of azimuths that is not informative."""
        return describe_masks(self.glare_rad, self.unknown_rad)

    @cached_property
    def unknown_rad(self) -> Array:
        """(AZIMUTH_BINS,) elevation below which ground off the maps could stand, or -pi/2; needs no table."""
        table = load_table(self.table_key, self.square)
        return unknown_elevations_rad(self) if table is None else table.unknown_rad

    def error_warnings(self) -> list[str]:
        """Lines of text: errors that the terrain file leaves out, so that they count as 0; datums of unknown place."""
        of_maps = [
            (one.source, text) for one in self.maps for text in (one.projection.transformation_warning, *one.notes)
        ]
        return [
            f"terrain {self.name}: its file states no {key}: taken as 0; circles are too small unless the ground is "
            "exactly so; state the errors (0 for a model from which pictures are rendered)"
            for key in self.unstated_errors
            if not getattr(self, key)
        ] + [f"map {source}: {warning}" for source, warning in of_maps if warning]

    def facts(self) -> dict[str, Any]:
        """Facts about the maps and their errors, as JSON values."""
        common = self.horizon_sigma_common_rad
        return {
            "kind": "dem",
            "maps": [raster.facts() for raster in self.maps],
            "maps_end": facts_of_ends(self, self.unknown_rad),
            "height_sigma_m": self.height_sigma_m,
            "horizon_sigma_deg": None if common is None else round(float(np.degrees(common)), 6),
            "horizons": str(self.table_path),
            "horizons_ready": self.table_path.is_file(),
        }

    def near(self, centre_m: Array, half_m: float, azimuths_rad: Array, across: int = 3) -> Terrain:
        """The ground near a centre (2,), see `HorizonInterpolator`."""
        centre = np.asarray(centre_m, dtype=np.float64)
        return HorizonInterpolator(self, centre, half_m, np.unique(azimuths_rad), across)

    def expected_crests(self, point_m: Array, azimuths_rad: Array) -> ExpectedCrests | None:
        """By the places along each ray that may stand highest; see kernels/crests.c and `Terrain`."""
        if self.height_sigma_m == 0.0:
            return None
        tan, distance, _ = self.horizons(point_m, azimuths_rad)
        points, count = np.tile(np.asarray(point_m, dtype=np.float64), (len(tan), 1)), len(tan)
        mean, own, post, response = *np.empty((2, count)), np.empty((count, POSTS), np.int64), np.empty((count, POSTS))
        fixed = self.ground.record, self.camera_height_m, self.height_sigma_m
        rays = points, np.array(azimuths_rad, dtype=np.float64), tan, distance
        _crests(*fixed, *rays, NORMAL_CDF, mean, own, post, response)
        flat = 1.0 / (1.0 + mean * mean)
        rise = np.arctan(mean) - np.arctan(tan)
        return ExpectedCrests(rise, flat * np.sqrt(own), post, flat[:, None] * response)

    def crest_posts(self, point_m: Array, azimuths_rad: Array) -> Ints:
        """See `Terrain`."""
        tan, distance, _ = self.horizons(point_m, azimuths_rad)
        away = distance[:, None] * np.stack([np.sin(azimuths_rad), np.cos(azimuths_rad)], axis=1)
        up = float(self.ground_m(point_m)) + self.camera_height_m + tan * distance
        post, weight = cell_posts(self.site, self.maps, np.column_stack([point_m + away, up]))
        return np.asarray(post[np.arange(len(post)), np.argmax(weight, axis=1)])

    def ground_posts(self, point_m: Array, azimuths_rad: Array) -> tuple[Ints, Array]:
        """The posts about a camera at `point_m`; see `Terrain`."""
        tan, distance, _ = self.horizons(point_m, azimuths_rad)
        post, weight = cell_posts(self.site, self.maps, np.append(point_m, self.ground_m(point_m))[None])
        weights = -weight / ((1.0 + tan * tan) * distance)[:, None]
        return np.repeat(post, len(tan), axis=0), weights

    def post_positions_m(self, posts: Ints) -> Array:
        """See `Terrain`."""
        return post_positions(self.site, self.maps, posts)


def are_in_sectors(azimuths_rad: Array, sectors_rad: Sectors) -> Bools:
    """Whether the azimuths (...) are in one of the sectors."""
    azimuths = np.asarray(azimuths_rad)
    inside = np.zeros(azimuths.shape, dtype=bool)
    for start, end in sectors_rad:
        inside |= (azimuths - start) % (2 * np.pi) <= (end - start) % (2 * np.pi)
    return inside


def describe_masks(glare_rad: Sectors, unknown_rad: Array) -> list[str]:
    """One line per masked range of azimuths.

    `unknown_rad` (n,) of n equal sectors from north eastward is the elevation below which unmapped ground may stand,
    or -pi/2.
    """
    lines = [
        f"azimuths {_range_text(start, end)}: no evidence is taken there, {GLARE} (glare_deg)"
        for start, end in glare_rad
    ]
    step = 2 * np.pi / len(unknown_rad)
    for first, last in circular_runs(unknown_rad > -np.pi / 2):
        highest = np.degrees(np.take(unknown_rad, range(first, last), mode="wrap").max())
        lines.append(
            f"azimuths {_range_text(first * step, last * step)}: the maps end, and {OFF_MAP} could stand up to "
            f"{highest:.1f} degrees high; no evidence is taken below that"
        )
    return lines


def _range_text(start_rad: float, end_rad: float) -> str:
    if end_rad - start_rad >= 2 * np.pi - 1e-9:
        return "0 to 360 degrees"
    return f"{np.degrees(start_rad) % 360:.0f} to {np.degrees(end_rad) % 360:.0f} degrees"


_crests = kernel(
    "crests", "ground: ground", "camera_height: float64", "sigma: float64", "points: float64[n, 2]",
    "azimuths: float64[n]", "tan: float64[n]", "distance: float64[n]", f"cdf: float64[{len(NORMAL_CDF)}]",
    "mean: out float64[n]", "own: out float64[n]", f"post: out int64[n, {POSTS}]",
    f"response: out float64[n, {POSTS}]",
)  # fmt: skip
