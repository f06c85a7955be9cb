"""Frames of ground that is not the map's, and of light that is not the sky's: rendered once, located by any program.

    python benchmarks/map_against_ground.py render FRAMES [--cases seam turned] [--max 6] [--reference HORIZON.csv]
    python benchmarks/map_against_ground.py locate FRAMES ROWS.jsonl [--files stated] [--cases ...] [--max 6]
    python benchmarks/map_against_ground.py table ROWS.jsonl [--write]

Sky of 7 and 30 % of the background, 5 sigma at V 6.0. `render` skips the frames that FRAMES has; beside each image
are its sidecar and NAME.truth.json. `locate` appends a row for each frame that ROWS.jsonl lacks. The files `shipped`
are those that users have; the files `stated` tell of waves of the horizon what the errors were drawn from. `table`
has a line for each case and share of the sky. --reference is a table azimuth_deg, elevation_deg of the horizon seen
2 m above 303.2 m south of the origin of `shackleton` (tests/data/shackleton_floor_horizon.csv).
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import time
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from _cameras import EXPOSURE_S, camera_for_share
from _classes import measured
from _evidence_hazards import Row, answered, beyond, median
from _ground_cases import Case, Drawn, Rng, Seen, cases_of
from _results import table, write_section
from _sky_view import View
from scipy.ndimage import gaussian_filter

from startrack.camera import load_camera, save_camera
from startrack.catalog import load_catalog
from startrack.chain import Located, locate
from startrack.core.files import data_dir
from startrack.core.types import Exposure
from startrack.exposure import read_exposure, write_exposure, write_sidecar
from startrack.rendering import Scene, Series, load_sky_catalog, render
from startrack.terrain import HeightMap, Terrain, load_terrain

SEED = 60611
BLUR_PX = 1.0  # of the added light
SHIPPED, STATED = "shipped", "stated"
HEAD = [
    "case", "sky", "frames", "answered", "beyond the 99.9 % circle", "beyond twice it", "beyond the protection level",
    "mean error, m", "mean NEES", "median 95 % circle, m", "CPU s a frame",
]  # fmt: skip


def main() -> None:
    """Run one of the stages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    stages = parser.add_subparsers(dest="stage", required=True)
    for name in ("render", "locate"):
        stage = stages.add_parser(name)
        stage.add_argument("frames", type=Path)
        stage.add_argument("--cases", nargs="*", default=[], choices=("reference", *cases_of(None)), help="all without")
        stage.add_argument("--max", type=int, default=10**6, help="frames of each case: numbers below this")
        stage.add_argument("--minutes", type=float, default=np.inf, help="after which no further frames are begun")
        if name == "locate":
            stage.add_argument("rows", type=Path)
            stage.add_argument("--files", choices=(SHIPPED, STATED), default=SHIPPED)
        else:
            stage.add_argument("--reference", type=Path)
    stage = stages.add_parser("table")
    stage.add_argument("rows", type=Path)
    stage.add_argument("--write", action="store_true", help="as a section of RESULTS.md")
    args = parser.parse_args()
    {"render": run_render, "locate": run_locate, "table": print_table}[args.stage](args)


def run_render(args: argparse.Namespace) -> None:
    """Render the frames that are lacking."""
    cases = cases_of(args.reference)
    if args.reference is None:
        print("case reference is left out: it needs --reference")
    jobs = [
        (name, number, str(args.frames.resolve()), args.reference)
        for name in cases if name in (args.cases or cases) for number in range(min(cases[name].frames, args.max))
        if not truth_path(args.frames, name, number).exists()
    ]  # fmt: skip
    for (name, number, *_), seconds in measured(jobs, render_frame, 1, args.minutes):
        print(f"{name} {number}: {seconds:.1f} s", flush=True)


def truth_path(root: Path, name: str, number: int) -> Path:
    """The file that is written last of a frame."""
    return root / name / f"{name}-{number:03d}.truth.json"


