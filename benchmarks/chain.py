"""The whole chain on many frames, from pixels to position, beside the thesis's methods on the same detections.

    python benchmarks/chain.py                   50 rendered frames of the thesis's crater
    python benchmarks/chain.py --folder FRAMES   frames with sidecar and truth, from any renderer (nothing is written)

Conditions: 2048 px fisheye, V 6 on the axis at 5 sigma, the real sky with stars that the catalogue lacks, 3 % scatter
of the fluxes beside the catalogue's own errors, hot pixels, cosmic rays, random positions, dates 2024-2034, headings,
tilt to 5 degrees.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _cameras import SENSOR
from _results import table, write_section

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import Identified, Located, Oriented, Outcome, last_value, locate
from startrack.core.types import Evidence, NoSolution
from startrack.exposure import read_exposure
from startrack.frames import R_from_quat_xyzw
from startrack.localization import PseudoGradient
from startrack.localization.thesis_methods import descend, hull_position, stars_on_rim_plane
from startrack.rendering import Series, render
from startrack.terrain import Cylinder, load_terrain

# 10 s reach V 6.0 at 5 sigma in 100 e of background, of which 7 e are sky.
ARCSEC = np.degrees(1.0) * 3600


def main() -> None:
    """Run, print and, for rendered frames, write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--seed", type=int, default=2008)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("-j", "--jobs", type=int, default=2)
    args = parser.parse_args()
    jobs: list[Any] = sorted(args.folder.rglob("*.truth.json")) if args.folder else [
        (args.seed, number) for number in range(args.frames)
    ]  # fmt: skip
    with ProcessPoolExecutor(args.jobs) as pool:
        rows = list(pool.map(locate_file if args.folder else locate_rendered, jobs))
    body = summary(rows)
    print(body)
    if not args.folder:
        write_section("Chain", f"python benchmarks/chain.py --frames {args.frames}", ("numpy", "scipy"), body)


def locate_rendered(job: tuple[int, int]) -> dict[str, Any]:
    """One random frame, located."""
    seed, number = job
    camera = replace(load_camera("fisheye-2048"), sensor=SENSOR)
    terrain, catalog = load_terrain("shackleton-thesis"), load_catalog()
    series = Series(
        camera=camera, terrain=terrain, catalog=catalog, seed=seed, exposure_s=10.0, hot_pixels=200, cosmic_rays=30
    )
    scene, rng = series.scene(number, f"frame-{number:03d}")
    exposure, truth = render(scene, rng=rng)
    start = time.perf_counter()
    result = locate(exposure, camera, terrain, catalog)
    return score_result(result, truth.position_enu_m, truth.R_cam_icrs, time.perf_counter() - start)


def locate_file(truth_path: Path) -> dict[str, Any]:
    """One frame of a folder, located."""
    image = next(p for p in truth_path.parent.glob(truth_path.name.replace(".truth.json", ".*")) if p.suffix != ".json")
    truth = json.loads(truth_path.read_text())
    exposure = read_exposure(image)
    start = time.perf_counter()
    result = locate(exposure, load_camera(exposure.camera or ""), load_terrain(exposure.terrain or ""), load_catalog())
    quat = np.array(truth["quat_xyzw_cam_icrs"])
    return score_result(result, np.array(truth["position_enu_m"]), R_from_quat_xyzw(quat), time.perf_counter() - start)


def score_result(result: Outcome, position_m: np.ndarray, R_cam_icrs: np.ndarray, seconds: float) -> dict[str, Any]:
    """Errors of one result."""
    row: dict[str, Any] = {"status": result.status, "reason": result.reason, "seconds": seconds}
    row["stage_ms"] = dict(result.timing_ms)
    value = last_value(result)
    if isinstance(value, Oriented):
        rotation = R_cam_icrs @ value.attitude.R_cam_icrs.T
        antisymmetric = 0.5 * (rotation - rotation.T)
        w = antisymmetric[[2, 0, 1], [1, 2, 0]]
        row["attitude_arcsec"] = float(np.linalg.norm(w) * ARCSEC)
        row["attitude_nees"] = float(w @ np.linalg.solve(value.attitude.covariance_rad2, w))
        row["wrong"], row["matches"] = wrong_identities(value, R_cam_icrs)
    if isinstance(result, Located):
        d = result.fix.position_enu_m[:2] - position_m[:2]
        row["error_m"] = float(np.linalg.norm(d))
        row["nees"] = float(d @ np.linalg.solve(result.fix.covariance_m2, d))
        row["in95"] = row["error_m"] < result.fix.radius95_m
        row["in999"] = row["error_m"] < result.fix.radius999_m
        row |= peers(result, position_m)
    return row


