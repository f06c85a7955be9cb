"""Waits within a process, for waits.py: the function with the name given as argument prints its cost [ms of CPU time].

Runs under the code that PYTHONPATH holds, also that of an older commit: it uses names that both have.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

SAMPLE = Path(__file__).parent.parent / "sample_images/near-wall.png"
RUNS = 15


def read_to_fix() -> None:
    """A sample image from its file to the fix, no output files."""
    from startrack import locate

    print_ms(lambda: locate(SAMPLE))


def sep_winpos() -> None:
    """sep finds the stars of the same image: background, extraction, windowed centroids."""
    import cv2
    import numpy as np
    from _star_peers import sep_winpos as find

    image = cv2.imread(str(SAMPLE), cv2.IMREAD_UNCHANGED).astype(np.float32)
    print_ms(lambda: find(image, 1.0))


def print_ms(run: Callable[[], object]) -> None:
    """The median CPU time of a call, after one that loads what it needs."""
    run()
    costs = []
    for _ in range(RUNS):
        start = time.process_time()
        run()
        costs.append(time.process_time() - start)
    print(1e3 * statistics.median(costs))


if __name__ == "__main__":
    globals()[sys.argv[1]]()
