"""Store the outputs of the commands of one version, for benchmarks/compare_outputs.py.

    OLD/python benchmarks/store_outputs.py outputs-old --frames SCENES
    NEW/python benchmarks/store_outputs.py outputs-new --frames SCENES --batch outputs-old/frames
    NEW/python benchmarks/compare_outputs.py outputs-old outputs-new

Runs the command `startrack` that lies beside the interpreter, one process at a time, and imports nothing of the
package, so that it works with every version. OUT must be new or empty. It gets

    locate/          the rendered sample images: NAME.fix.json, NAME.stars.ecsv, NAME.wcs, NAME.corr
    identify/        the photograph with its own camera file; identify-fov/ with --fov 180 alone
    detect/          a sample image and the photograph
    calibrate/       a camera file fitted to the photograph with --fov 180
    reproduce/       the thesis's tables and figures in quick mode, seed 0
    frames/          rendered frames of 1024 px, seeds 1 to 6; with --batch nothing is rendered
    batch/           the frames, located; --batch FOLDER takes those of another version instead
    scenes/NAME/     `locate` of every image of each --frames folder; FOLDER=TERRAIN names a terrain
    frames.json      SHA-256 of each image in frames/
    commands.json    exit code and seconds of every command; log/ has stdout and stderr

Horizon tables are computed afresh in a folder of this run alone (a map takes two to three minutes), so that no version
reads those of another.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
IMAGE_SUFFIXES = (".png", ".tif", ".fits", ".bz2")
PHOTOGRAPH = "lowell-2018-08-06.fits.bz2"
SEEDS = (1, 2, 3, 4, 5, 6)
CAMERA = """format = 1
name = "fisheye-1024"
model = "kannala_brandt"
size_px = [1024, 1024]
focal_px = [326.0, 326.0]
centre_px = [511.5, 511.5]
k = [0.0, 0.0, 0.0, 0.0]
max_angle_deg = 92.5
calibrated_angle_deg = 92.0
mirrored = false

[sensor]
zero_point_e_per_s = 44000.0
gain_e_per_adu = 0.5
bias_adu = 100.0
read_noise_e = 2.5
dark_e_per_s = 0.05
saturation_adu = 65535
psf_sigma_px = 1.0
vignetting = [0.0, 0.0]
"""


class Commands:
    """Runs `startrack` and keeps exit code, stdout, stderr and time of each command in the output folder."""

    def __init__(self, out: Path, cache: str) -> None:
        """Find the command and set up an environment with one thread and a cache of its own."""
        script = Path(sys.executable).with_name("startrack")
        self.program = [str(script)] if script.exists() else [sys.executable, "-m", "startrack.cli.main"]
        one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        self.environment = {**os.environ, **one_thread, "XDG_CACHE_HOME": cache}
        self.out, self.done = out, {}
        (out / "log").mkdir(parents=True)

    def __call__(self, name: str, *words: object) -> None:
        """Run one command; its stdout goes to log/NAME.stdout (.jsonl with --json), stderr to log/NAME.stderr."""
        start = time.perf_counter()
        log = self.out / "log"
        output = log / (f"{name}.jsonl" if "--json" in words else f"{name}.stdout")
        with output.open("wb") as stdout, (log / f"{name}.stderr").open("wb") as stderr:
            # In the output folder: from a checkout, `python -m` would take the checkout's package.
            run = subprocess.run(
                [*self.program, *map(str, words)], cwd=self.out, env=self.environment, stdout=stdout, stderr=stderr
            )
        seconds = time.perf_counter() - start
        self.done[name] = {"exit_code": run.returncode, "seconds": seconds, "words": [str(word) for word in words]}
        (self.out / "commands.json").write_text(json.dumps(self.done, indent=1) + "\n", encoding="utf-8")
        print(f"{name}: exit code {run.returncode}, {seconds:.1f} s", flush=True)


def main() -> None:
    """Run all commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--repo", type=Path, default=ROOT, help="checkout with sample_images/ (that of this script)")
    parser.add_argument("--frames", nargs="+", default=[], metavar="FOLDER[=TERRAIN]", help="locate these images too")
    parser.add_argument("--batch", type=Path, metavar="FOLDER", help="frames of another version; none are rendered")
    args = parser.parse_args()
    out, samples = args.out.resolve(), args.repo.resolve() / "sample_images"
    if out.exists() and any(out.iterdir()):
        parser.error(f"{out}: not empty")
    if not (samples / PHOTOGRAPH).exists():
        parser.error(f"{samples}: no sample images")
    scenes = [(Path(folder).resolve(), terrain) for folder, _, terrain in (text.partition("=") for text in args.frames)]
    for folder, _ in scenes:
        if not images(folder):
            parser.error(f"{folder}: no images")
    with tempfile.TemporaryDirectory(prefix="startrack-store-") as cache:
        start = time.perf_counter()
        run = Commands(out, cache)
        run("version", "--version")
        store_samples(run, samples)
        run("reproduce", "reproduce", "--quick", "--seed", 0, "-j", 1, "--no-plots", "--json", "-D", out / "reproduce")
        store_batch(run, None if args.batch is None else args.batch.resolve())
        for folder, terrain in scenes:
            words = ["-t", terrain] if terrain else []
            where = out / "scenes" / folder.name
            run(f"scene-{folder.name}", "locate", "--no-plots", *words, "-D", where, *images(folder))
        print(f"all: {time.perf_counter() - start:.0f} s")


def images(folder: Path) -> list[Path]:
    """The images of a folder in the order of their names."""
    return sorted(path for path in folder.glob("*") if path.suffix in IMAGE_SUFFIXES)


def store_samples(run: Commands, samples: Path) -> None:
    """The commands for single images, on the samples."""
    photograph, rendered = samples / PHOTOGRAPH, sorted(samples.glob("*.png"))
    run("locate", "locate", "--no-plots", "-D", run.out / "locate", *rendered)
    run("identify", "identify", "--no-plots", "-D", run.out / "identify", photograph)
    run("identify-fov", "identify", "--no-plots", "--fov", 180, "-D", run.out / "identify-fov", photograph)
    run("detect", "detect", "--no-plots", "--json", "-D", run.out / "detect", rendered[0], photograph)
    camera = run.out / "calibrate/camera.toml"
    run("calibrate", "calibrate", photograph, "--fov", 180, "-o", camera, "--no-plots", "--json")


def store_batch(run: Commands, given: Path | None) -> None:
    """Render frames, unless they are given, and locate them as one batch."""
    frames = run.out / "frames" if given is None else given
    if given is None:
        frames.mkdir()
        (frames / "camera.toml").write_text(CAMERA, encoding="utf-8")
        for seed in SEEDS:
            words = ["--seed", seed, "--cosmic-rays", 30, "-D", frames]
            run(f"render-{seed}", "render", "-c", frames / "camera.toml", *words)
    hashes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in images(frames)}
    (run.out / "frames.json").write_text(json.dumps(hashes, indent=1) + "\n", encoding="utf-8")
    run("batch", "batch", "-j", 1, "--no-plots", "-D", run.out / "batch", frames)


if __name__ == "__main__":
    main()
