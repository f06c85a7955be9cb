"""The picture of a track: what it draws, where, and of what it makes a legend."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_track import odometry_alone, synthetic_track

from startrack.applications.tracking.picture import (
    ODOMETRY,
    SEEN_PX,
    TRACK_SIZE_PX,
    UNUSED,
    draw_last_position,
    draw_track,
    draw_track_map,
    half_axes_95_m,
    track_extent,
)
from startrack.output import TEXT_PX, Canvas, Ink
from startrack.output.picture.canvas import text_box
from startrack.terrain import load_terrain

BOX = (0.0, 0.0, 600.0, 600.0)


def pixels_like(pixels, colour) -> int:
    return int(np.count_nonzero(np.abs(pixels.astype(int) - colour).sum(axis=-1) < 12))


def drawn(track):
    """The map's pixels, its view and its legend."""
    canvas = Canvas(601, 601)
    view, legend = draw_track_map(canvas, BOX, track)
    return canvas.pixels, view, legend


def test_the_map_shows_every_part_of_a_track_and_its_legend_names_them():
    track = synthetic_track()
    track = replace(track, odometry_m=odometry_alone(track))
    pixels, view, legend = drawn(track)
    for colour in (Ink.POSITION, Ink.BLUE, ODOMETRY, UNUSED):
        assert pixels_like(pixels, colour) > 20
    words = " | ".join(text for _, _, text in legend)
    for word in ("smoothed", "filtered", "odometry alone", "refused frame", "frame left out", "slip", "true size"):
        assert word in words
    everything = np.concatenate([track.smoothed.position_enu_m[:, :2], track.odometry_m])
    places = view.canvas_px(everything)
    assert (places > 10).all() and (places < 590).all()
    plain, _, legend = drawn(replace(synthetic_track(), slipped=np.zeros(7, dtype=bool)))
    assert pixels_like(plain, ODOMETRY) == 0
    assert not any(word in text for _, _, text in legend for word in ("slip", "odometry"))


@pytest.mark.parametrize(("step_m", "is_enlarged"), [(500.0, True), (2.0, False)])
def test_ellipses_have_their_true_size_and_a_small_last_one_is_enlarged_beside_the_map(step_m, is_enlarged):
    track = synthetic_track(step_m=step_m)
    axis_m = half_axes_95_m(track.smoothed.covariance_m2)[-1]
    canvas, box = Canvas(961, 601), (640.0, 300.0, 940.0, 600.0)
    view, _ = draw_track_map(canvas, BOX, track)
    draw_last_position(view, box, track)
    assert any("enlarged" in text for _, text, *_ in canvas._texts) == is_enlarged
    middle, metres_per_px = view.canvas_px(track.smoothed.position_enu_m[-1, :2]), view.metres_per_px
    if is_enlarged:
        assert axis_m < SEEN_PX * view.metres_per_px
        middle, metres_per_px = np.array([790.0, 450.0]), 2.0 * axis_m / 150.0
    along = np.linalg.eigh(track.smoothed.covariance_m2[-1])[1][:, 1] * [1.0, -1.0]
    for end in (middle + along * axis_m / metres_per_px, middle - along * axis_m / metres_per_px):
        x, y = np.rint(end).astype(int)
        assert pixels_like(canvas.pixels[y - 3 : y + 4, x - 3 : x + 4], Ink.POSITION) >= 2


def test_heights_of_contours_stand_clear_of_the_track_and_of_the_caption():
    track = synthetic_track(load_terrain("shackleton"), start_m=(-6000.0, 0.0), step_m=200.0, frames=40)
    canvas = Canvas(601, 601)
    view, _ = draw_track_map(canvas, BOX, track)
    heights = [text_box(at, text, anchor, size) for at, text, anchor, size, *_ in canvas._texts if text[-1].isdigit()]
    assert len(heights) > 3
    places = view.canvas_px(track.smoothed.position_enu_m[:, :2])
    for left, top, right, bottom in heights:
        assert top > 2 * TEXT_PX
        assert not ((places > [left, top]) & (places < [right, bottom])).all(axis=1).any()


def test_half_axes_hold_95_percent():
    np.testing.assert_allclose(half_axes_95_m(np.diag([4.0, 1.0])[None]), 2.0 * np.sqrt(5.991464547), rtol=1e-6)
    assert np.isinf(half_axes_95_m(np.full((1, 2, 2), np.inf)))[0]


def test_a_map_at_rest_holds_all_ellipses():
    track = synthetic_track(at_rest=True)
    pixels, view, legend = drawn(track)
    assert ("ring", Ink.BLUE, "95 % ellipses, at their true size") in legend
    assert pixels_like(pixels, Ink.BLUE) > 100 < pixels_like(pixels, Ink.POSITION)
    away_m = np.abs(track.filtered.position_enu_m[:, :2] - view.centre_m).max(axis=1)
    reach_m = half_axes_95_m(track.filtered.covariance_m2) + away_m
    assert reach_m.max() < view.half_m.min()


@pytest.mark.parametrize("at_rest", [False, True])
def test_frames_without_a_position_are_not_drawn(at_rest):
    part, none = (synthetic_track(at_rest=at_rest, unknown=count) for count in (3, 8))
    assert draw_track(part).shape == draw_track(none).shape == (*TRACK_SIZE_PX[::-1], 3)
    assert track_extent(none) == ((0.0, 0.0), none.terrain.search_radius_m)
    assert pixels_like(drawn(part)[0], Ink.BLUE) > pixels_like(drawn(none)[0], Ink.BLUE) == 0


def test_one_frame_is_a_track():
    assert draw_track(synthetic_track(frames=1, at_rest=True)).any()


def test_the_relief_of_the_map_is_that_of_its_own_place():
    ground = load_terrain("shackleton")
    west, east = (synthetic_track(ground, start_m=(x, 0.0), step_m=200.0) for x in (-6000.0, 6000.0))
    assert any("contours" in text for _, text, *_ in _texts_of(east))
    free = np.s_[500:590, 20:200]  # no track there
    assert np.abs(drawn(west)[0][free].astype(int) - drawn(east)[0][free]).mean() > 10


def _texts_of(track):
    canvas = Canvas(601, 601)
    draw_track_map(canvas, BOX, track)
    return canvas._texts