def render_frame(job: tuple[str, int, str, Path | None]) -> float:
    """Write one frame of one case; CPU time [s]."""
    start, (name, number, root, reference) = time.process_time(), job
    case, truth = cases_of(reference)[name], truth_path(Path(root), name, number)
    truth.parent.mkdir(parents=True, exist_ok=True)
    files = write_files(truth.parent.parent, name, case, case.shares[number % len(case.shares)])
    seed = int(np.random.SeedSequence([SEED, *(case.pair or name).encode()]).generate_state(1)[0])
    rng, scene, noise = np.random.default_rng([seed, number]), *scene_of(case, files, seed, number)
    ground = case.ground(scene.terrain, scene.position_enu_m[:2], rng)
    scene = replace(scene, terrain=Seen(ground.terrain, scene.position_enu_m[:2]), name=f"{name}-{number:03d}")
    scene = replace(scene, ground_brightness=ground.brightness or scene.ground_brightness)
    exposure, _ = render(scene, rng=noise)
    exposure, ground = with_light(case, exposure, scene, ground, rng)
    exposure = replace(exposure, time_sigma_s=case.time_sigma_s)
    image = write_exposure(truth.with_name(f"{name}-{number:03d}.png"), exposure, overwrite=True)
    write_sidecar(image, exposure, overwrite=True)
    facts = {
        "case": name, "number": number, "share": case.shares[number % len(case.shares)], **files,
        "position_enu_m": scene.position_enu_m.tolist(), "R_cam_icrs": scene.R_cam_icrs.tolist(), "drawn": ground.facts,
    }  # fmt: skip
    truth.write_text(json.dumps(facts), encoding="utf-8")
    return time.process_time() - start


def scene_of(case: Case, files: dict[str, str], seed: int, number: int) -> tuple[Scene, Rng]:
    """The scene of a frame, with the ground's map as terrain, and the generator of its noise."""
    terrain = load_once(files["ground"])
    east_m, north_m = None, None
    if case.place is not None:
        assert isinstance(terrain, HeightMap)
        east_m, north_m = case.place(terrain, number, np.random.default_rng([seed, number, 1]))
    _, sky = camera_for_share(case.shares[number % len(case.shares)])
    series = Series(
        camera=load_camera(files["camera"]), terrain=terrain, catalog=load_sky_catalog("auto"), seed=seed,
        exposure_s=EXPOSURE_S, sky_v_mag_arcsec2=sky, east_m=east_m, north_m=north_m, hot_pixels=200, cosmic_rays=30,
        camera_ref=files["camera"], terrain_ref=files[SHIPPED],
    )  # fmt: skip
    return series.scene(number)


def with_light(case: Case, exposure: Exposure, scene: Scene, ground: Drawn, rng: Rng) -> tuple[Exposure, Drawn]:
    """The exposure with the light that the case adds, its noise included, and what was drawn for it."""
    if case.light_e is None:
        return exposure, ground
    light, facts = case.light_e(View.of(scene), rng)
    electrons = rng.poisson(gaussian_filter(light, BLUR_PX))
    pixels = np.minimum(exposure.pixels_adu + np.rint(electrons / scene.sensor.gain_e_per_adu), 65535.0)
    return replace(exposure, pixels_adu=pixels.astype(np.float32)), Drawn(ground.terrain, ground.facts | facts)


def write_files(root: Path, name: str, case: Case, share: float) -> dict[str, str]:
    """Paths of the camera, of the ground's map, and of the terrain files for locating; what is lacking is written."""
    camera = root / f"camera-{round(100 * share)}.toml"
    if not camera.exists():
        save_camera(camera_for_share(share)[0], camera)
    files = {"camera": str(camera), "ground": case.terrain, SHIPPED: case.terrain}
    text = (data_dir("terrain") / f"{case.terrain}.toml").read_text(encoding="utf-8")
    if case.keys:
        files["ground"] = files[SHIPPED] = write_terrain(root / f"{name}.toml", text, dict(case.keys))
    if case.fine_map:
        maps = re.search(r"^file = \[(.*)\]$", text, re.MULTILINE)
        assert maps is not None
        fine = {"file": f'["{case.fine_map}", {maps[1]}]'}
        files["ground"] = write_terrain(root / f"{name}-ground.toml", text, {**case.keys, **fine})
    if case.waves_deg is not None:
        path, terrain = root / f"{name}-stated.toml", load_once(case.terrain)
        assert isinstance(terrain, HeightMap)
        waves = ", ".join(f"{sigma:.6f}" for sigma in case.waves_deg(terrain))
        files[STATED] = write_terrain(path, text, {"horizon_waves_sigma_deg": f"[{waves}]"})
    return files


def write_terrain(path: Path, text: str, keys: dict[str, str]) -> str:
    """A terrain file from the `text` of another one with other values of `keys`, and its maps beside it; its path."""
    for key, value in keys.items():
        line = f"{key} = {value}"
        text, found = re.subn(rf"^{key} = .*$", line, text, flags=re.MULTILINE)
        text = text if found else text.replace("[dem]\n", f"[dem]\n{line}\n")
    for name in re.findall(r'"([^"]*\.tif)"', text):
        if not (path.parent / name).exists():
            shutil.copy(data_dir("terrain") / name, path.parent / name)
    path.write_text(text, encoding="utf-8")
    return str(path)