def wrong_identities(result: Identified, R_cam_icrs: np.ndarray) -> tuple[int, int]:
    """Matches whose star, at the true attitude, lies more than 1.5 px from its detection; and all matches."""
    found = result.identification
    px, _ = result.camera.project(result.stars.rays_icrs[found.star] @ R_cam_icrs.T)
    distance = np.linalg.norm(px - result.detections.xy_px[found.detection], axis=1)
    return int(np.count_nonzero(distance > 1.5)), len(found)


def peers(result: Located, position_m: np.ndarray) -> dict[str, float]:
    """The thesis's methods on this frame's own list: catalogue stars to the detection limit, seen when identified.

    They need a cylinder; nothing on other terrain.
    """
    if not isinstance(result.terrain, Cylinder):
        return {}
    photometry = result.photometry
    seen = np.isin(photometry.star, result.identification.star)
    listed = seen | (photometry.expected_e > 5.0 * np.maximum(photometry.sigma_e, 1e-9))
    listed &= photometry.usable & (photometry.elevation_rad > np.radians(3.0))
    evidence = Evidence(
        azimuth_rad=photometry.azimuth_rad[listed],
        elevation_rad=photometry.elevation_rad[listed],
        llr=np.where(seen[listed], 9.0, -9.0),
        edge_sigma_rad=np.zeros(int(listed.sum())),
    )
    plane, method = stars_on_rim_plane(evidence, result.terrain), PseudoGradient()
    try:
        hull = hull_position(plane.points_m[plane.seen], plane.wall_m, plane.radius_m)
    except NoSolution:
        return {}
    # As in the thesis, where the descent ends is its answer, settled or not.
    refined, _ = descend(plane.points_m, plane.seen, hull, plane.radius_m, method.gain, method.most_steps)
    return {name: float(np.linalg.norm(p - position_m[:2])) for name, p in (("hull_m", hull), ("gradient_m", refined))}


def summary(rows: list[dict[str, Any]]) -> str:
    """The tables."""

    def column(key: str) -> np.ndarray:
        return np.array([row[key] for row in rows if key in row])

    def spread(key: str) -> list[str]:
        values = column(key)
        return [f"{f(values):.1f}" for f in (np.mean, np.median, np.std, np.max)] if len(values) else ["-"] * 4

    def stages() -> Iterator[str]:
        for stage in ("detect", "identify", "attitude", "evidence", "locate"):
            yield f"{stage} {np.median([row['stage_ms'].get(stage, 0.0) for row in rows]):.0f}"

    methods = [("startrack", "error_m"), ("pseudo-gradient (Kua 2008)", "gradient_m"), ("hull (Kua 2008)", "hull_m")]
    position = table(["position error, m", "mean", "median", "s.d.", "max"], [[n, *spread(k)] for n, k in methods])
    nees = column("nees")
    ok, ambiguous = (sum(row["status"] == status for row in rows) for status in ("ok", "ambiguous"))
    wrong, matches = int(column("wrong").sum()), int(column("matches").sum())
    arcsec, attitude_nees = float(np.median(column("attitude_arcsec"))), float(column("attitude_nees").mean())
    in95, in999 = 100 * float(column("in95").mean()), 100 * float(column("in999").mean())
    figures = [
        ["frames", f"{len(rows)}: {ok} ok, {ambiguous} ambiguous"],
        ["identified", f"{len(column('matches'))}; wrong identities {wrong} of {matches}"],
        ["attitude", f"median {arcsec:.2f} arcsec, mean NEES {attitude_nees:.2f} (3 is perfect)"],
        ["position NEES", f"mean {nees.mean():.2f} (2 is perfect), median {np.median(nees):.2f}"],
        ["inside the stated circles", f"95 %: {in95:.0f} %, 99.9 %: {in999:.1f} %"],
        ["ms (median)", ", ".join(stages())],
    ]
    return position + "\n\n" + table(["", ""], figures)


if __name__ == "__main__":
    main()
