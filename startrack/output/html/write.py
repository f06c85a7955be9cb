"""The page itself: a fixed frame, its style and scripts, and the results as JSON inside it."""

from __future__ import annotations

import html
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from startrack.core import REPORTED_IMAGES
from startrack.core.errors import Reason
from startrack.core.files import write_atomically
from startrack.output.html.details import (
    Horizon,
    ground_map,
    horizon_from,
    horizon_line,
    load_or_none,
    picture_of,
    skyline_of,
)
from startrack.output.html.rows import (
    COLUMNS,
    Found,
    Position,
    errors_of,
    facts_of,
    folder_of,
    headings,
    images_with_details,
    number_of,
    row_of,
    section_of,
)
from startrack.output.html.stars import sectors_of, star_table_of
from startrack.terrain import Terrain

HERE = Path(__file__).parent
STYLES = ("page.css",)
DRAWING = ("basics.js", "view.js", "axes.js", "input.js", "theme.js")  # in every page
SCRIPTS = (
    "sky.js", "panorama.js", "picture.js", "evidence.js", "designations.js", "search.js", "map.js", "errors.js",
    "detail.js", "table.js", "page.js",
)  # fmt: skip
FEW_IMAGES = 4  # images whose details may be large
LARGE, SMALL = (1400, 4000, 1441), (1000, 1500, 721)  # px of the picture, stars, azimuths of the horizon
FILES = (".annotated.png", ".stars.ecsv", ".skyline.ecsv", ".skyline.png", ".wcs", ".corr")


def write_page(
    path: str | os.PathLike[str],
    found: Sequence[Found],
    *,
    unread: Sequence[str] = (),
    real: Mapping[str, Position] | None = None,
    images: int = REPORTED_IMAGES,
    single: bool = False,
) -> None:
    """Write the page of the results to `path`, whole or not at all. Raises BadInput where it cannot be written.

    The other arguments are those of `page_text`: `found`, `unread`, `real`, `images` and `single`.
    """
    base = _relative_url(folder_of(found[0]), Path(path).parent)
    text = page_text(found, unread=unread, real=real, images=images, single=single, base=base)
    write_atomically(path, text.encode("utf-8", "replace"), overwrite=True)


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
    names = sorted({name for one in found if (name := _terrain_name(one.record))})
    terrains = {name: terrain for name in names if (terrain := load_or_none(name)) is not None}
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
    return filled_frame(title, data, SCRIPTS)


def filled_frame(
    title: str, data: Mapping[str, Any], scripts: Sequence[str], *, style: str = "", script: str = ""
) -> str:
    """A page with a `title`, the `data` by their names, the style, and this room's DRAWING and further `scripts`.

    `style` and `script` are texts that follow those of this room.
    """
    parts = {
        "TITLE": html.escape(title),
        "STYLE": _joined(STYLES) + style,
        "DATA": "\n".join(_script_of_data(name, value) for name, value in data.items()),
        "SCRIPT": _joined(dict.fromkeys((*DRAWING, *scripts))) + script,
    }
    # Never replaced twice: a result may hold any text.
    pieces = (HERE / "page.html").read_text(encoding="utf-8").split("@@")
    return "".join(parts.get(piece, piece) for piece in pieces)


def _joined(names: Iterable[str]) -> str:
    return "".join((HERE / name).read_text(encoding="utf-8") for name in names)


def _relative_url(folder: Path, seen_from: Path) -> str:
    """Relative URL of a folder for links of a page in another; absolute where none exists (another drive)."""
    try:
        return quote(Path(os.path.relpath(folder, seen_from)).as_posix())
    except ValueError:
        return folder.absolute().as_uri()


def _detail(found: Found, terrains: Mapping[str, Terrain], size: tuple[int, int, int]) -> dict[str, Any]:
    record = found.record
    longest_px, most_stars, azimuths = size
    table = star_table_of(found.companion(".stars.ecsv"), most_stars)
    stars = None if table is None else table.shown
    horizon = _horizon(record, terrains)
    line = None if horizon is None else horizon_line(horizon, azimuths)
    horizon = None if line is None else horizon
    skyline = skyline_of(found.companion(".skyline.ecsv"), horizon, stars)
    return {
        "record": {key: value for key, value in record.items() if key not in ("matches", "detections", "camera")},
        "facts": facts_of(record),
        "picture": picture_of(found.companion(".annotated.png"), longest_px),
        "stars": stars,
        "horizon": line,
        "skyline": skyline,
        "sectors": None if table is None or horizon is None else sectors_of(table.measured, horizon),
        "files": [
            found.path.name,
            *(found.companion(end).name for end in FILES if found.companion(end).is_file()),
        ],
    }


def _horizon(record: dict[str, Any], terrains: Mapping[str, Terrain]) -> Horizon | None:
    """Horizon at the position, or at the likeliest one; None without a position or without the terrain's file."""
    modes = record.get("modes")
    position = section_of(record, "position") or (modes[0] if isinstance(modes, list) and modes else {})
    east, north = number_of(position, "east_m"), number_of(position, "north_m")
    name = _terrain_name(record)
    terrain = terrains.get(name) if name and record["status"] != "refused" else None
    if terrain is None or east is None or north is None:
        return None
    return horizon_from(terrain, east, north)


def _terrain_name(record: dict[str, Any]) -> str | None:
    name = section_of(record, "provenance").get("terrain")
    return name if isinstance(name, str) else None


def _script_of_data(name: str, value: Any) -> str:
    """A script of data: `<` is written as an escape, so that no text in it can end the script."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>'
