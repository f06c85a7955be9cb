"""The page of an image in a browser: marks drawn over the picture, search, theme, evidence by azimuth, axe."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from html_helpers import DESKTOP, NASTY, SMALL, Window, results_in

from startrack.catalog import proper_name_designations, star_names
from startrack.output import page_text, result_at, results_under

pytestmark = pytest.mark.slow

READ_TWICE = "willReadFrequently"  # a hint of Chromium where a test reads a canvas more than once
VIEW = "document.querySelector('#detail .stage canvas').view"


@pytest.fixture(scope="module")
def folder(located, tmp_path_factory) -> Path:
    out = results_in(tmp_path_factory.mktemp("results"), located)
    found, unread = results_under(out)
    (out / "report.html").write_text(page_text(found, unread=unread), encoding="utf-8")
    one = page_text([result_at(out / "small.fix.json")], single=True)
    (out / "one.html").write_text(one, encoding="utf-8")
    return out


@pytest.fixture
def window(chromium, folder) -> Iterator[Any]:
    opened = []

    def make(size: tuple[int, int] = DESKTOP, name: str = "one.html", scheme: str = "light") -> Window:
        opened.append(Window(chromium, folder / name, size, scheme))
        return opened[-1]

    yield make
    for one in opened:
        one.close(ignored=READ_TWICE)


def painted(w: Window) -> None:
    """Wait until the picture is drawn as it is set."""
    w.wait_for(f"!{VIEW}.waiting && {VIEW}.box !== undefined")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(("name", "size"), [("one.html", DESKTOP), ("one.html", SMALL), ("report.html", SMALL)])
def test_axe_finds_nothing(window, axe, name, size, scheme):
    """On the page of an image, the list of images, and an image that is refused."""
    w = window(size, name, scheme)
    for hash in ("", "#i0")[: 1 + (name == "report.html")]:
        w.page.evaluate("hash => { location.hash = hash }", hash)
        w.wait_for(f"document.getElementById('{'detail' if hash else 'overview'}').hidden === false || page.single")
        w.page.evaluate(axe)
        found = w.page.evaluate("axe.run()")
        assert [(one["id"], [node["html"] for node in one["nodes"]]) for one in found["violations"]] == []
        assert len(found["passes"]) > 20  # the rules have run
        assert w.has_no_overflow()


def test_axe_finds_a_fault(window, axe):
    """A page that is made worse is found to be so: the rules reach what they are to check."""
    w = window()
    w.page.evaluate("find('theme').textContent = ''; document.querySelector('.lead').style.color = '#bbb'")
    w.page.evaluate(axe)
    found = w.page.evaluate("axe.run()")
    assert {one["id"] for one in found["violations"]} >= {"button-name", "color-contrast"}


def test_a_star_is_found_by_name_and_by_number(window):
    w = window()
    w.page.keyboard.press("/")
    assert w.page.evaluate("document.activeElement.id") == "star-search"
    w.page.keyboard.type("canopu")
    w.page.keyboard.press("Enter")
    answer = w.page.locator(".answer")
    assert "Canopus: HIP 30438, V −0.62" in answer.inner_text().replace("\u00a0", " ")
    assert w.page.evaluate(f"{VIEW}.pinned.name") == "Canopus"
    assert w.zoom == 6
    centre = w.page.evaluate(f"{VIEW}.centre")
    assert centre == pytest.approx(w.page.evaluate(f"[{VIEW}.pinned.x, {VIEW}.pinned.y]"), abs=1)
    marked = w.page.evaluate("[...View.all].filter(v => v.pinned && v.node.isConnected).map(v => v.pinned.id)")
    assert marked[:2] == ["HIP 30438"] * 2  # the picture and the panorama
    for words in ("HIP 30438", "30438", "alpha Car", "alf Car", "α Car", "αCar", "ALPHA CARINAE"):
        w.page.evaluate(f"{VIEW}.reset()")
        assert w.page.evaluate(f"{VIEW}.pinned") is None
        w.page.get_by_label("Find a star").fill(words)
        w.page.get_by_role("button", name="Find").click()
        assert w.page.evaluate(f"{VIEW}.pinned.name") == "Canopus"
    w.page.get_by_label("Find a star").fill("Nowhere")
    w.page.keyboard.press("Enter")
    assert "“Nowhere” is outside of the picture" in answer.inner_text()


def test_components_of_a_designation_are_found(window):
    """Without an index the brightest one; and every designation of the catalogue is read as one."""
    w = window()
    shown = {
        "alpha Cen": "Rigil Kentaurus",
        "α¹ Cen": "Rigil Kentaurus",
        "alf02 Cen": "Toliman",
        "rigil": "Rigil Kentaurus",
    }
    shown |= {"gam2 Vel": "gamma2 Vel", "γ Velorum": "gamma2 Vel", "bet Canis Majoris": "Mirzam", "Nowhere Cen": None}
    stars = [
        {"id": f"HIP {k}", "name": name}
        for k, name in enumerate(("Rigil Kentaurus", "Toliman", "gamma2 Vel", "Mirzam"))
    ]
    proper = proper_name_designations()
    found = w.page.evaluate(
        "([stars, designations, words]) => {"
        "const columns = { id: stars.map(s => s.id), name: stars.map(s => s.name) };"
        "const read = starsOf({ stars: { columns, designations } });"
        "return words.map(one => starOf(read, one)?.name ?? null) }",
        [stars, dict(proper), list(shown)],
    )
    assert dict(zip(shown, found, strict=True)) == shown
    known = [*proper.values(), *(set(star_names().values()) - set(proper))]
    assert w.page.evaluate("known => known.filter(one => !designationOf(one))", known) == []
    assert len(known) > 3500


def test_a_planet_is_found_and_described(window):
    w = window()
    bodies = w.page.evaluate("detailOf(0).picture.marks.bodies")
    name, x, y, _ = bodies[0]
    w.page.get_by_label("Find a star").fill(name.lower())
    pinned = w.page.evaluate(f"[{VIEW}.pinned.name, {VIEW}.pinned.px, {VIEW}.pinned.py]")
    assert pinned == [name, x, y]
    assert w.page.locator(".answer").inner_text().startswith(f"{name}: predicted")
    marked = w.page.evaluate(f"{VIEW}.shown({VIEW}.pinned)")
    w.page.get_by_label("planets").first.uncheck()
    assert [marked, w.page.evaluate(f"{VIEW}.shown({VIEW}.pinned)")] == [True, False]


def test_the_hint_in_the_search_is_whole_on_a_small_screen(window):
    w = window(SMALL)
    room, width = w.page.evaluate(
        "(() => { const input = find('star-search'), style = getComputedStyle(input);"
        "const g = make('canvas').getContext('2d'); g.font = style.font;"
        "return [input.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight),"
        "g.measureText(input.placeholder).width] })()"
    )
    assert 0 < width < room - 24  # beside the browser's own button


def test_a_star_behind_the_wall_is_found_as_hidden(window):
    w = window()
    name = w.page.evaluate(f"{VIEW}.points.find(p => p.kind === 'hidden' && p.name).name")
    w.page.get_by_label("Find a star").fill(name)  # the whole name, as picked from the list: no key is needed
    assert w.page.locator(".answer").inner_text().endswith("hidden")
    assert w.page.evaluate(f"{VIEW}.pinned.name") == name


def test_marks_are_drawn_sharp_at_any_magnification(chromium, folder):
    """A ring is as thin and its star as centred at 15 times as at 3, in pixels of the screen."""
    context = chromium.new_context(viewport={"width": 1000, "height": 1008}, device_scale_factor=2)
    page = context.new_page()
    page.goto((folder / "one.html").as_uri())
    widths = []
    for zoom in (3, 15):
        widths.append(
            page.evaluate(
                "async (zoom) => { const canvas = document.querySelector('#detail .stage canvas'), v = canvas.view;"
                "while (!v.box) await new Promise(requestAnimationFrame);"
                "const star = v.points.find(p => p.name === 'Canopus');"
                "v.reset(); v.centre = [star.x, star.y]; v.zoomBy(zoom);"
                "while (v.waiting) await new Promise(requestAnimationFrame);"
                "const [sx, sy] = v.screen(star.x, star.y);"
                "const row = canvas.getContext('2d').getImageData(0, Math.round(2 * sy), canvas.width, 1).data;"
                "const green = (k) => row[4 * k + 1] > row[4 * k] + 60 && row[4 * k + 1] > row[4 * k + 2] + 20;"
                "const stroke = (step) => { let first = Math.round(2 * sx); while (!green(first)) first += step;"
                "let last = first; while (green(last)) last += step; return [Math.abs(last - first), first - 2 * sx] };"
                "return [stroke(-1), stroke(1)] }", zoom,
            )
        )  # fmt: skip
    context.close()
    for (left, before), (right, after) in widths:
        assert 2 <= left <= 4 and 2 <= right <= 4  # 1.5 px, doubled
        assert abs(before + after) < 3


def test_marks_can_be_left_out(window):
    w = window()
    painted(w)
    picture = "[...document.querySelector('#detail .stage canvas').getContext('2d').getImageData(0, 0, 900, 900).data]"
    coloured = f"{picture}.filter((v, k, d) => k % 4 === 1 && v > d[k - 1] + 60).length"
    marked = w.page.evaluate(coloured)
    figure = w.page.locator("#detail figure").first
    for box in figure.get_by_role("checkbox").all():
        box.uncheck()
    painted(w)
    assert marked > 2000
    assert w.page.evaluate(coloured) < 0.02 * marked


def test_the_button_changes_the_theme_of_page_and_drawings(window):
    w = window(name="report.html")
    w.open("small.png")
    paper = "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).reduce((a, b) => a + +b, 0)"
    ground = "colour('plot')"
    light = w.page.evaluate(f"[{paper}, {ground}]")
    w.page.get_by_role("button", name="Dark theme").click()
    dark = w.page.evaluate(f"[{paper}, {ground}]")
    assert light[0] > 700 and dark[0] < 100 and light[1] != dark[1]
    w.page.reload()  # the choice is kept
    assert w.page.evaluate(f"[{paper}, {ground}]") == dark
    w.page.emulate_media(color_scheme="dark")
    w.page.get_by_role("button", name="Light theme").click()
    assert w.page.evaluate(f"[{paper}, {ground}]") == light
    w.said.remove(w.page.url.partition("#")[0])  # of the reload


def test_the_theme_changes_where_the_browser_refuses_storage(window):
    w = window()
    w.page.add_init_script(
        "const get = () => { throw new DOMException('refused', 'SecurityError') };"
        "Object.defineProperty(window, 'localStorage', { get });"
    )
    w.page.reload()
    w.page.get_by_role("button", name="Dark theme").click()
    assert w.page.get_by_role("button", name="Light theme").is_visible()
    w.said.remove(w.page.url)  # of the reload


def test_a_sector_of_the_evidence_is_described(window):
    w = window()
    card = w.page.locator("section", has=w.page.get_by_role("heading", name="Evidence by azimuth"))
    assert "No sector contradicts the position" in card.inner_text()
    canvas = card.locator("canvas[tabindex]").first
    canvas.focus()
    w.page.keyboard.press("n")
    tip = card.locator(".tip").first.inner_text()
    for words in ("Azimuth 0° to 5°", "above", "below", "for the position", "against it"):
        assert words in tip


def test_an_image_without_stars_has_no_search(window):
    w = window(name="report.html")
    w.page.evaluate("location.hash = '#i0'")
    w.page.wait_for_selector("#detail h1")
    assert w.page.locator("#detail h1").inner_text() == NASTY
    assert w.page.locator("#star-search").count() == 0  # no star table: nothing to search in
    w.page.keyboard.press("/")  # and nothing fails
