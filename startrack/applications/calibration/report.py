"""Report of a calibration: a self-contained HTML page, and its picture as PNG."""

from __future__ import annotations

import base64
import html
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from startrack.applications.calibration.acceptance import star_coverage
from startrack.applications.calibration.record import arcmin_per_px, camera_summary, image_rows, summary
from startrack.applications.calibration.run import Calibration
from startrack.core.errors import how_to_install
from startrack.core.files import write_atomically

NO_PICTURE = f"no picture: it needs matplotlib, the extra plots ({how_to_install('plots')})"
STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#1b2430;background:#fff}
h1{font-size:1.6rem;margin-bottom:.2rem} h2{font-size:1.15rem;margin-top:2rem}
table{border-collapse:collapse;margin:.5rem 0;font-variant-numeric:tabular-nums;display:block;overflow-x:auto}
td,th{padding:.25rem .7rem;border-bottom:1px solid #d8dee6;text-align:right}
td:first-child,th:first-child{text-align:left}
.ok{color:#00694d;font-weight:600} .no{color:#b34700;font-weight:600} img{max-width:100%;height:auto}
pre{background:#f3f5f8;padding:.8rem;overflow-x:auto} p.lead{font-size:1.05rem}
"""


def write_report(camera_path: Path, calibration: Calibration) -> str:
    """Write NAME.report.html and, where matplotlib is installed, NAME.report.png beside the file `camera_path`.

    The files show the `calibration`. It returns the line that explains how to get the picture; empty where it is
    written.
    """
    picture = b""
    if find_spec("matplotlib") is not None:
        from startrack.applications.calibration.plots import report_png

        picture = report_png(calibration)
        write_atomically(camera_path.with_suffix(".report.png"), picture, overwrite=True)
    page = _report_html(calibration, picture)
    write_atomically(camera_path.with_suffix(".report.html"), page.encode("utf-8"), overwrite=True)
    return "" if picture else f"{camera_path.with_suffix('.report.html').name}: {NO_PICTURE}"


def _report_html(calibration: Calibration, picture: bytes) -> str:
    """The page, without scripts or other files."""
    camera = calibration.camera
    text = "accepted" if calibration.accepted else f"refused: {html.escape(calibration.message)}"
    image = (
        f'<img alt="residuals and map sigma" src="data:image/png;base64,{base64.b64encode(picture).decode()}">'
        if picture
        else f"<p>{NO_PICTURE}.</p>"
    )
    models = [
        [html.escape(c.name), str(c.parameters), f"{c.held_out_chi2:.0f}", f"{c.held_out_rms_px:.3f}"]
        for c in calibration.joint.fit.candidates
    ]
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>Calibration of {html.escape(camera.name)}</title><style>{STYLE}</style>"
        f"<h1>Calibration of {html.escape(camera.name)}</h1>"
        f'<p class="lead">{_verdict(calibration.accepted, text)}</p>'
        f"<p>{html.escape(summary(calibration, camera.name))}</p>"
        f"<h2>Acceptance checks</h2>{_checks_table(calibration)}"
        f"<h2>Residuals</h2>{image}{_rings_table(calibration)}"
        "<h2>Lens models, tested with held-out stars</h2>"
        f"{_table(['model', 'parameters', 'held-out chi²', 'held-out RMS px'], models)}"
        f"<h2>Pictures</h2>{_pictures_table(calibration)}"
        f"<h2>Throughput and sensor</h2>{_photometry_table(calibration)}"
        f"<h2>The camera</h2><pre>{html.escape(camera_summary(camera))}</pre></html>\n"
    )


def _verdict(good: bool, text: str) -> str:
    return f'<span class="{"ok" if good else "no"}">{text}</span>'


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [("th", head), *(("td", row) for row in rows)]
    texts = ["<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>" for tag, cells in lines]
    return f"<table>{''.join(texts)}</table>"


def _checks_table(calibration: Calibration) -> str:
    return _table(
        ["condition", "value", "required", "", "advice"],
        [
            [html.escape(c.name), f"{c.value:,.0f}" if c.value >= 1000 else f"{c.value:.3g}", html.escape(c.limit),
             _verdict(c.passed, "passed" if c.passed else "failed"), "" if c.passed else html.escape(c.advice)]
            for c in calibration.checks
        ],
    )  # fmt: skip


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
        f"<p>Held-out RMS distance by ring and by sector (from image right, clockwise). All stars: "
        f"{fit.held_out_rms_px:.3f} px = {fit.held_out_rms_px * scale:.2f}', chi² per degree of freedom with the "
        f"stated centroid errors {fit.chi2_per_dof:.2f}; additional error {fit.extra_sigma_px:.3f} px per axis. "
        f"{int((~fit.used).sum())} of {len(fit.used)} matches were rejected.</p>"
    )
    head = ["ring", "stars", "RMS px", "RMS '", *(f"{360 * k // sectors}°" for k in range(sectors))]
    return _table(head, rows) + note


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
    return _table(["picture", "time", "stars", "matched", "RMS px", ""], rows) + f"<p>{note}</p>"


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
    return _table(["", "measured"], rows) + (f"<ul>{notes}</ul>" if notes else "")


def _amount_text(value: float | None, unit: str) -> str:
    return "not measured" if value is None else f"{value:.4g} {unit}"
