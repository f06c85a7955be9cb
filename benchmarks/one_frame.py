"""CPU time of one warm frame, from the file to the position, stage by stage, beside sep on the same frame.

    python benchmarks/one_frame.py [IMAGE] [--repeats 9] [--write]

One thread. The frame is located once beforehand, so that files are cached. Each repeat measures
`startrack.locate` and sep (background, extraction at 2 sigma, windowed centroids) one after the other.
"""

# ruff: noqa: E402 - the numbers of threads must be set before the libraries are imported
from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import argparse
import time
from collections.abc import Callable
from statistics import median
from typing import Any
from unittest import mock

import cv2
import numpy as np
import sep
from _results import table, write_section

import startrack
from startrack.exposure import read_exposure

SEP_THRESHOLD_SIGMA = 2.0
SEP_WINDOW_PX = 1.2  # sigma of the window of the centroids
SAMPLE = "sample_images/near-wall.png"
PACKAGES = ("numpy", "opencv-contrib-python-headless", "sep")


def main() -> None:
    """Print the tables; with --write put them into RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("image", nargs="?", default=SAMPLE)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--write", action="store_true", help="put the tables into RESULTS.md")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    first_s, _ = cpu_s(lambda: locate(args.image))
    locate(args.image)
    rows = [one_repeat(args.image) for _ in range(args.repeats)]
    body = summary(rows, first_s)
    print(body)
    if args.write:
        write_section("One frame", f"python benchmarks/one_frame.py --repeats {args.repeats}", PACKAGES, body)


def locate(image: str) -> Any:
    """The frame's solution; the stage times of the chain are CPU times here."""
    with mock.patch("time.perf_counter", time.process_time):
        solution = startrack.locate(image)
    if not solution:
        raise SystemExit(f"{image} was not located: {solution.result.message}")
    return solution


def one_repeat(image: str) -> dict[str, float]:
    """CPU milliseconds of the stages, of the whole, and of sep on the same frame."""
    read_s, exposure = cpu_s(lambda: read_exposure(image))
    total_s, solution = cpu_s(lambda: locate(image))
    stages: dict[str, float] = {"read": 1e3 * read_s}
    stages |= {name: ms for name, ms in solution.result.timing_ms.items() if name != "read"}
    stages["rest"] = 1e3 * total_s - sum(stages.values())
    sep_s, _ = cpu_s(lambda: sep_centroids(exposure.pixels_adu))
    return stages | {"total": 1e3 * total_s, "sep": 1e3 * sep_s}


def sep_centroids(pixels_adu: np.ndarray) -> np.ndarray:
    """sep's windowed centroids (n, 2) of the sources in an image (H, W)."""
    data = pixels_adu.copy()
    background = sep.Background(data)
    data -= background.back()
    found = sep.extract(data, SEP_THRESHOLD_SIGMA, err=background.globalrms)
    x, y, _ = sep.winpos(data, found["x"], found["y"], np.full(len(found), SEP_WINDOW_PX))
    return np.stack([x, y], axis=1)


def cpu_s(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of this process, and the value."""
    start = time.process_time()
    value = work()
    return time.process_time() - start, value


def summary(rows: list[dict[str, float]], first_s: float) -> str:
    """The table of medians."""
    names = list(rows[0])
    lines = [[name, f"{median(row[name] for row in rows):.0f}"] for name in names]
    ratios = [row["total"] / row["sep"] for row in rows]
    lines.append(["total over sep", f"{median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"])
    lines.append(["first frame of the process", f"{1e3 * first_s:.0f}"])
    return table(["CPU, ms", "median"], lines)


if __name__ == "__main__":
    main()
