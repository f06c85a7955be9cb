"""Height maps: positions on a crater's floor, from pixels, with the true map and with a degraded one.

    python benchmarks/terrain.py [--terrain shackleton] [--frames 20] [--radius 4000]

The degraded map has errors of 5 m (s.d.) at every post, and all crests too low by a height that is 0.08 degrees at the
median crest; its file states both (height_sigma_m = 5, horizon_sigma_deg = 0.08). In the last row the crests are too
low by the same angle instead, near or far, which is not what the file states. Conditions as in chain.py; positions with
a slope below 15 degrees.
"""

from __future__ import annotations

import argparse
import pickle
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _results import table, write_section
from chain import SENSOR

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import Measured, last_value, locate
from startrack.core.types import Evidence, Fix, NoSolution
from startrack.localization import ExactPosterior
from startrack.rendering import Series, render
from startrack.terrain import HeightMap, load_terrain

NOISE_M, BIAS_RAD, SLOPE_RAD = 5.0, np.radians(0.08), np.radians(15.0)
SLOPE_ERROR_RAD = np.radians(6.0)  # errors of 5 m at posts 240 m apart tilt the ground by 1.7 degrees (s.d.)


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--terrain", default="shackleton")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--radius", type=float, default=4000.0)
    parser.add_argument("--seed", type=int, default=6)
    parser.add_argument("--no-degraded", action="store_true")
    parser.add_argument("--keep", type=Path, help="folder where the frames' evidence is kept, and taken from if there")
    args = parser.parse_args()
    rendered = load_terrain(f"{args.terrain}-rendered")
    true = replace_settings(rendered, search_radius_m=args.radius, most_slope_rad=SLOPE_RAD)
    maps = {"the map as it is": (replace_sigma(true, 0.0, 0.0), 0.0), "the errors of its -rendered file": (true, 0.0)}
    if not args.no_degraded:
        degraded = degrade_map(true, args.seed)
        low_m = BIAS_RAD * true.errors.crest_distance_m  # the camera as much too high is the same
        lower = replace_settings(degraded, camera_height_m=true.camera_height_m + low_m)
        maps |= {"degraded, and known to be": (lower, 0.0), "degraded by one angle all around": (degraded, BIAS_RAD)}
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in maps}
    for number in range(args.frames):
        evidence, position = load_or_observe(args.keep, true, args.seed, number)
        for name, (terrain, bias) in maps.items():
            rows[name].append(
                score_fix(replace(evidence, elevation_rad=evidence.elevation_rad + bias), terrain, position)
            )
            print(number, name, rows[name][-1], flush=True)
    body = summary(rows)
    print(body)
    write_section(
        f"Height maps: {args.terrain}", f"python benchmarks/terrain.py --terrain {args.terrain} --frames {args.frames}",
        ("numpy", "scipy"), body,
    )  # fmt: skip


def replace_settings(terrain: Any, **changes: Any) -> HeightMap:
    """The terrain with other settings and a horizon table of its own."""
    made = replace(terrain, **changes)
    made.prepare()
    return made


def replace_sigma(terrain: HeightMap, height_sigma_m: float, common_rad: float) -> HeightMap:
    """The same map with other stated errors."""
    return replace_settings(terrain, height_sigma_m=height_sigma_m, horizon_sigma_common_rad=common_rad)


def degrade_map(terrain: HeightMap, seed: int) -> HeightMap:
    """A map with errors at every post, which it states."""
    rng = np.random.default_rng(seed)
    maps = [
        replace(m, heights_m=(m.heights_m + rng.normal(0.0, NOISE_M, m.heights_m.shape)).astype(np.float32))
        for m in terrain.maps
    ]
    return replace_settings(
        terrain, maps=tuple(maps), height_sigma_m=NOISE_M, horizon_sigma_common_rad=BIAS_RAD,
        most_slope_rad=SLOPE_RAD + SLOPE_ERROR_RAD,
    )  # fmt: skip


def load_or_observe(folder: Path | None, terrain: HeightMap, seed: int, number: int) -> tuple[Evidence, np.ndarray]:
    """`observe_frame`, or its stored result if a file exists."""
    if folder is None:
        return observe_frame(terrain, seed, number)
    path = folder / f"{terrain.name}-{seed}-{number:03d}.pkl"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(observe_frame(terrain, seed, number)))
    found: tuple[Evidence, np.ndarray] = pickle.loads(path.read_bytes())
    return found


def observe_frame(terrain: HeightMap, seed: int, number: int) -> tuple[Evidence, np.ndarray]:
    """Evidence of one random frame, through the whole chain, and the true position."""
    camera, catalog = replace(load_camera("fisheye-2048"), sensor=SENSOR), load_catalog()
    series = Series(
        camera=camera, terrain=terrain, catalog=catalog, seed=seed, exposure_s=10.0, hot_pixels=200, cosmic_rays=30
    )
    scene, rng = series.scene(number, f"frame-{number:03d}")
    exposure, truth = render(scene, rng=rng)
    result = locate(exposure, camera, terrain, catalog)
    value = last_value(result)
    assert isinstance(value, Measured), result.message
    return value.evidence(), np.asarray(truth.position_enu_m)


def score_fix(evidence: Evidence, terrain: HeightMap, position: np.ndarray) -> dict[str, Any]:
    """Error, stated uncertainty and time of a fix."""
    start, cpu = time.perf_counter(), time.process_time()
    try:
        fix: Fix = ExactPosterior()(evidence, terrain)
        took, cpu = time.perf_counter() - start, time.process_time() - cpu
    except NoSolution as cause:
        return {"status": cause.reason}
    off = fix.position_enu_m[:2] - position[:2]
    return {
        "status": "ambiguous" if fix.ambiguous else "ok", "error_m": round(float(np.hypot(*off)), 2),
        "nees": round(float(off @ np.linalg.solve(fix.covariance_m2, off)), 2),
        "in95": bool(np.hypot(*off) < fix.radius95_m), "in999": bool(np.hypot(*off) < fix.radius999_m),
        "r95": round(fix.radius95_m, 1), "seconds": round(took, 2), "cpu": round(cpu, 2),
    }  # fmt: skip


def summary(rows: dict[str, list[dict[str, Any]]]) -> str:
    """A table: one row per map."""
    lines = []
    for name, found in rows.items():
        ok = [row for row in found if row["status"] == "ok"]
        error = np.array([row["error_m"] for row in ok])
        lines.append([
            name, f"{len(ok)} of {len(found)}", f"{error.mean():.1f}", f"{np.median(error):.1f}", f"{error.max():.1f}",
            f"{np.mean([row['nees'] for row in ok]):.2f}",
            f"{np.mean([row['r95'] for row in ok]):.0f}", f"{100 * np.mean([row['in95'] for row in ok]):.0f} %",
            f"{100 * np.mean([row['in999'] for row in ok]):.0f} %", f"{np.median([row['cpu'] for row in ok]):.2f}",
        ])  # fmt: skip
    head = ["map", "located", "mean error, m", "median", "largest", "NEES", "95 % circle, m", "in it", "in the 99.9 %",
            "CPU s, checks included"]  # fmt: skip
    return table(head, lines)


if __name__ == "__main__":
    main()
