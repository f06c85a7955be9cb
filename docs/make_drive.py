"""Makes the animation of the landing page: a drive on the floor of Shackleton, its track beside what the camera sees.

    python docs/make_drive.py

Needs the extra `plots`. About ten minutes of CPU. A stopped run is resumed from startrack-drive/.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from astropy.table import Table
from PIL import Image

import startrack
from startrack.applications.tracking import read_odometry
from startrack.cli.main import main
from startrack.output.picture.annotate import PANEL_WIDTH, annotate

matplotlib.use("Agg")
from make_pictures import DARK, IMAGES
from matplotlib import pyplot as plt
from matplotlib.patches import Circle

OUT = Path("startrack-drive")
FRAMES, TRACK = OUT / "frames", OUT / "track"
TERRAIN = "shackleton-rendered"
WAYPOINTS = "east_m,north_m\n1500,-800\n1540,-790\n1570,-760\n1580,-715\n1610,-690\n"
DRIVE = ["--speed", "0.05", "--every", "120", "--seed", "11", "--time", "2030-06-01T00:00:00", "--faint-stars", "9"]
PICTURE_PX = 420
STEP_MS, LAST_MS = 450, 3000
MAX_BYTES = 1_500_000
ROOM_M = 12.0  # of the map, beyond the way
TRUE, DRAWN = "#cc79a7", "#f07a2b"


def drive() -> None:
    """Render the drive and estimate its track, once."""
    path = OUT / "path.csv"
    OUT.mkdir(exist_ok=True)
    path.write_text(WAYPOINTS)
    if not (FRAMES / "odometry.tum").exists():
        words = ["render", "-t", TERRAIN, "--path", str(path), *DRIVE, "-D", str(FRAMES), "--no-plots", "-q"]
        stop_unless_done(main(words), "not rendered")
    odometry = str(FRAMES / "odometry.tum")
    stop_unless_done(main(["track", str(FRAMES), "--odometry", odometry, "-D", str(TRACK), "--no-plots"]), "no track")


def stop_unless_done(code: int, message: str) -> None:
    if code != 0:
        raise SystemExit(message)


def sky_of(name: str) -> Image.Image:
    """The annotated picture of one frame without its panel."""
    kept = OUT / f"{Path(name).stem}.sky.png"
    if not kept.exists():
        picture = annotate(startrack.locate(FRAMES / name).result)
        Image.fromarray(picture[:, :-PANEL_WIDTH]).resize((PICTURE_PX, PICTURE_PX), Image.Resampling.LANCZOS).save(kept)
    return Image.open(kept)


def draw_step(table: Table, true_m: Any, k: int) -> Image.Image:
    """Map and picture after frame `k`: the positions known on the way, and the 95 % circle of the newest."""
    with plt.rc_context({**DARK, "font.size": 9}):
        size = PICTURE_PX / 100
        figure, (left, right) = plt.subplots(1, 2, figsize=(2 * size, size), dpi=100)
        figure.subplots_adjust(0.09, 0.11, 1.0, 0.99, wspace=0.02)
        left.plot(*true_m.T, color=TRUE, lw=1.2, ls="--", label="true path")
        way = np.stack([table["filtered_east_m"], table["filtered_north_m"]], axis=-1)[: k + 1]
        left.plot(*way.T, "-o", color=DRAWN, ms=3, lw=1.5, label="position by startrack")
        radii_m = np.asarray(table["filtered_radius95_m"], dtype=float)
        for place, former_m in zip(way[:-1], radii_m, strict=False):
            left.add_patch(Circle(tuple(place), former_m, fill=False, color=DRAWN, lw=0.8, alpha=0.35))
        radius_m = float(radii_m[k])
        left.add_patch(Circle(tuple(way[-1]), radius_m, fill=False, color=DRAWN, lw=2))
        left.plot([], [], "o", color=DRAWN, mfc="none", ms=9, mew=2, label="95 % circle")
        middle_m, half_m = 0.5 * (true_m.max(axis=0) + true_m.min(axis=0)), 0.5 * np.ptp(true_m, axis=0).max() + ROOM_M
        left.set(xlim=middle_m[0] + half_m * np.array([-1, 1]), ylim=middle_m[1] + half_m * np.array([-1, 1]))
        left.set(xlabel="east, m", ylabel="north, m", aspect="equal")
        left.legend(loc="upper left", frameon=False)
        left.text(0.97, 0.05, f"±{radius_m:.1f} m", transform=left.transAxes, ha="right", fontsize=30, weight="bold")
        left.text(0.97, 0.18, f"image {k + 1}", transform=left.transAxes, ha="right", fontsize=12)
        left.grid(color="#252c3a", lw=0.6)
        right.imshow(sky_of(f"{table['image'][k]}.png"))
        right.set_axis_off()
        file = io.BytesIO()
        figure.savefig(file, format="png")
        plt.close(figure)
    return Image.open(file).convert("RGB")


def save_animation(steps: list[Image.Image], path: Path) -> None:
    """An endless animated WebP at the best quality below MAX_BYTES."""
    times = [STEP_MS] * (len(steps) - 1) + [LAST_MS]
    for quality in range(80, 20, -10):
        steps[0].save(path, save_all=True, append_images=steps[1:], duration=times, loop=0, quality=quality, method=4)
        if path.stat().st_size < MAX_BYTES:
            return
    raise SystemExit(f"{path} is larger than {MAX_BYTES} bytes")


if __name__ == "__main__":
    drive()
    table = Table.read(TRACK / "track.ecsv", format="ascii.ecsv")
    true_m = read_odometry(FRAMES / "truth.tum").position_m[:, :2]
    save_animation([draw_step(table, true_m, k) for k in range(len(table))], IMAGES / "drive.webp")
