"""A reproduced table or figure, as values and as files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.applications.reproduction.drawing import png_bytes
from startrack.core.chunk_store import ChunkStore
from startrack.core.files import write_atomically
from startrack.output import Column, ecsv_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Size:
    """Amount of work: numbers of positions per sky. Smaller sizes are the first part of larger ones."""

    name: str
    skies: int  # of table 3.1 and figures B.1 to B.10
    per_sky: int
    ours_per_sky: int
    bound_per_sky: int
    deep_per_sky: int  # at magnitude 8
    one_sky: int  # of figures 3.4 and 3.10
    ours_one_sky: int
    sweep_skies: int  # per magnitude and per aspect ratio
    sweep_per_sky: int
    traverses: int

    def limit_ours(self, most: int) -> Size:
        """This size with our method on at most `most` positions per starfield, ten times as many in figure 3.10."""
        per_sky = {name: min(getattr(self, name), most) for name in ("ours_per_sky", "bound_per_sky", "deep_per_sky")}
        return replace(self, **per_sky, ours_one_sky=min(self.ours_one_sky, 10 * most))


QUICK = Size("quick", 10, 500, 60, 60, 10, 5_000, 500, 5, 12, 10)
FULL = Size("full", 10, 10_000, 10_000, 1_000, 500, 100_000, 100_000, 10, 100, 100)


@dataclass(frozen=True)
class Context:
    """The common inputs of all tables and figures."""

    size: Size
    seed: int
    store: ChunkStore[Any]  # of the fixes; see `fix_store`


@dataclass(frozen=True)
class Picture:
    """A figure and the caption below it."""

    draw: Callable[[], Figure]
    caption: str


@dataclass(frozen=True)
class Artefact:
    """One reproduced table or figure of the thesis."""

    name: str  # such as "fig3.7"
    title: str
    line: str  # the outcome in one line
    text: str  # Markdown: the table, or the caption of the figure with the comparison
    values: Mapping[str, Any]  # "thesis", "reproduced", "ours"
    columns: tuple[Column, ...] = ()
    pictures: Mapping[str, Picture] = field(default_factory=dict)  # by the stems of their files
    timing_ms: Mapping[str, float] = field(default_factory=dict)  # per fix

    @classmethod
    def of_figure(
        cls, name: str, title: str, line: str, picture: Picture, values: Mapping[str, Any], text: str = "", **more: Any
    ) -> Artefact:
        """The figure `name` with one `picture`; the `title` is put after its number.

        The `text` is the caption of the picture unless it is given. `line`, `values` and `more` are
        fields of the class.
        """
        title = f"Figure {name.removeprefix('fig')}: {title}"
        return cls(name, title, line, text or picture.caption, values, pictures={name: picture}, **more)


def write_artefact(artefact: Artefact, out: Path, *, plots: bool) -> list[Path]:
    """Write NAME.md, NAME.ecsv and, with `plots`, pictures of an `artefact` to `out`; their paths. Raises BadInput."""
    files: dict[str, bytes] = {}
    if artefact.columns:
        files[f"{artefact.name}.ecsv"] = ecsv_text(artefact.columns).encode()
    shown = artefact.pictures if plots else {}
    files |= {f"{stem}.png": png_bytes(picture.draw(), picture.caption) for stem, picture in shown.items()}
    parts = [f"## {artefact.title}", *(f"![{stem}.png]({stem}.png)" for stem in shown), artefact.text.strip()]
    files[f"{artefact.name}.md"] = ("\n\n".join(parts) + "\n").encode()
    for name, data in files.items():
        write_atomically(out / name, data, overwrite=True)
    return [out / name for name in files]


def markdown_table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Rows of cells as a Markdown table."""
    head = list(head)
    lines = [head, ["---"] * len(head), *([str(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
