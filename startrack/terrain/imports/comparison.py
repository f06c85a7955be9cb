"""Errors of a height map where a finer map covers the same ground: of heights, of crests, and waves of the horizon."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from startrack.core.errors import length_text
from startrack.core.types import Array, BadInput, Bools
from startrack.frames import Site
from startrack.terrain.ground import ground_up_m
from startrack.terrain.height_map import HeightMap
from startrack.terrain.imports.roughness import carried_spacing
from startrack.terrain.map_errors import COMMON_PER_POST
from startrack.terrain.maps.raster import Raster
from startrack.terrain.shape import WAVE_COUNT, sigmas_of_waves

FINER = 2.0  # a finer map has at least so many posts to one of the map
MIN_POSTS_ACROSS = 20.0  # of the map, in the overlap
LEAST_POSTS = 9  # that two maps share, to compare their levels
SAMPLES_ACROSS = 400  # posts of the finer map at which heights are compared
SMALLER = 0.8  # from one size of the compared square to the next, where maps have holes or edges
OTHER_GROUND = 0.5  # s.d. of the differences, relative to that of the heights: above it the maps show other ground
SAME_RAD = 1e-6  # latitudes that differ by more are two: an orthographic map holds places on its far side, too
RIM_RADII = 1.5  # of the search area: most of the rim is nearer
CREST_POSITIONS, CREST_AZIMUTHS = 150, 90  # from which, and in which, horizons are compared
CREST_POSTS = 4.0  # least distance of the crests compared; crests farther apart than this on the two maps are two
MIN_CRESTS = 15  # of one position, for its mean; and positions, for a mean of them
LEAST_WAVE = 0.15  # wave 1, of what height_sigma_m makes: the least of the shipped maps, 0.14 (Haworth) to 0.42
STANDING_TRIES = 1000  # positions of which the flat ones are taken
STANDING_SLOPE_RAD = np.radians(20.0)  # rovers are built for slopes of 15 to 25 degrees
OWN_POSTS = 2.0  # distance of crests up to which the errors of single posts correlate: a cell of one meets the next's
MIN_PAIRS = 100  # of crests at about one distance, for a covariance
MEASURED_LAGS = 0.5  # of the longest: longer ones are those of a few crests on opposite sides
CORRELATION_LENGTHS = 40  # tried for the correlation, from two posts to the longest distance
HEIGHT_SAMPLES = 151  # points across the rim at which the heights of two maps are compared
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


@dataclass(frozen=True, kw_only=True)
class CrestErrors:
    """Errors of the crests that are seen from p positions at a azimuths."""

    higher_m: Array  # (p, a) by which the crest stands higher on the finer map
    crests_m: Array  # (p, a, 2) east, north of the crest on the finer map
    inside: Bools  # (p, a) whether the crest counts

    @property
    def means_m(self) -> Array:
        """Mean error (p,) [m] of the crests about each position; NaN where few crests count."""
        count = self.inside.sum(axis=1)
        total_m = np.where(self.inside, self.higher_m, 0.0).sum(axis=1)
        return np.where(count >= MIN_CRESTS, total_m / np.maximum(count, 1), np.nan)


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """Errors of height with the covariance sigma_m^2 exp(-distance / length_m) between two crests."""

    sigma_m: float
    length_m: float

    def waves_m(self, crests_m: Array) -> Array:
        """Standard deviations [m] of the cosine's and the sine's coefficient of waves 1 to WAVE_COUNT, (WAVE_COUNT,).

        Waves of the errors of crests (p, a, 2) at `a` equal steps of azimuth; the median over the p positions.
        """
        count = crests_m.shape[1]
        azimuths = 2 * np.pi * np.arange(count) / count
        turns = np.cos(np.arange(1, WAVE_COUNT + 1)[:, None, None] * (azimuths[:, None] - azimuths))
        apart_m = (np.hypot(*np.moveaxis(one[:, None] - one, -1, 0)) for one in crests_m)
        variances = [np.tensordot(turns, np.exp(-d / self.length_m), 2) * 2 / count**2 for d in apart_m]
        return np.asarray(self.sigma_m * np.sqrt(np.median(variances, axis=0)))

    def waves_rad(self, terrain: HeightMap) -> Array:
        """Standard deviations [rad] of the horizon's waves, (WAVE_COUNT,), at its median crest."""
        positions = standing_positions(terrain)
        distance = terrain.horizons(positions[:, None], _azimuths())[1]
        return terrain.crest_rad_per_m * self.waves_m(_places(positions, distance))