@lru_cache
def load_once(name_or_path: str) -> Terrain:
    """A terrain, without its table of horizons."""
    return load_terrain(name_or_path)


def run_locate(args: argparse.Namespace) -> None:
    """Locate the frames that have no row yet."""
    known = {(row["case"], row["number"], row["files"]) for row in load_rows(args.rows)}
    truths = [json.loads(path.read_text("utf-8")) for path in sorted(args.frames.glob("*/*.truth.json"))]
    names = args.cases or ["reference", *cases_of(None)]
    jobs = [
        (str(args.frames), one["case"], one["number"], args.files) for name in names for one in truths
        if one["case"] == name and one["number"] < args.max and args.files in one
        and (name, one["number"], args.files) not in known
    ]  # fmt: skip
    for _, row in measured(jobs, locate_frame, 1, args.minutes):
        with args.rows.open("a", encoding="utf-8") as out:
            out.write(json.dumps(row) + "\n")
        size = "" if row["error_m"] is None else f"{row['error_m']:.1f} m of {row['radius999_m']:.1f} m"
        print(row["case"], row["number"], row["status"], row["reason"], size, f"{row['cpu_s']:.1f} s", flush=True)


def locate_frame(job: tuple[str, str, int, str]) -> Row:
    """The row of one frame, by the files of a kind."""
    root, name, number, files = job
    path = truth_path(Path(root), name, number)
    truth = json.loads(path.read_text(encoding="utf-8"))
    terrain = load_once(truth[files])
    terrain.prepare()
    exposure = read_exposure(path.with_name(f"{name}-{number:03d}.png"))
    start = time.process_time()
    result = locate(exposure, load_camera(truth["camera"]), terrain, load_catalog())
    row: Row = {
        "case": name, "number": number, "share": truth["share"], "files": files, "status": str(result.status),
        "reason": str(result.reason or ""), "message": result.message, "cpu_s": time.process_time() - start,
        "error_m": None,
    }  # fmt: skip
    return row | answer(result, truth["position_enu_m"]) if isinstance(result, Located) else row


def answer(result: Located, position_enu_m: list[float]) -> Row:
    """What a fix states, beside its error."""
    fix = result.fix
    off = fix.position_enu_m[:2] - np.array(position_enu_m)[:2]
    level_m = None if fix.integrity is None else float(fix.integrity.protection_level_m)
    return {
        "error_m": float(np.hypot(*off)), "off_m": off.tolist(), "radius95_m": float(fix.radius95_m),
        "radius999_m": float(fix.radius999_m), "covariance_m2": fix.covariance_m2.tolist(),
        "level_m": level_m if level_m is not None and np.isfinite(level_m) else None,
        "nees": float(off @ np.linalg.solve(fix.covariance_m2, off)),
    }  # fmt: skip


def load_rows(path: Path) -> list[Row]:
    """The rows of a file, none where there is no file."""
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()] if path.exists() else []


def print_table(args: argparse.Namespace) -> None:
    """The table of stored rows; with --write a section of RESULTS.md."""
    groups: dict[tuple[str, str, float], list[Row]] = {}
    for row in load_rows(args.rows):
        groups.setdefault((row["files"], row["case"], row["share"]), []).append(row)
    body = table(HEAD, [summary(*key, rows) for key, rows in groups.items()])
    print(body)
    if args.write:
        write_section(
            "Ground that is not the map's", f"python benchmarks/{Path(__file__).name} table ROWS.jsonl --write",
            ("numpy", "scipy"), body,
        )  # fmt: skip


def summary(files: str, case: str, share: float, rows: list[Row]) -> list[str]:
    """One line of the table."""
    found = answered(rows)
    means = [f"{np.mean([row[key] for row in found]):.1f}" if found else "-" for key in ("error_m", "nees")]
    return [
        case if files == SHIPPED else f"{case}, waves stated", f"{100 * share:.0f} %", str(len(rows)), str(len(found)),
        str(len(beyond(rows))), str(len(beyond(rows, times=2.0))), str(len(beyond(rows, "level_m"))), *means,
        median(rows, "radius95_m"), f"{np.median([row['cpu_s'] for row in rows]):.1f}",
    ]  # fmt: skip


if __name__ == "__main__":
    main()
