"""The diffuse light of the sky as evidence of the position, beside the stars.

    python benchmarks/sky_light.py [--frames 24] [--hazards 12]

Rendered frames of the thesis's crater and of Shackleton's floor, located with the stars alone, with the sky's light
alone and with both; the cases of one terrain have the same poses. Then frames with light and shadow that no file
states, in turn with a sky of 7 and of 90 %. A number of 0 leaves a table out, and then nothing is written. Takes an
hour on two cores.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from _cameras import EXPOSURE_S, camera_for_share
from _results import table, write_section
from _sky_hazards import HAZARDS
from _sky_scenes import SEED, bend_camera, degraded_map, map_of_floor, raised_map, uneven_crater  # fmt: skip
from _sky_view import expose

from startrack.camera import Camera
from startrack.catalog import load_catalog
from startrack.chain import Located, Settings, locate
from startrack.core.types import Array, Exposure
from startrack.rendering import Series, render
from startrack.terrain import Cylinder, Terrain, load_terrain

SOURCES = ("stars", "sky", "both")
HAZARD_SOURCES = ("stars", "both")
HAZARD_SHARES = (0.07, 0.9)  # of the frames in turn
BEYOND = {"beyond 95 %": 1.0, "beyond 99.9 %": 1.0, "beyond twice 99.9 %": 2.0}


@dataclass(frozen=True)
class Case:
    """One kind of frames: the sky's share of the background, and what the locator's inputs have wrong."""

    name: str
    share: float
    map_m: float | None = None  # errors of the height map, else the cylinder
    rim_m: float = 0.0  # error of the cylinder's wall
    lens_px: float = 0.0

    def terrains(self, rng: np.random.Generator) -> tuple[Terrain, Terrain]:
        """The true ground, and the one stated."""
        if self.map_m is not None:
            return (raised_map(self.map_m), degraded_map(self.map_m)) if self.map_m else (map_of_floor(),) * 2
        crater = load_terrain("shackleton-thesis")
        assert isinstance(crater, Cylinder)
        if not self.rim_m:
            return crater, crater
        return uneven_crater(crater, self.rim_m, rng), replace(crater, depth_sigma_m=self.rim_m)


EXACT = [Case("cylinder, exact", share) for share in (0.0, 0.07, 0.3, 0.9)]
RIM = [Case(f"cylinder, rim wrong by {m:g} m", share, rim_m=m) for m in (1.0, 5.0) for share in (0.07, 0.9)]
MAPS = [Case(f"height map, posts wrong by {m:g} m", share, map_m=m) for m in (0.0, 1.0, 5.0) for share in (0.07, 0.9)]
LENS = [Case(f"cylinder, lens wrong by {px:g} px", share, lens_px=px) for px in (0.05, 0.2) for share in (0.07, 0.9)]
CASES = (*EXACT, *RIM, *MAPS, *LENS)


def main() -> None:
    """Run both tables, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=24, help="of each case")
    parser.add_argument("--hazards", type=int, default=12, help="frames of each hazard")
    parser.add_argument("-j", "--jobs", type=int, default=2)
    args = parser.parse_args()
    frames = [(case, number) for case in range(len(CASES)) for number in range(args.frames)]
    hazards = [(name, number) for name in HAZARDS for number in range(args.hazards)]
    if frames:  # the tables of horizons once, before the processes need them
        for case in MAPS:
            case.terrains(np.random.default_rng(0))
    with ProcessPoolExecutor(args.jobs) as pool:
        rows = list(pool.map(measure_case, frames))
        troubled = list(pool.map(measure_hazard, hazards))
    parts = []
    if frames:
        parts.append(cases_table([(CASES[case], row) for (case, _), row in zip(frames, rows, strict=True)]))
    if hazards:
        parts.append(hazards_table([(name, row) for (name, _), row in zip(hazards, troubled, strict=True)]))
    body = "\n\n".join(parts)
    print(body)
    if frames and hazards:
        command = f"python benchmarks/sky_light.py --frames {args.frames} --hazards {args.hazards}"
        write_section("Sky light", command, ("numpy", "scipy"), body)


def measure_case(job: tuple[int, int]) -> dict[str, dict[str, Any]]:
    """One frame of a case, with each source of evidence."""
    case, number = CASES[job[0]], job[1]
    rng = np.random.default_rng([SEED, number])
    camera, sky_mag = camera_for_share(case.share)
    true, stated = case.terrains(rng)
    bent = bend_camera(camera, case.lens_px, rng) if case.lens_px else camera
    scene, noise = series(bent, true, sky_mag).scene(number, f"frame-{number:03d}")
    exposure, truth = render(scene, rng=noise)
    return {source: locate_with(source, exposure, camera, stated, truth.position_enu_m) for source in SOURCES}


