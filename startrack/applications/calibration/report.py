"""Report of a calibration: a self-contained HTML page, and its picture as PNG."""

from __future__ import annotations

import base64
import html
import io
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.calibration.acceptance import star_coverage
from startrack.applications.calibration.record import (
    arcmin_per_px,
    camera_summary,
    cone_rays,
    image_rows,
    projection_by_angle,
)
from startrack.applications.calibration.run import Calibration
from startrack.camera import Camera
from startrack.core.errors import how_to_install
from startrack.core.files import write_atomically
from startrack.core.types import Array
from startrack.output import fill_frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PLOT_STYLE: dict[Any, Any] = {
    "figure.constrained_layout.use": True, "figure.dpi": 100, "axes.titlesize": 12, "legend.fontsize": 9,
    "figure.facecolor": "#0d1119", "axes.facecolor": "#131924", "savefig.facecolor": "#0d1119",
    "text.color": "#ecf0f5", "axes.labelcolor": "#ecf0f5", "xtick.color": "#a3afc0", "ytick.color": "#a3afc0",
    "axes.edgecolor": "#4a5668", "legend.facecolor": "#131924", "legend.edgecolor": "#4a5668",
}  # fmt: skip
PLAIN, GOOD, BAD, LINE = "#ecf0f5", "#56b4e9", "#e69f00", "#2fd3a0"
DARK_LETTERS_FROM = 0.45  # of the colour map, from which dark letters are read on it
ARROW_FRACTION = 0.02  # of the frame's width: length of an arrow of the RMS residual
MAP_SIDE = 160
BLACK, WHITE = 1.0, 99.8  # percentiles of the photograph's pixels
DIMMED = 0.5  # opacity of the photograph, on which arrows are read
MAX_ARROWS = 1000  # more overlap
NO_PICTURE = f"no picture: it needs matplotlib, the extra plots ({how_to_install('plots')})"
STYLE = """
.card table { margin: 0 0 .8rem; }
.card td, .card th { padding: .25rem .7rem; border-bottom: 1px solid var(--grid); text-align: right; }
.card td:first-child, .card th:first-child { text-align: left; font-weight: 400; }
.card thead th, .card thead th:first-child { font-weight: 600; }
.card img { display: block; max-width: 100%; height: auto; border-radius: 6px; margin-bottom: .8rem; }
@media (max-width: 52rem) { .card td, .card th { padding: .25rem .3rem; } }
pre { margin: 0; font-size: .9rem; }
"""
LEAST_CHANCE = -299.5  # log10: a smaller one is only told to be that
CHECKS = {  # of a check by its name: what the page calls it, and what it means
    "matched stars": ("stars matched", "stars of the catalogue that were found in the pictures"),
    "matched fraction": ("part of the stars that is matched", "of the stars that should be visible"),
    "log10 chance of as many matches": ("probability of as many matches by chance", "at a wrong attitude"),
    "held-out RMS [px]": ("error at stars that the fit did not see [px]", "root of the mean square distance"),
    "rings with stars": ("rings with stars", "of four rings of equal width about the middle"),
    "sectors with stars": ("sectors with stars", "of eight sectors about the middle"),
    "map sigma [px]": ("error of the lens [px]", "one sigma of a projected direction, the largest within the "
                       "calibrated angle"),
    "opposite handedness [px]": ("error of the mirror image [px]", "a mirror image that fits as well would be one"),
}  # fmt: skip


