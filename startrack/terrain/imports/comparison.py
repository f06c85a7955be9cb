"""Errors of a height map, measured where a finer map covers the same ground."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from startrack.core.errors import length_text
from startrack.core.types import Array, BadInput
from startrack.frames import Site
from startrack.terrain.height_map import HeightMap
from startrack.terrain.imports.crest_errors import (
    CREST_POSTS,
    MIN_CRESTS,
    Correlation,
    CrestErrors,
    correlate,
    measure_crest_errors,
    spread_positions,
)
from startrack.terrain.map_errors import COMMON_PER_POST
from startrack.terrain.maps.raster import Raster

FINER = 2.0  # a finer map has at least so many posts to one of the map
MIN_POSTS_ACROSS = 20.0  # of the map, in the overlap
LEAST_POSTS = 9  # that two maps share, to compare their levels
SAMPLES_ACROSS = 400  # posts of the finer map at which heights are compared
SMALLER = 0.8  # from one size of the compared square to the next, where maps have holes or edges
OTHER_GROUND = 0.5  # s.d. of the differences, relative to that of the heights: above it the maps show other ground
SAME_RAD = 1e-6  # latitudes that differ by more are two: an orthographic map holds places on its far side, too


@dataclass(frozen=True, kw_only=True)
class MapComparison:
    """Differences of a map and a finer one over the ground that both cover."""

    finer: str  # file of the finer map
    finer_post_m: float
    across_m: float  # side of the square compared
    height_bias_m: float  # mean of map minus finer map
    height_sigma_m: float  # standard deviation, of all ground and not only of the posts
    heights_sigma_m: float  # of the ground itself
    crest_bias_m: float  # by which crests stand higher in the finer map; NaN where too few are in the overlap
    crest_bias_sigma_m: float  # of the positions' means
    crest_sigma_m: float  # of the crests about the mean of their position
    correlation: Correlation | None = None  # of the crests' errors; None where too few are in the overlap

    @property
    def same_ground(self) -> bool:
        """Whether both maps show the same ground at the same place."""
        return self.height_sigma_m < OTHER_GROUND * self.heights_sigma_m

    @cached_property
    def common_crest_sigma_m(self) -> float:
        """Standard deviation of an error of height [m] that the crests about a position share.

        At least `COMMON_PER_POST` times the error of posts: the ridges of an overlap are clipped less than the sharp
        rim of a crater (Site01 by 5 m, Shackleton by 16 m, at posts 240 m apart).
        """
        measured = np.nan_to_num(np.hypot(self.crest_bias_m, self.crest_bias_sigma_m))
        return float(max(measured, COMMON_PER_POST * self.height_sigma_m))

    def line(self) -> str:
        """Text of the comparison in one line."""
        crests = (
            "too few crests in the overlap"
            if np.isnan(self.crest_bias_m)
            else f"crests {self.crest_bias_m:.1f} m too low (s.d. {self.crest_bias_sigma_m:.1f} m between positions, "
            f"{self.crest_sigma_m:.1f} m between the crests of one)"
        )
        return (
            f"compared with {self.finer} (posts {length_text(self.finer_post_m, 3)} apart) over "
            f"{self.across_m / 1000:.1f} km: heights {self.height_bias_m:+.1f} m, "
            f"s.d. {self.height_sigma_m:.1f} m; {crests}"
        )


def compare_with_finest(height_map: Raster, others: Iterable[Raster]) -> MapComparison | None:
    """The comparison with the finest of the other maps that is finer and overlaps; None where there is none."""
    body = height_map.projection.body
    finer = [one for one in others if one.projection.body == body and FINER * one.post_m <= height_map.post_m]
    for one in sorted(finer, key=lambda raster: raster.post_m):
        found = compare_maps(height_map, one)
        if found is not None:
            return found
    return None


def heights_of_both(height_map: Raster, finer: Raster) -> tuple[Array, Array, Array]:
    """Heights (n,) of a map and (n,) of a finer one at posts of the latter that both know, and these posts.

    Row and column (n, 2) of posts that are spread over the finer map.
    """
    lines = [np.arange(0, n, max(n // SAMPLES_ACROSS, 1), dtype=np.float64) for n in finer.heights_m.shape]
    at = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    lat, lon = finer.projection.latlon_from_xy(*finer.xy(at))
    where = height_map.row_column(lat, lon)
    fine_m, coarse_m = finer.sample(at), height_map.sample(where)
    both = np.isfinite(fine_m) & np.isfinite(coarse_m)
    both &= np.abs(height_map.projection.latlon_from_xy(*height_map.xy(where))[0] - lat) < SAME_RAD
    return coarse_m[both], fine_m[both], at[both]


def offsets_of_maps_m(maps: Sequence[Raster]) -> list[float]:
    """Height [m] by which each further one of the `maps`, finest first, stands above the first that it overlaps.

    The median over the ground that both cover; 0 where none is.
    """
    found = []
    for k, one in enumerate(maps[1:], 1):
        pairs = (heights_of_both(one, finer) for finer in maps[:k])
        off = next((coarse_m - fine_m for coarse_m, fine_m, _ in pairs if len(fine_m) >= LEAST_POSTS), np.zeros(1))
        found.append(float(np.median(off)))
    return found


def compare_maps(height_map: Raster, finer: Raster) -> MapComparison | None:
    """Differences of a map and a finer one; None where the square that both cover is too small."""
    coarse_m, fine_m, at = heights_of_both(height_map, finer)
    pair = _terrains_of(height_map, finer, at) if len(at) else None
    if pair is None:
        return None
    off = coarse_m - fine_m
    radius_m = pair[0].search_radius_m
    errors = measure_crest_errors(*pair, spread_positions(radius_m), CREST_POSTS * height_map.post_m, radius_m)
    return MapComparison(
        finer=finer.source, finer_post_m=finer.post_m, across_m=2 * radius_m,
        height_bias_m=float(off.mean()), height_sigma_m=float(off.std()), heights_sigma_m=float(fine_m.std()),
        **_crest_errors(errors, height_map.post_m),
    )  # fmt: skip


def _terrains_of(height_map: Raster, finer: Raster, overlap: Array) -> tuple[HeightMap, HeightMap] | None:
    """Both maps as terrains about the middle of the overlap (n, 2), with the largest search area that both cover."""
    low, high = overlap.min(axis=0), overlap.max(axis=0)
    lat, lon = finer.projection.latlon_from_xy(*finer.xy((low + high) / 2))
    site = Site(finer.projection.body, float(lat), float(lon))
    radius_m = 0.5 * float((high - low).min()) * finer.post_m
    while 2 * radius_m >= MIN_POSTS_ACROSS * height_map.post_m:
        try:
            coarse, fine = (HeightMap(site=site, maps=(one,), search_radius_m=radius_m) for one in (height_map, finer))
        except BadInput:  # the maps do not cover it
            radius_m *= SMALLER
        else:
            return coarse, fine
    return None


def _crest_errors(errors: CrestErrors, post_m: float) -> dict[str, Any]:
    """Fields of a comparison about the crests: their bias, its spread, the rest, and how it correlates."""
    means_m = errors.means_m[np.isfinite(errors.means_m)]
    if len(means_m) < MIN_CRESTS:
        return dict.fromkeys(("crest_bias_m", "crest_bias_sigma_m", "crest_sigma_m"), float("nan"))
    about_m = (errors.higher_m - errors.means_m[:, None])[errors.inside]
    return {
        "crest_bias_m": float(means_m.mean()), "crest_bias_sigma_m": float(means_m.std()),
        "crest_sigma_m": float(np.nanstd(about_m)), "correlation": correlate(errors, post_m),
    }  # fmt: skip
