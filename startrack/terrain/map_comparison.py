"""Errors of a height map, measured where a finer map covers the same ground."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.core.errors import length_text
from startrack.core.types import Array, BadInput
from startrack.frames import Site
from startrack.terrain.height_map import COMMON_PER_POST, HeightMap
from startrack.terrain.raster import Raster

FINER = 2.0  # a finer map has at least so many posts to one of the map
MIN_POSTS_ACROSS = 20.0  # of the map, in the overlap
SAMPLES_ACROSS = 400  # posts of the finer map at which heights are compared
SMALLER = 0.8  # from one size of the compared square to the next, where maps have holes or edges
OTHER_GROUND = 0.5  # s.d. of the differences, relative to that of the heights: above it the maps show other ground
CREST_POSITIONS, CREST_AZIMUTHS = 150, 90  # from which, and in which, horizons are compared
CREST_POSTS = 4.0  # least distance of the crests compared; crests farther apart than this on the two maps are two
MIN_CRESTS = 15  # of one position, for its mean
SAME_RAD = 1e-6  # latitudes that differ by more are two: an orthographic map holds places on its far side, too
SEED = 1


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
        """The comparison in one line of text."""
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


def compare_maps(height_map: Raster, finer: Raster) -> MapComparison | None:
    """Differences of a map and a finer one; None where the square that both cover is too small."""
    lines = [np.arange(0, n, max(n // SAMPLES_ACROSS, 1), dtype=np.float64) for n in finer.heights_m.shape]
    at = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)  # rows and columns of posts spread over the map
    lat, lon = finer.projection.latlon_from_xy(*finer.xy(at))
    where = height_map.row_column(lat, lon)
    fine_m, coarse_m = finer.sample(at), height_map.sample(where)
    both = np.isfinite(fine_m) & np.isfinite(coarse_m)
    both &= np.abs(height_map.projection.latlon_from_xy(*height_map.xy(where))[0] - lat) < SAME_RAD
    pair = _terrains_of(height_map, finer, at[both]) if both.any() else None
    if pair is None:
        return None
    off = (coarse_m - fine_m)[both]
    return MapComparison(
        finer=finer.source, finer_post_m=finer.post_m, across_m=2 * pair[0].search_radius_m,
        height_bias_m=float(off.mean()), height_sigma_m=float(off.std()), heights_sigma_m=float(fine_m[both].std()),
        **_crest_errors(*pair, CREST_POSTS * height_map.post_m),
    )  # fmt: skip


def crest_angle_rad_per_m(terrain: HeightMap) -> float:
    """Elevation that a metre of a crest's height makes, cos^2 H / distance: the median over the search area."""
    positions = _positions(terrain.search_radius_m)
    tan, distance, _ = terrain.horizons(positions[:, None], _azimuths())
    return float(np.median(1.0 / ((1.0 + tan**2) * distance)))


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


def _crest_errors(coarse: HeightMap, fine: HeightMap, apart_m: float) -> dict[str, float]:
    """How much higher crests inside the search area stand on the finer map; without the error of the camera's ground.

    tan H d is the height of the crest above the camera: the difference is that of the crests' heights.
    """
    positions, azimuths = _positions(coarse.search_radius_m), _azimuths()
    tan, distance, _ = coarse.horizons(positions[:, None], azimuths)
    fine_tan, fine_distance, _ = fine.horizons(positions[:, None], azimuths)
    rise = (fine.ground_m(positions) - coarse.ground_m(positions))[:, None]
    higher = fine_distance * (fine_tan - tan) + rise
    u = np.stack([np.sin(azimuths), np.cos(azimuths)], axis=-1)
    inside = (fine_distance > apart_m) & (np.abs(distance - fine_distance) < apart_m)
    for d in (distance, fine_distance):
        inside &= np.hypot(*np.moveaxis(positions[:, None] + d[..., None] * u, -1, 0)) < coarse.search_radius_m
    enough = inside.sum(axis=1) >= MIN_CRESTS
    means = np.array([row[which].mean() for row, which in zip(higher[enough], inside[enough], strict=True)])
    about = [row[which] - mean for row, which, mean in zip(higher[enough], inside[enough], means, strict=True)]
    if len(means) < MIN_CRESTS:
        return dict.fromkeys(("crest_bias_m", "crest_bias_sigma_m", "crest_sigma_m"), float("nan"))
    return {
        "crest_bias_m": float(means.mean()), "crest_bias_sigma_m": float(means.std()),
        "crest_sigma_m": float(np.concatenate(about).std()),
    }  # fmt: skip


def _positions(radius_m: float) -> Array:
    """Positions (n, 2) spread evenly over a circle."""
    rng = np.random.default_rng(SEED)
    azimuth, distance = rng.uniform(0, 2 * np.pi, CREST_POSITIONS), radius_m * np.sqrt(rng.random(CREST_POSITIONS))
    return distance[:, None] * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=-1)


def _azimuths() -> Array:
    return np.arange(CREST_AZIMUTHS) * 2 * np.pi / CREST_AZIMUTHS
