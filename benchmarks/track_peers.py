"""The track's smoother and filter beside GTSAM's iSAM2 and fixed-lag smoother, on the same observations.

    python benchmarks/track_peers.py PYTHON [--drives 5]

PYTHON is an interpreter with gtsam (`pip install gtsam`), which needs no startrack. Drives of 40 frames 50 m apart on a
map of 5 m errors per post, with simulated evidence as in drives.py.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from _drive_frames import frames_by_evidence
from _results import table, write_section
from drives import Case, course_of, odometry

from startrack.applications.tracking.odometry import Moves
from startrack.applications.tracking.positions import filter_positions
from startrack.estimation.trajectory import smooth

CASE = Case(40, 50.0, 900.0, degraded=True)
SEED = 43
WORKER = Path(__file__).with_name("_gtsam_worker.py")


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("python", help="an interpreter with gtsam")
    parser.add_argument("--drives", type=int, default=5)
    args = parser.parse_args()
    rows = []
    for number in range(args.drives):
        rows.append(compare(np.random.default_rng([SEED, number]), args.python))
        print(rows[-1], flush=True)
    mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
    most = {key: float(np.max([row[key] for row in rows])) for key in rows[0]}
    lines = [
        ["Kalman filter with posts", f"{mean['filter_m']:.2f}", "", f"{1e3 * mean['filter_s']:.1f}"],
        [
            "iSAM2, at each frame",
            f"{mean['isam2_m']:.2f}",
            f"{most['isam2_off_m']:.1e}",
            f"{1e3 * mean['isam2_s']:.1f}",
        ],
        ["fixed lag of 10 frames", f"{mean['lag_m']:.2f}", f"{most['lag_off_m']:.1e}", f"{1e3 * mean['lag_s']:.1f}"],
        ["least squares, all frames", f"{mean['smooth_m']:.2f}", "", f"{1e3 * mean['smooth_s']:.1f}"],
        ["iSAM2, at the end", f"{mean['end_m']:.2f}", f"{most['end_off_m']:.1e}", ""],
    ]
    head = ["estimator", "mean error, m", "largest difference from ours, m", "ms of CPU a frame"]
    body = table(head, lines)
    print(body)
    write_section("Tracks beside GTSAM", f"python benchmarks/track_peers.py PYTHON --drives {args.drives}",
                  ("numpy", "scipy"), body)  # fmt: skip


def compare(rng: np.random.Generator, python: str) -> dict[str, float]:
    """Mean errors and differences [m], and seconds of CPU a frame, of one drive."""
    course = course_of(CASE, rng, pixels=False)
    estimates = [frame.modes[0] for frame in frames_by_evidence(course, rng)]
    steps = odometry(CASE, course.position_m, rng)
    start = time.process_time()
    ours = smooth(estimates, steps).position_m
    middle = time.process_time()
    filtered = filter_positions([(e,) for e in estimates], [Moves.of(steps)], len(course.shared)).position_m
    end = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        given, answer = Path(folder, "in.npz"), Path(folder, "out.npz")
        ragged = {name: np.empty(len(estimates), dtype=object) for name in ("post", "by_post")}
        for k, e in enumerate(estimates):
            ragged["post"][k], ragged["by_post"][k] = e.post, e.by_post
        whole = {name: np.array([getattr(e, name) for e in estimates]) for name in ("mean", "response", "noise")}
        np.savez(given, move_m=steps.move_m, sigma_m=steps.sigma_m, **whole, **ragged)
        subprocess.run([python, WORKER, given, answer], check=True)
        peers = dict(np.load(answer))

    def error(position: np.ndarray) -> float:
        return float(np.linalg.norm(position - course.position_m, axis=1).mean())

    return {
        "smooth_m": error(ours), "filter_m": error(filtered), "end_m": error(peers["smoothed"]),
        "isam2_m": error(peers["isam2"]), "lag_m": error(peers["lag"]),
        "end_off_m": float(np.abs(peers["smoothed"] - ours).max()),
        "isam2_off_m": float(np.abs(peers["isam2"] - filtered).max()),
        "lag_off_m": float(np.abs(peers["lag"] - filtered).max()),
        "smooth_s": (middle - start) / len(ours), "filter_s": (end - middle) / len(ours),
        "isam2_s": float(peers["isam2_s"].mean()), "lag_s": float(peers["lag_s"].mean()),
    }  # fmt: skip


if __name__ == "__main__":
    main()
