"""Live tracks on one core: time from an image's file to its position, and runs that are killed.

    python benchmarks/live.py [--images 12] [--kills 3] [--place NAME ...]

Frames of 2048 px, with the renderer's usual sky, are written one by one into a folder that `startrack track --follow`
watches on one core; the next one follows after the answer. The time is that from the end of writing to the printed
line; the 0.1 s for which a file must not change are in it. "CPU" is the time of the process between two lines, which
does not depend on other processes. The first images load: they do not count. Then the images come without
waiting, the command is killed (SIGKILL) at random times, and its files are compared with those of the undisturbed run.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from _results import table, write_section

from startrack.cli.main import main as run_command

WARM_UP = 2  # images
PLACES = {"shackleton-thesis": (-4000.0, 3000.0), "shackleton-rendered": (-1500.0, 1000.0)}  # start, on the floor
SPACING_M, EVERY_S = 50.0, 900.0
CORE = 0
TRACK_FILES = ("track.tum", "track.filtered.tum", "track.ecsv", "track.geojson", "track.json")
KILL_AFTER_S = 1.0, 8.0  # of each start, uniform
SEED = 7


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--place", action="append", choices=PLACES)
    args = parser.parse_args()
    rows = []
    for name in args.place or PLACES:
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder)
            render_drive(root, name, args.images)
            times_s, cpu_s = np.array(measure_times(root, root / "whole"))[WARM_UP:].T
            same = all_equal(root / "whole", kill_at_random(root, args.kills))
        rows.append([name, str(len(times_s)), f"{np.median(times_s):.2f}", f"{max(times_s):.2f}",
                     f"{np.median(cpu_s):.2f}", f"{args.kills} times: {'the same' if same else 'OTHER'}"])  # fmt: skip
        print(rows[-1], flush=True)
    body = table(["terrain", "images", "median, s", "largest, s", "CPU, s", "files after kills"], rows)
    print(body)
    if not args.place:
        write_section("Live tracks on one core", f"python benchmarks/live.py --images {args.images}",
                      ("numpy", "scipy"), body)  # fmt: skip


def render_drive(root: Path, terrain: str, images: int) -> None:
    """Images and odometry of a drive to the east in `root`/frames."""
    east, north = PLACES[terrain]
    end = east + SPACING_M * (images - 1)
    (root / "path.csv").write_text(f"east_m,north_m\n{east},{north}\n{end + 1.0},{north}\n")
    code = run_command([
        "render", "--path", str(root / "path.csv"), "--speed", str(SPACING_M / EVERY_S), "--every", str(EVERY_S), "-n",
        str(images), "--seed", str(SEED), "-q", "-t", terrain, "-D", str(root / "frames"),
    ])  # fmt: skip
    if code:
        raise SystemExit(code)


def follow(root: Path, out: Path, until_idle_s: float) -> subprocess.Popen[str]:
    """The command, on one core."""
    command = [
        "taskset", "-c", str(CORE), sys.executable, "-m", "startrack", "track", "--follow", str(root / "live"), "-D",
        str(out), "--odometry", str(root / "frames" / "odometry.tum"), "--no-plots", "--until-idle", str(until_idle_s),
    ]  # fmt: skip
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def give(root: Path, image: Path) -> None:
    """Write an image into the folder that is followed."""
    shutil.copyfile(image.with_suffix(".json"), root / "live" / image.with_suffix(".json").name)
    shutil.copyfile(image, root / "live" / image.name)


def cpu_time_s(pid: int) -> float:
    """Of a process so far."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def measure_times(root: Path, out: Path) -> list[tuple[float, float]]:
    """Seconds from each image to its line, and those of the process since the line before."""
    (root / "live").mkdir()
    images, times_s = sorted((root / "frames").glob("*.png")), []
    running = follow(root, out, 60.0)
    assert running.stdout is not None
    for image in images:
        give(root, image)
        start, before_s = time.monotonic(), cpu_time_s(running.pid)
        line = running.stdout.readline()
        times_s.append((time.monotonic() - start, cpu_time_s(running.pid) - before_s))
        print(f"{times_s[-1][0]:.2f} s, CPU {times_s[-1][1]:.2f} s  {line.strip()}", flush=True)
    time.sleep(1.0)  # files that take long are written when no image waits
    running.terminate()
    running.communicate()
    return times_s


def kill_at_random(root: Path, kills: int) -> Path:
    """The folder of a run that was killed and begun anew so often."""
    rng, out = np.random.default_rng(SEED), root / "killed"
    shutil.rmtree(root / "live")
    (root / "live").mkdir()
    images = sorted((root / "frames").glob("*.png"))
    for part in np.array_split(np.arange(len(images)), kills):
        running = follow(root, out, 60.0)
        for k in part:
            give(root, images[k])
        time.sleep(rng.uniform(*KILL_AFTER_S))
        running.kill()
        running.communicate()
        stored = len(list((out / ".frames").glob("*.npz"))) if (out / ".frames").is_dir() else 0
        print(f"killed with {stored} of {part[-1] + 1} images located", flush=True)
    follow(root, out, 30.0).communicate()  # longer than an image takes beside other processes
    return out


def all_equal(one: Path, other: Path) -> bool:
    """Whether both folders have the same files of the track."""
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in TRACK_FILES)


if __name__ == "__main__":
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    main()
