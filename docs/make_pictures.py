"""Makes the pictures of README.md and docs/ from samples, tutorials and benchmarks/results/.

    python docs/make_pictures.py [NAME ...]

Needs the extra `plots` and, for `report`, Chromium. The figures of the thesis are made by
`startrack reproduce` instead.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from PIL import ExifTags, Image

import startrack
from startrack.chain import Settings
from startrack.core.types import Array, Evidence

matplotlib.use("Agg")
from matplotlib import pyplot as plt

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / "docs/images"
SAMPLE = ROOT / "sample_images/near-wall.png"
TRUE_M = (-6900.0, 4700.0)  # near-wall.truth.json
MAX_BYTES = 300_000
WIDE_LLR = 4.0  # rows of the panel of the whole floor: they decide the sum at distances of hundreds of metres
NEAR_RAD = np.radians(3.0)  # other rows are the same at every position of the enlarged panel
PAGE_PX = "1200,1850"  # width and height of the picture of the report page
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
DARK = {"figure.facecolor": "#0c0f16", "axes.facecolor": "#0c0f16", "savefig.facecolor": "#0c0f16",
        "text.color": "#e8eaf0", "axes.labelcolor": "#c8ccd8", "xtick.color": "#a0a6b4", "ytick.color": "#a0a6b4",
        "axes.edgecolor": "#58606e", "font.size": 11}  # fmt: skip


def make_annotated(solution: Any, folder: Path) -> None:
    """The annotated picture of the sample."""
    save_webp(Image.open(folder / "near-wall.annotated.png"), "annotated", 1600, str(solution))


def make_lowell(solution: Any, folder: Path) -> None:
    """The real photograph of the samples with its stars."""
    found = startrack.identify(ROOT / "sample_images/lowell-2018-08-06.fits.bz2")
    found.write(folder)
    save_webp(Image.open(folder / "lowell-2018-08-06.annotated.png"), "lowell", width_px=1200)


def make_skyline(solution: Any, folder: Path) -> None:
    """The panorama of the sample."""
    save_webp(Image.open(folder / "near-wall.skyline.png"), "skyline", 1440, str(solution))


def make_report(solution: Any, folder: Path) -> None:
    """The upper part of the HTML page of the sample, as a browser shows it."""
    run("report", str(folder / "near-wall.fix.json"))
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise SystemExit("Chromium is not installed")
    page, picture = (folder / "near-wall.report.html").as_uri(), folder / "report.png"
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=3000"]
    subprocess.run([browser, *flags, f"--window-size={PAGE_PX}", f"--screenshot={picture}", page], check=True)
    save_webp(Image.open(picture), "report", 1200, str(solution))


def make_posterior(solution: Any, folder: Path) -> None:
    """Posterior on the whole floor, and enlarged by the stars and by all, each with its 95 % circle, and the truth.

    By all it is the normal distribution of the stated covariance, which has the errors of image and attitude.
    """
    by_stars = startrack.locate(SAMPLE, settings=Settings(evidence_sources="stars")).result.fix
    located, terrain = solution.result, solution.result.terrain
    rows, middle_m = located.evidence(), np.asarray(located.fix.position_enu_m[:2])
    horizon = terrain.horizon_rad(middle_m[None], rows.azimuth_rad)
    near = rows.take(np.abs(rows.elevation_rad - horizon.ravel()) < NEAR_RAD)
    half_m = 1.5 * by_stars.radius95_m
    panels = [
        ("Stars: crater floor (logarithm)", np.zeros(2), 10_000.0, rows.take(np.abs(rows.llr) > WIDE_LLR), None),
        ("Stars: enlarged", middle_m, half_m, near, by_stars),
        ("Stars and light of the sky", middle_m, half_m, None, located.fix),
    ]
    with plt.rc_context(DARK):
        figure, all_axes = plt.subplots(1, 3, figsize=(12, 4.0), layout="constrained")
        for axes, (title, centre_m, half, used, fix) in zip(all_axes, panels, strict=True):
            draw_posterior(axes, terrain, used, centre_m, half, fix)
            axes.set_title(title)
        save_figure(figure, "posterior", str(solution))


def draw_posterior(axes: Any, terrain: Any, rows: Evidence | None, centre_m: Array, half_m: float, fix: Any) -> None:
    """One panel: of the whole floor (`fix` None) the logarithm of the posterior, else itself, with the circle.

    Without `rows` it is the normal distribution that `fix` states.
    """
    scale, unit = (1e-3, "km") if fix is None else (1.0, "m")
    line = np.linspace(-half_m, half_m, 161)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) + centre_m
    inside = np.hypot(*points.T) < 9_990.0
    log_p = np.full(len(points), np.nan)
    log_p[inside] = log_normal(fix, points[inside]) if rows is None else log_posterior(rows, terrain, points[inside])
    log_p -= np.nanmax(log_p)
    shown = log_p if fix is None else np.exp(log_p)
    extent = np.repeat(centre_m, 2) + half_m * np.array([-1, 1, -1, 1])
    lowest = np.nanquantile(shown, 0.02)
    axes.imshow(shown.reshape(161, 161), origin="lower", extent=extent * scale, cmap="inferno", vmin=lowest)
    axes.plot(TRUE_M[0] * scale, TRUE_M[1] * scale, "+", color="#4fd1c5", ms=14, mew=2, label="true position")
    if fix is not None:
        turn = np.linspace(0, 2 * np.pi, 121)
        circle_m = np.asarray(fix.position_enu_m[:2]) + fix.radius95_m * np.stack([np.sin(turn), np.cos(turn)], -1)
        axes.plot(*circle_m.T, color="#63b3ed", lw=1.8, label=f"95 % within {fix.radius95_m:.1f} m")
        axes.legend(loc="upper left", fontsize=9)
    axes.set(xlabel=f"east, {unit}", ylabel=f"north, {unit}")
    axes.ticklabel_format(useOffset=False)
    axes.locator_params(nbins=4)


def log_normal(fix: Any, points_m: Array) -> Array:
    """Logarithm (n,), less a constant, of the normal density that a fix states at points (n, 2) [m]."""
    away_m = points_m - fix.position_enu_m[:2]
    return -0.5 * np.einsum("ni,ij,nj->n", away_m, np.linalg.inv(fix.covariance_m2), away_m)


def log_posterior(rows: Evidence, terrain: startrack.Terrain, points_m: Array) -> Array:
    """Sum of the rows' contributions at the points (n, 2) for a hard skyline; the prior is uniform."""
    total = np.zeros(len(points_m))
    for part in np.array_split(np.arange(len(points_m)), max(1, len(points_m) // 500)):
        horizon = terrain.horizon_rad(points_m[part][:, None], rows.azimuth_rad)
        total[part] = (rows.elevation_rad > horizon) @ rows.llr
    return total


def make_accuracy(solution: Any, folder: Path) -> None:
    """Position errors of the methods on the same rendered frames: the stored result of benchmarks/chain.py."""
    stored = json.loads((ROOT / "benchmarks/results/chain.json").read_text(encoding="utf-8"))
    rows = next(one["rows"] for one in stored["blocks"] if "head" in one and one["head"][0] == "position error, m")
    names = [row[0] for row in rows][::-1]
    mean, median, _, largest = np.array([[float(cell) for cell in row[1:]] for row in rows])[::-1].T
    with plt.rc_context(DARK):
        figure, axes = plt.subplots(figsize=(8, 2.6), layout="constrained")
        axes.hlines(names, median, largest, color="#58606e", lw=3)
        for values, colour, label in ((median, "#9fb0c8", "median"), (mean, "#f07a2b", "mean"),
                                      (largest, "#63b3ed", "largest")):  # fmt: skip
            axes.plot(values, names, "o", color=colour, ms=9, label=label)
        for name, one, far in zip(names, mean, largest, strict=True):
            for value, colour, side in ((one, "#f07a2b", "right"), (far, "#63b3ed", "left")):
                text = f"{value:.1f} m" if value < 100 else f"{value:.0f} m"
                axes.annotate(text, (value, name), (0, 9), textcoords="offset points", ha=side, color=colour)
        axes.set(xscale="log", xlim=(1, 4000), ylim=(-0.5, len(names) - 0.3), xlabel="position error, m (logarithmic)")
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
        save_figure(figure, "accuracy")


def make_horizon(solution: Any, folder: Path) -> None:
    """The skyline of the photograph of the samples."""
    image, site = str(ROOT / "sample_images/lowell-2018-08-06.fits.bz2"), "--site=34.7443,-111.4223,2361"
    run("horizon", image, "-c", "lowell-ldt", site, "-o", str(folder / "horizon.png"))
    save_webp(Image.open(folder / "horizon.png"), "horizon", width_px=1440)


def make_terrain(solution: Any, folder: Path) -> None:
    """Relief of the real Shackleton and the panorama from its floor, one below the other."""
    run("terrain", "show", "shackleton", "--at", "1000", "-500", "-D", str(folder))
    save_webp(Image.open(folder / "shackleton.relief.png"), "relief", width_px=800)
    save_webp(Image.open(folder / "shackleton.horizon.png"), "panorama", width_px=1440)


def run(*words: str) -> None:
    """Run a command of startrack."""
    from startrack.cli.main import main as command

    if command(list(words)) != 0:
        raise SystemExit(f"startrack {' '.join(words)} failed")


def make_tutorial(page: str, picture: str, name: str) -> None:
    """A picture that the commands of a tutorial write, made in a folder of its own."""
    sys.path.insert(0, str(ROOT / "tests"))
    from page_helpers import run_page

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        Path("sample_images").symlink_to(ROOT / "sample_images")
        run_page(ROOT / f"docs/tutorials/{page}.md")
        save_webp(Image.open(picture), name, width_px=1440)


def save_webp(image: Image.Image, name: str, width_px: int, line: str = "") -> None:
    """The image in docs/images/, at the best quality below MAX_BYTES, with the printed `line` that it shows."""
    exif = Image.Exif()
    exif[ExifTags.Base.ImageDescription] = without_time(line)
    image = image.convert("RGB")
    if image.width > width_px:
        image = image.resize((width_px, round(image.height * width_px / image.width)), Image.Resampling.LANCZOS)
    path = IMAGES / f"{name}.webp"
    for quality in range(90, 20, -5):
        image.save(path, quality=quality, method=6, exif=exif)
        if path.stat().st_size < MAX_BYTES:
            return
    raise SystemExit(f"{path} is larger than {MAX_BYTES} bytes")


def save_figure(figure: Any, name: str, line: str = "") -> None:
    figure.savefig(IMAGES / f"{name}.png", dpi=110, metadata={"Software": None, "Description": without_time(line)})
    plt.close(figure)


def without_time(line: str) -> str:
    """The line of a solution without the time that it took; tests/test_readme.py compares it with the pages."""
    return re.sub(r"  [\d.]+ s$", "", line).replace("±", "+-").replace("°", "")


PICTURES = {
    "annotated": make_annotated, "lowell": make_lowell, "skyline": make_skyline, "posterior": make_posterior,
    "report": make_report, "accuracy": make_accuracy, "horizon": make_horizon, "terrain": make_terrain,
}  # fmt: skip
TUTORIALS = {  # name: page, and the file that its commands write
    "crater": ("own-terrain", "startrack-out/crater.horizon.png"),
    "ridge": ("place-from-a-photograph", "startrack-out/ridge.skyline.png"),
    "valley": ("earth-valley", "startrack-out/night.annotated.png"),
    "lens": ("calibrate-your-camera", "my-camera.report.png"),
}


def main() -> None:
    """Make all pictures, or those named."""
    solution = startrack.locate(SAMPLE)
    with tempfile.TemporaryDirectory() as folder:
        solution.write(folder)
        for name in sys.argv[1:] or [*PICTURES, *TUTORIALS]:
            if name in TUTORIALS:
                make_tutorial(*TUTORIALS[name], name)
            else:
                PICTURES[name](solution, Path(folder))


if __name__ == "__main__":
    main()