def map_of_rim(maps: Sequence[Raster], radius_m: float) -> Raster:
    """The finest map that may hold the rim of a search area, or the last."""
    wide = (one for one in maps if 0.5 * min(one.heights_m.shape) * one.post_m >= RIM_RADII * radius_m)
    return next(wide, maps[-1])


def measure_waves(terrain: HeightMap, measured: Correlation | None) -> tuple[Array, str]:
    """Sigmas [rad] of the waves of a terrain's horizon, and their source: "" and none where too few crests are seen.

    By the map that makes the horizon and its coarser self; at least what was `measured` against a finer map, whose
    ridges are clipped less than the sharp rim of a crater, and LEAST_WAVE.
    """
    own = correlate_with_coarser(map_of_rim(terrain.maps, terrain.search_radius_m), terrain, terrain.height_sigma_m)
    found = {"itself made coarser, scaled to height_sigma_m": own, "the finer map": measured}
    shown = {source: one for source, one in found.items() if one is not None}
    if not shown:
        return np.zeros(0), ""
    least_rad = np.array(sigmas_of_waves(LEAST_WAVE * terrain.height_sigma_m * terrain.crest_rad_per_m))
    waves_rad = {source: one.waves_rad(terrain) for source, one in shown.items()}
    source = max(shown, key=lambda source: waves_rad[source][0])
    comment = (
        f"errors of crests beyond those of single posts, {length_text(shown[source].sigma_m)} (s.d.) over "
        f"{length_text(shown[source].length_m)} by the map and {source}; wave 1 at least {LEAST_WAVE:g} of what "
        "height_sigma_m makes of the horizon"
    )
    return np.max([least_rad, *waves_rad.values()], axis=0), comment


def measure_crest_errors(
    coarse: HeightMap, fine: HeightMap, positions: Array, apart_m: float, within_m: float = np.inf
) -> CrestErrors:
    """Errors of the crests seen from `positions` (p, 2); without the error of the camera's ground.

    Those count that stand within `within_m` of the origin, beyond `apart_m` of the camera, and no more than that
    farther or nearer on one map than on the other. tan H d is the height of the crest above the camera: the difference
    is that of the crests' heights.
    """
    tan, distance, _ = coarse.horizons(positions[:, None], _azimuths())
    fine_tan, fine_distance, _ = fine.horizons(positions[:, None], _azimuths())
    rise = (fine.ground_m(positions) - coarse.ground_m(positions))[:, None]
    inside = (fine_distance > apart_m) & (np.abs(distance - fine_distance) < apart_m)
    for one in (distance, fine_distance):
        inside &= np.hypot(*np.moveaxis(_places(positions, one), -1, 0)) < within_m
    return CrestErrors(
        higher_m=fine_distance * (fine_tan - tan) + rise, crests_m=_places(positions, fine_distance), inside=inside
    )


