"""Results as one HTML page that needs no server, no network and no other file.

A page is a fixed frame, its style and scripts, and the results as JSON inside it.
"""

from __future__ import annotations

import html
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from startrack.core import REPORTED_IMAGES
from startrack.core.errors import Reason, fitting_advice
from startrack.core.files import write_atomically
from startrack.core.types import BadInput
from startrack.output.html.details import (
    Horizon,
    ground_map,
    picture_of,
    round_values,
    sectors_of,
    skyline_of,
    star_table_of,
)
from startrack.output.html.rows import (
    COLUMNS,
    Found,
    Position,
    errors_of,
    facts_of,
    headings,
    images_with_details,
    row_of,
)
from startrack.output.write import COMPANIONS
from startrack.terrain import Terrain, load_terrain

HERE = Path(__file__).parent
DRAWING = ("basics.js", "view.js", "axes.js", "input.js", "theme.js")  # in every page
SCRIPTS = (
    "sky.js", "panorama.js", "picture.js", "evidence.js", "designations.js", "search.js", "map.js", "errors.js",
    "detail.js", "table.js", "page.js",
)  # fmt: skip
DRAWN_MAIN = """<noscript><p>This page draws its results with JavaScript, which is switched off here.</p></noscript>
<div id="overview" hidden></div>
<div id="detail" hidden></div>"""
FEW_IMAGES = 4  # images whose details may be large
LARGE, SMALL = (1400, 4000, 1441), (1000, 1500, 721)  # px of the picture, stars, azimuths of the horizon


def write_page(path: str | os.PathLike[str], found: Sequence[Found], **options: Any) -> None:
    """Write the page of the results `found` to `path`, whole or not at all. Raises BadInput where it cannot be written.

    `options` are the keyword arguments of `page_text`, but for `base`.
    """
    folder = found[0].folder
    try:
        base = quote(Path(os.path.relpath(folder, Path(path).parent)).as_posix())
    except ValueError:  # on another drive
        base = folder.absolute().as_uri()
    write_atomically(path, page_text(found, base=base, **options).encode("utf-8", "replace"), overwrite=True)


def page_text(
    found: Sequence[Found],
    *,
    unread: Sequence[str] = (),
    real: Mapping[str, Position] | None = None,
    images: int = REPORTED_IMAGES,
    single: bool = False,
    base: str = ".",
) -> str:
    """The page as text: the same results give the same text.

    Args:
        found: the results.
        unread: a line of text for each result that could not be read.
        real: the true (east, north) [m] of images by their stems, where a caller knows them.
        images: how many images have their details in the page.
        single: whether the page is about one image, without a list.
        base: the folder of the results, relative to the page.
    """
    real = real or {}
    terrains = {}
    for name in sorted({name for one in found if (name := one.at("provenance.terrain"))}):
        with suppress(BadInput):  # the page needs only the results: it states what is missing
            terrains[name] = load_terrain(name)
    detailed = images_with_details(found, images)
    rows = [row_of(one, real.get(one.stem), k in detailed) for k, one in enumerate(found)]
    size = LARGE if len(detailed) <= FEW_IMAGES else SMALL
    details = {k: _detail(found[k], terrains, size) for k in sorted(detailed)}
    head = {
        "columns": COLUMNS,
        "rows": rows,
        "headings": headings(),
        "single": single and len(found) == 1,
        "base": base,
        "unread": list(unread),
        "errors": errors_of(rows),
        "words": {one.value: (one.meaning, one.advice) for one in Reason if one in {row[3] for row in rows}},
        "terrains": {name: ground_map(terrain) for name, terrain in terrains.items()},
    }
    title = f"{found[0].record['image']} · startrack" if head["single"] else f"{len(found):,} images · startrack"
    data = {"results": head, **{f"detail-{k}": detail for k, detail in details.items()}}
    return fill_frame(title, data, SCRIPTS)


def fill_frame(
    title: str, data: Mapping[str, Any], scripts: Sequence[str], *, style: str = "", script: str = "",
    main: str = DRAWN_MAIN,
) -> str:  # fmt: skip
    """A page with a `title`, the `data` by their names, the style, and this room's DRAWING and further `scripts`.

    `style` and `script` are texts that follow those of this room. `main` is its content as HTML, for pages that no
    script draws.
    """
    parts = {
        "TITLE": html.escape(title),
        "MAIN": main,
        "STYLE": _join_files(["page.css"]) + style,
        "DATA": "\n".join(_script_of_data(name, value) for name, value in data.items()),
        "SCRIPT": _join_files(dict.fromkeys((*DRAWING, *scripts))) + script,
    }
    # Never replaced twice: a result may hold any text.
    pieces = (HERE / "page.html").read_text(encoding="utf-8").split("@@")
    return "".join(parts.get(piece, piece) for piece in pieces)


def _join_files(names: Iterable[str]) -> str:
    return "".join((HERE / name).read_text(encoding="utf-8") for name in names)


def _detail(found: Found, terrains: Mapping[str, Terrain], size: tuple[int, int, int]) -> dict[str, Any]:
    longest_px, most_stars, azimuths = size
    shown, stars = star_table_of(found.companion(".stars.ecsv"), most_stars)
    horizon, line, unknown = _horizon(found, terrains), None, None
    if horizon is not None:
        around_rad = np.linspace(0.0, 2 * np.pi, azimuths)  # both ends included
        elevation_rad = horizon(around_rad)
        line = round_values(np.degrees(elevation_rad), 3) if np.isfinite(elevation_rad).all() else None
        unknown_rad = terrains[found.at("provenance.terrain")].unknown_below_rad(around_rad)
        unknown = round_values(np.degrees(np.where(unknown_rad > elevation_rad, unknown_rad, np.nan)), 2)
        horizon = None if line is None else horizon  # a position off the map
    files = (found.companion(end) for end in COMPANIONS)
    return {
        "record": {k: value for k, value in found.record.items() if k not in ("matches", "detections", "camera")},
        "facts": facts_of(found.at),
        "advice": fitting_advice(str(found.record.get("message") or "")),
        "picture": picture_of(found.companion(".annotated.png"), longest_px),
        "stars": shown,
        "horizon": line,
        "unknown": unknown,
        "skyline": skyline_of(found.companion(".skyline.ecsv"), horizon, shown),
        "sectors": None if horizon is None or shown is None else sectors_of(stars, horizon),
        "files": [found.path.name, *(file.name for file in files if file.is_file())],
    }


def _horizon(found: Found, terrains: Mapping[str, Terrain]) -> Horizon | None:
    """Horizon at the position, or at the likeliest one; None without a position or without the terrain's file."""
    place = [found.at("position.east_m"), found.at("position.north_m")]
    modes, terrain = found.at("modes"), terrains.get(found.at("provenance.terrain") or "")
    if None in place and modes:
        place = [modes[0]["east_m"], modes[0]["north_m"]]
    if terrain is None or None in place or found.record["status"] == "refused":
        return None
    return lambda azimuth_rad: np.asarray(
        terrain.horizon_rad(np.broadcast_to(np.array(place), (len(azimuth_rad), 2)), azimuth_rad)
    )


def _script_of_data(name: str, value: Any) -> str:
    """A script of data: `<` is written as an escape, so that no text in it can end the script."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>'
