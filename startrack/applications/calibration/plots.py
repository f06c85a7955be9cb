"""Picture of a calibration: residual vectors on a photograph, residuals by angle, projection sigma, sectors."""

from __future__ import annotations

import io
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.applications.calibration.acceptance import star_coverage
from startrack.applications.calibration.record import cone_rays, projection_by_angle
from startrack.applications.calibration.run import Calibration
from startrack.camera import Camera
from startrack.core.types import Array

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
