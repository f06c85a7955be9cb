"""The annotated picture: marks at independently computed positions, and drawings of every kind of result."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.special import ndtr
from stage_helpers import as_stage

from startrack.camera import Camera, Pinhole
from startrack.chain import pipeline
from startrack.chain.stages import Detected, Inputs, Measured, Oriented, Refused
from startrack.core.types import Mode
from startrack.localization.thesis_methods import point_fix
from startrack.output import write_annotated
from startrack.output.picture.annotate import PANEL_WIDTH, STATUS, _facts, _legend, annotate
from startrack.output.picture.backdrop import View, fit_to_canvas, remove_hot_pixels
from startrack.output.picture.canvas import LARGE_PX, TEXT_PX, TITLE_PX, Canvas, Ink, text_box, text_width
from startrack.output.picture.marks import draw_marks, overlay_of
from startrack.output.tables import status_of


def has_colour_near(picture, place, colour, reach=2, tolerance=60):
    """Whether a pixel within `reach` of the position has nearly the colour."""
    x, y = np.rint(place).astype(int)
    patch = picture[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1].astype(int)
    return bool((np.abs(patch - colour).sum(axis=-1) < tolerance).any())


def render_stars(shape, centres, fluxes, sigma_px):
    """Gaussian stars, integrated over the pixels."""
    light = np.zeros(shape, dtype=np.float32)
    edges = [np.arange(n + 1) - 0.5 for n in shape]
    for (x, y), flux in zip(centres, fluxes, strict=True):
        down, across = (np.diff(ndtr((edge - at) / sigma_px)) for edge, at in zip(edges, (y, x), strict=True))
        light += (flux * np.outer(down, across)).astype(np.float32)
    return light


def count_pixels(picture, colour, tolerance=30):
    return int((np.abs(picture.astype(int) - colour).sum(axis=-1) < tolerance).sum())


@pytest.fixture(scope="module")
def picture(located):
    return annotate(located.result)


@pytest.fixture(scope="module")
def view(located, picture):
    scale, size = fit_to_canvas(located.result.exposure.size_px)
    return View(scale, (0.0, float((picture.shape[0] - size[1]) // 2)), size)


def test_size(picture):
    assert picture.dtype == np.uint8
    assert picture.shape[2] == 3
    assert 1000 <= picture.shape[0] <= 1600
    assert fit_to_canvas((2048, 2048)) == (1400 / 2048, (1400, 1400))
    assert fit_to_canvas((3000, 2000))[1] == (1400, 933)
    assert fit_to_canvas((512, 512))[1] == (900, 900)
    assert fit_to_canvas((1024, 1024))[0] == 1.0
    assert fit_to_canvas((64, 64)) == (4.0, (256, 256))


def test_the_skyline_is_where_the_true_wall_is(picture, view, located):
    """From the truth and the crater's formula, without any code of the picture's."""
    (x, y, up), camera = located.truth.position_enu_m, located.result.camera
    azimuth = np.radians(np.arange(0.0, 360.0, 5.0))
    along = x * np.sin(azimuth) + y * np.cos(azimuth)
    elevation = np.arctan2(2000.0 - up, np.sqrt(along**2 + 10_000.0**2 - x**2 - y**2) - along)
    level = np.cos(elevation)
    rays = np.stack([np.sin(azimuth) * level, np.cos(azimuth) * level, np.sin(elevation)], axis=-1)
    xy_px, inside = camera.project(rays @ located.truth.R_cam_enu.T)
    assert inside.all()
    assert np.mean([has_colour_near(picture, place, Ink.SKYLINE) for place in view.canvas_px(xy_px)]) > 0.9
    astray = [has_colour_near(picture, place, Ink.SKYLINE) for place in view.canvas_px(xy_px + 12.0)]
    assert np.mean(astray) < 0.5


def test_identified_stars_have_a_green_ring_and_hidden_ones_a_cross(picture, view, located):
    result = located.result
    ringed = []
    for k in np.sort(result.identification.detection)[:40]:  # the brightest: rings of faint ones fade
        at = view.canvas_px(result.detections.xy_px[k])
        ringed.append(
            any(has_colour_near(picture, at + np.array([0.0, r]), Ink.IDENTIFIED, tolerance=120) for r in range(5, 11))
        )
    assert np.mean(ringed) > 0.8
    hidden = np.flatnonzero(result.photometry.llr < -3.0)[:10]
    assert (
        np.mean(
            [has_colour_near(picture, place, Ink.HIDDEN) for place in view.canvas_px(result.photometry.xy_px[hidden])]
        )
        > 0.8
    )


def test_beyond_the_image_circle_is_paper(picture, view, located):
    corner = picture[int(view.origin[1]) + 3, 3]
    assert corner.max() < 40
    middle = picture[int(view.origin[1]) + 400 : int(view.origin[1]) + 600, 400:600]
    assert middle.max() == 255


@pytest.mark.parametrize("psf_sigma_px", [0.7, 0.8, 1.0, 2.0])
def test_hot_pixels_go_and_stars_stay(psf_sigma_px):
    rng = np.random.default_rng(1)
    sky = rng.normal(100, 3, (200, 200)).astype(np.float32)
    places = np.stack(np.meshgrid(np.arange(20, 180, 20), np.arange(20, 180, 20)), axis=-1).reshape(-1, 2)
    centres = places + rng.uniform(-0.5, 0.5, places.shape)
    stars = sky + render_stars(sky.shape, centres, np.geomspace(200, 1e5, len(centres)), psf_sigma_px)
    hot = stars.copy()
    hot[places[:, 1] + 9, places[:, 0] + 9] += np.geomspace(60, 5e4, len(places)).astype(np.float32)
    np.testing.assert_array_equal(remove_hot_pixels(stars, psf_sigma_px), stars)
    assert np.abs(remove_hot_pixels(hot, psf_sigma_px) - stars).max() < 20


def test_detections_beyond_the_image_circle_are_not_drawn(located, view):
    found = located.result.detections
    astray = replace(found, xy_px=np.concatenate([[[20.0, 20.0]], found.xy_px[1:]]))
    names = located.result.names
    others = replace(names, stars=names.stars.take(located.result.identification.detection != 0),
                     is_nameless=names.is_nameless | (np.arange(len(found)) == 0))  # fmt: skip
    drawn = annotate(replace(located.result, detections=astray, names=others))
    x, y = np.rint(view.canvas_px((20.0, 20.0))).astype(int)
    assert np.ptp(drawn[y - 12 : y + 13, x - 12 : x + 13].reshape(-1, 3), axis=0).max() == 0


def test_names_lie_on_no_other_name_and_no_bright_mark(located, view):
    result = located.result
    canvas = Canvas(2048, 2048)
    overlay = overlay_of(result)
    draw_marks(canvas, view, result, overlay)
    names = [(text, text_box(xy, text, anchor, size)) for xy, text, anchor, size, _, _ in canvas._texts]
    assert len(names) > 20
    seen = result.names.stars
    first = seen.xy_px[np.argsort(result.stars.v_mag[seen.star], kind="stable")[:20]]
    hidden_px = result.photometry.xy_px[status_of(result.photometry) == "hidden"][:10]
    marks = [view.canvas_px(place) for place in (*first, *hidden_px, *(body[1:3] for body in overlay["bodies"]))]
    for k, (text, (left, top, right, bottom)) in enumerate(names):
        assert "hidden" not in text
        assert not any(left < x < right and top < y < bottom for x, y in marks), text
        for other, (x0, y0, x1, y1) in names[:k]:
            assert not (left < x1 and x0 < right and top < y1 and y0 < bottom), (text, other)


def test_a_letter_of_the_compass_steps_aside_for_a_star(located, view):
    overlay = overlay_of(located.result)
    north = next(tick for tick in overlay["compass"] if tick[0] == 0)

    def place_of_north(bodies):
        canvas = Canvas(2048, 2048)
        draw_marks(canvas, view, located.result, overlay | {"bodies": bodies})
        return next(xy for xy, text, *_ in canvas._texts if text == "N")

    assert np.allclose(place_of_north([]), view.canvas_px(north[3]))
    assert np.hypot(*(place_of_north([["Venus", *north[3], False]]) - view.canvas_px(north[3]))) > 2 * TEXT_PX / 3


def test_the_most_significant_of_many_sources_without_a_name_are_drawn(located):
    result = located.result
    overlay = overlay_of(result)
    nameless = result.names.is_nameless & (
        result.camera.angle_rad(result.detections.xy_px) <= result.camera.max_angle_rad
    )
    assert len(overlay["others"]) == np.count_nonzero(nameless & (result.detections.snr > 10.0))
    assert len(overlay["others"]) + overlay["undrawn"] == np.count_nonzero(nameless)
    detected = as_stage(result, Detected)
    assert len(overlay_of(detected)["others"]) == 300
    assert overlay_of(detected)["undrawn"] > 0
    assert any(
        f"{overlay['undrawn']} further point sources not drawn" in words
        for _, _, words in _legend(result, False, overlay["undrawn"])
    )


def test_truth_is_drawn_only_when_given(picture, located):
    assert count_pixels(picture, Ink.TRUTH) == 0
    given = annotate(located.result, tuple(located.truth.position_enu_m[:2]))
    assert count_pixels(given[:, -PANEL_WIDTH:], Ink.TRUTH) > 20


def test_the_facts_of_a_sky_without_a_terrain_fit_in_the_panel(located):
    facts = dict(_facts(as_stage(located.result, Oriented, terrain=None)))
    assert "Middle" in facts
    room_px = PANEL_WIDTH - 2 * TITLE_PX - 7.5 * LARGE_PX
    assert all(text_width(fact, LARGE_PX) < room_px for fact in facts.values())


def test_every_kind_of_result_can_be_drawn(located):
    result = located.result
    modes = (Mode(east_m=6000.0, north_m=-2500.0, weight=0.7), Mode(east_m=-3000.0, north_m=4000.0, weight=0.3))

    def make_refusal(reason, message, stage):
        return Refused(reason=reason, message=message, reached=as_stage(result, stage))

    badge = np.s_[20:70, -200:]
    cases = {
        "ambiguous": replace(result, fix=replace(result.fix, modes=modes, ambiguous=True)),
        "inconsistent": make_refusal("inconsistent_evidence", "m " * 400, Measured),
        "not identified": make_refusal("not_identified", "why", Detected),
        "no stars": make_refusal("no_stars", "", Inputs),
        "identified": as_stage(result, Oriented, terrain=None),
        "detected": as_stage(result, Detected, camera=None, terrain=None),
    }
    for name, one in cases.items():
        drawn = annotate(one)
        assert count_pixels(drawn[badge], STATUS[one.status]) > 500, name
    assert count_pixels(annotate(cases["ambiguous"])[:, -PANEL_WIDTH:], Ink.POSITION) > 2 * 60


def test_a_position_without_a_circle_is_drawn_without_a_zoom(located, picture):
    result = located.result
    point = annotate(replace(result, fix=point_fix(result.fix.position_enu_m[:2], result.terrain)))
    drawn, circled = (count_pixels(one[:, -PANEL_WIDTH:], Ink.POSITION) for one in (point, picture))
    assert 60 < drawn < 0.5 * circled


def test_an_image_of_another_size_than_the_cameras(located):
    wide = replace(located.result.exposure, pixels_adu=located.result.exposure.pixels_adu[:300])
    refused = pipeline.identify(wide, located.result.camera, SimpleNamespace(name="not needed"))
    assert refused.reason == "size_mismatch"
    assert annotate(refused).shape[1] > 1024


def test_a_narrow_camera_that_sees_no_skyline(located):
    """A pinhole camera of 20 degrees looking up: no compass, no wall, no rim in the frame, and no error."""
    camera = Camera(
        name="narrow",
        size_px=(1024, 1024),
        focal_px=(2900.0, 2900.0),
        centre_px=(511.5, 511.5),
        max_angle_rad=0.25,
        calibrated_angle_rad=0.25,
        lens=Pinhole(),
    )
    result = replace(located.result, camera=camera)
    assert count_pixels(annotate(result)[:, :1024], Ink.SKYLINE) == 0


def test_a_name_that_the_font_cannot_write(located):
    exposure = replace(located.result.exposure, path="nächte/星空 – " + "very long " * 20 + ".png")
    annotate(replace(located.result, exposure=exposure))


def test_the_png_is_whole_and_the_same_each_time(located, picture, tmp_path):
    first, second = tmp_path / "a.annotated.png", tmp_path / "b.annotated.png"
    write_annotated(first, located.result)
    write_annotated(second, located.result)
    np.testing.assert_array_equal(np.asarray(Image.open(first)), picture)
    assert first.read_bytes() == second.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == [first.name, second.name]


def test_a_true_position_is_written_with_the_picture(located, tmp_path):
    bare, marked = tmp_path / "bare.png", tmp_path / "marked.png"
    write_annotated(bare, located.result)
    write_annotated(marked, located.result, truth_enu_m=(100.0, 200.0))
    expected = annotate(located.result, (100.0, 200.0))
    np.testing.assert_array_equal(np.asarray(Image.open(marked)), expected)
    assert (expected != np.asarray(Image.open(bare))).any()


def test_matplotlib_stays_out():
    code = "import sys, startrack.output.picture.annotate, startrack.output.write; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
