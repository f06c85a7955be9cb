"""Many small frames in one process: memory and open files must not grow.

    python benchmarks/soak.py [--frames 10000]

One rendered 512 px frame with fresh noise each time, located again and again. Memory is the resident set after a tenth
of the frames, when caches are full, and at the end.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from _results import table, write_section

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import locate
from startrack.rendering import Series, render
from startrack.terrain import load_terrain

SEED, SIZE_PX, NOISE_ADU = 77, 512, 2.0


def main() -> None:
    """Locate the frames; write the section of RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10_000)
    count = parser.parse_args().frames
    part = SIZE_PX / 2048
    camera = load_camera("fisheye-2048")
    camera = replace(
        camera, size_px=(SIZE_PX, SIZE_PX), focal_px=tuple(part * f for f in camera.focal_px),
        centre_px=((SIZE_PX - 1) / 2,) * 2,
    )  # fmt: skip
    terrain, catalog, rng = load_terrain("shackleton-thesis"), load_catalog(), np.random.default_rng(SEED)
    scene, noise = Series(camera=camera, terrain=terrain, catalog=catalog, seed=SEED).scene(0)
    exposure, _ = render(scene, rng=noise)
    results: Counter[str] = Counter()
    seen = []
    for number in range(count):
        pixels = np.asarray(exposure.pixels_adu) + rng.normal(0.0, NOISE_ADU, exposure.pixels_adu.shape)
        results[locate(replace(exposure, pixels_adu=pixels.astype(np.float32)), camera, terrain, catalog).status] += 1
        if number in (count // 10, count - 1):
            seen.append((number + 1, resident_mb(), len(os.listdir("/proc/self/fd"))))
    body = table(["frames", "resident set, MB", "open files"], [[str(n), f"{mb:.0f}", str(fd)] for n, mb, fd in seen])
    body += "\n\nResults: " + ", ".join(f"{n} {status}" for status, n in results.most_common()) + "."
    print(body)
    write_section("Soak", f"python benchmarks/soak.py --frames {count}", ("numpy",), body)


def resident_mb() -> float:
    """Of this process (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


if __name__ == "__main__":
    main()
