"""Pictures with nothing wrong: how many are answered, and which reasons refuse the others.

    python benchmarks/answered.py [--frames 40] [--only shackleton]

Rendered frames of every shipped terrain: places over the whole ground where a camera can stand, exposures that reach
V 5 to 8, tilts up to 20 degrees, a sky of 21 to 24 mag/arcsec2. Half of the frames of the thesis's crater are within
200 m of the wall, and no nearer than 20 m.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from _classes import run_classes

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import Located, locate
from startrack.core.files import data_dir
from startrack.rendering import Series, load_sky_catalog, render
from startrack.rendering.sources import exposure_for_snr
from startrack.terrain import Cylinder, load_terrain

SEED, NEAR_WALL_M, WALL_MARGIN_M = 2026, 200.0, 20.0
FAINT_V_MAG = Series.faint_v_mag or np.inf
TERRAINS = sorted(p.stem for p in data_dir("terrain").glob("*.toml") if "rendered" in p.stem or "thesis" in p.stem)


def main() -> None:
    """Render and locate the frames, print the table; write the section if all terrains were run."""
    head = ["terrain", "frames", "answered", "refused", "mean error, m", "beyond the 99.9 % circle"]
    run_classes(__file__, __doc__, "Answered", TERRAINS, 40, head, measure_frame, summary)


def measure_frame(job: tuple[str, int]) -> dict[str, Any]:
    """One frame of one terrain."""
    name, number = job
    rng = np.random.default_rng([SEED, number, TERRAINS.index(name)])
    camera, terrain, catalog = load_camera("fisheye-2048"), load_terrain(name), load_catalog()
    east_m, north_m = (None, None)
    if isinstance(terrain, Cylinder) and number % 2:
        azimuth = rng.uniform(0, 2 * np.pi)
        radius = terrain.diameter_m / 2 - rng.uniform(WALL_MARGIN_M, NEAR_WALL_M)
        east_m, north_m = float(radius * np.sin(azimuth)), float(radius * np.cos(azimuth))
    sky = float(rng.uniform(21.0, 24.0))
    series = Series(
        camera=camera, terrain=terrain, catalog=load_sky_catalog("auto").brighter_than(FAINT_V_MAG), seed=SEED,
        east_m=east_m, north_m=north_m, sky_v_mag_arcsec2=sky,
        exposure_s=exposure_for_snr(camera, sky, v_mag=float(rng.uniform(5.0, 8.0)), snr=5.0),
        max_tilt_rad=float(np.radians(20.0)),
    )  # fmt: skip
    scene, noise = series.scene(number)
    exposure, truth = render(scene, rng=noise)
    result = locate(exposure, camera, terrain, catalog)
    if not isinstance(result, Located) or result.status != "ok":
        return {"reason": str(result.reason), "message": result.message}
    error = float(np.linalg.norm(result.fix.position_enu_m[:2] - truth.position_enu_m[:2]))
    return {"reason": None, "error_m": error, "beyond": error > result.fix.radius999_m}


def summary(name: str, rows: list[dict[str, Any]]) -> list[str]:
    """The table's line of a terrain."""
    ok = [row for row in rows if row["reason"] is None]
    reasons = Counter(row["reason"] for row in rows if row["reason"] is not None)
    why = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common()) or "0"
    mean = f"{np.mean([row['error_m'] for row in ok]):.2f}" if ok else "-"
    return [name, str(len(rows)), str(len(ok)), why, mean, str(sum(row["beyond"] for row in ok))]


if __name__ == "__main__":
    main()
