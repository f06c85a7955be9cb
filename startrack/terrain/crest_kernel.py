"""Skylines of ground whose posts err, compiled with numba: mean, variance, and how they follow each post.

The tangent of the skyline is the largest of those of many places along a ray. Each is normal about the map's, by the
posts of its cell and those of the camera's. The larger of two normal numbers is taken as normal again (Clark 1961,
Operations Research 9, 145). Its covariance with the error of a post is exact for two places, by Stein's lemma: the mean
of the response to the post. Places at about one distance are compared first, because their errors are alike: the
largest of them is nearly normal. The largest of each octave of distance are then compared from the farthest on.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from math import exp, pi, sqrt

import numpy as np

from startrack.core.kernels import njit, normal_cdf
from startrack.terrain.block_kernel import NUDGE_M, step_over_blocks
from startrack.terrain.horizon_kernel import locate, map_cell, surface_place

LOW_SIGMAS = 2.0  # of the crest's post, by which the skyline is surely no lower than the map's
POSTS = 64  # that one ray follows; the variance by more of them counts as its own
CERTAIN = 4.0  # sigmas by which a place is sure to be hidden, or to hide the others
LEAST_TAN = 1e-9  # standard deviation of the difference of two places, below which they are the same
OCTAVES, FIRST_OCTAVE_M = 16, 16.0  # of distance; the first holds what is nearer
MEAN, OWN, PER_M, USED = 0, 1, 2, 3  # numbers of a tangent: mean, variance that follows no post, mean of 1 / s, posts


@njit(cache=True)
def crests(ground, camera_height, sigma, points, azimuths, tan, distance, mean, own, post, response):
    """Fill the moments of skylines (n,) seen from points (n, 2) at azimuths (n,), whose posts err by `sigma` metres.

    `tan` and `distance` (n,) are those of the map. Filled are `mean` and `own` (n,), the mean tangent and the variance
    that follows no post, and `post` and `response` (n, POSTS), the posts and the mean rise of the tangent by a metre
    of each, as of a camera that stays where it is. A post of -1 is none. Where no place of a map makes the skyline, as
    at the edge where a ray leaves the maps, it is the map's own, wrong by `sigma` at its distance.
    """
    grid, heights, posts, _, _, _, _, _, _, _, radius, _, _ = ground
    seat, weight = np.empty(4, dtype=np.int64), np.empty(4)
    numbers = np.empty((OCTAVES + 2, 4))
    posts_of, responses = np.empty((OCTAVES + 2, POSTS), dtype=np.int64), np.empty((OCTAVES + 2, POSTS))
    for k in range(len(azimuths)):
        numbers[:, USED] = 0.0
        up, at = surface_place(grid, posts, heights, radius, points[k, 0], points[k, 1], 0.0)
        up, at = surface_place(grid, posts, heights, radius, points[k, 0], points[k, 1], up)
        weigh_posts(posts, at, seat, weight)
        ray = points[k, 0], points[k, 1], up + camera_height, np.sin(azimuths[k]), np.cos(azimuths[k])
        low = tan[k] - LOW_SIGMAS * sigma / distance[k]
        fill_octaves(ground, sigma, ray, low, distance[k], seat, weight, numbers, posts_of, responses)
        last = OCTAVES
        for octave in range(OCTAVES - 1, -1, -1):
            take_larger(numbers, posts_of, responses, last, octave, sigma)
        post[k], response[k] = -1, 0.0
        mean[k], own[k] = numbers[last, MEAN], numbers[last, OWN]
        if numbers[last, USED] == 0.0:
            mean[k], own[k] = tan[k], (sigma / max(distance[k], NUDGE_M)) ** 2
        for j in range(int(numbers[last, USED])):
            post[k, j], response[k, j] = posts_of[last, j], responses[last, j]
            for i in range(4):
                if post[k, j] == seat[i]:
                    response[k, j] += weight[i] * numbers[last, PER_M]


@njit(cache=True, inner=True)
def fill_octaves(ground, sigma, ray, low, distance, seat, weight, numbers, posts_of, responses):
    """Fill the moments of the largest tangents of octaves of distance; see `crests`.

    The map's crest comes first, then places on the edges and in the middles of cells from the camera on. Those whose
    ground stands far below the sight line of the tangent `low` are passed by.
    """
    grid, _, posts, tops, _, _, blocks, levels, _, _, radius, highest, sag = ground
    east, north, up, sin_a, cos_a = ray
    s, level, known, raised, running = 0.0, 0, -1.0, CERTAIN * sigma, True
    add_place(ground, sigma, ray, distance, low, seat, weight, numbers, posts_of, responses)
    while running:
        e, n = east + s * sin_a, north + s * cos_a
        z = radius + up + low * s - sag * s * s
        m, column, row = locate(grid, posts, e, n, z)
        r = np.sqrt(e * e + n * n + z * z)
        climb = (e * sin_a + n * cos_a + z * (low - 2 * sag * s)) / r
        if m < 0 or (climb >= 0.0 and r - radius >= highest + raised):
            running = False
        else:
            column2, row2 = map_cell(grid, m, e + sin_a, n + cos_a, z + low)
            level = min(level, levels[m] - 1)
            is_over, level, length = step_over_blocks(
                tops, blocks, m, level, column, row, column2 - column, row2 - row, r - radius, climb, raised
            )
            if is_over:
                s += length
            else:
                for part in range(known == s, 3):
                    there = s + 0.5 * part * length
                    add_place(ground, sigma, ray, there, low, seat, weight, numbers, posts_of, responses)
                s += length
                known = s


@njit(cache=True, inner=True)
def weigh_posts(posts, at, number, weight):
    """Fill the numbers and bilinear weights (4,) of the posts about a place (map, column, row)."""
    m, column, row = at
    i, j = int(row), int(column)
    down, right = row - i, column - j
    for corner in range(4):
        a, b = corner >> 1, corner & 1
        number[corner] = posts[m, 0] + (i + a) * posts[m, 2] + j + b
        weight[corner] = (down if a else 1.0 - down) * (right if b else 1.0 - right)


@njit(cache=True, inner=True)
def add_place(ground, sigma, ray, s, low, seat, weight, numbers, posts_of, responses):
    """Take the place at a distance s into the largest of its octave, unless it is surely below the tangent `low`."""
    grid, heights, posts, _, _, _, _, _, _, _, radius, _, sag = ground
    east, north, up, sin_a, cos_a = ray
    z, at = surface_place(grid, posts, heights, radius, east + s * sin_a, north + s * cos_a, up + low * s)
    tan, here = (z - up) / max(s, NUDGE_M) + sag * s, OCTAVES + 1
    if at[0] >= 0 and s > NUDGE_M and tan + CERTAIN * sigma * sqrt(2.0) / s > low:
        number, share = posts_of[here], responses[here]
        weigh_posts(posts, at, number, share)
        for i in range(4):
            share[i] /= s
        used = 4
        for i in range(4):
            j = 0
            while j < used and number[j] != seat[i]:
                j += 1
            if j == used:
                number[j], share[j] = seat[i], 0.0
                used += 1
            share[j] -= weight[i] / s
        numbers[here, MEAN], numbers[here, OWN], numbers[here, PER_M], numbers[here, USED] = tan, 0.0, 1.0 / s, used
        octave, end = 0, FIRST_OCTAVE_M
        while s > end and octave < OCTAVES - 1:
            octave += 1
            end *= 2.0
        take_larger(numbers, posts_of, responses, octave, here, sigma)


@njit(cache=True)
def take_larger(numbers, posts_of, responses, into, other, sigma):
    """Replace the moments of the tangent `into` by those of the larger of it and the `other`; each of 0 posts is none.

    numbers (n, 4): see MEAN. posts_of, responses (n, POSTS): posts, and the rise of the tangent with each.
    """
    square, common, whole = 0.0, 0.0, 0.0
    used, count = int(numbers[into, USED]), int(numbers[other, USED])
    post, response = posts_of[into], responses[into]
    if used == 0:
        numbers[into] = 0.0
    for i in range(count):
        square += responses[other, i] ** 2
        for j in range(used):
            if posts_of[other, i] == post[j]:
                common += responses[other, i] * response[j]
    for j in range(used):
        whole += response[j] * response[j]
    mean, tan = numbers[into, MEAN], numbers[other, MEAN]
    variance = numbers[into, OWN] + sigma * sigma * whole
    variance_there = numbers[other, OWN] + sigma * sigma * square
    apart = sqrt(max(variance + variance_there - 2.0 * sigma * sigma * common, LEAST_TAN * LEAST_TAN))
    above = (mean - tan) / apart if used > 0 else -np.inf
    if count > 0 and above < CERTAIN:
        kept, second, largest = 0.0, variance_there, tan
        if above > -CERTAIN:
            kept = normal_cdf(above)
            density = exp(-0.5 * above * above) / sqrt(2.0 * pi)
            largest = mean * kept + tan * (1.0 - kept) + apart * density
            second = (mean * mean + variance) * kept + (tan * tan + variance_there) * (1.0 - kept)
            second += (mean + tan) * apart * density - largest * largest
        for j in range(used):
            response[j] *= kept
        for i in range(count):
            j = 0
            while j < used and post[j] != posts_of[other, i]:
                j += 1
            if j == used and used < POSTS:
                post[j], response[j] = posts_of[other, i], 0.0
                used += 1
            if j < used:
                response[j] += (1.0 - kept) * responses[other, i]
        whole = 0.0
        for j in range(used):
            whole += response[j] * response[j]
        numbers[into, MEAN], numbers[into, OWN] = largest, max(second - sigma * sigma * whole, 0.0)
        numbers[into, PER_M] = kept * numbers[into, PER_M] + (1.0 - kept) * numbers[other, PER_M]
        numbers[into, USED] = used
