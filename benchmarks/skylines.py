"""Skylines that `startrack horizon` measures in photographs of a fixed camera, and in sets of them: do they agree?

    python benchmarks/skylines.py PHOTOGRAPH ... [--site 34.7443 -111.4223 2361] [--fov 180] [--without 234 272 343 346]

Photographs of one fixed camera: those of the Lowell all-sky camera are in github.com/mommermi/cloudynight
(example_data/images, BSD-3-Clause), those of the MAGIC telescopes in
github.com/tudo-astroparticlephysics/all_sky_cloud_detection (tests/resources/magic_images, MIT). All pairs of single
photographs are compared, and ten random divisions into two sets. Azimuths at which something moves are left out.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from _results import table, write_section

from startrack.applications.horizon import orient_frames
from startrack.applications.horizon.measure import measure_frame, skyline_of_frames
from startrack.catalog import load_catalog
from startrack.core.types import Array, MeasuredSkyline
from startrack.exposure import read_exposure
from startrack.frames import Site

SET_SIZES, DIVISIONS = (2, 4, 7), 10


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photographs", nargs="+", type=Path)
    parser.add_argument("--site", nargs=3, type=float, default=(34.7443, -111.4223, 2361.0), help="degrees, metres")
    parser.add_argument("--fov", type=float, default=180.0, help="degrees")
    parser.add_argument("--without", nargs="*", type=int, default=(), help="azimuths from and to, degrees")
    parser.add_argument("--clear", nargs="*", default=(), help="names of photographs of clear nights")
    parser.add_argument("--section", default="Skylines of one camera")
    args = parser.parse_args()
    site = Site("earth", *np.radians(args.site[:2]), args.site[2])
    exposures = [read_exposure(path) for path in args.photographs]
    frames, _ = orient_frames(exposures, load_catalog(), site, camera=None, fov_rad=np.radians(args.fov))
    measured = [measure_frame(frame, site) for frame in frames]
    moved = np.zeros(360, dtype=bool)
    for first, last in zip(args.without[::2], args.without[1::2], strict=True):
        moved[first:last] = True

    def skyline(of: Sequence[int]) -> MeasuredSkyline:
        return skyline_of_frames([measured[i] for i in of], site)

    rng, count = np.random.default_rng(0), len(frames)
    clear = [i for i, frame in enumerate(frames) if frame.name in args.clear]
    orders = [rng.permutation(count).tolist() for _ in range(DIVISIONS)]
    compared = {"single pictures, each pair": [((i,), (j,)) for i, j in combinations(range(count), 2)]}
    compared["single clear pictures, each pair"] = [((i,), (j,)) for i, j in combinations(clear, 2)]
    for size in SET_SIZES:
        halves = [(order[:size], order[size : 2 * size]) for order in orders if 2 * size <= count]
        compared[f"two sets of {size}"] = halves
    rows = [
        [name, *row_of([(skyline(a), skyline(b)) for a, b in pairs], moved)]
        for name, pairs in compared.items() if pairs
    ]  # fmt: skip
    head = ["skylines compared", "azimuths known", "RMS of those within 3 sigma", "RMS of all", "more than 3 sigma"]
    body = f"{count} of {len(exposures)} photographs are identified.\n\n" + table(head, rows)
    print(body)
    write_section(args.section, command_of(args), ("numpy",), body)


def command_of(args: argparse.Namespace) -> str:
    """The command with these arguments, the photographs without their folder."""
    words = ["python", "benchmarks/skylines.py", *(path.name for path in args.photographs)]
    words += ["--site", *(f"{one:.10g}" for one in args.site), "--fov", f"{args.fov:g}"]
    words += ["--without", *map(str, args.without)] if args.without else []
    words += ["--clear", *args.clear] if args.clear else []
    return shlex.join([*words, "--section", args.section])


def row_of(pairs: Sequence[tuple[MeasuredSkyline, MeasuredSkyline]], moved: Array) -> list[str]:
    """Of pairs of skylines: mean number of known azimuths, and differences in sigmas of the difference.

    `moved`: azimuths (n,) that are left out of the differences.
    """
    known = np.mean([[int(one.known.sum()) for one in pair] for pair in pairs])
    both = [(a, b, a.known & b.known & ~moved) for a, b in pairs]
    z = np.concatenate([
        (a.elevation_rad - b.elevation_rad)[at] / np.hypot(a.sigma_rad, b.sigma_rad)[at] for a, b, at in both
    ])  # fmt: skip
    within = np.abs(z) < 3.0
    rms = (f"{np.sqrt(np.mean(np.square(part))):.1f}" for part in (z[within], z))
    return [f"{known:.0f}", *rms, f"{100 * np.mean(~within):.1f} %"]


if __name__ == "__main__":
    main()
