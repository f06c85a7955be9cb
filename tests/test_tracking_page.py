"""The page of a track: its data, and in a real browser the slider, the table and an empty console."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from html_helpers import DESKTOP, PHONE, Window
from synthetic_track import NASTY, odometry_alone, synthetic_track

from startrack.applications.tracking.write import track_page
from startrack.estimation.trajectory import radius_holding
from startrack.output import png_bytes

pytestmark = pytest.mark.slow

PICTURE = png_bytes(np.full((40, 60, 3), 90, dtype=np.uint8))
TITLE = 'A drive & </script><i>"more"</i>'


def data_of(text: str) -> dict[str, Any]:
    return json.loads(re.search(r'<script type="application/json" id="results">(.*?)</script>', text, re.S)[1])


def test_the_page_holds_the_frames_and_needs_nothing_else():
    track = synthetic_track(unknown=1)
    odometry_m = odometry_alone(track)
    text = track_page(track, PICTURE, title=TITLE, odometry_m=odometry_m)
    data = data_of(text)
    frames = data["frames"]
    assert {len(values) for values in frames.values()} == {8}
    assert frames["image"][2] == NASTY and frames["status"][2:4] == ["refused", "left_out"]
    assert frames["east_m"][0] is None and frames["slipped"][6] == 1
    np.testing.assert_allclose(frames["east_m"][1:], track.smoothed.position_enu_m[1:, 0], atol=1e-4)
    expected = radius_holding(track.filtered.covariance_m2[1:], 0.95)
    np.testing.assert_allclose(frames["filtered_radius95_m"][1:], expected, atol=1e-4)
    np.testing.assert_allclose(data["odometry"], odometry_m[1:], atol=1e-3)
    assert data["picture"].startswith("data:image/png;base64,")
    assert TITLE not in text and not re.search(r"https?://", text)

    assert [one for one in re.findall(r'(?:src|href)="([^"]*)"', text) if "data:" not in one] == ["#main"]


def test_a_page_without_a_position_can_be_made():
    data = data_of(track_page(synthetic_track(unknown=8), PICTURE, title="nothing"))
    assert set(data["frames"]["radius95_m"]) == {None}
    assert data["odometry"] is None


@pytest.fixture
def window(chromium, tmp_path) -> Iterator[Any]:
    opened = []

    def make(track, size=DESKTOP, scheme="light", odometry_m=None) -> Window:
        page = tmp_path / f"{len(opened)}.html"
        page.write_text(track_page(track, PICTURE, title=TITLE, odometry_m=odometry_m), encoding="utf-8")
        opened.append(Window(chromium, page, size, scheme))
        return opened[-1]

    yield make
    for one in opened:
        one.close()


def test_the_slider_chooses_the_frame_by_keys_buttons_and_rows(window):
    track = synthetic_track()
    w = window(track, odometry_m=odometry_alone(track))
    slider, frame = w.page.get_by_role("slider"), w.page.locator("#frame")
    assert w.page.locator("h1").inner_text() == TITLE
    assert "frame-8.png" in frame.inner_text()
    slider.focus()
    w.page.keyboard.press("Home")
    assert "frame-1.png" in frame.inner_text()
    for _ in range(2):
        w.page.keyboard.press("ArrowRight")
    words = frame.inner_text()
    east_m, north_m = (f"{value:,.2f}" for value in track.smoothed.position_enu_m[2, :2])
    radius_m = radius_holding(track.filtered.covariance_m2, 0.95)[2]
    for word in (NASTY, "refused", "no star found", "2030-06-01 00:30:00 UTC", east_m, north_m, f"{radius_m:.2f}"):
        assert word.replace("-9", "\N{MINUS SIGN}9") in words.replace("\u00a0", " ")
    assert frame.locator("b").count() == 0
    assert "3 of 8" in slider.get_attribute("aria-valuetext")
    w.page.get_by_role("button", name="Next frame").click()
    assert "left out" in frame.inner_text()
    assert "ended before the proof" not in frame.inner_text()
    w.page.get_by_role("button", name="frame-7.png").click()
    assert "slip before this frame" in frame.inner_text()
    assert "ended before the proof" in frame.inner_text()
    assert slider.input_value() == "7"
    assert w.page.locator("tr[aria-current=true]").inner_text().startswith("frame-7.png")


def test_the_marker_stands_at_the_chosen_frame_and_a_click_chooses(window):
    track = synthetic_track()
    w = window(track)
    canvas = w.page.locator("canvas").first
    canvas.scroll_into_view_if_needed()
    place = "([k]) => map.screen(...placeOf(k, ''))"
    w.wait_for("Boolean(map.box) && !map.waiting")
    x, y = w.page.evaluate(place, [1])
    canvas.click(position={"x": x, "y": y})
    assert "frame-2.png" in w.page.locator("#frame").inner_text()
    w.wait_for("!map.waiting")
    ring = w.page.evaluate("([x, y]) => [...map.canvas.getContext('2d').getImageData(x - 11, y, 1, 1).data]", [x, y])
    ink = w.page.evaluate("colour('ink')")
    np.testing.assert_allclose(ring[:3], [int(ink[k : k + 2], 16) for k in (1, 3, 5)], atol=60)


@pytest.mark.parametrize(("size", "scheme"), [(DESKTOP, "dark"), (PHONE, "light")])
def test_the_page_is_no_wider_than_its_window(window, size, scheme):
    for at_rest in (False, True):
        w = window(synthetic_track(at_rest=at_rest), size, scheme)
        assert w.has_no_overflow()
        luminance = w.page.evaluate(
            "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).reduce((a, b) => a + +b, 0)"
        )
        assert (luminance < 150) == (scheme == "dark")


def test_the_frames_are_played(window):
    w = window(synthetic_track())
    w.page.get_by_role("button", name="Play").click()
    w.wait_for("document.querySelector('input[type=range]').value === '3'")
    w.page.get_by_role("button", name="Pause").click()
    assert w.page.get_by_role("button", name="Play").count() == 1


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_axe_finds_nothing_on_a_track(window, axe, size, scheme):
    w = window(synthetic_track(), size, scheme)
    assert w.violations(axe) == []
    assert w.has_no_overflow()


def test_the_lead_names_the_last_position_and_the_axis_of_radii_begins_at_zero(window):
    track = synthetic_track()
    w = window(track)
    lead = w.page.locator("p.lead").inner_text().replace("\u00a0", " ")
    east_m, north_m, _ = track.smoothed.position_enu_m[-1]
    assert f"within {track.smoothed.radius95_m[-1]:.2f} m (95 %)" in lead
    assert f"east {east_m:,.2f} m, north {north_m:,.2f} m".replace("-", "−") in lead
    is_log, low, words = w.page.evaluate("[isLog, radii.world[1], radii.axes.y]")
    radii_m = np.concatenate([track.smoothed.radius95_m, track.filtered.radius95_m])
    assert is_log == (8 * np.nanmin(radii_m) < np.nanmax(radii_m))
    assert (low == 0 and words == "95 % radius") or (is_log and words == "95 % radius (logarithmic)")
