"""A folder of results as `locate` and `batch` write it, and a browser window that shows its page."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from startrack.output import write_json, write_results

NASTY = "ein <b>\"Bild\"</b> & 'mehr' </script><script>alert(1)</script> ünï✶.png"
DESKTOP, PHONE, SMALL = (1280, 800), (390, 844), (360, 740)


def results_in(out: Path, located: Any) -> Path:
    """One image solved, one ambiguous in a folder below, two refused."""
    record = write_results(located.result, out / "small.fix.json") | {"image": "small.png"}
    record["provenance"] |= {"camera": "/somewhere/else/cameras/small-fisheye.toml"}
    write_json(out / "small.fix.json", record)
    (out / "night 1").mkdir()
    modes = [
        {"east_m": 6000.0, "north_m": -2500.0, "weight": 0.75, "radius95_m": 300.0, "radius999_m": 500.0},
        {"east_m": -3000.0, "north_m": 10.0, "weight": 0.25},
    ]
    ambiguous = {key: value for key, value in record.items() if key != "position"} | {
        "image": "night 1/two.png", "status": "ambiguous", "reason": "ambiguous", "message": "two places fit",
        "modes": modes, "warnings": ["EXIF orientation 6 is not used"],
    }  # fmt: skip
    write_json(out / "night 1/two.fix.json", ambiguous)
    shutil.copy(out / "small.annotated.png", out / "night 1/two.annotated.png")
    shutil.copy(out / "small.wcs", out / "night 1/two.wcs")
    refused = {"format": "startrack.fix/1", "status": "refused"}
    write_json(out / "bad.fix.json", {**refused, "image": NASTY, "reason": "bad_image", "message": NASTY})
    write_json(out / "dark.fix.json", {**refused, "image": "dark.png", "reason": "no_stars", "message": "no star"})
    return out


class Window:
    """An open page with its messages on the console."""

    def __init__(self, chromium: Any, path: Path, size: tuple[int, int], scheme: str = "light") -> None:
        touch = size != DESKTOP
        view = {"width": size[0], "height": size[1]}
        self.context = chromium.new_context(viewport=view, color_scheme=scheme, has_touch=touch, is_mobile=touch)
        self.said: list[str] = []
        self.page = self.context.new_page()
        self.page.set_default_timeout(60_000)
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on(
            "request", lambda request: self.said.append(request.url) if "data:" not in request.url[:5] else None
        )
        self.page.goto(path.as_uri())
        self.said.remove(path.as_uri())

    def close(self, ignored: str | None = None) -> None:
        """Close the page: no error, no warning, and no request but for itself; messages with `ignored` do not count."""
        said = [text for text in self.said if ignored is None or ignored not in text]
        self.context.close()
        assert said == []

    def violations(self, axe: str) -> list[tuple[str, list[str]]]:
        """What the rules of `axe` find, with the elements."""
        self.page.evaluate(axe)
        found = self.page.evaluate("axe.run()")
        assert len(found["passes"]) > 20  # the rules have run
        return [(one["id"], [node["html"] for node in one["nodes"]]) for one in found["violations"]]

    def wait_for(self, condition: str) -> None:
        """Wait for a condition in JavaScript. (Playwright's own way polls by eval, which the page's rules forbid.)"""
        for _ in range(600):
            if self.page.evaluate(condition):
                return
            self.page.wait_for_timeout(100)
        raise AssertionError(f"never came true: {condition}")

    def open(self, name: str) -> None:
        self.page.get_by_role("link", name=name).click()
        self.page.wait_for_selector("#detail h1")

    def star_position(self, name: str) -> tuple[float, float]:
        """Position in the window of a star of the picture."""
        self.page.locator("#detail .stage canvas").first.scroll_into_view_if_needed()
        x, y = self.page.evaluate(
            "name => { const c = document.querySelector('#detail .stage canvas'); const f = c.getBoundingClientRect();"
            "const s = c.view.points.find(p => p.name === name); const [x, y] = c.view.screen(s.x, s.y);"
            "if (f.top + y > innerHeight - 40) scrollBy(0, f.top + y - innerHeight / 2);"
            "return [f.left + x, c.getBoundingClientRect().top + y]; }", name,
        )  # fmt: skip
        return x, y

    @property
    def zoom(self) -> float:
        return float(self.page.locator("#detail .stage").first.get_attribute("data-zoom"))

    def tip(self) -> str:
        return self.page.locator("#detail .tip").first.inner_text()

    def has_no_overflow(self) -> bool:
        """Whether no element extends beyond the right edge."""
        return self.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
