"""A large batch: throughput on one and on all cores, memory, resumption after three kills, a lost Dask worker.

    python benchmarks/batch.py [--frames 1000] [--single 150] [--folder FOLDER]

Frames of 1024 x 1024 pixels are rendered into the folder, once. Each run is the command `startrack batch`; memory is
the sum over its processes, shared pages in proportion.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from _results import table, write_section

CRATER, SIDE_PX, POLL_S = "shackleton-thesis", 1024, 0.25
TABLES = ("results.ecsv", "trajectory.tum", "manifest.json")


@dataclass
class Run:
    """Time, memory and exit code of one run of the command."""

    seconds: float
    peak_bytes: int
    code: int


def main() -> None:
    """Render, run, compare, write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--single", type=int, default=150, help="frames of the run on one core")
    parser.add_argument("--folder", type=Path, help="keep the frames and the results there")
    parser.add_argument("--no-write", action="store_true", help="leave RESULTS.md as it is")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.folder or Path(scratch)
        images = render_frames(folder, args.frames)
        rows, notes = measure_runs(folder, images, args.single)
    body = table(["run", "frames", "seconds", "frames a second", "peak memory, GB"], rows) + "\n\n" + "\n".join(notes)
    print(body)
    if args.no_write:
        return
    command = f"python benchmarks/batch.py --frames {args.frames} --single {args.single}"
    write_section("A night of images", command, ("numpy", "opencv-contrib-python-headless", "dask"), body)


def measure_runs(folder: Path, images: list[Path], single: int) -> tuple[list[list[str]], list[str]]:
    """All runs; rows of the table, and notes of the comparisons."""
    cores = len(os.sched_getaffinity(0))
    first = images[:single]
    run(folder, first[:2], folder / "warm", 1)  # loads files and makes tables
    one = run(folder, first, folder / "one", 1)
    both = run(folder, first, folder / "both", cores)
    whole = run(folder, images, folder / "whole", cores)
    killed = run_with_kills(folder, images, folder / "killed", cores, whole.seconds)
    cluster, lost = run_on_cluster(folder, first, folder / "cluster", cores)
    solved = (folder / "whole" / "results.ecsv").read_text().count(".png,ok,")
    rows = [
        row("one core", len(first), one), row(f"{cores} cores", len(first), both),
        row(f"{cores} cores, all", len(images), whole), row("the same, killed three times", len(images), killed),
        row(f"Dask, {cores} workers, one killed", len(first), cluster),
    ]  # fmt: skip
    notes = [
        f"Located: {solved} of {len(images)}.",
        f"Throughput of {cores} cores: {one.seconds / both.seconds:.2f} times that of one.",
        f"Killed (-9) three times and taken up again: {compare_tables(folder / 'whole', folder / 'killed')}.",
        f"Dask, worker {lost} killed: {compare_tables(folder / 'both', folder / 'cluster')} as by the local run.",
    ]
    return rows, notes


def render_frames(folder: Path, count: int) -> list[Path]:
    """Render the frames that do not exist yet; the paths of all."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    paths = [folder / "images" / f"{k // 100:02d}" / f"frame-{k:04d}.png" for k in range(count)]
    todo = [(path, k) for k, path in enumerate(paths) if not path.with_suffix(".json").exists()]
    with ProcessPoolExecutor() as pool:
        for _ in pool.map(render_one, *zip(*todo, strict=True), chunksize=8) if todo else ():
            pass
    return paths


def render_one(path: Path, number: int) -> None:
    """One frame with its sidecar and the camera's file."""
    from startrack.camera import load_camera, save_camera
    from startrack.catalog import load_catalog
    from startrack.exposure import write_exposure, write_sidecar
    from startrack.rendering import Series, render
    from startrack.terrain import load_terrain

    scale, middle = SIDE_PX / 2048, (SIDE_PX - 1) / 2
    camera = replace(
        load_camera("fisheye-2048"), name=f"fisheye-{SIDE_PX}", size_px=(SIDE_PX, SIDE_PX),
        focal_px=(652.0 * scale, 652.0 * scale), centre_px=(middle, middle),
    )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.parent / "camera.toml"
    if not file.exists():
        save_camera(camera, file)
    series = Series(
        camera=camera, terrain=load_terrain(CRATER), catalog=load_catalog(), seed=1000, hot_pixels=100,
        camera_ref=str(file), terrain_ref=CRATER, faint_v_mag=8.5,
    )  # fmt: skip
    scene, rng = series.scene(number, path.stem)
    exposure, _ = render(scene, rng=rng)
    write_exposure(path, exposure)
    write_sidecar(path, exposure)


