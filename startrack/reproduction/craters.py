"""Figure A.2: how deep the Moon's craters are for their width."""

from __future__ import annotations

from functools import partial

import numpy as np

from startrack.output.ecsv import Column
from startrack.reproduction import published
from startrack.reproduction.artefact import Context, Piece
from startrack.reproduction.plots import STAR, new_figure, png
from startrack.types import Array


def fig_a2(context: Context) -> Piece:
    """Aspect ratios of lunar craters by diameter."""
    simple, complex_ = np.linspace(0.5, 15, 59), np.linspace(12, 275, 264)
    ratios = simple / published.simple_depth_km(simple), complex_ / published.complex_depth_km(complex_)
    shown = [f"{r.min():.2f} to {r.max():.2f}" for r in ratios]
    caption = (
        f"Figure A.2: Lunar crater aspect ratio ranges: simple craters {shown[0]} (thesis: approximately 5; axis 4.96 "
        f"to 5.14), complex craters {shown[1]} (thesis: approximately 5 to 50)."
    )
    return Piece(
        name="figA.2",
        title="Figure A.2: Lunar crater aspect ratio ranges",
        line=f"simple craters {shown[0]} (thesis 5), complex {shown[1]} (thesis 5 to 50)",
        text=caption,
        columns=(
            Column("diameter", np.concatenate([simple, complex_]), unit="km", form="%.3f"),
            Column("aspect_ratio", np.concatenate(ratios), form="%.4f", description="diameter over depth"),
            Column("craterform", ["simple"] * len(simple) + ["complex"] * len(complex_), "string"),
        ),
        pictures={"figA.2": partial(_draw_ratios, (simple, complex_), ratios, caption)},
        values={
            "thesis": {"aspect_ratios": list(published.LUNAR_ASPECT_RATIOS)},
            "reproduced": {"simple": [*map(float, (ratios[0].min(), ratios[0].max()))],
                           "complex": [*map(float, (ratios[1].min(), ratios[1].max()))]},
        },
    )  # fmt: skip


def _draw_ratios(diameters: tuple[Array, Array], ratios: tuple[Array, Array], caption: str) -> bytes:
    figure = new_figure(7.0, 8.0)
    titles = "(a) Aspect ratios for simple craterforms", "(b) Aspect ratios for complex craterforms"
    limits = ((0, 15), (4.96, 5.14)), ((0, 300), (5, 50))
    for axes, x, y, title, (xlim, ylim) in zip(figure.subplots(2, 1), diameters, ratios, titles, limits, strict=True):
        axes.plot(x, y, color=STAR)
        axes.set(xlim=xlim, ylim=ylim, xlabel="Diameter (km)", ylabel="Aspect Ratio (X:1)")
        axes.set_title(title, fontsize=10)
    return png(figure, caption)
