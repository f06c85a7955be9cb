"""Positions from simulated stars against positions from pixels, of the same scenes.

    python benchmarks/simulation.py [--frames 16] [--draws 8]

Each scene is rendered once and located by its stars alone, and its evidence is drawn several times without pixels.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from _cameras import EXPOSURE_S, camera_for_share
from _map_draws import draw_position
from _results import table, write_section

from startrack.catalog import load_catalog
from startrack.chain import Located, Settings, StarFix, locate, locate_rays
from startrack.core.types import NoSolution
from startrack.localization.integrity import Integrity
from startrack.rendering import Scene, Series, render
from startrack.simulation import simulate_rays
from startrack.terrain import HeightMap, load_terrain

SEED, SHARE = 7, 0.07
FLOOR_M, FLOOR_SLOPE_RAD = 4000.0, np.radians(15.0)  # positions on height maps
TERRAINS = {"shackleton-thesis": 1, "shackleton-rendered": 2}  # with one in how many frames is measured
Row = dict[str, float]


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--draws", type=int, default=8, help="of each frame without pixels")
    args = parser.parse_args()
    lines = []
    for name, every in TERRAINS.items():
        pairs = [compare(name, number, args.draws) for number in range(args.frames // every)]
        lines += summary(name, [pair for pair in pairs if pair is not None], len(pairs))
        print(*lines[-2:], flush=True)
    head = ["terrain", "stars", "frames", "root mean squared error, m", "NEES", "95 % circle, m",
            "protection level, m (median)"]  # fmt: skip
    body = table(head, lines)
    print(body)
    command = f"python benchmarks/simulation.py --frames {args.frames} --draws {args.draws}"
    write_section("Simulated evidence against pixels", command, ("numpy", "scipy"), body)


def compare(name: str, number: int, draws: int) -> tuple[Row, list[Row]] | None:
    """Scores of one image and of its draws; None where the image or a draw is refused."""
    terrain, catalog = load_terrain(name), load_catalog()
    camera, sky = camera_for_share(SHARE)
    place: dict[str, Any] = {}
    if isinstance(terrain, HeightMap):
        at = draw_position(terrain, FLOOR_M, FLOOR_SLOPE_RAD, np.random.default_rng([SEED, number]))
        place = {"east_m": float(at[0]), "north_m": float(at[1])}
    series = Series(
        camera=camera, terrain=terrain, catalog=catalog, seed=SEED, exposure_s=EXPOSURE_S, hot_pixels=200,
        cosmic_rays=30, sky_v_mag_arcsec2=sky, **place,
    )  # fmt: skip
    scene, noise = series.scene(number)
    exposure, _ = render(scene, rng=noise)
    image = locate(exposure, camera, terrain, catalog, Settings(evidence_sources="stars"))
    if not isinstance(image, Located) or image.status != "ok":
        return None
    try:
        rng = np.random.default_rng([SEED, number])
        drawn = [locate_rays(simulate_rays(scene, catalog, rng=rng)) for _ in range(draws)]
    except NoSolution:
        return None
    return score(image, scene), [score(one, scene) for one in drawn]


def score(found: StarFix, scene: Scene) -> Row:
    """Error and stated uncertainty of a position."""
    fix, off = found.fix, (found.fix.position_enu_m - scene.position_enu_m)[:2]
    level = found.fix.integrity.protection_level_m if isinstance(found.fix.integrity, Integrity) else np.inf
    nees = float(off @ np.linalg.solve(fix.covariance_m2, off))
    return {"squared_m2": float(off @ off), "nees": nees, "circle_m": fix.radius95_m, "level_m": level}


def summary(name: str, pairs: list[tuple[Row, list[Row]]], frames: int) -> list[list[str]]:
    """Two lines of the table: of the images and of the draws."""
    images, drawn = [image for image, _ in pairs], [row for _, rows in pairs for row in rows]
    lines = []
    for word, rows in (("of pixels", images), ("simulated", drawn)):
        mean = {key: float(np.mean([row[key] for row in rows])) for key in ("squared_m2", "nees", "circle_m")}
        level = np.median([row["level_m"] for row in rows])
        of = f"{len(pairs)} of {frames}" if rows is images else str(len(rows))
        lines.append([name, word, of, f"{mean['squared_m2'] ** 0.5:.1f}", f"{mean['nees']:.2f}",
                      f"{mean['circle_m']:.1f}", f"{level:.0f}"])  # fmt: skip
    return lines


if __name__ == "__main__":
    main()
