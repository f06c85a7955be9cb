"""Ground that differs from the shipped map by the errors that its file states: fixes from simulated rays.

    python benchmarks/map_errors.py [--terrain shackleton] [--draws 30] [--positions 10]

Each draw adds independent normal errors of `--sigma` metres to every post of the map; the result is the ground. At each
position rays of signal-to-noise ratio 1 to 4 near the skyline of that ground are located on the shipped map. The same
rays are located on the map as an exact one, too: this shows what the stated errors are needed for.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from _map_draws import draw_ground, draw_position
from _results import table, write_section

from startrack.core.types import Array, Evidence, NoSolution
from startrack.localization import ExactPosterior
from startrack.terrain import HeightMap, load_terrain

RAYS, HALF_BAND_RAD, EDGE_RAD = 2000, np.radians(3.5), np.radians(0.01)
MAX_LLR = 9.0


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--terrain", default="shackleton")
    parser.add_argument("--exact", default="shackleton-rendered", help="the same map, stated as exact")
    parser.add_argument("--draws", type=int, default=30)
    parser.add_argument("--positions", type=int, default=10, help="of each draw")
    parser.add_argument("--sigma", type=float, default=5.0, help="of the errors of posts [m]")
    parser.add_argument("--radius", type=float, default=4000.0, help="of the positions about the origin [m]")
    parser.add_argument("--slope", type=float, default=15.0, help="steepest ground of the positions [degrees]")
    parser.add_argument("--seed", type=int, default=5)
    args = parser.parse_args()
    stated, exact = load_terrain(args.terrain), load_terrain(args.exact)
    assert isinstance(stated, HeightMap)
    assert isinstance(exact, HeightMap)
    stated.prepare()
    found: dict[str, list[dict[str, Any]]] = {args.terrain: [], args.exact: []}
    for draw in range(args.draws):
        rng = np.random.default_rng([args.seed, draw])
        ground = draw_ground(stated, args.sigma, rng)
        for _ in range(args.positions):
            position = draw_position(stated, args.radius, np.radians(args.slope), rng)
            evidence = simulate_rays(ground, position, rng)
            for name, terrain in ((args.terrain, stated), (args.exact, exact)):
                found[name].append(score_fix(evidence, terrain, position))
        print(draw, *(summary(name, rows) for name, rows in found.items()), flush=True)
    head = ["terrain file", "located", "refused or ambiguous", "mean error, m", "largest", "NEES", "95 % circle, m",
            "in it", "beyond the 99.9 % circle"]  # fmt: skip
    command = f"python benchmarks/map_errors.py --draws {args.draws} --positions {args.positions}"
    body = table(head, [summary(name, rows) for name, rows in found.items()])
    print(body)
    write_section(f"Ground with errors of {args.sigma:g} m per post", command, ("numpy", "scipy"), body)


def simulate_rays(terrain: HeightMap, position: Array, rng: np.random.Generator) -> Evidence:
    """Rays spread evenly about the skyline of the ground, with the noise of photometry."""
    azimuth = rng.uniform(0, 2 * np.pi, RAYS)
    horizon = terrain.horizon_rad(position[None], azimuth)
    elevation = horizon + rng.uniform(-HALF_BAND_RAD, HALF_BAND_RAD, RAYS)
    snr = rng.uniform(1, 4, RAYS)
    light = snr * (elevation + EDGE_RAD * rng.normal(size=RAYS) > horizon) + rng.normal(size=RAYS)
    return Evidence(
        azimuth_rad=azimuth, elevation_rad=elevation, llr=np.clip(snr * light - snr**2 / 2, -MAX_LLR, MAX_LLR),
        edge_sigma_rad=np.full(RAYS, EDGE_RAD),
    )  # fmt: skip


def score_fix(evidence: Evidence, terrain: HeightMap, position: Array) -> dict[str, Any]:
    """Error and stated uncertainty of a fix, or the reason of its refusal."""
    try:
        fix = ExactPosterior()(evidence, terrain)
    except NoSolution as cause:
        return {"status": str(cause.reason)}
    if fix.ambiguous:
        return {"status": "ambiguous"}
    off = fix.position_enu_m[:2] - position
    distance = float(np.hypot(*off))
    return {
        "status": "ok", "error_m": distance, "nees": float(off @ np.linalg.solve(fix.covariance_m2, off)),
        "radius95_m": fix.radius95_m, "in95": distance < fix.radius95_m, "in999": distance < fix.radius999_m,
    }  # fmt: skip


def summary(name: str, rows: list[dict[str, Any]]) -> list[str]:
    """One line of the table."""
    ok = [row for row in rows if row["status"] == "ok"]
    if not ok:
        return [name, f"0 of {len(rows)}", str(len(rows)), *"------"]
    mean = {key: float(np.mean([row[key] for row in ok])) for key in ok[0] if key != "status"}
    return [
        name, f"{len(ok)} of {len(rows)}", str(len(rows) - len(ok)), f"{mean['error_m']:.1f}",
        f"{max(row['error_m'] for row in ok):.1f}", f"{mean['nees']:.2f}", f"{mean['radius95_m']:.0f}",
        f"{100 * mean['in95']:.0f} %", str(sum(not row["in999"] for row in ok)),
    ]  # fmt: skip


if __name__ == "__main__":
    main()
