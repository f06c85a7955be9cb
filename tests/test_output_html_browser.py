"""The page in a real browser: hover, zoom, touch, keys, sorting and filtering, and an empty console."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from html_helpers import DESKTOP, NASTY, PHONE, SMALL, Window, results_in

from startrack.output import Found, page_text, results_under, write_page

pytestmark = pytest.mark.slow

REAL = {"small": (6010.0, -2507.0)}


@pytest.fixture(scope="module")
def folder(located, tmp_path_factory) -> Path:
    out = results_in(tmp_path_factory.mktemp("results"), located)
    found, unread = results_under(out)
    (out / "report.html").write_text(page_text(found, unread=unread, real=REAL), encoding="utf-8")
    rows = [
        Found(f"n/{k:05}", Path("x"), {**one.record, "image": f"n/{k:05}.png"}) for k, one in enumerate(found * 2500)
    ]
    real = {one.stem: (6003.0, -2498.0) for one in rows}
    (out / "many.html").write_text(page_text(rows, real=real, images=0), encoding="utf-8")
    return out


@pytest.fixture
def window(chromium, folder) -> Iterator[Any]:
    opened = []

    def make(size: tuple[int, int] = DESKTOP, name: str = "report.html", scheme: str = "light") -> Window:
        opened.append(Window(chromium, folder / name, size, scheme))
        return opened[-1]

    yield make
    for one in opened:
        one.close()


def test_hover_shows_a_star_and_the_wheel_zooms_at_the_pointer(window):
    w = window()
    w.open("small.png")
    x, y = w.star_position("Canopus")
    assert not w.page.locator("#detail .tip").first.is_visible()
    w.page.mouse.move(x + 3, y + 2)
    w.page.wait_for_selector("#detail .tip:not([hidden])")
    for words in ("Canopus", "HIP 30438", "V −0.62", "seen", "its light is there", "evidence", "azimuth"):
        assert words in w.tip()
    w.page.mouse.wheel(0, -400)
    w.wait_for("document.querySelector('#detail .stage').dataset.zoom > 2")
    assert w.star_position("Canopus") == pytest.approx((x, y), abs=4)
    before = w.star_position("Canopus")
    w.page.mouse.down()
    w.page.mouse.move(before[0] + 80, before[1] - 50, steps=4)
    w.page.mouse.up()
    assert w.star_position("Canopus") == pytest.approx((before[0] + 75, before[1] - 50), abs=6)
    w.page.mouse.dblclick(*w.star_position("Canopus"))
    assert w.zoom == 1


def test_keys_zoom_move_and_step_through_the_stars(window):
    w = window()
    w.open("small.png")
    w.page.locator("#detail .stage canvas").first.focus()
    w.page.keyboard.press("+")
    assert w.zoom == pytest.approx(1.4)
    centre = "document.querySelector('#detail .stage canvas').view.centre[0]"
    before = w.page.evaluate(centre)
    w.page.keyboard.press("ArrowRight")
    assert w.page.evaluate(centre) > before
    w.page.keyboard.press("n")
    first = w.page.locator("#detail figure [role=status]").first.text_content()
    w.page.keyboard.press("n")
    assert "magnitude" in first
    assert w.page.locator("#detail figure [role=status]").first.text_content() not in ("", first)
    w.page.keyboard.press("0")
    assert w.zoom == 1


def test_each_figure_has_two_stops_of_the_tab_key(window):
    """The drawing, and all of its buttons and boxes, among which the arrow keys, Home and End move."""
    w = window()
    w.open("small.png")
    stops = w.page.evaluate(
        "[...document.querySelectorAll('#detail figure')].map(figure => [...figure.querySelectorAll("
        "'canvas, [role=toolbar] *')].filter(one => one.tabIndex >= 0).length)"
    )
    assert len(stops) > 4 and set(stops) == {2}
    bar = w.page.locator("#detail figure [role=toolbar]").first
    w.page.locator("#detail .stage canvas").first.focus()
    focused = (
        "[...document.querySelector('#detail [role=toolbar]').querySelectorAll('button, input')]"
        ".indexOf(document.activeElement)"
    )
    walked = []
    for key in ("Tab", "ArrowRight", "ArrowDown", "ArrowLeft", "End", "ArrowRight", "ArrowLeft", "Home"):
        w.page.keyboard.press(key)
        walked.append(w.page.evaluate(focused))
    last = bar.locator("button, input").count() - 1
    assert last > 4 and walked == [0, 1, 2, 1, last, 0, last, 0]
    w.page.keyboard.press("End")
    before = w.page.evaluate("document.activeElement.checked")
    w.page.keyboard.press("Space")
    assert w.page.evaluate("document.activeElement.checked") is not before
    w.page.keyboard.press("Shift+Tab")
    assert w.page.evaluate("document.activeElement.tagName") == "CANVAS"
    w.page.keyboard.press("Tab")
    assert w.page.evaluate(focused) == last  # the one left


def test_fingers_tap_and_pinch(window):
    w = window(PHONE)
    w.open("small.png")
    x, y = w.star_position("Canopus")
    w.page.touchscreen.tap(x, y)
    w.page.wait_for_selector("#detail .tip:not([hidden])")
    assert "magnitude" in w.tip()
    box, stage = (w.page.locator(f"#detail {which}").first.bounding_box() for which in (".tip", ".stage"))
    assert box["x"] >= 0 and box["x"] + box["width"] <= PHONE[0]
    assert box["y"] >= stage["y"] + stage["height"]  # the picture and the star stay in sight
    assert box["y"] + box["height"] <= PHONE[1] + 1  # the page scrolls by whole pixels
    x, y = w.star_position("Canopus")
    session = w.context.new_cdp_session(w.page)
    for apart, kind in ((20, "touchStart"), (30, "touchMove"), (60, "touchMove"), (60, "touchEnd")):
        points = [{"x": x - apart, "y": y, "id": 0}, {"x": x + apart, "y": y, "id": 1}]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [] if kind == "touchEnd" else points})
    assert w.zoom == pytest.approx(3, rel=0.2)


@pytest.mark.parametrize(("size", "scheme"), [(DESKTOP, "light"), (PHONE, "dark"), (SMALL, "light")])
def test_nothing_stands_out_sideways(window, size, scheme):
    w = window(size, scheme=scheme)
    assert w.has_no_overflow()
    beyond = w.page.evaluate(  # px, from the right edge of each badge of an outcome to that of its cell
        "[...document.querySelectorAll('td.mid .badge')].map(badge => badge.closest('td').getBoundingClientRect().right"
        " - badge.getBoundingClientRect().right)"
    )
    assert len(beyond) == 4 and min(beyond) >= 0
    for index in range(4):
        w.page.evaluate("k => { location.hash = `#i${k}` }", index)
        w.wait_for(f"document.getElementById('detail').dataset.index === '{index}'")
        assert w.has_no_overflow()
    luminance = w.page.evaluate(
        "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).reduce((a, b) => a + +b, 0)"
    )
    assert (luminance < 150) == (scheme == "dark")


def test_rows_are_sorted_filtered_and_opened(window):
    w = window()
    names = w.page.locator("tbody th[scope=row]")
    assert names.all_inner_texts() == ["dark.png", NASTY, "night 1/two.png", "small.png"]
    outcome = w.page.get_by_role("button", name="Outcome")
    outcome.focus()
    w.page.keyboard.press("Enter")
    assert names.first.inner_text() == "night 1/two.png"  # ambiguous, ok, refused
    w.page.keyboard.press("Enter")
    assert names.first.inner_text() == NASTY
    assert w.page.locator("th[aria-sort=descending]").inner_text().startswith("Outcome")
    w.page.get_by_role("button", name="refused").click()
    assert names.count() == 2
    w.page.get_by_role("searchbox").fill("NO star")
    assert names.all_inner_texts() == ["dark.png"]
    assert "1 of 4" in w.page.locator("#overview [role=status]").first.inner_text()
    w.page.locator("tbody td").first.click()
    assert w.page.locator("#detail h1").inner_text() == "dark.png"
    assert "What to try" in w.page.locator(".why").inner_text()
    assert not w.page.locator("#overview").is_visible()
    w.page.go_back()
    w.page.wait_for_selector("#overview table")
    assert w.page.locator("#detail").is_hidden()


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_the_ways_out_of_an_image_stand_in_one_line(window, size):
    w = window(size)
    w.open("night 1/two.png")
    links = w.page.locator("nav.path a")
    boxes = [links.nth(k).bounding_box() for k in range(3)]
    assert len({box["y"] for box in boxes}) == 1
    assert boxes[2]["x"] - boxes[1]["x"] - boxes[1]["width"] >= 16


def test_an_ambiguous_image_shows_every_mode_and_its_warnings(window):
    w = window()
    w.open("night 1/two.png")
    places = w.page.locator(".why li").all_inner_texts()
    assert [text.replace("\u00a0", " ") for text in places] == [
        "East 6,000.0 m, north −2,500.0 m, within 300.0 m (95 %): probability 75.0 %",
        "East −3,000.0 m, north 10.0 m: probability 25.0 %",  # of an older version, without a circle
    ]
    assert w.page.locator("#detail figcaption", has_text="Position 1, probability 75.0").count() == 1  # its map
    area, close = w.page.evaluate(
        "[...View.all].filter(v => v.axes === METRES && v.node.closest('#detail')).map(v => [v.world[2] - v.world[0],"
        "v.points.map(p => v.describe(p)[1].map(row => row.join(' ')).join('; ').replaceAll('\u00a0', ' '))])"
    )
    assert area[0] > 20_000 and close[0] == 2 * 1.25 * 500
    position = "east 6,000.0 m; north −2,500.0 m; probability 75.0 %"
    assert close[1][0] == f"{position}; 95 % within 300.0 m; 99.9 % within 500.0 m"
    text = w.page.locator("#detail").inner_text()
    assert re.search(r"Search\s+(proven|beam)", text)
    assert "EXIF orientation" in text
    assert w.page.locator("a", has_text="two.fix.json").get_attribute("href") == "./night%201/two.fix.json"


def test_a_magnified_pixel_of_the_picture_looks_like_one(window):
    w = window()
    w.open("small.png")
    x, y = w.star_position("Canopus")
    w.page.evaluate(
        "([x, y]) => { const c = document.querySelector('#detail .stage canvas'), f = c.getBoundingClientRect();"
        "c.view.zoomBy(20, x - f.left, y - f.top) }", [x, y],
    )  # fmt: skip
    for box in w.page.locator("#detail figure").first.get_by_role("checkbox").all():
        box.uncheck()
    w.wait_for("document.querySelector('#detail .stage').dataset.zoom > 19")
    w.wait_for("!document.querySelector('#detail .stage canvas').view.waiting")
    steps, pixel_px = w.page.evaluate(
        "() => { const c = document.querySelector('#detail .stage canvas'), side = 200;"
        "const { data } = c.getContext('2d').getImageData(c.width / 2 - side / 2, c.height / 2 - side / 2, side, side);"
        "const level = (x, y) => data.slice(4 * (side * y + x), 4 * (side * y + x) + 3).join();"
        "const rows = [...Array(side).keys()];"
        "return [rows.slice(1).filter((x) => rows.some((y) => level(x, y) !== level(x - 1, y))).length,"
        "c.view.magnified] }"
    )
    assert pixel_px > 8
    assert steps <= 200 / pixel_px + 1  # columns where anything changes: the pixels' edges


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_words_beside_the_axes_keep_apart(window, size):
    w = window(size)
    w.open("small.png")
    w.page.wait_for_selector("text=The position and how sure it is")
    rooms = w.page.evaluate(
        "[...View.all].filter(v => v.axes && find('detail').contains(v.node)).map(v => {"
        "const [xs, step] = ticks(v, 0);"
        "const at = xs.map(x => v.screen(x, 0)[0]); return at.slice(1).map((x, k) => x - at[k]"
        "- (widthOf(v, xs[k], step) + widthOf(v, xs[k + 1], step)) / 2) })"
    )
    assert len(rooms) == 6
    assert min(room for one in rooms for room in one) > 4


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_the_skyline_of_the_image_is_shown_twice(window, size):
    """On the panorama and enlarged: each point has its elevation with sigma, source and height above the map's."""
    w = window(size)
    w.open("small.png")
    views = "[...View.all].filter(v => v.axes && find('detail').contains(v.node) && /horizon/.test(v.label))"
    panorama, enlarged = w.page.evaluate(
        f"{views}.map(v => v.points.filter(p => p.kind in SKYLINES).map(p => [p.x, p.y, p.el, p.sigma, p.above]))"
    )
    assert len(panorama) == len(enlarged) > 100
    assert all(y == el for _, y, el, _, _ in panorama) and all(y == above for _, y, _, _, above in enlarged)
    card = w.page.locator("section", has=w.page.get_by_role("heading", name="Panorama"))
    assert "The skyline of the image, enlarged" in card.inner_text()
    figure = card.locator("figure").nth(1)
    canvas = figure.locator("canvas").first
    canvas.scroll_into_view_if_needed()
    x, y = canvas.evaluate("c => c.view.screen(...['x', 'y'].map(k => c.view.points.find(p => p.kind in SKYLINES)[k]))")
    canvas.click(position={"x": x, "y": y})
    tip = figure.locator(".tip").inner_text()
    for words in ("Skyline of the image at azimuth", "elevation", "±", "above the map's", "from"):
        assert words in tip
    boxes = figure.get_by_role("group", name="Skyline of the image").get_by_role("checkbox")
    shown = "c => c.view.points.filter(p => p.kind in SKYLINES && c.view.shown(p)).length"
    assert canvas.evaluate(shown) == len(enlarged)
    for k in range(boxes.count()):
        boxes.nth(k).uncheck()
    assert canvas.evaluate(shown) == 0