def report_png(calibration: Calibration) -> bytes:
    """The picture as PNG."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    drawn = io.BytesIO()
    with rc_context(PLOT_STYLE):
        width, height = calibration.camera.size_px
        figure = Figure(figsize=(13.0, 2.0 + 10.5 * height / width))
        axes = figure.subplots(2, 2)
        _draw_vectors(axes[0, 0], calibration)
        _draw_by_angle(axes[0, 1], calibration)
        _draw_sigma(axes[1, 0], calibration.camera)
        _draw_sectors(axes[1, 1], calibration)
        for one in axes.flat:
            one.set_box_aspect(height / width)  # panels of one size
        figure.savefig(drawn, format="png", metadata={"Software": None})
    return drawn.getvalue()


def _draw_frame(axes: Axes, camera: Camera) -> None:
    """Axes of the frame, y down, with the image circle and the calibrated radius."""
    width, height = camera.size_px
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="x px", ylabel="y px")
    for angle, style, label in (
        (camera.calibrated_angle_rad, "-", f"calibrated to {np.degrees(camera.calibrated_angle_rad):.1f}°"),
        (camera.max_angle_rad, ":", f"image circle {np.degrees(camera.max_angle_rad):.1f}°"),
    ):
        px = camera.project_unlimited(cone_rays(np.array(angle), np.linspace(0.0, 2 * np.pi, 181)))
        axes.plot(px[:, 0], px[:, 1], style, color=LINE, linewidth=1.2, label=label)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), borderaxespad=4.5, ncols=3, frameon=False)


def _draw_vectors(axes: Axes, calibration: Calibration) -> None:
    """Arrows of the residuals of all pictures, on the first of them."""
    fit, camera, frames = calibration.joint.fit, calibration.camera, calibration.joint.frames
    dark, bright = np.percentile(frames[0].exposure.pixels_adu, (BLACK, WHITE))
    axes.imshow(frames[0].exposure.pixels_adu, cmap="gray", vmin=dark, vmax=bright, alpha=DIMMED)
    if len(frames) > 1:
        axes.text(0.01, 0.98, f"on the first of {len(frames)} pictures", transform=axes.transAxes, va="top")
    px, residual = calibration.joint.points.xy_px, fit.held_out_px
    scale = ARROW_FRACTION * camera.size_px[0] / max(fit.held_out_rms_px, 1e-6)
    used = np.flatnonzero(fit.used)
    used = used[:: max(len(used) // MAX_ARROWS, 1)]
    axes.quiver(
        px[used, 0], px[used, 1], scale * residual[used, 0], scale * residual[used, 1], color=GOOD, angles="xy",
        scale_units="xy", scale=1, width=0.0016,
    )  # fmt: skip
    rejected = ~fit.used
    axes.plot(px[rejected, 0], px[rejected, 1], "x", color=BAD, markersize=5, label=f"{rejected.sum()} rejected")
    axes.set_title(f"Errors at stars not in the fit, {scale:.0f} times enlarged (RMS {fit.held_out_rms_px:.3f} px)")
    _draw_frame(axes, camera)


def _draw_by_angle(axes: Axes, calibration: Calibration) -> None:
    fit, camera, points = calibration.joint.fit, calibration.camera, calibration.joint.points
    px, residual = points.xy_px[fit.used], fit.held_out_px[fit.used]
    offset = px - np.asarray(camera.centre_px)
    outwards = offset / np.maximum(np.linalg.norm(offset, axis=1), 1e-9)[:, None]
    radial = np.sum(residual * outwards, axis=1)
    across = residual[:, 1] * outwards[:, 0] - residual[:, 0] * outwards[:, 1]
    for shown, colour, name in ((radial, GOOD, "radial"), (across, BAD, "across")):
        axes.plot(np.degrees(camera.angle_rad(px)), shown, ".", color=colour, markersize=3, label=name, alpha=0.6)
    grid = np.linspace(0.0, camera.calibrated_angle_rad, 60)
    sigma = projection_by_angle(camera, grid)[2]
    for sign in (-1, 1):
        label = "3 sigma of the lens" if sign > 0 else None
        axes.plot(np.degrees(grid), sign * 3 * sigma, color=PLAIN, linewidth=1.2, label=label)
    axes.axvline(float(np.degrees(camera.calibrated_angle_rad)), color=LINE, linewidth=1.2)
    top = 4.0 * max(fit.held_out_rms_px, 1e-3)
    axes.set(ylim=(-top, top), xlabel="angle off the axis, degrees", ylabel="error, px")
    axes.set_title("By angle off the axis: a bend shows a wrong lens model")
    axes.legend(loc="upper left", ncols=3)


def _draw_sigma(axes: Axes, camera: Camera) -> None:
    width, height = camera.size_px
    x, y = np.meshgrid(np.linspace(0, width - 1, MAP_SIDE), np.linspace(0, height - 1, MAP_SIDE * height // width))
    rays = camera.unproject(np.stack([x, y], axis=-1))
    inside = camera.angle_rad(np.stack([x, y], axis=-1)) <= camera.calibrated_angle_rad
    sigma: Array = np.ma.masked_where(~inside, camera.projection_sigma_px(rays))
    drawn = axes.imshow(sigma, extent=(-0.5, width - 0.5, height - 0.5, -0.5), cmap="viridis", interpolation="bilinear")
    axes.figure.colorbar(drawn, ax=axes, shrink=0.85, label="px per axis")
    axes.set_title("One sigma of the lens within the calibrated angle")
    _draw_frame(axes, camera)


def _draw_sectors(axes: Axes, calibration: Calibration) -> None:
    cover = star_coverage(calibration.joint)
    drawn = axes.imshow(np.ma.masked_invalid(cover.rms_px), cmap="viridis", aspect="auto", vmin=0.0)
    axes.figure.colorbar(drawn, ax=axes, shrink=0.85, label="RMS error, px")
    dark = np.nanmax(cover.rms_px) * DARK_LETTERS_FROM if np.isfinite(cover.rms_px).any() else 0.0
    for ring, row in enumerate(cover.rms_px):
        for sector, value in enumerate(row):
            text = f"{value:.2f}\n{cover.stars[ring, sector]:.0f} stars" if np.isfinite(value) else "no star"
            colour = "black" if np.isfinite(value) and value > dark else "white"
            axes.text(sector, ring, text, ha="center", va="center", fontsize=8, color=colour)
    edges = np.degrees(cover.ring_edges_rad)
    rings, sectors = cover.rms_px.shape
    axes.set_xticks(range(sectors), [f"{360 * k // sectors}°" for k in range(sectors)])
    axes.set_yticks(range(rings), [f"{a:.0f}–{b:.0f}°" for a, b in pairwise(edges)])
    axes.set(xlabel="sector, from image right, clockwise", ylabel="ring")
    axes.set_title("RMS error and number of stars by ring and sector")


def write_report(camera_path: Path, calibration: Calibration) -> str:
    """Write NAME.report.html and, where matplotlib is installed, NAME.report.png beside the file `camera_path`.

    The files show the `calibration`. It returns the line that explains how to get the picture; empty where it is
    written.
    """
    picture = b""
    if find_spec("matplotlib") is not None:
        from startrack.applications.calibration.report import report_png

        picture = report_png(calibration)
        write_atomically(camera_path.with_suffix(".report.png"), picture, overwrite=True)
    page = _report_html(calibration, picture)
    write_atomically(camera_path.with_suffix(".report.html"), page.encode("utf-8"), overwrite=True)
    return "" if picture else f"{camera_path.with_suffix('.report.html').name}: {NO_PICTURE}"


def _report_html(calibration: Calibration, picture: bytes) -> str:
    """The page in the frame of the reports, without other files."""
    camera = calibration.camera
    words = "Residuals by place and by angle, error of the lens, errors by ring and sector"
    data = base64.b64encode(picture).decode()
    image = f'<img alt="{words}" src="data:image/png;base64,{data}">' if picture else f"<p>{NO_PICTURE}.</p>"
    models = [
        [html.escape(c.name), str(c.parameters), f"{c.held_out_chi2:.0f}", f"{c.held_out_rms_px:.3f}"]
        for c in calibration.joint.fit.candidates
    ]
    scale = arcmin_per_px(camera)
    fit = calibration.joint.fit
    count = len(image_rows(calibration))
    lead = (
        f"{count} picture{'s' * (count != 1)}, {int(fit.used.sum()):,} stars: {fit.held_out_rms_px:.2f} px "
        f"({fit.held_out_rms_px * scale:.2f}') off at stars that the fit did not see; known to "
        f"{np.degrees(camera.calibrated_angle_rad):.1f}° off the axis."
    )
    refused = "" if calibration.accepted else (
        '<section class="card why refused"><h2>What to do</h2>'
        f'<p class="message">{html.escape(calibration.message)}</p></section>'
    )  # fmt: skip
    main = (
        f'<div class="title"><h1>Calibration of {html.escape(camera.name)}</h1>'
        f"{_verdict(calibration.accepted, 'accepted' if calibration.accepted else 'refused')}</div>"
        f'<p class="lead">{lead}</p>{refused}'
        + _card("Checks", _checks_table(calibration))
        + _card("Errors", image + _rings_table(calibration))
        + _card(
            "Lens models, tested with stars that the fit did not see",
            _table(["model", "parameters", "chi²", "error [px]"], models, "Lens models"),
        )
        + _card("Pictures", _pictures_table(calibration))
        + _card("Throughput and sensor", _photometry_table(calibration))
        + _card("The camera", _scroll("The camera file", f"<pre>{html.escape(camera_summary(camera))}</pre>"))
    )
    title = f"Calibration of {camera.name} · startrack"
    return fill_frame(title, {"results": {"columns": []}}, (), style=STYLE, main=main)


def _card(title: str, content: str) -> str:
    return f'<section class="card"><h2>{title}</h2>{content}</section>'


def _scroll(name: str, content: str) -> str:
    """The `content`, which scrolls inside itself, as a region with a `name`."""
    return f'<div class="scroll" tabindex="0" role="region" aria-label="{name}">{content}</div>'


def _verdict(good: bool, text: str) -> str:
    return f'<span class="badge {"ok" if good else "refused"}">{text}</span>'


def _table(head: list[str], rows: list[list[str]], name: str) -> str:
    """A table with a `name`; the first cell of a row is its heading. Without any word in the `head` it has none."""

    def row_html(cells: list[str], kind: str) -> str:
        first, *others = cells
        kind_of_first = '<th scope="row">{}</th>' if kind == "td" else '<th scope="col">{}</th>'
        rest = ("<td>{}</td>" if kind == "td" or not cell else '<th scope="col">{}</th>' for cell in others)
        return "<tr>" + kind_of_first.format(first) + "".join(map(str.format, rest, others)) + "</tr>"

    heading = f"<thead>{row_html(head, 'th')}</thead>" if any(head) else ""
    body = "".join(row_html(row, "td") for row in rows)
    return _scroll(name, f"<table>{heading}<tbody>{body}</tbody></table>")


def _checks_table(calibration: Calibration) -> str:
    rows, failed = [], not calibration.accepted
    for check in calibration.checks:
        name, meaning = CHECKS.get(check.name, (check.name, ""))
        title = f' class="tipped" title="{html.escape(meaning)}"' if meaning else ""
        value, limit = f"{check.value:,.0f}" if check.value >= 1000 else f"{check.value:.3g}", check.limit
        if check.name.startswith("log10 "):
            value = f"{'below ' if check.value <= LEAST_CHANCE else ''}1e{check.value:.0f}"
            limit = limit.replace("<= ", "<= 1e")
        limit = html.escape(limit.replace(">=", "≥").replace("<=", "≤"))
        verdict = _verdict(check.passed, "passed" if check.passed else "failed")
        row = [f"<span{title}>{html.escape(name)}</span>", verdict, value, limit]
        rows.append([*row, "" if check.passed else html.escape(check.advice)] if failed else row)
    return _table(["condition", "", "value", "required", *(["what to do"] if failed else [])], rows, "Checks")


def _rings_table(calibration: Calibration) -> str:
    cover = star_coverage(calibration.joint)
    scale = arcmin_per_px(calibration.camera)
    edges = np.degrees(cover.ring_edges_rad)
    rings, sectors = cover.stars.shape
    rows = [
        [f"{edges[k]:.0f}° to {edges[k + 1]:.0f}°", f"{cover.stars[k].sum():.0f}", _two_decimals(cover.ring_rms_px[k]),
         _two_decimals(cover.ring_rms_px[k] * scale), *map(_two_decimals, cover.rms_px[k])]
        for k in range(rings)
    ]  # fmt: skip
    fit = calibration.joint.fit
    note = (
        f"<p>Errors (RMS) at stars that the fit did not see, by ring and by sector from image right, clockwise. All: "
        f"{fit.held_out_rms_px:.3f} px = {fit.held_out_rms_px * scale:.2f}', chi² per degree of freedom with the "
        f"stated centroid errors {fit.chi2_per_dof:.2f}; additional error {fit.extra_sigma_px:.3f} px per axis. "
        f"{int((~fit.used).sum())} of {len(fit.used)} matches were rejected.</p>"
    )
    head = ["ring", "stars", "RMS px", "RMS '", *(f"{360 * k // sectors}°" for k in range(sectors))]
    return _table(head, rows, "Errors by ring and sector") + note


def _two_decimals(value: float | None) -> str:
    return f"{value:.2f}" if value is not None and np.isfinite(value) else "–"


def _pictures_table(calibration: Calibration) -> str:
    rows = [
        [html.escape(row["image"]), html.escape(row["time_utc"]), str(row["stars"]), f"{row['matched_fraction']:.2f}",
         _two_decimals(row["held_out_rms_px"]), "used"]
        for row in image_rows(calibration)
    ]  # fmt: skip
    rows += [
        [html.escape(r.name), *4 * [""], _verdict(False, html.escape(f"{r.reason}: {r.message}"))]
        for r in calibration.refused
    ]
    note = "Refraction is taken out." if calibration.is_free_of_refraction else (
        "No site on the Earth was given: of pictures taken through air this lens contains the refraction (up to half a "
        "degree at the horizon). Give --site."
    )  # fmt: skip
    head = ["picture", "time", "stars", "matched", "error [px]", ""]
    return _table(head, rows, "Pictures") + f"<p>{note}</p>"


def _photometry_table(calibration: Calibration) -> str:
    found = calibration.photometry
    rows: list[list[str]] = []
    if found.throughput is not None:
        light = found.throughput
        rows += [
            ["zero point", f"{light.zero_point_adu_per_s:.0f} ADU/s (± {light.zero_point_sigma_mag:.3f} mag)"],
            ["vignetting", f"{light.vignetting[0]:.3f}, {light.vignetting[1]:.3f}"],
            ["colour term", _amount_text(light.colour_mag, "mag per B-V")],
            ["extinction", _amount_text(light.extinction_mag, "mag per airmass")],
            ["scatter", f"{light.scatter_mag:.3f} mag, {light.stars} stars"],
        ]
    sensor = found.properties
    gain = sensor.transfer.gain_e_per_adu if sensor.transfer is not None else None
    rows += [
        ["gain (photon transfer)", _amount_text(gain, "e/ADU")],
        ["dark level", _amount_text(sensor.bias_adu, "ADU")],
        ["saturation", _amount_text(sensor.saturation_adu, "ADU")],
        ["PSF sigma", _amount_text(sensor.psf_sigma_px, "px")],
        ["PSF sigma by ring", ", ".join("–" if v is None else f"{v:.2f}" for v in sensor.psf_by_ring_px) + " px"],
        ["hot pixels", "–" if sensor.hot_px is None else str(len(sensor.hot_px))],
    ]
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in found.notes)
    return _table(["", ""], rows, "Throughput and sensor") + (f"<ul>{notes}</ul>" if notes else "")


def _amount_text(value: float | None, unit: str) -> str:
    return "not measured" if value is None else f"{value:.4g} {unit}"
