"""A reproduced table or figure: its values, its pictures in the thesis's colours, and its files."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.chunk_store import ChunkStore
from startrack.applications.reproduction.simulator import directions
from startrack.core.files import write_atomically
from startrack.core.types import Array
from startrack.output import Column, ecsv_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FIGURE_STYLE: dict[Any, Any] = {
    "figure.constrained_layout.use": True, "figure.dpi": 100, "axes.titlesize": 10, "legend.frameon": False
}  # fmt: skip
EDGE_COLOUR = "#1a9641"  # the thesis draws the crater's edge in green
STAR, OTHER_STAR = "#20304a", "#b9c0cc"
CENTRE = PUBLISHED = "#d7191c"  # and centres of mass in red
LABEL_STEP = 0.042  # of the axes' height, between names at the ends of curves
PALETTE_SIZE = 128  # of a PNG's palette: enough for these drawings, at a third of the size


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
    compared_per_sky: int  # by every method that the thesis names
    compared_on_map: int  # places of the map of Shackleton, each under its own sky
    compared_in_valley: int  # the same on the Earth
    compared_series: int  # places of a ground with many exposures

    def limit_our_positions(self, most: int) -> Size:
        """Copy with our method on at most `most` positions per starfield, ten times as many in figure 3.10."""
        per_sky = {name: min(getattr(self, name), most) for name in ("ours_per_sky", "bound_per_sky", "deep_per_sky")}
        return replace(self, **per_sky, ours_one_sky=min(self.ours_one_sky, 10 * most))


QUICK = Size("quick", 10, 500, 60, 60, 10, 5_000, 500, 5, 12, 10, 4, 12, 5, 8)
FULL = Size("full", 10, 10_000, 10_000, 1_000, 500, 100_000, 100_000, 10, 100, 100, 20, 40, 20, 20)


@dataclass(frozen=True)
class Context:
    """The common inputs of all tables and figures."""

    size: Size
    seed: int
    store: ChunkStore[Any]  # of the fixes; see `fix_store`


@dataclass(frozen=True)
class Picture:
    """A figure and the caption below it."""

    size_in: tuple[float, float]  # (width, height)
    draw: Callable[[Figure], None]
    caption: str

    def png(self) -> bytes:
        """The figure with its caption below, as a PNG with a palette; the same figure gives the same bytes."""
        from matplotlib import rc_context
        from matplotlib.figure import Figure
        from PIL import Image

        drawn, packed = io.BytesIO(), io.BytesIO()
        with rc_context(FIGURE_STYLE):
            figure = Figure(figsize=self.size_in)
            self.draw(figure)
            lines = textwrap.wrap(self.caption, int(13.7 * self.size_in[0]))
            figure.supxlabel("\n".join(lines), fontsize=9, x=0.02, ha="left")
            figure.savefig(drawn, format="png", metadata={"Software": None})
        picture = Image.open(drawn).convert("RGB")
        picture = picture.quantize(PALETTE_SIZE, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        picture.save(packed, format="PNG", optimize=True)
        return packed.getvalue()


@dataclass(frozen=True)
class Artefact:
    """Reproduced table or figure of the thesis."""

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
        cls, name: str, title: str, detail: str, line: str, size_in: tuple[float, float],
        draw: Callable[[Figure], None], values: Mapping[str, Any], **more: Any,
    ) -> Artefact:  # fmt: skip
        """The figure `name` with one picture of `size_in`, which `draw` draws on an empty figure.

        The `title` is put after the figure's number; the caption is both and the `detail`. `line`, `values` and `more`
        are fields of the class.
        """
        title = f"Figure {name.removeprefix('fig')}: {title}"
        picture = Picture(size_in, draw, title + detail)
        return cls(name, title, line, picture.caption, values, pictures={name: picture}, **more)


def write_artefact(artefact: Artefact, out: Path, *, plots: bool) -> list[Path]:
    """Write NAME.md, NAME.ecsv and, with `plots`, pictures of an `artefact` to `out`; their paths. Raises BadInput."""
    files: dict[str, bytes] = {}
    if artefact.columns:
        files[f"{artefact.name}.ecsv"] = ecsv_text(artefact.columns).encode()
    shown = artefact.pictures if plots else {}
    files |= {f"{stem}.png": picture.png() for stem, picture in shown.items()}
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


def fisheye_points(azimuth_rad: Array, elevation_rad: Array) -> Array:
    """Points (n, 2) of the picture: zenith distance in degrees times the horizontal direction, east to the right."""
    return np.degrees(np.pi / 2 - elevation_rad)[:, None] * directions(azimuth_rad)


def fisheye_axes(axes: Axes) -> None:
    """Equal scales, the horizon as a circle, and no tick labels, as in the thesis."""
    axes.plot(*fisheye_points(np.linspace(0.0, 2 * np.pi, 361), np.zeros(361)).T, color="0.6", linewidth=0.7)
    axes.set(aspect="equal", xlim=(-93, 93), ylim=(-93, 93), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def label_ends(axes: Axes, ends: Sequence[tuple[str, tuple[float, float], str]]) -> None:
    """Write names of curves at the right of the axes: near to their last points, clear of each other, in colours."""
    from scipy.optimize import isotonic_regression

    axes.autoscale_view()
    at = axes.transData + axes.transAxes.inverted()
    heights = [(float(at.transform(point)[1]), name, point, colour) for name, point, colour in ends]
    steps = LABEL_STEP * np.arange(len(heights))
    free = isotonic_regression(np.array([height for height, *_ in sorted(heights)]) - steps).x
    places = np.clip(free, 0.0, max(1.0 - steps[-1], 0.0)) + steps
    for place, (_, name, point, colour) in zip(places, sorted(heights), strict=True):
        line = {"arrowstyle": "-", "color": colour, "lw": 0.7, "relpos": (0.0, 0.5), "shrinkA": 1.0, "shrinkB": 0.0}
        axes.annotate(
            name, point, (1.05, place), "data", "axes fraction", color=colour, fontsize=9, va="center", arrowprops=line
        )
