"""A rover at rest by stars alone: what the stated error of the map and the catalogue's magnitudes cost.

    python benchmarks/rests.py [--rests 20]

Exposures 12 hours apart on real Shackleton, with simulated evidence as in drives.py, in one posterior as
`startrack track --at-rest` has it. The ground is the map, or differs from it by 1 m of white noise at each post. The
map states an error of its posts, which need not be the true one. Errors of magnitudes belong to the star, as in a real
catalogue, or are drawn anew for each exposure. The position is by the first 4 exposures, and by 12.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np
from _drive_frames import FLUX_SCATTER, draw_course, simulate_evidence
from _map_draws import draw_ground
from _results import table, write_section
from drives import RADIUS_M, SLOPE_RAD, mean_error_and_nees

from startrack.applications.tracking import ObservedFrame, TrackErrors
from startrack.applications.tracking.frame_estimate import estimate_frame
from startrack.applications.tracking.positions import positions_at_rest
from startrack.catalog import load_catalog
from startrack.terrain import HeightMap, load_terrain

EXPOSURES, EVERY_S = (4, 12), 12 * 3600.0
FIRST_ERROR_M, FIRST_SIGMA_M = 7.0, 8.0  # of the first guess of each exposure, in place of a search
SEED = 41


@dataclass(frozen=True)
class Case:
    """Errors of the ground, of what the map states, and whether those of magnitudes belong to the stars."""

    post_m: float
    stated_m: float
    of_stars: bool = True


CASES = (Case(0.0, 1.0), Case(0.0, 0.4), Case(0.0, 0.1), Case(1.0, 1.0), Case(0.0, 1.0, of_stars=False))


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rests", type=int, default=20)
    args = parser.parse_args()
    exact = load_terrain("shackleton-rendered")
    assert isinstance(exact, HeightMap)
    exact.prepare()
    lines = []
    for case in CASES:
        stated = replace(exact, height_sigma_m=case.stated_m)
        rows = [score_rest(case, exact, stated, np.random.default_rng([SEED, k])) for k in range(args.rests)]
        means = np.mean(rows, axis=0)
        lines.append([
            f"{case.post_m:g}", f"{case.stated_m:g}", "the star" if case.of_stars else "the exposure",
            *(f"{x:.2f}" for x in means.ravel()),
        ])  # fmt: skip
        print(lines[-1], flush=True)
    head = ["posts wrong by, m", "stated, m", "magnitudes of"]
    head += [text for count in EXPOSURES for text in (f"{count} exposures, m", "NEES")]
    body = table(head, lines)
    print(body)
    write_section("Rests by stars", f"python benchmarks/rests.py --rests {args.rests}", ("numpy", "scipy"), body)


def score_rest(case: Case, exact: HeightMap, stated: HeightMap, rng: np.random.Generator) -> list[list[float]]:
    """Error [m] and NEES of the position by the first exposures, for each number of them."""
    ground = draw_ground(exact, case.post_m, rng) if case.post_m else exact
    course = draw_course(
        ground, exact, 0.0, frames=max(EXPOSURES), spacing_m=0.0, every_s=EVERY_S, radius_m=RADIUS_M,
        slope_rad=SLOPE_RAD, rng=rng,
    )  # fmt: skip
    catalog = load_catalog()
    sigma_mag = np.hypot(catalog.v_sigma_mag, FLUX_SCATTER)
    error_mag, frames = rng.normal(size=len(catalog)) * sigma_mag, []
    shared = TrackErrors.of(stated, None)
    for number, (position, when) in enumerate(zip(course.position_m, course.time_utc, strict=True)):
        own = error_mag if case.of_stars else rng.normal(size=len(catalog)) * sigma_mag
        rows = simulate_evidence(course, position, when, own, rng)
        at = position + FIRST_ERROR_M * rng.normal(size=2)
        estimate = estimate_frame(rows, stated, shared, at, FIRST_SIGMA_M**2 * np.eye(2))
        frames.append(ObservedFrame(f"frame-{number:03d}", when, None, (estimate,), rows))
    by_first = positions_at_rest(frames, stated, shared)[1]
    position, covariance = by_first.position_m, by_first.covariance_m2
    used = [count - 1 for count in EXPOSURES]
    return [mean_error_and_nees(position[k : k + 1], covariance[k : k + 1], course.position_m[:1]) for k in used]


if __name__ == "__main__":
    main()