def measure_hazard(job: tuple[str, int]) -> dict[str, dict[str, Any]]:
    """One frame with a hazard, with the stars and with both."""
    name, number = job
    camera, sky_mag = camera_for_share(HAZARD_SHARES[number % len(HAZARD_SHARES)])
    crater = load_terrain("shackleton-thesis")
    scene, _ = series(camera, crater, sky_mag).scene(number, f"{name}-{number:03d}")
    rng = np.random.default_rng([SEED, number, list(HAZARDS).index(name)])
    exposure, truth, file = expose(scene, HAZARDS[name], rng)
    return {source: locate_with(source, exposure, file, crater, truth.position_enu_m) for source in HAZARD_SOURCES}


def series(camera: Camera, terrain: Terrain, sky_mag: float | None) -> Series:
    """Random frames: the same poses for all cameras, skies and errors."""
    return Series(
        camera=camera, terrain=terrain, catalog=load_catalog(), seed=SEED, exposure_s=EXPOSURE_S,
        sky_v_mag_arcsec2=sky_mag, hot_pixels=200, cosmic_rays=30,
    )  # fmt: skip


def locate_with(source: str, exposure: Exposure, camera: Camera, terrain: Terrain, position_m: Array) -> dict[str, Any]:
    """Score of the position from one source of evidence."""
    result = locate(exposure, camera, terrain, load_catalog(), Settings(evidence_sources=source))
    if not isinstance(result, Located) or result.status != "ok":
        return {"status": result.status, "reason": str(result.reason)}
    off = result.fix.position_enu_m[:2] - position_m[:2]
    error, radius95, radius999 = float(np.hypot(*off)), result.fix.radius95_m, result.fix.radius999_m
    return {
        "status": "ok", "error_m": error, "nees": float(off @ np.linalg.solve(result.fix.covariance_m2, off)),
        "sky": uses_sky(result), "beyond 95 %": error > radius95, "beyond 99.9 %": error > radius999,
        "beyond twice 99.9 %": error > 2 * radius999,
    }  # fmt: skip


def uses_sky(result: Located) -> bool:
    """Whether the light of the sky is among the evidence."""
    return result.evidence_source != "stars"


def cases_table(rows: list[tuple[Case, dict[str, dict[str, Any]]]]) -> str:
    """One line per case and source."""
    lines = []
    for case in CASES:
        found = [row for of, row in rows if of is case]
        for source in SOURCES:
            ok = [row[source] for row in found if row[source]["status"] == "ok"]
            error, nees = np.array([r["error_m"] for r in ok]), [r["nees"] for r in ok]
            figures = [f"{np.mean(error):.2f}", f"{np.median(error):.2f}", f"{np.mean(nees):.2f}"] if ok else ["-"] * 3
            inside = [f"{100 - 100 * np.mean([r[k] for r in ok]):.0f} %" if ok else "-" for k in list(BEYOND)[:2]]
            reasons = sorted({row[source]["reason"] for row in found if row[source]["status"] != "ok"})
            located = f"{len(ok)} of {len(found)}" + (f" ({', '.join(reasons)})" if reasons else "")
            lines.append([
                case.name, f"{100 * case.share:.0f} %", source, located, *figures, *inside,
                str(sum(r["sky"] for r in ok)),
            ])  # fmt: skip
    head = ["scene", "sky", "evidence", "located", "mean error, m", "median", "NEES", "in the 95 % circle",
            "in the 99.9 %", "sky used"]  # fmt: skip
    return table(head, lines)


def hazards_table(rows: list[tuple[str, dict[str, dict[str, Any]]]]) -> str:
    """One line per hazard: both sources, and the stars alone in brackets."""
    lines = []
    for name in HAZARDS:
        found = [row for of, row in rows if of == name]
        counts = {source: count_results([row[source] for row in found]) for source in HAZARD_SOURCES}
        lines.append([name, *(f"{both} ({stars})" for stars, both in zip(*counts.values(), strict=True))])
    head = ["hazard: both, in brackets the stars alone", "located", "refused or ambiguous", "sky used", *BEYOND]
    return table(head, lines)


def count_results(rows: list[dict[str, Any]]) -> list[int]:
    """Numbers of frames by what became of them."""
    ok = [row for row in rows if row["status"] == "ok"]
    return [len(ok), len(rows) - len(ok), *(sum(row[key] for row in ok) for key in ("sky", *BEYOND))]


if __name__ == "__main__":
    main()
