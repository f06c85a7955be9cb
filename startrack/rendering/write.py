"""The truth beside a rendered image: NAME.truth.json and NAME.truth.ecsv, for tests and scorers only."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from startrack.core.files import write_atomically
from startrack.frames import quat_xyzw_from_R
from startrack.rendering.scene import Truth

# ECSV 1.0 (astropy enhancement proposal 6), written as text: astropy.table would take longer than the rendering.
_COLUMNS = (
    ("catalog_id", "string", None, "HIP, FIELD (not in the catalogue) or the name of a body"),
    ("x_px", "float64", "pix", "at mid-exposure; (0, 0) is the centre of the top-left pixel"),
    ("y_px", "float64", "pix", "at mid-exposure"),
    ("v_mag", "float64", "mag", "as the catalogue states it"),
    ("flux_e", "float64", "electron", "whole PSF, from v_mag"),
    ("hidden", "bool", None, "the terrain hides it at mid-exposure"),
)


def truth_paths(image: str | Path) -> tuple[Path, Path]:
    """NAME.truth.json and NAME.truth.ecsv beside the image NAME.png."""
    path = Path(image)
    return path.with_name(f"{path.stem}.truth.json"), path.with_name(f"{path.stem}.truth.ecsv")


def write_truth(
    image: str | Path, truth: Truth, settings: dict[str, Any], *, to_v_mag: float, overwrite: bool = False
) -> tuple[Path, Path]:
    """Write the truth beside the image and return both paths; the table holds the sources down to `to_v_mag`.

    `settings` are further keys of the JSON file (exposure, seed, ...). Raises BadInput bad_image where a file is
    there and not `overwrite`, or cannot be written.
    """
    pose_path, table_path = truth_paths(image)
    pose = {
        "position_enu_m": truth.position_enu_m.tolist(),
        "quat_xyzw_cam_icrs": quat_xyzw_from_R(truth.R_cam_icrs).tolist(),
        "R_cam_enu": truth.R_cam_enu.tolist(),
        "sources_visible": int((~truth.hidden).sum()),
        "sources_hidden": int(truth.hidden.sum()),
        **settings,
    }
    text = json.dumps(pose, ensure_ascii=False, allow_nan=False, indent=1)
    write_atomically(pose_path, text.encode("utf-8") + b"\n", overwrite=overwrite)
    write_atomically(table_path, truth_ecsv(truth, to_v_mag).encode("utf-8"), overwrite=overwrite)
    return pose_path, table_path


def truth_ecsv(truth: Truth, to_v_mag: float) -> str:
    """The table of sources down to `to_v_mag` as the text of an ECSV file, in the order of the truth."""
    head = ["# %ECSV 1.0", "# ---", "# datatype:"]
    for name, kind, unit, description in _COLUMNS:
        unit_text = f"unit: {unit}, " if unit else ""
        head.append(f"# - {{name: {name}, {unit_text}datatype: {kind}, description: '{description}'}}")
    head += ["# schema: astropy-2.0", " ".join(name for name, *_ in _COLUMNS)]
    kept = truth.sources.v_mag <= to_v_mag
    rows = zip(
        truth.sources.catalog_id[kept].tolist(),
        truth.xy_px[kept].tolist(),
        truth.sources.v_mag[kept].tolist(),
        truth.flux_e[kept].tolist(),
        truth.hidden[kept].tolist(),
        strict=True,
    )
    body = [f'"{name}" {x:.4f} {y:.4f} {v:.4f} {flux:.6g} {hidden}' for name, (x, y), v, flux, hidden in rows]
    return "\n".join(head + body) + "\n"
