"""Detection against other programs on the same frames in the same run, and against the Cramer-Rao bound.

    python benchmarks/stars_detection.py [--frames 20] [--write]

Needs the extra `bench`; programs that are not installed are left out. Single-threaded.
"""

# ruff: noqa: E402 - the numbers of threads must be set before the libraries are imported
from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import argparse
import time
from collections import defaultdict
from dataclasses import dataclass, field
from importlib import metadata

import cv2
import numpy as np
from _results import table, write_section
from _star_frames import Frame, star_frame
from _star_peers import Finder, available_finders
from scipy.spatial import cKDTree

WIDTHS_PX = (0.6, 0.8, 1.0, 1.2, 2.0, 3.0)
MAIN_WIDTH_PX = 1.2
SNR_RANGE = (3.0, 300.0)
FAINT_BINS, BRIGHT_BINS = ((4, 5), (5, 7), (7, 10)), ((10, 20), (20, 50), (50, 100), (100, 300))
STARS = 2000
PEERS = ("numpy", "opencv-contrib-python-headless", "sep", "photutils", "tetra3rs")


@dataclass
class Tally:
    """Results of one detector on the frames of one PSF width."""

    ms_per_mpx: list[float] = field(default_factory=list)
    snr: list[np.ndarray] = field(default_factory=list)
    error: list[np.ndarray] = field(default_factory=list)  # (n, 2) px, infinite where missed
    bound: list[np.ndarray] = field(default_factory=list)
    false: int = 0
    mpx: float = 0.0

    def completeness(self, low: float, high: float) -> float:
        """Completeness [%] among isolated stars with these SNR."""
        snr, error = np.concatenate(self.snr), np.concatenate(self.error)
        return 100 * float(np.isfinite(error[(snr >= low) & (snr < high), 0]).mean())

    def rms_to_bound(self, low: float, high: float) -> float:
        """RMS centroid error per coordinate over that of stars at the bound."""
        snr, error, bound = np.concatenate(self.snr), np.concatenate(self.error), np.concatenate(self.bound)
        which = (snr >= low) & (snr < high) & np.isfinite(error[:, 0])
        return float(np.sqrt(np.mean(error[which] ** 2) / np.mean(bound[which] ** 2))) if which.any() else np.inf


def main() -> None:
    """Print the tables; with --write put them into RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--frames", type=int, default=20, help="of 4 Mpx, at the main PSF width; a quarter at the others"
    )
    parser.add_argument("--write", action="store_true", help="put the tables into RESULTS.md")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    finders = available_finders()
    body = [_main_table(finders, args.frames), _widths_table(finders, max(2, args.frames // 4))]
    print("\n\n".join(body))
    if args.write:
        packages = tuple(name for name in PEERS if _installed(name))
        write_section("Stars: detection", f"python benchmarks/stars_detection.py --frames {args.frames}", packages,
                      "\n\n".join(body))  # fmt: skip


def _installed(package: str) -> bool:
    try:
        metadata.version(package)
    except metadata.PackageNotFoundError:
        return False
    return True


def _main_table(finders: dict[str, Finder], frames: int) -> str:
    tallies = _run(finders, MAIN_WIDTH_PX, frames)
    head = ["detector", "ms per Mpx", "time against sep", "found %, SNR 4-5 / 5-7 / 7-10", "false in 4 Mpx",
            "centroid RMS / bound, SNR 10-20 / 20-50 / 50-100 / 100-300"]  # fmt: skip
    peer = np.median(tallies["sep + winpos"].ms_per_mpx) if "sep + winpos" in tallies else np.nan
    rows = [
        [name, f"{np.median(t.ms_per_mpx):.1f}", f"{np.median(t.ms_per_mpx) / peer:.2f}",
         " / ".join(f"{t.completeness(*b):.0f}" for b in FAINT_BINS), f"{4.194 * t.false / t.mpx:.2f}",
         " / ".join(f"{t.rms_to_bound(*b):.2f}" for b in BRIGHT_BINS)]
        for name, t in tallies.items()
    ]  # fmt: skip
    return f"PSF sigma {MAIN_WIDTH_PX} px, {frames} frames of 2048 x 2048 with {STARS} stars, SNR 3 to 300; stars " \
        f"with a neighbour within 8 sigma are not counted\n\n{table(head, rows)}"  # fmt: skip


def _widths_table(finders: dict[str, Finder], frames: int) -> str:
    names = [name for name in ("startrack", "startrack, nothing known", "sep + winpos") if name in finders]
    rows = []
    for width in WIDTHS_PX:
        tallies = _run({name: finders[name] for name in names}, width, frames)
        for name, t in tallies.items():
            rows.append([
                f"{width}", name, f"{t.completeness(5, 7):.0f} / {t.completeness(7, 10):.0f}",
                f"{4.194 * t.false / t.mpx:.2f}",
                " / ".join(f"{t.rms_to_bound(*b):.2f}" for b in BRIGHT_BINS), f"{np.median(t.ms_per_mpx):.1f}",
            ])  # fmt: skip
    head = [
        "PSF sigma, px",
        "detector",
        "found %, SNR 5-7 / 7-10",
        "false in 4 Mpx",
        "centroid RMS / bound",
        "ms per Mpx",
    ]
    return f"Other PSF widths, {frames} frames each\n\n{table(head, rows)}"


def _run(finders: dict[str, Finder], sigma_px: float, frames: int) -> dict[str, Tally]:
    tallies: dict[str, Tally] = defaultdict(Tally)
    for seed in range(frames):
        frame = star_frame(sigma_px, STARS, SNR_RANGE, rng=np.random.default_rng([1, seed]))
        for name, finder in finders.items():
            finder(frame.image[:512, :512], sigma_px)
            start = time.process_time()  # not the wall: other programs may be running
            found = finder(frame.image, sigma_px)
            tallies[name].ms_per_mpx.append(1e3 * (time.process_time() - start) / (frame.image.size / 1e6))
            _score(tallies[name], frame, found)
    return dict(tallies)


def _score(tally: Tally, frame: Frame, found: np.ndarray) -> None:
    error = np.full((len(frame.xy_px), 2), np.inf)
    tally.mpx += frame.image.size / 1e6
    if len(found):
        reach = 1.5 + frame.sigma_px
        distance, nearest = cKDTree(found).query(frame.xy_px)
        near = distance < reach
        error[near] = found[nearest[near]] - frame.xy_px[near]
        tally.false += int(np.count_nonzero(cKDTree(frame.xy_px).query(found)[0] > reach))
    tally.snr.append(frame.snr[frame.alone])
    tally.error.append(error[frame.alone])
    tally.bound.append(frame.bound_px[frame.alone])


if __name__ == "__main__":
    main()
