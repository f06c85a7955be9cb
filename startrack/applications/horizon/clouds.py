"""Probability that a measured edge is a cloud's, in front of a lower skyline.

A cloud's edge is as sharp and as long as a skyline, and every column of azimuth shows it alike: columns are no
independent witnesses of which edge is the skyline. A picture's sky above the skyline shows how many such edges it has.
Those in front of a lower skyline are a Poisson process of the same density, which the stars behind the edge thin out.
Below a cloud's edge is sky, hardly darker than above; ground is darker.
"""

from __future__ import annotations

import numpy as np

from startrack.applications.horizon.columns import AZIMUTH_COLUMNS, COLUMNS_PER_AZIMUTH, SKYLINE_AZIMUTHS
from startrack.applications.horizon.posterior import NEAR_EDGE_RAD, limited_rows, sky_likelihood_ratio
from startrack.applications.horizon.skylight import StarLight, Steps
from startrack.core.types import Array

# Of the edges counted: dark ones below a brighter sky, in the widest averages of single pixels, where stars are none.
# Of 14 pictures of one camera five with clouds have 3 to 13 times the density of seven clear ones. From 3 sigma a clear
# picture knows 26 azimuths fewer; from a contrast of 0.15 clear pictures differ by 6.4 in units of sigma (RMS), not by
# 2.8. That was with 4 sigma of the pixels' noise, which are 2.5 of the measured scatter (1.6 times that noise in the
# median).
CLOUD_CONTRAST, CLOUD_SIGNIFICANCE = 0.1, 2.5
# The sky that is counted, above the skyline (beside whose edge are trees) and up to an elevation.
CLEAR_OF_GROUND_RAD, HIGHEST_CLOUD_RAD = np.radians(3.0), np.radians(20.0)
# A layer of clouds is foreshortened towards the horizon, by 1 / sin^2 of the elevation; below this one no further.
FLAT_RAD = np.radians(8.0)
LEAST_EDGES = 4.0  # columns with an edge that a picture without any is taken to have
BEYOND_TWO_SIGMA = 0.0455  # probability of an error of more than two sigma
BESIDE_RAD = np.radians(1.5)  # of azimuth: stars this near to a bin are behind its edge


def layer_depth(elevation_rad: Array) -> Array:
    """The integral (n,) of a layer's foreshortening from the horizon to elevations (n,) [rad]; below it negative."""
    elevation = np.asarray(elevation_rad)
    above = 1.0 / np.tan(FLAT_RAD) - 1.0 / np.tan(np.maximum(elevation, FLAT_RAD))
    return np.asarray(np.minimum(elevation, FLAT_RAD) / np.sin(FLAT_RAD) ** 2 + above)


def cloud_density(steps: Steps, skyline_rad: Array) -> float:
    """Edges per column and unit of `layer_depth` in the sky of a picture, by its `steps` above a skyline.

    `skyline_rad`: elevations (AZIMUTH_COLUMNS,).
    """
    lowest = np.minimum(skyline_rad + CLEAR_OF_GROUND_RAD, HIGHEST_CLOUD_RAD)
    above = (steps.elevation_rad > lowest[steps.column]) & (steps.elevation_rad < HIGHEST_CLOUD_RAD)
    clear = (steps.contrast < -CLOUD_CONTRAST) & (steps.significance > CLOUD_SIGNIFICANCE)
    count = np.count_nonzero(above & clear)
    seen = float(np.sum(layer_depth(HIGHEST_CLOUD_RAD) - layer_depth(lowest)))
    least = AZIMUTH_COLUMNS * float(layer_depth(HIGHEST_CLOUD_RAD) - layer_depth(HIGHEST_CLOUD_RAD / 2)) / 2
    return (count + LEAST_EDGES) / max(seen, least)  # where little sky is seen, little is known of its clouds


def edge_likelihood_ratio(steps: Steps, skyline_rad: Array) -> Array:
    """Likelihood ratio (SKYLINE_AZIMUTHS,) of a cloud's edge to the ground's, by the light below the edge in each bin.

    `skyline_rad`: elevations (AZIMUTH_COLUMNS,) of the edge; 1 where none of the `steps` of the picture is near it.
    """
    steps = steps.take(np.abs(steps.elevation_rad - skyline_rad[steps.column]) < NEAR_EDGE_RAD)
    of_bin = steps.column // COLUMNS_PER_AZIMUTH
    number, total = (np.bincount(of_bin, part, SKYLINE_AZIMUTHS) for part in (None, steps.log_ratio))
    return np.where(number > 0, sky_likelihood_ratio(total / np.maximum(number, 1)), 1.0)


def cloud_probability(
    steps: Steps, stars: StarLight, skyline_rad: Array, elevation_rad: Array, lowest_rad: float
) -> Array:  # fmt: skip
    """Probability (SKYLINE_AZIMUTHS,) that an edge at `elevation_rad` is a cloud's, before a skyline at `lowest_rad`.

    Stars missing behind the edge say that it is ground's, unless one cloud hides them all, and so does darkness.

    Args:
        steps: steps of the picture, in the widest averages of single pixels (CLOUD_STEPS).
        stars: stars of the picture.
        skyline_rad: elevations (AZIMUTH_COLUMNS,) of the edge.
        elevation_rad: (SKYLINE_AZIMUTHS,) of the edge in each bin; infinite or nan ones have no meaning.
        lowest_rad: the lowest elevation that the skyline may have.
    """
    depth = np.maximum(layer_depth(elevation_rad) - layer_depth(np.array(lowest_rad)), 0.0)
    # What hides stars high in the sky is clouds of half the layer's depth.
    density = cloud_density(steps, skyline_rad) + stars.missing / float(0.5 * layer_depth(HIGHEST_CLOUD_RAD))
    expected = density * depth * edge_likelihood_ratio(steps, skyline_rad)
    rays, llr = limited_rows(stars.rays, stars.missing)
    place = rays.azimuth_rad * (SKYLINE_AZIMUTHS / (2.0 * np.pi))
    beside = BESIDE_RAD * (SKYLINE_AZIMUTHS / (2.0 * np.pi))  # bins
    bins = np.rint(place)[:, None] + np.arange(-np.ceil(beside), np.ceil(beside) + 1.0)  # (stars, bins beside)
    near, number = np.abs(bins - place[:, None]) < beside, bins.astype(np.int64) % SKYLINE_AZIMUTHS
    near &= (rays.elevation_rad > lowest_rad)[:, None] & (rays.elevation_rad[:, None] < elevation_rad[number])
    behind = np.bincount(number[near], np.broadcast_to(llr[:, None], near.shape)[near], SKYLINE_AZIMUTHS)
    odds = expected * np.maximum(np.exp(np.minimum(behind, 0.0)), stars.missing)
    return np.asarray(odds / (1.0 + odds))


def cloud_sigma_rad(probability: Array, height_rad: Array) -> Array:
    """Sigma (n,) of an edge that is a cloud's with a `probability` (n,), its two sigma held with 95.45 %.

    The skyline behind a cloud's edge is anywhere down to `height_rad` (n,) below it.
    """
    return np.asarray(0.5 * height_rad * (1.0 - BEYOND_TWO_SIGMA / np.maximum(probability, BEYOND_TWO_SIGMA)))