def test_a_file_is_shown_by_its_name_and_found_by_its_path(window):
    w = window()
    w.open("small.png")
    camera = w.page.locator(".facts dd .tipped")
    assert camera.inner_text() == "small-fisheye"
    assert camera.get_attribute("title") == "/somewhere/else/cameras/small-fisheye.toml"
    assert "The first image of a run" in w.page.locator("#detail").inner_text()


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_long_names_are_whole_and_rows_stay_where_they_are_reckoned(window, folder, size):
    record = json.loads((folder / "dark.fix.json").read_text())
    long = "{:04}-a-name-of-many-words-that-needs-some-lines-WWWWWWWWWWWWWWWW-in-the-table-of-images-{:04}-left.png"
    names = [long.format(k // 2, k) if k % 3 else f"{k // 2:04}.png" for k in range(300)]
    rows = [Found(f"r{k}", folder / f"r{k}.fix.json", record | {"image": name}) for k, name in enumerate(names)]
    (folder / "long.html").write_text(page_text(rows, unread=["x.fix.json: no JSON"], images=0), encoding="utf-8")
    w = window(size, name="long.html")
    assert "x.fix.json: no JSON" in w.page.locator("#overview").inner_text()
    for place in ("0", "box.scrollHeight / 2", "box.scrollHeight"):
        w.page.locator(".rows").evaluate(f"box => {{ box.scrollTop = {place} }}")
        w.page.wait_for_timeout(100)
        told = w.page.evaluate(
            "[...document.querySelectorAll('tbody tr[data-index]')].map(tr => { const a = tr.querySelector('a');"
            "const cell = a.parentElement;"
            "return [a.innerText === page.rows[+tr.dataset.index][column.image], a.offsetHeight <= cell.clientHeight,"
            "a.scrollWidth <= cell.clientWidth, tr.getBoundingClientRect().height - parseFloat(tr.style.height)] })"
        )
        assert len(told) > 10
        assert all(whole and high and wide and abs(off) < 1 for whole, high, wide, off in told)
    w.page.get_by_role("link", name=max(names)).click()
    assert w.page.locator("#detail h1").inner_text() == max(names)


def test_links_lead_from_the_page_to_the_results(window, folder):
    place = folder / "other # place"
    place.mkdir()
    found, _ = results_under(folder)
    write_page(place / "rep.html", found)
    files = linked_files(window(name="other # place/rep.html"), "night 1/two.png")
    assert len(files) == 3 and all(file.is_file() for file in files)
    assert files[0].samefile(folder / "night 1/two.fix.json")


def test_an_image_without_details_leads_to_its_result_of_either_kind(window, folder):
    place = folder / "stars alone"
    place.mkdir()
    shutil.copy(folder / "dark.fix.json", place / "dark.identification.json")
    found, _ = results_under(place)
    write_page(place / "rep.html", found, images=0)
    (file,) = linked_files(window(name="stars alone/rep.html"), "dark.png")
    assert file.samefile(found[0].path)


def linked_files(w: Window, image: str) -> list[Path]:
    """The files that the page of an image links to."""
    w.open(image)
    addresses = w.page.evaluate("[...document.querySelectorAll('.files a')].map(a => a.href)")
    return [Path(unquote(urlsplit(address).path)) for address in addresses]


def test_texts_stay_texts(window):
    w = window()
    w.open(NASTY)
    assert w.page.locator("#detail h1").inner_text() == NASTY
    assert w.page.locator("#detail b").count() == 0


def test_ten_thousand_rows_scroll(window):
    w = window(name="many.html")
    assert w.page.locator("tbody tr").count() < 80
    w.page.locator(".rows").evaluate("box => { box.scrollTop = box.scrollHeight }")
    w.page.wait_for_selector("text=n/09999.png")
    assert w.page.locator("tbody tr").count() < 80
    took_ms = w.page.evaluate(
        "() => { const start = performance.now(); document.querySelectorAll('thead button')[1].click();"
        "return performance.now() - start }"
    )
    assert took_ms < 3000
    w.page.get_by_role("searchbox").fill("00042")
    assert w.page.locator("tbody th[scope=row]").all_inner_texts() == ["n/00042.png"]
    assert "2,500 with a known position" in w.page.locator("#overview").inner_text()


def test_the_headline_says_when_where_how_sure_and_whither(window):
    w = window()
    w.open("small.png")
    lead = w.page.locator("#detail .lead").inner_text().replace("\u00a0", " ")
    record = w.page.evaluate("detailOf(page.rows.findIndex((row) => row[column.image] === 'small.png')).record")
    position = record["position"]
    assert lead.startswith(record["provenance"]["time_utc"][:19].replace("T", " ") + " UTC: east ")
    assert f"within {position['radius95_m']:,.1f} m (95 %)" in lead
    assert f"heading {record['attitude']['heading_deg']:.1f}°" in lead
    assert f"{len(record['warnings']) or 'no'} warning" in lead
    level = position["protection_level_m"]
    assert ("protection level" in lead) == (level is not None)
    assert ("(99.9 %)" in lead) == (position["radius999_m"] > 5 * position["radius95_m"])
    term = w.page.locator("#detail .facts dt", has_text="95 % within").first
    assert "holds 95 %" in term.get_attribute("title")
