"""Bounds of the horizon over boxes, compiled with numba, by the rays of `horizon_kernel`.

A ray from anywhere in a box passes near the middle line: the steepest slopes to the side bound the ground there. Over a
block of cells as large as the band is wide the slopes are the same, and the line is straight on the map.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import njit
from startrack.terrain.block_kernel import FAR_M, NUDGE_M, block_at, exit_of
from startrack.terrain.ground_kernel import level_of, slope_range, steepness
from startrack.terrain.horizon_kernel import (
    LOWEST_TAN,
    STRAIGHT_M,
    best_in_step,
    height_on_line,
    horizon,
    locate,
    map_cell,
    surface,
    surface_place,
)

FINE_POSTS = 1.2  # posts: of narrower bands slopes are taken cell by cell
KINK_M = 0.02  # by which a traced ray may miss a kink of the ground: NUDGE_M times the change of slope
STEP_PARTS = 4  # of a step, whose slopes are taken one by one


@njit(cache=True, inline="always")
def _most_tan(above, s, reach, cos_turn):
    """Largest tan of a height above the lowest camera, at s from the middle of the box."""
    if above > 0.0:
        tan = above / (s - reach) if s > reach else FAR_M
    else:
        tan = above * cos_turn / (s + reach) if s > -reach else -FAR_M
    return tan


@njit(cache=True, inline="always")
def _least_tan(above, s, reach, cos_turn):
    under = above / (s - reach) if s > reach else LOWEST_TAN
    return above * cos_turn / (s + reach) if above > 0.0 else under


@njit(cache=True, inner=True)
def _step_bounds(s0, s1, s2, z0, z1, z2, slack, low_up, high_up, reach, cos_turn):
    """Most tan of the ground of a step, least tan of it, and the distance and height of the latter.

    The middle line's heights z0, z1, z2 stand at s0, s1 (half way) and s2; the ground beside differs by up to `slack`.
    """
    over = slack + max(2 * z1 - z0 - z2, 0.0) / 8
    if min(z0, z1, z2) + slack > low_up and s0 > reach:
        rest = slack - low_up
        top, _ = best_in_step(-FAR_M, 0.0, s0 - reach, s2 - reach, z0 + rest, z1 + rest, z2 + rest)
    else:
        top = max(
            _most_tan(z0 + over - low_up, s0, reach, cos_turn),
            _most_tan(z1 + over - low_up, s1, reach, cos_turn),
            _most_tan(z2 + over - low_up, s2, reach, cos_turn),
        )
    bottom, bottom_s, bottom_z = LOWEST_TAN, 0.0, 0.0
    rest = slack + high_up
    if min(z0, z1, z2) > rest and s0 > 0.0:
        tan, at = best_in_step(-FAR_M, 0.0, s0 + reach, s2 + reach, z0 - rest, z1 - rest, z2 - rest)
        bottom, bottom_s, bottom_z = tan * cos_turn, at - reach, tan * at + high_up
    else:
        for k in range(3):
            s_k = s0 if k == 0 else s1 if k == 1 else s2
            z_k = (z0 if k == 0 else z1 if k == 1 else z2) - slack
            if s_k > 0.0 and _least_tan(z_k - high_up, s_k, reach, cos_turn) > bottom:
                bottom, bottom_s, bottom_z = _least_tan(z_k - high_up, s_k, reach, cos_turn), s_k, z_k
    return top, bottom, bottom_s, bottom_z


@njit(cache=True)
def bounds(
    ground, east, north, height, up, low_up, high_up, slope_e, slope_n, half, sin_a, cos_a, turn, start_m, end_m,
    hint_m, tilt_to_crest, found,
):  # fmt: skip
    """Bounds of the horizon over a box, written to `found`.

    The box reaches `half` to each side of (east, north), the camera stands `height` above the ground, between low_up
    and high_up there (at `up` in the middle), and azimuths reach `turn` to each side. Ground nearer than start_m or
    beyond end_m is left out.
    A ray from the box passes the middle line's point s within w = r + (s + r) tan(turn) to the side, at a distance
    between s - r and (s + r) / cos(turn) of its own, r the half width of the box seen along the ray. There the ground
    is within w times the steepest slope to the side of what it is on the middle line. What air makes of the distance
    s counts as height of the ground; of the ray's own distance it differs by `bent` at most. Close to the box the
    horizon is no higher than the steepest slope along the ray, less what the height of the camera makes of it.

    Slopes to the side come from the pyramid. With `tilt_to_crest`, where a step may make the horizon and w is below
    about a post, they are taken again from the cells that the band touches, in STEP_PARTS parts of the step.

    All heights (low_up and high_up too) may be relative to a plane through the middle of the box that rises by slope_e
    to the east and slope_n to the north: a tan then is less by the plane's own rise along the ray. With `tilt_to_crest`
    the plane is replaced by the one through the box and the middle's horizon, tilted to the side as the ground is
    there. The linear change of the horizon over the box is then that of the camera's height above this plane, whose
    bounds over a box are exact: h (|dz/de| + |dz/dn|).

    found: 0, 1: bounds of tan; 2, 3: range of s of the ground that may make the horizon; 4: s of the middle's horizon;
    5: its tan t; 6: a such that this ground is no higher than a + t s on the middle line, and 9: g such that it is no
    higher than that plus g w at w aside; 7, 8: an s and a height that the ground reaches everywhere there, and 10: the
    slope to the side that this assumes. 5 to 10 hold only if the slopes are zero and not `tilt_to_crest`.
    """
    grid, heights, posts, tops, wide_tops, slopes, blocks, levels, slope_unit, post_m, radius, highest, sag = ground
    reach = half * (abs(sin_a) + abs(cos_a))
    tan_turn, cos_turn = np.tan(turn), np.cos(turn)
    aside = abs(east * cos_a - north * sin_a)
    middle_tan, best_at, _ = horizon(ground, east, north, up, sin_a, cos_a, max(start_m, 0.0), end_m, hint_m)
    if tilt_to_crest and half > 0.0 and middle_tan > LOWEST_TAN:
        width = reach + (best_at + reach) * tan_turn
        e, n = east + best_at * sin_a, north + best_at * cos_a
        z0 = surface(grid, posts, heights, radius, e - width * cos_a, n + width * sin_a, up + middle_tan * best_at)
        z2 = surface(grid, posts, heights, radius, e + width * cos_a, n - width * sin_a, z0)
        side_rise = (z2 - z0) / (2 * width)
        to_e, to_n = middle_tan * sin_a + side_rise * cos_a, middle_tan * cos_a - side_rise * sin_a
        spread = half * (abs(slope_e - to_e) + abs(slope_n - to_n))
        low_up, high_up, slope_e, slope_n = low_up - spread, high_up + spread, to_e, to_n
    along_rise, side_rise = slope_e * sin_a + slope_n * cos_a, slope_e * cos_a - slope_n * sin_a  # of the plane
    tilted = abs(side_rise)
    whole, sink = start_m <= 0.0, max(sag, 0.0)
    low, high = LOWEST_TAN, LOWEST_TAN
    first, last = FAR_M, -FAR_M
    line_from = -FAR_M
    low_s, low_z, low_rise = 0.0, low_up - FAR_M, 0.0
    most_rise = 0.0
    steepest = -FAR_M  # along the ray, from the box's near side on
    begin = -reach if whole else start_m
    s = best_at if best_at > reach else 12.0 * reach + 1.0
    level, known_s, known_z, known = 0, -FAR_M, up, (-1, 0.0, 0.0)
    d_column, d_row, to_column, to_row, right, left, ahead = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    straight_map, straight_to, straight_low, at_before = -1, -FAR_M, low, -1
    probing, running = True, True  # one step at the middle's own horizon gives a lower bound that lets much be skipped
    while running:
        e, n = east + s * sin_a, north + s * cos_a
        width = reach + (abs(s) + reach) * tan_turn
        if probing:
            known_z = surface(grid, posts, heights, radius, e, n, known_z)
            line = radius + known_z
        else:
            line = radius + low_up + low * (max(s - reach, 0.0) if low >= 0.0 else (abs(s) + reach) / cos_turn)
            own_most = (s + reach) / cos_turn  # most distance of this ground from a camera in the box
            line += along_rise * s - tilted * width - sink * own_most * own_most
        m, column, row = locate(grid, posts, e, n, line)
        r = np.sqrt(e * e + n * n + line * line)
        fall = 2 * sink * (s + reach) / (cos_turn * cos_turn)
        climb = (e * sin_a + n * cos_a + line * (low + along_rise - tilted * tan_turn - fall)) / r
        floor = r - radius - (aside + width) / radius * width
        if m < 0 or (not probing and (s >= end_m or (climb >= 0.0 and floor >= highest and s > reach))):
            running = probing
            if probing:
                probing, s, known_z = False, begin, up
        else:
            if s > straight_to or m != straight_map or low != straight_low:
                step, rise = post_m[m], max(low + along_rise, -1.0)
                column2, row2 = map_cell(grid, m, e + step * sin_a, n + step * cos_a, line + rise * step)
                d_column, d_row = (column2 - column) / step, (row2 - row) / step
                column2, row2 = map_cell(grid, m, e + step * cos_a, n - step * sin_a, line)
                to_column, to_row = (column2 - column) / step, (row2 - row) / step
                straight_map, straight_low, at_before = m, low, -1
                straight_to = s + STRAIGHT_M
            least_level = level_of(levels, m, post_m, radius, width * (1 + 3 * tan_turn), e, n)
            near = whole and s < 6.0 * reach and not probing
            level = least_level if near or probing else min(max(level, least_level), levels[m] - 1)
            descending, skipped = not (near or probing), False
            while descending:
                length = exit_of(column, row, d_column, d_row, level)
                if floor + min(climb * length, 0.0) >= wide_tops[block_at(blocks, m, level, column, row)]:
                    s += length
                    level += 1
                    descending, skipped = False, True
                elif level <= least_level:
                    descending = False
                else:
                    level -= 1
            if not skipped:
                at, bend = block_at(blocks, m, least_level, column, row), np.sqrt(e * e + n * n) / radius
                if at != at_before:
                    right = steepness(slopes, at, slope_unit[m], to_column, to_row)
                    left = steepness(slopes, at, slope_unit[m], -to_column, -to_row)
                    ahead = steepness(slopes, at, slope_unit[m], d_column, d_row)
                    at_before = at
                if known_s != s:
                    known_z, known = surface_place(grid, posts, heights, radius, e, n, known_z)
                whole_level = 0 if probing else least_level
                span = exit_of(column, row, d_column, d_row, whole_level)
                end_z, end = surface_place(grid, posts, heights, radius, e + span * sin_a, n + span * cos_a, known_z)
                if whole_level > 0 and (end[0] != known[0] or end[0] < 0):
                    whole_level, span = 0, exit_of(column, row, d_column, d_row, 0)
                    end_z, end = surface_place(
                        grid, posts, heights, radius, e + span * sin_a, n + span * cos_a, known_z
                    )
                run_column, run_row = (end[1] - known[1]) / span, (end[2] - known[2]) / span
                floor += tilted * width
                to_side, steep = max(right - side_rise, left + side_rise, 0.0), max(abs(right), abs(left))
                rise_aside = to_side + steep * (0.005 + 2 * bend) + (aside + width + span * tan_turn) / radius
                if near:
                    along = abs(ahead) * (0.01 + 2 * bend) + bend + width / radius + steep * tan_turn
                    steepest = max(steepest, ahead - along_rise + along)
                begun, z_begun, is_known = 0.0, known_z, True
                while begun < span:  # from grid line to grid line
                    column, row = known[1] + begun * run_column, known[2] + begun * run_row
                    done = begun + exit_of(column, row, run_column, run_row, 0)
                    if whole_level == 0 or done + 2 * NUDGE_M > span:
                        done = span
                    length = done - begun
                    width += length * tan_turn
                    own_most = (s + done + reach) / cos_turn
                    bent = abs(sag) * max(own_most * own_most - (s + done) * (s + done), reach * reach)
                    slack = rise_aside * width + bent
                    low_here = floor + climb * begun + min(climb * length, 0.0)
                    is_open = near or probing or low_here < tops[block_at(blocks, m, 0, column, row)] + slack
                    if is_open:
                        if not is_known:
                            z_begun = height_on_line(
                                heights, posts, radius, known, run_column, run_row, e, n, sin_a, cos_a, begun
                            )
                        middle, z1, z2 = begun + 0.5 * length, 0.0, end_z
                        if end[0] == known[0] and end[0] >= 0:
                            z1 = height_on_line(
                                heights, posts, radius, known, run_column, run_row, e, n, sin_a, cos_a, middle
                            )
                            if done < span:
                                z2 = height_on_line(
                                    heights, posts, radius, known, run_column, run_row, e, n, sin_a, cos_a, done
                                )
                        else:
                            z1 = surface(grid, posts, heights, radius, e + middle * sin_a, n + middle * cos_a, z_begun)
                        next_z = z2
                        s0, s1, s2 = s + begun, s + middle, s + done
                        z0 = z_begun - along_rise * s0 + sag * s0 * s0
                        z1, z2 = z1 - along_rise * s1 + sag * s1 * s1, z2 - along_rise * s2 + sag * s2 * s2
                        top, bottom, bottom_s, bottom_z = _step_bounds(
                            s0, s1, s2, z0, z1, z2, slack, low_up, high_up, reach, cos_turn
                        )
                        parts, part_slack = 1, KINK_M * min(width, 1.0) + bent
                        if tilt_to_crest and top >= low and width < FINE_POSTS * post_m[m]:
                            parts = STEP_PARTS
                        bend_k = (z0 - 2 * z1 + z2) * 2 / (length * length)
                        rise_k = (z2 - z0) / length - bend_k * length
                        for k in range(parts):
                            t0, t1, t2 = s0, s1, s2
                            y0, y1, y2 = z0, z1, z2
                            part_rise = rise_aside
                            if parts > 1:
                                a0, a2 = length * k / parts, length * (k + 1) / parts
                                a1 = 0.5 * (a0 + a2)
                                least, most = slope_range(
                                    heights, posts, m, column, row, d_column, d_row, a0, a2, to_column, to_row, width
                                )
                                if least <= most:
                                    part_rise = max(most - side_rise, side_rise - least, 0.0)
                                    part_rise += (
                                        max(abs(least), abs(most)) * (0.005 + 2 * bend) + (aside + width) / radius
                                    )
                                    part_rise = min(part_rise, rise_aside)
                                t0, t1, t2 = s0 + a0, s0 + a1, s0 + a2
                                y0 = z0 + a0 * (rise_k + a0 * bend_k)
                                y1 = z0 + a1 * (rise_k + a1 * bend_k)
                                y2 = z0 + a2 * (rise_k + a2 * bend_k)
                                top, bottom, bottom_s, bottom_z = _step_bounds(
                                    t0, t1, t2, y0, y1, y2, part_rise * width + part_slack, low_up, high_up, reach,
                                    cos_turn,
                                )  # fmt: skip
                            if bottom > low:
                                low, low_s, low_z, low_rise = bottom, bottom_s, bottom_z, part_rise
                            if near:
                                top = min(
                                    top, steepest + sink * (t2 + reach) / cos_turn - height * cos_turn / (t2 + reach)
                                )
                            if not probing and top >= low and t2 > -reach:
                                first, last = min(first, t0), max(last, t2)
                                high = max(high, top)
                                most_rise = max(most_rise, part_rise)
                                over = max(2 * y1 - y0 - y2, 0.0) / 8 + bent
                                line_from = max(line_from, over + y0 - middle_tan * t0, over + y1 - middle_tan * t1)
                                line_from = max(line_from, over + y2 - middle_tan * t2)
                        z_begun = next_z
                    is_known, begun = is_open, done
                if probing:
                    probing, s, known_z = False, begin, up
                else:
                    known_s, known_z, known, s = s + span, end_z, end, s + span
    # What the plane itself rises along a ray that is turned by up to `turn`.
    turned = abs(along_rise) * (1.0 - cos_turn) + tilted * np.sqrt(1.0 - cos_turn * cos_turn)
    found[0], found[1], found[2], found[3], found[4] = low, max(high, low), first, last, best_at
    found[0] += along_rise - turned
    found[1] += along_rise + turned
    found[5], found[6], found[7], found[8] = middle_tan, line_from, low_s, low_z
    found[9], found[10] = most_rise, low_rise