def start(folder: Path, images: list[Path], out: Path, *flags: str) -> subprocess.Popen[str]:
    """Start the command."""
    command = [sys.executable, "-m", "startrack.cli.main", "batch", str(folder / "images"), "-D", str(out), *flags]
    process = subprocess.Popen([*command, "--no-plots", "--files-on-stdin", "-q"], stdin=subprocess.PIPE, text=True)
    assert process.stdin is not None
    process.stdin.write("".join(f"{path}\n" for path in images))
    process.stdin.close()
    return process


def run(folder: Path, images: list[Path], out: Path, jobs: int) -> Run:
    """Run the command to its end."""
    return watch(start(folder, images, out, "-j", str(jobs)))


def watch(
    process: subprocess.Popen[str], most_s: float = np.inf, top: int | None = None, each: Callable[[], None] = int
) -> Run:
    """Time of a process, and the peak memory of the processes below `top` (itself); killed with -9 after `most_s`.

    `each` is called at every poll.
    """
    begin, peak = time.perf_counter(), 0
    while process.poll() is None:
        peak = max(peak, sum(map(resident_bytes, process_family(top or process.pid))))
        if time.perf_counter() - begin > most_s:
            os.kill(process.pid, signal.SIGKILL)
        each()
        time.sleep(POLL_S)
    return Run(time.perf_counter() - begin, peak, process.wait())


def run_with_kills(folder: Path, images: list[Path], out: Path, jobs: int, usual_s: float) -> Run:
    """Run the command, killed at three random times and resumed."""
    rng, runs = np.random.default_rng(9), []
    for _ in range(3):
        runs.append(watch(start(folder, images, out, "-j", str(jobs)), float(rng.uniform(0.1, 0.3) * usual_s)))
    runs.append(run(folder, images, out, jobs))
    return Run(sum(r.seconds for r in runs), max(r.peak_bytes for r in runs), runs[-1].code)


def run_on_cluster(folder: Path, images: list[Path], out: Path, workers: int) -> tuple[Run, int]:
    """Run the command on a Dask scheduler, one of whose workers is killed meanwhile."""
    from distributed import LocalCluster

    killed: list[int] = []
    with LocalCluster(workers, processes=True, threads_per_worker=1, dashboard_address=None) as cluster:

        def kill_one() -> None:
            if not killed and sum(1 for _ in out.rglob("*.fix.json")) > len(images) // 3:
                killed.append(next(iter(cluster.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)

        process = start(folder, images, out, "--cluster", cluster.scheduler_address)
        return watch(process, top=os.getpid(), each=kill_one), killed[0]


def process_family(pid: int) -> list[int]:
    """The process and all below it (Linux)."""
    found = [pid]
    for parent in found:
        try:
            found += map(int, Path(f"/proc/{parent}/task/{parent}/children").read_text().split())
        except OSError:
            continue  # it has ended
    return found


def resident_bytes(pid: int) -> int:
    """Memory that the process holds; shared pages in proportion."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0  # it has ended
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:"))


def compare_tables(one: Path, other: Path) -> str:
    """Whether two runs gave the same tables, byte for byte."""
    differ = [name for name in TABLES if (one / name).read_bytes() != (other / name).read_bytes()]
    return f"differ in {', '.join(differ)}" if differ else f"the same bytes in {', '.join(TABLES)}"


def row(name: str, frames: int, took: Run) -> list[str]:
    """One line of the table."""
    assert took.code in (0, 5), f"{name}: exit code {took.code}"
    return [
        name, str(frames), f"{took.seconds:.0f}", f"{frames / took.seconds:.2f}", f"{took.peak_bytes / 1e9:.2f}",
    ]  # fmt: skip


if __name__ == "__main__":
    main()
