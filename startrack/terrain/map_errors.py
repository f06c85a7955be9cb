"""Errors of a height map: of single posts by their places in the skyline, and of its shape by the traced horizon."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from startrack.core.statistics import NORMAL_CDF
from startrack.core.types import MIDDLES_RAD, Array, Ints
from startrack.kernels.library import kernel
from startrack.terrain.ground import cell_posts, number_of_maps, post_positions
from startrack.terrain.horizon_table import AZIMUTH_BINS, HorizonSigma
from startrack.terrain.shape import (
    BIAS,
    CAMERA_ERROR,
    OFFSETS,
    REFRACTION,
    STRETCH,
    ExpectedCrests,
    GroundErrors,
    ShapeError,
    offset_names,
    refraction_errors,
    refraction_slopes_rad,
    select_slopes,
    vertical_fact,
    wave_errors,
    wave_slopes_rad,
)

if TYPE_CHECKING:
    from startrack.terrain.height_map import HeightMap

COMMON_PER_POST = 3.0
POSTS = 64  # that the skyline of one ray follows; in crests.c too
NUDGE_M = 0.05  # nearer crests count as so far away
BETWEEN_POSTS = 2.0 / 3.0  # RMS over a cell of the bilinear mean of independent errors at four posts, in that of one


class MapErrors(GroundErrors):
    """Errors of the height maps of a ground: the stated ones, and usual ones where its file is silent."""

    def __init__(self, whole: HeightMap) -> None:
        self.map, self.height_sigma_m = whole, whole.height_sigma_m

    @cached_property
    def common_sigma_rad(self) -> float:  # type: ignore[override]
        """Standard deviation [rad] of the crests' common error at their median distance, with the camera's ground's.

        If it is not known, three times the horizon's sigma from `height_sigma_m`: crests clipped by the grid of posts
        stand too low by some such amount all around.
        """
        if not self.height_sigma_m and not self.map.horizon_sigma_common_rad:
            return 0.0
        own, known = self.post_rad, self.map.horizon_sigma_common_rad
        return float(np.hypot(own, COMMON_PER_POST * own if known is None else known))

    @cached_property
    def post_rad(self) -> float:
        """Sigma [rad] of the horizon by the error of single posts: the median over search area and azimuth."""
        if not self.height_sigma_m:
            return 0.0
        cells = np.hypot(*self.map.square.centres_m.T) < self.map.search_radius_m
        return float(np.median(self._sigma.blocks_rad[0].reshape(-1, AZIMUTH_BINS)[cells]))

    @cached_property
    def crest_distance_m(self) -> float:  # type: ignore[override]
        """Median distance [m] over azimuth from the origin to the crest that makes the horizon."""
        return float(np.median(self.map.horizons(np.zeros(2), MIDDLES_RAD)[1]))

    @cached_property
    def shape(self) -> tuple[ShapeError, ...]:  # type: ignore[override]
        """Errors of bias, stretch, tilt, waves, map offsets, camera and refraction. The bias needs the table.

        The camera stands as much too high as the ground between four posts is.
        """
        whole, offsets = self.map, replace(OFFSETS, errors=offset_names(len(self.map.maps)))
        return (
            *BIAS.errors_of_shape(self.common_sigma_rad), *STRETCH.errors_of_shape(whole.stretch_sigma_1),
            *vertical_fact(whole.site.body).errors_of_shape(whole.vertical_sigma_rad),
            *wave_errors(whole.waves_sigma_rad, 0.0 if whole.waves_sigma_rad else self.post_rad),
            *offsets.errors_of_shape(whole.map_offset_sigma_m),
            *CAMERA_ERROR.errors_of_shape(whole.camera_height_sigma_m, beside=BETWEEN_POSTS * self.height_sigma_m),
            *REFRACTION.errors_of_shape(whole.terrestrial_refraction_sigma_1), *refraction_errors(whole.air),
        )  # fmt: skip

    def slopes_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Change (k, ...) [rad] of the horizon by one unit of each error, from the traced horizon and its distance.

        The bias and the waves are errors of the crests' heights, see `crest_share`. Of a tilt the change of elevation
        alone: that of azimuth moves the skyline by its slope times tan H times the tilt, which is left out.
        """
        tan, distance, _ = self.map.horizons(points_m, azimuths_rad)
        flat = 1.0 / (1.0 + np.square(tan))  # cos^2 H
        by_crest = self.map.crest_share(tan, distance)
        waves = {name: by_crest * wave for name, wave in wave_slopes_rad(azimuths_rad).items()}
        slopes = {
            "bias_rad": by_crest, "stretch_1": tan * flat, "vertical_east_rad": np.sin(azimuths_rad),
            "vertical_north_rad": np.cos(azimuths_rad), "camera_height_m": -flat / np.maximum(distance, NUDGE_M),
            "terrestrial_refraction_1": distance / (2 * self.map.ground.radius_m) * flat,
            **waves, **self._offset_slopes_rad(points_m, azimuths_rad, tan, distance),
        }  # fmt: skip
        return select_slopes(self.shape, slopes | refraction_slopes_rad(self.map.air, np.arctan(tan)), np.shape(tan))

    def _offset_slopes_rad(self, points_m: Array, azimuths_rad: Array, tan: Array, distance: Array) -> dict[str, Array]:
        """Rise (...) of the horizon by a metre of each further map, below its crests less below the camera."""
        if len(self.map.maps) == 1:
            return {}
        away = distance[..., None] * np.stack([np.sin(azimuths_rad), np.cos(azimuths_rad)], axis=-1)
        camera_up_m = np.asarray(self.map.ground_m(points_m))
        crest_m = np.concatenate([points_m + away, (camera_up_m + tan * distance)[..., None]], axis=-1)
        camera_m = np.concatenate([points_m, camera_up_m[..., None]], axis=-1)
        of_crest, of_camera = (
            number_of_maps(self.map.site, self.map.maps, at.reshape(-1, 3)).reshape(at.shape[:-1])
            for at in (crest_m, camera_m)
        )
        per_m = 1.0 / ((1.0 + np.square(tan)) * distance)
        names = offset_names(len(self.map.maps))
        return {name: per_m * (1.0 * (of_crest == k) - (of_camera == k)) for k, name in enumerate(names, 1)}

    def sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Sigma (...) [rad] by the height of the single post that makes the horizon: sigma cos^2 H / its distance."""
        if self.height_sigma_m == 0:
            return super().sigma_rad(points_m, azimuths_rad)
        return self._sigma.sigma_rad(points_m, azimuths_rad)

    def most_sigma_rad(self, centres_m: Array, half_m: float, azimuths_rad: Array, azimuth_half_rad: float) -> Array:
        """Largest `sigma_rad` (...) over boxes and azimuths."""
        if self.height_sigma_m == 0:
            return super().most_sigma_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)
        return self._sigma.max_sigma_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)

    @cached_property
    def _sigma(self) -> HorizonSigma:
        return HorizonSigma(self.map.table, self.height_sigma_m)

    def expected_crests(self, point_m: Array, azimuths_rad: Array) -> ExpectedCrests | None:
        """Skyline with all errors of posts, by the places along each ray that may stand highest; None without such."""
        if self.height_sigma_m == 0.0:
            return None
        tan, distance, _ = self.map.horizons(point_m, azimuths_rad)
        points, count = np.tile(np.asarray(point_m, dtype=np.float64), (len(tan), 1)), len(tan)
        mean, own, post, response = *np.empty((2, count)), np.empty((count, POSTS), np.int64), np.empty((count, POSTS))
        fixed = self.map.ground.record, self.map.camera_height_m, self.height_sigma_m
        rays = points, np.array(azimuths_rad, dtype=np.float64), tan, distance
        _crests(*fixed, *rays, NORMAL_CDF, mean, own, post, response)
        flat = 1.0 / (1.0 + mean * mean)
        rise = np.arctan(mean) - np.arctan(tan)
        return ExpectedCrests(rise, flat * np.sqrt(own), post, flat[:, None] * response)

    def ground_posts(self, point_m: Array, azimuths_rad: Array) -> tuple[Ints, Array]:
        """Posts (n, 4) about a camera at `point_m` (2,), and the change (n, 4) [rad/m] of the horizon by each."""
        tan, distance, _ = self.map.horizons(point_m, azimuths_rad)
        post, weight = cell_posts(self.map.site, self.map.maps, np.append(point_m, self.map.ground_m(point_m))[None])
        weights = -weight / ((1.0 + tan * tan) * distance)[:, None]
        return np.repeat(post, len(tan), axis=0), weights

    def post_positions_m(self, posts: Ints) -> Array:
        """Positions (n, 3) [m] in enu of the `posts` (n,), by the maps."""
        return post_positions(self.map.site, self.map.maps, posts)

    def warnings(self) -> list[str]:
        """Lines of text: an error of posts that no file states, so that it counts as 0; datums of unknown place."""
        of_maps = [
            f"map {one.source}: {text}"
            for one in self.map.maps
            for text in (one.projection.transformation_warning, *one.notes)
            if text
        ]
        if self.map.height_sigma_is_stated or self.height_sigma_m:
            return of_maps
        silent = (
            f"terrain {self.map.name}: its file states no height_sigma_m: taken as 0; circles are too small unless the "
            "ground is exactly so; state the errors (0 for a model from which pictures are rendered)"
        )
        return [silent, *of_maps]


class PostErrors(MapErrors):
    """Errors of the single posts of a map alone."""

    shape, common_sigma_rad = (), 0.0  # type: ignore[assignment]
    slopes_rad = GroundErrors.slopes_rad


_crests = kernel(
    "crests", "ground: ground", "camera_height: float64", "sigma: float64", "points: float64[n, 2]",
    "azimuths: float64[n]", "tan: float64[n]", "distance: float64[n]", f"cdf: float64[{len(NORMAL_CDF)}]",
    "mean: out float64[n]", "own: out float64[n]", f"post: out int64[n, {POSTS}]",
    f"response: out float64[n, {POSTS}]",
)  # fmt: skip
