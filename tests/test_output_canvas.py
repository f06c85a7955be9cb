"""Elements of pictures: positions to a fraction of a pixel, labels without overlap, maps with north up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from startrack.core.types import Fix, Mode
from startrack.frames import Site
from startrack.output import relief_picture
from startrack.output.picture.backdrop import View
from startrack.output.picture.canvas import Canvas, Ink, mix_colours, nice_step, printable, text_width, wrap_text
from startrack.output.picture.maps import Map, distance_text, draw_overview, draw_zoom
from startrack.terrain import Terrain

WHITE = (255, 255, 255)
SITE = Site("moon", -1.5, 0.0)


def centroid(pixels):
    light = pixels.astype(float).sum(axis=-1)
    y, x = np.indices(light.shape)
    return np.array([(light * x).sum(), (light * y).sum()]) / light.sum()


@pytest.mark.parametrize("place", [(50.0, 40.0), (50.25, 40.5), (49.8125, 40.3125)])
@pytest.mark.parametrize("draw", ["disc", "ring", "curve", "cross", "plus"])
def test_shapes_stand_at_fractions_of_a_pixel(place, draw):
    canvas = Canvas(100, 80, (0, 0, 0))
    if draw == "disc":
        canvas.circle(place, 12.0, WHITE, -1)
    elif draw == "ring":
        canvas.circle(place, 12.0, WHITE, 2)
    elif draw == "curve":
        canvas.curve(np.array(place) + np.array([[-20.0, 0.0], [0.0, 0.0], [20.0, 0.0]]), WHITE, 4.0)
    else:
        canvas.mark(place, draw, 10.0, WHITE, 1)
    # OpenCV rounds the edges of areas to one side: a quarter of a pixel.
    np.testing.assert_allclose(centroid(canvas.pixels), place, atol=0.27 if draw in ("ring", "curve") else 0.1)


def test_a_window_clips_and_keeps_positions():
    canvas = Canvas(100, 80, (0, 0, 0))
    window = canvas.window((20, 10, 59, 49))
    window.circle((40.0, 30.0), 5.0, WHITE, -1)
    np.testing.assert_allclose(centroid(canvas.pixels), (40.0, 30.0), atol=0.05)
    window.rectangle((0, 0, 99, 79), WHITE)
    lit = np.argwhere(canvas.pixels.any(axis=-1))
    assert lit.min(axis=0).tolist() == [10, 20]
    assert lit.max(axis=0).tolist() == [49, 59]


def test_labels_keep_apart_and_inside():
    canvas, rng = Canvas(400, 300), np.random.default_rng(3)
    inside = (0.0, 0.0, 399.0, 299.0)
    put = [canvas.label(rng.uniform((0, 0), (400, 300)), "Canopus", WHITE, 10.0, inside) for _ in range(200)]
    boxes = canvas._occupied
    assert 10 < sum(put) == len(boxes) < 150
    x0, y0, x1, y1 = np.transpose(boxes)[:, :, None]
    overlap = (x0 < x1.T) & (x1 > x0.T) & (y0 < y1.T) & (y1 > y0.T)
    assert np.count_nonzero(overlap) == len(boxes)  # each with itself
    assert np.min(boxes) >= 0
    assert (np.max(boxes, axis=0)[2:] <= [399, 299]).all()


def test_a_text_lies_in_its_box():
    canvas = Canvas(300, 100, (0, 0, 0))
    left, top, right, bottom = canvas.text((150, 50), "Sagittarius", WHITE, "mm", 30.0)
    lit = np.argwhere(canvas.rendered_pixels().max(axis=-1) > 60)
    (y0, x0), (y1, x1) = lit.min(axis=0), lit.max(axis=0)
    assert left - 1 <= x0 < left + 4
    assert right - 5 < x1 <= right + 1
    assert top - 1 <= y0
    assert y1 <= bottom + 1
    assert (y0 + y1) / 2 == pytest.approx(50, abs=5)


def test_letters_that_the_font_lacks():
    assert printable("Nächte −5 ± 2° …") == "Nachte -5 ± 2° ..."
    assert printable("星.png\n") == "?.png "


def test_wrapping():
    lines = wrap_text("is the camera file right, and is it the night sky that it shows?", 20.0, 200.0)
    assert " ".join(lines) == "is the camera file right, and is it the night sky that it shows?"
    assert len(lines) > 2
    assert max(text_width(line, 20.0) for line in lines) <= 200.0
    assert wrap_text("", 20.0, 100.0) == []


def test_the_view_keeps_pixel_centres():
    """Half a pixel beyond the corners of the exposure is half a canvas pixel beyond those of the picture."""
    view = View(0.5, (10.0, 20.0), (50, 40))
    np.testing.assert_allclose(view.canvas_px([[-0.5, -0.5], [99.5, 79.5]]), [[9.5, 19.5], [59.5, 59.5]])


def test_north_is_up_and_east_is_right():
    view = Map.of_extent(Canvas(600, 600), (100, 200, 500, 400), (1000.0, -500.0), 50.0)
    np.testing.assert_allclose(view.canvas_px((1000.0, -500.0)), (300.0, 300.0))
    np.testing.assert_allclose(view.canvas_px((1050.0, -450.0)), (400.0, 200.0))


@pytest.mark.parametrize(("length", "step"), [(9.99, 5.0), (10.0, 10.0), (0.3, 0.2), (7300.0, 5000.0), (0.0199, 0.01)])
def test_steps_are_nice(length, step):
    assert nice_step(length) == pytest.approx(step)


def test_distances_in_words():
    assert [distance_text(m) for m in (5000.0, 200.0, 0.5, 0.02)] == ["5 km", "200 m", "0.5 m", "2 cm"]


def fix_at(east, north, covariance):
    return Fix(
        position_enu_m=np.array([east, north, 1.5]),
        covariance_m2=np.array(covariance),
        radius95_m=10.0,
        radius999_m=20.0,
        modes=(Mode(east_m=east, north_m=north, weight=1.0),),
        ambiguous=False,
    )


@pytest.mark.parametrize(
    ("covariance", "along"),
    [
        ([[16.0, 0.0], [0.0, 1.0]], (1.0, 0.0)),
        ([[10.6, 7.2], [7.2, 6.4]], (0.8, 0.6)),
        ([[10.6, -7.2], [-7.2, 6.4]], (0.8, -0.6)),
    ],
)
def test_the_ellipse_is_one_sigma_wide_and_turned_as_the_covariance(covariance, along):
    """Sigmas of 4 m along the direction (east, north) and of 1 m across it."""
    canvas, filled = Canvas(601, 601), np.array(mix_colours(Ink.PAPER, Ink.POSITION, 0.35))
    view = draw_zoom(canvas, (0, 0, 600, 600), fix_at(30.0, 70.0, covariance), None)
    y, x = np.nonzero(np.abs(canvas.pixels.astype(int) - filled).sum(axis=-1) < 12)
    east_north = np.stack([x - 300.0, 300.0 - y], axis=-1) * view.metres_per_px
    east_north = east_north[np.linalg.norm(east_north, axis=1) < 8.0]  # the 95 % circle is further out
    assert np.abs(east_north @ np.array(along)).max() == pytest.approx(4.0, abs=0.15)
    across = east_north @ np.array([-along[1], along[0]])
    assert np.abs(across).max() == pytest.approx(1.0, abs=0.15)


@dataclass(frozen=True)
class Ramp(Terrain):
    """Ground that rises to the east: its slopes face west, towards the light of the map."""

    rise: float
    name: str = "ramp"
    site: Site = SITE
    search_radius_m: float = 1000.0
    camera_height_m: float = 1.5

    @property
    def reach_m(self) -> float:
        return 1500.0

    def horizon_rad(self, points_m: Any, azimuths_rad: Any) -> Any:
        raise NotImplementedError("maps draw the ground")

    def horizon_bounds_rad(self, *args: Any) -> Any:
        raise NotImplementedError("maps draw the ground")

    def ground_m(self, points_m: Any) -> Any:
        return self.rise * points_m[..., 0]

    def allowed(self, points_m: Any) -> Any:
        return points_m[..., 1] > -500.0


def disc(points_m: Any) -> Any:
    return np.hypot(points_m[..., 0], points_m[..., 1]) < 900.0


def test_the_edge_of_the_ground_is_smooth():
    terrain = Ramp(0.3)
    object.__setattr__(terrain, "allowed", disc)
    canvas = Canvas(601, 601)
    view = Map.of_extent(canvas, (0, 0, 600, 600), (0.0, 0.0), 1000.0)
    view.draw_relief(*view.ground(terrain))
    light = canvas.pixels.max(axis=-1).astype(float)
    half = (light.max() + light[0, 0]) / 2
    radii = []
    for turn in np.linspace(0, 2 * np.pi, 180, endpoint=False):
        along = np.arange(200.0, 300.0, 0.25)
        xy = np.rint(300 + along[:, None] * [np.cos(turn), np.sin(turn)]).astype(int)
        radii.append(along[light[xy[:, 1], xy[:, 0]] > half].max())
    assert np.mean(radii) == pytest.approx(270.0, abs=1.0)  # 900 m
    assert np.std(radii) < 0.7  # a cell is 2 px


def test_contours_stand_at_their_heights_with_their_names():
    terrain, canvas = Ramp(0.3), Canvas(601, 601)
    view = Map.of_extent(canvas, (0, 0, 600, 600), (0.0, 0.0), 1000.0)
    assert "each 50 m" in view.draw_heights(terrain)  # from -300 to 300 m
    row = canvas.pixels[200].astype(int).sum(axis=-1)
    lines = np.flatnonzero((row > sum(Ink.PAPER) + 60) & (row >= np.roll(row, 1)) & (row > np.roll(row, -1)))
    np.testing.assert_allclose(lines[lines > 10], 300 + np.arange(-250, 300, 50), atol=1.0)  # a pixel is 1 m of height
    assert {text for _, text, *_ in canvas._texts} == {str(height) for height in range(-250, 300, 50)}
    for (x, _), text, *_ in canvas._texts:  # each name stands on its own contour
        assert x == pytest.approx(300 + float(text), abs=1.5)
    assert view.draw_heights(Ramp(0.0)) == ""


def test_the_relief_picture_has_scales_and_contours():
    flat, steep = (relief_picture(Ramp(rise)) for rise in (0.0, 0.3))
    assert flat.shape == steep.shape
    assert flat[-50:].max() > 100 and flat[:, :50].max() > 100  # numbers along both sides
    assert np.abs(flat.astype(int) - steep).max() > 30


def test_relief_is_lit_from_the_north_west():
    west, east = (Canvas(200, 200) for _ in range(2))
    draw_overview(west, (0, 0, 199, 199), Ramp(0.3))
    draw_overview(east, (0, 0, 199, 199), Ramp(-0.3))
    spot = np.s_[60:75, 60:75]
    assert west.pixels[spot].mean() > 2 * east.pixels[spot].mean()
    assert west.pixels[180:190, 20:35].mean() < 25  # south of -500 m there is no ground