def correlate(errors: CrestErrors, post_m: float) -> Correlation | None:
    """Correlation of errors of crests on a map with posts `post_m` apart; None where too few crests are seen.

    Fitted to the covariance of crests that are seen from one position, about their mean, which `horizon_sigma_deg`
    states.
    """
    off_m = errors.higher_m - errors.means_m[:, None]
    inside = errors.inside & np.isfinite(off_m)
    products, lags = [], []
    for step in range(1, inside.shape[1] // 2 + 1):
        both = inside & np.roll(inside, step, axis=1)
        apart_m = np.hypot(*np.moveaxis(errors.crests_m - np.roll(errors.crests_m, step, axis=1), -1, 0))
        products.append((off_m * np.roll(off_m, step, axis=1))[both])
        lags.append((apart_m[both] / post_m).astype(np.int64))
    lag = np.concatenate(lags)
    pairs = np.bincount(lag)
    measured = np.flatnonzero(pairs >= MIN_PAIRS)
    used = measured[(measured >= OWN_POSTS) & (measured <= MEASURED_LAGS * measured.max(initial=0))]
    if len(used) < 2:
        return None
    covariance_m2, weight = np.bincount(lag, np.concatenate(products))[used] / pairs[used], pairs[used]
    lengths = np.geomspace(OWN_POSTS, measured.max(), CORRELATION_LENGTHS)
    falls = np.exp(-(used + 0.5) / lengths[:, None])
    variances_m2 = np.maximum(falls @ (weight * covariance_m2) / (falls**2 @ weight), 0.0)
    best = np.argmin((covariance_m2 - variances_m2[:, None] * falls) ** 2 @ weight)
    return Correlation(sigma_m=float(np.sqrt(variances_m2[best])), length_m=float(lengths[best] * post_m))


def correlate_with_coarser(one: Raster, terrain: HeightMap, height_sigma_m: float) -> Correlation | None:
    """The correlation of the errors of a map's crests, where no finer one shows them; None where its own do not.

    Between the map and itself, averaged to posts twice as far apart as those that it carries, errors of crests are
    like those between the ground and the map, but for their size, which is that of `height_sigma_m` to the errors of
    heights in and about the search area of the `terrain`.
    """
    coarser = average_posts(one, 2 * int(np.ceil(carried_spacing(one.heights_m.astype(np.float64)))))
    try:
        fine, coarse = (
            HeightMap(site=terrain.site, maps=(each,), search_radius_m=terrain.search_radius_m)
            for each in (one, coarser)
        )
    except BadInput:  # the coarser one does not cover the search area
        return None
    line = np.linspace(-RIM_RADII, RIM_RADII, HEIGHT_SAMPLES) * terrain.search_radius_m
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    error_m = float(np.nanstd(np.subtract(*(ground_up_m(terrain.site, (each,), points) for each in (one, coarser)))))
    errors = measure_crest_errors(coarse, fine, standing_positions(fine), CREST_POSTS * coarser.post_m)
    found = correlate(errors, coarser.post_m) if error_m > 0.0 else None
    return None if found is None else replace(found, sigma_m=found.sigma_m * height_sigma_m / error_m)


def average_posts(one: Raster, step: int) -> Raster:
    """A map whose posts are the means of `step` by `step` posts of another."""
    rows, columns = (n // step for n in one.heights_m.shape)
    blocks = one.heights_m[: rows * step, : columns * step].reshape(rows, step, columns, step)
    middle = (step - 1) / 2
    return replace(
        one, heights_m=blocks.mean(axis=(1, 3), dtype=np.float64).astype(np.float32), dx_m=one.dx_m * step,
        dy_m=one.dy_m * step, x0_m=one.x0_m + middle * one.dx_m, y0_m=one.y0_m + middle * one.dy_m,
    )  # fmt: skip


def standing_positions(terrain: HeightMap) -> Array:
    """Positions (n, 2) of the search area where a rover stands; all of them where hardly one is flat enough."""
    positions = spread_positions(terrain.search_radius_m, STANDING_TRIES)
    flat = terrain.slope_rad(positions) < STANDING_SLOPE_RAD
    return (positions[flat] if np.count_nonzero(flat) >= MIN_CRESTS else positions)[:CREST_POSITIONS]


def spread_positions(radius_m: float, count: int = CREST_POSITIONS) -> Array:
    """Positions (count, 2) [m] spread evenly over a circle about the origin."""
    rng = np.random.default_rng(SEED)
    azimuth, distance = rng.uniform(0, 2 * np.pi, count), radius_m * np.sqrt(rng.random(count))
    return distance[:, None] * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=-1)


def _places(positions: Array, distance_m: Array) -> Array:
    """Places (p, a, 2) at distances (p, a) in the azimuths of the comparison."""
    azimuths = _azimuths()
    return np.asarray(positions[:, None] + distance_m[..., None] * np.stack([np.sin(azimuths), np.cos(azimuths)], -1))


def _azimuths() -> Array:
    """Azimuths (CREST_AZIMUTHS,) [rad] in which horizons are compared."""
    return np.arange(CREST_AZIMUTHS) * 2 * np.pi / CREST_AZIMUTHS
