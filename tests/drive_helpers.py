"""Rendered drives of a small camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from startrack.camera import load_camera, save_camera
from startrack.cli.main import main


def render_small_drive(folder: Path, waypoints: str) -> None:
    """small.toml, and in frames/ exposures 25 m apart along `waypoints` (lines of east,north [m]), with odometry."""
    camera = load_camera("fisheye-2048")
    small = replace(camera, name="small", size_px=(1024, 1024), focal_px=(326.0, 326.0), centre_px=(511.5, 511.5))
    save_camera(small, folder / "small.toml")
    (folder / "path.csv").write_text(f"east_m,north_m\n{waypoints}\n")
    code = main([
        "render", "--path", str(folder / "path.csv"), "--speed", "0.05", "--every", "500", "--seed", "3", "-q",
        "-c", str(folder / "small.toml"), "-D", str(folder / "frames"),
    ])  # fmt: skip
    assert code == 0
