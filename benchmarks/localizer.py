"""Time per fix on the thesis's lists: the exact posterior against the thesis's own method, in the same run.

    python benchmarks/localizer.py --places 300

Every method gets the same evidence (2142 stars, perfect lists) and returns a Fix; the methods alternate, so that a busy
machine affects all equally, and the ratio is the median over the rounds. The pseudo-gradient is vectorised and stops as
soon as its two sets of stars agree.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from _results import table, write_section

from startrack.applications.reproduction.simulator import (
    ASPECT_RATIO,
    MAGNITUDE,
    PERFECT,
    Sky,
    crater,
    draw_positions,
    visible_stars,
)
from startrack.core.types import Evidence, Fix
from startrack.localization import ExactPosterior, PseudoGradient

ROUNDS = 9
SEED = 11


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, default=300)
    args = parser.parse_args()
    cylinder, truth, lists = crater(ASPECT_RATIO), draw_positions(SEED, 0, 0, args.places), thesis_lists(args.places)
    methods: dict[str, tuple[Callable[..., Fix], int]] = {  # and the number of lists
        "pseudo-gradient (Kua 2008)": (PseudoGradient(), args.places),
        "posterior": (ExactPosterior(), args.places),
    }
    times: dict[str, list[float]] = {name: [] for name in methods}
    errors = {
        name: np.mean([error_m(method(e, cylinder), p) for e, p in zip(lists[:n], truth[:n], strict=True)])
        for name, (method, n) in methods.items()
    }
    for _ in range(ROUNDS):
        for name, (method, n) in methods.items():
            start = time.thread_time()
            for evidence in lists[:n]:
                method(evidence, cylinder)
            times[name].append(1e3 * (time.thread_time() - start) / n)
    thesis = np.array(next(iter(times.values())))
    rows = [
        [name, f"{np.median(ms):.2f}", f"{np.median(np.array(ms) / thesis):.2f}", f"{errors[name]:.1f}"]
        for name, ms in times.items()
    ]
    body = table(["method", "ms of CPU per fix", "ratio", "mean error, m"], rows)
    print(body)
    write_section("Localizer", f"python benchmarks/localizer.py --places {args.places}", ("numpy",), body)


def thesis_lists(count: int) -> list[Evidence]:
    """Perfect lists of one of the thesis's random skies at random positions."""
    sky, cylinder = Sky.draw(SEED, 0, MAGNITUDE), crater(ASPECT_RATIO)
    points = sky.project_to_rim_plane(cylinder)
    seen = [visible_stars(points, position, cylinder.radius_m) for position in draw_positions(SEED, 0, 0, count)]
    return [PERFECT.evidence(sky, PERFECT.draw_list(one, SEED, 0, k)) for k, one in enumerate(seen)]


def error_m(fix: Fix, position_m: np.ndarray) -> float:
    """Distance of a fix from the truth."""
    return float(np.linalg.norm(fix.position_enu_m[:2] - position_m))


if __name__ == "__main__":
    main()
