"""Corners and peaks of a skyline matched with those of the map: three give a pose, the whole skyline verifies it.

Built from the description in Kua 2008, section 2.2 (its reference [12], Naval et al.), not from the paper: features of
the image and of the map are matched, and the heading comes with the position. Published mean error: 373 m. A skyline
without features, as that of a round crater, gives nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, permutations

import numpy as np

from startrack.applications.reproduction.published.skylines import (
    LIT_SIGMA_RAD,
    close_gaps,
    crest_posts_m,
    grid_points,
    require_bearings,
)
from startrack.core.types import MIDDLES_RAD, Array, Ints, MeasuredSkyline, NotLocated
from startrack.terrain import Terrain

CORRESPONDENCES = 3  # for a pose: two coordinates and the heading, with an angle and elevations to check them
FEATURE_REACH, FEATURE_MEAN = 8, 5  # sectors to either side that a feature stands out of, and of a mean
SHARP_RAD = 4.0 * LIT_SIGMA_RAD * float(np.sqrt(1.5 / FEATURE_MEAN))  # least height of a feature, four sigma of it
VIEWS_STEP_M = 1500.0  # between positions from which the features of the map are collected
FEATURE_CELL_M = 300.0  # of the map, in which the same corner or peak is seen from several positions
MAP_FEATURES, SEEN_FEATURES = 50, 6  # those that most positions see, and the sharpest of the skyline
NARROWEST_RAD = float(np.radians(20.0))  # angle between two of three bearings
AGREEING_RAD = float(np.radians(1.0))  # of the three headings, and of the elevations with those of the map
MATCHED_RAD = float(np.radians(2.0))  # of the bearing of a further feature
VERIFIED_POSES = 500  # poses with the most matches whose skylines are compared
VERIFIED_RAD = float(np.radians(0.5))  # root mean square of the skyline from the map's, beyond which no pose is right


@dataclass(frozen=True, eq=False)
class MapFeatures:
    """Corners and peaks of a map: their points, those that most positions see first."""

    points_m: Array  # (n, 2)
    up_m: Array  # (n,)

    @classmethod
    def collect(cls, terrain: Terrain) -> MapFeatures:
        """Corners and peaks of the skylines of positions all over the search area of a `terrain`.

        Ground without posts has none.
        """
        found = [np.zeros((0, 3))]
        for view in grid_points(terrain, VIEWS_STEP_M):
            crest_m = crest_posts_m(terrain, view)[find_features(terrain.horizon_rad(view[None], MIDDLES_RAD))]
            found.append(crest_m[np.isfinite(crest_m[:, 0])])
        points = np.concatenate(found)
        _, cell, count = np.unique(
            np.floor(points[:, :2] / FEATURE_CELL_M), axis=0, return_inverse=True, return_counts=True
        )
        best = np.argsort(-count, kind="stable")[:MAP_FEATURES]
        middles = np.array([points[cell.ravel() == k].mean(axis=0) for k in best]).reshape(-1, 3)
        return cls(middles[:, :2], middles[:, 2])


map_features = lru_cache(maxsize=1)(MapFeatures.collect)  # once a process: a second


def find_features(elevation_rad: Array) -> Ints:
    """Sectors (n,) where a whole skyline (SECTORS,) stands highest over the line between its sides, sharpest first."""
    smooth = np.mean([np.roll(elevation_rad, k - FEATURE_MEAN // 2) for k in range(FEATURE_MEAN)], axis=0)
    over = smooth - 0.5 * (np.roll(smooth, FEATURE_REACH) + np.roll(smooth, -FEATURE_REACH))
    around = np.max([np.roll(over, k) for k in range(-FEATURE_REACH, FEATURE_REACH + 1)], axis=0)
    at = np.flatnonzero((over >= around) & (over > SHARP_RAD))
    return np.asarray(at[np.argsort(-over[at], kind="stable")])


def locate_by_features(skyline: MeasuredSkyline, terrain: Terrain, features: MapFeatures) -> Array:
    """The position (2,) [m] whose corners and peaks, at a heading that nobody gives, are those of the `skyline`.

    Raises NotLocated where the skyline or the `features` of the map are too few, where no three of each agree, and
    where no pose shows the whole skyline.
    """
    require_bearings(skyline)
    whole, known = close_gaps(skyline), np.flatnonzero(skyline.known)
    seen = find_features(whole)
    seen = seen[skyline.known[seen]]
    if min(len(seen), len(features.points_m)) < CORRESPONDENCES:
        raise NotLocated(f"{len(seen)} corners and peaks of the skyline, {len(features.points_m)} of the map: a pose "
                         f"takes {CORRESPONDENCES}")  # fmt: skip
    bearing, elevation = MIDDLES_RAD[seen], whole[seen]
    pose = np.concatenate([
        _poses(bearing[list(three)], elevation[list(three)], terrain, features)
        for three in combinations(range(min(len(seen), SEEN_FEATURES)), CORRESPONDENCES)
    ])  # fmt: skip
    if not len(pose):
        raise NotLocated("no three corners and peaks of the map are at the bearings of three that are seen")
    matches = _count_matches(pose, bearing, elevation, terrain, features)
    best = pose[np.argsort(-matches, kind="stable")[:VERIFIED_POSES]]
    azimuths = MIDDLES_RAD[known] + best[:, 2:]
    misfit = terrain.horizon_rad(best[:, None, :2], azimuths) - skyline.elevation_rad[known]
    square = np.square(misfit).mean(axis=1)
    if square.min() > VERIFIED_RAD**2:
        raise NotLocated(f"none of {len(best)} poses shows the skyline")
    return np.asarray(best[np.argmin(square), :2])


def _poses(bearing_rad: Array, elevation_rad: Array, terrain: Terrain, features: MapFeatures) -> Array:
    """Poses (n, 3), east and north [m] and heading [rad], from which three features of the map are those seen."""
    order = np.argsort(bearing_rad)
    bearing, elevation = bearing_rad[order], elevation_rad[order]
    between = np.diff(bearing, append=bearing[0] + 2 * np.pi)
    if between.min() < NARROWEST_RAD:
        return np.zeros((0, 3))
    three = _threes_of(len(features.points_m))
    if between.max() < np.pi:  # about a position between them they turn clockwise, as their bearings
        three = three[_turn(features.points_m[three]) < 0.0]
    position = resect(features.points_m[three], bearing)
    near = np.hypot(*position.T) <= terrain.search_radius_m  # NaN is not
    three, position = three[near], position[near]
    azimuth, found = _directions(position, features.points_m[three], features.up_m[three], terrain)
    heading = azimuth - bearing
    same = np.abs(_wrap(heading - heading[:, :1])).max(axis=1) < AGREEING_RAD
    fits = same & (np.abs(found - elevation).max(axis=1) < AGREEING_RAD)
    return np.column_stack([position[fits], heading[fits, 0]])


def resect(points_m: Array, bearing_rad: Array) -> Array:
    """Positions (n, 2) [m] from which three points (n, 3, 2) have the angles of `bearing_rad` (3,) between them.

    NaN on the circle through the points. Source: Pierlot and Van Droogenbroeck 2014, IEEE Trans. Robotics 30, 1117.
    """
    north, east = np.moveaxis(points_m - points_m[:, 1:2], -1, 0)[::-1]  # bearings turn from north to east
    x1, y1, x3, y3 = north[:, 0], east[:, 0], north[:, 2], east[:, 2]
    cot12, cot23 = 1.0 / np.tan(np.diff(bearing_rad))
    cot31 = (1.0 - cot12 * cot23) / (cot12 + cot23)
    x12, y12 = x1 + cot12 * y1, y1 - cot12 * x1
    x23, y23 = x3 - cot23 * y3, y3 + cot23 * x3
    x31, y31 = x3 + x1 + cot31 * (y3 - y1), y3 + y1 - cot31 * (x3 - x1)
    k31 = x1 * x3 + y1 * y3 + cot31 * (x1 * y3 - x3 * y1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = k31 / ((x12 - x23) * (y23 - y31) - (y12 - y23) * (x23 - x31))
    return np.asarray(points_m[:, 1] + np.column_stack([scale * (x23 - x12), scale * (y12 - y23)]))


def _count_matches(
    pose: Array, bearing_rad: Array, elevation_rad: Array, terrain: Terrain, features: MapFeatures
) -> Ints:
    """Number (n,) of the features seen (m,) that each pose (n, 3) explains by one of the map."""
    azimuth, elevation = _directions(pose[:, :2], features.points_m[None], features.up_m, terrain)
    bearing = azimuth - pose[:, 2:]
    found = [
        (np.hypot(_wrap(bearing - one), elevation - height) < MATCHED_RAD).any(axis=1)
        for one, height in zip(bearing_rad, elevation_rad, strict=True)
    ]
    return np.asarray(np.sum(found, axis=0))


def _directions(position_m: Array, points_m: Array, up_m: Array, terrain: Terrain) -> tuple[Array, Array]:
    """Azimuths and elevations (n, k) of points (n, k, 2), at heights (n, k), from the positions (n, 2) of a camera."""
    east, north = np.moveaxis(points_m - position_m[:, None], -1, 0)
    above = up_m - (terrain.ground_m(position_m) + terrain.camera_height_m)[:, None]
    return np.arctan2(east, north), np.arctan2(above, np.hypot(east, north))


@lru_cache(maxsize=1)
def _threes_of(count: int) -> Ints:
    return np.array(list(permutations(range(count), CORRESPONDENCES)))


def _turn(corners_m: Array) -> Array:
    """Twice the area (n,) [m2] of triangles (n, 3, 2), negative where they turn clockwise."""
    (a, b), (c, d) = np.moveaxis(np.diff(corners_m, axis=1), 0, -1)
    return np.asarray(a * d - b * c)


def _wrap(angle_rad: Array) -> Array:
    return np.asarray((angle_rad + np.pi) % (2 * np.pi) - np.pi)
