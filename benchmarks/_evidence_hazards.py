"""Hazards at the level of evidence: simulated stars instead of pixels, located with the checks of the pipeline."""

from __future__ import annotations

import sys
import time
from collections import Counter
from dataclasses import replace
from datetime import timedelta
from typing import Any

import numpy as np
from _cameras import EXPOSURE_S, camera_for_share
from _hazard_class import KINDS, Class, draw_place
from _hazard_classes import CLASSES
from _map_draws import draw_position

from startrack.catalog import load_catalog
from startrack.chain import StarFix, StarRays, locate_rays
from startrack.core.types import Array, NoSolution
from startrack.rendering import Series
from startrack.simulation import simulate_rays
from startrack.terrain import HeightMap, Terrain

SEEDS = {"choose": 515, "judge": 7321}  # numbers may be fitted on the first half, and are judged on the second
SHARE, FAINTEST_V_MAG = 0.07, 8.6  # stars fainter than this are no evidence in these frames
FLOOR_M, FLOOR_SLOPE_RAD = 4000.0, np.radians(15.0)  # positions on height maps
PLACE, GROUND, STARS, CLOCK, NOISE, ROWS = range(6)  # streams of a frame's seed: none depends on what another draws
HEAD = [
    "errors", "class", "frames", "answered", "refused", "median error, m", "median 99.9 % circle, m",
    "beyond it", "beyond twice it", "beyond the protection level",
]  # fmt: skip
Row = dict[str, Any]


def measure_frame(job: tuple[str, int, str]) -> Row:
    """One frame of one class, of a half of the seeds: a row of the stored table."""
    name, number, half = job
    start, one = time.monotonic(), CLASSES[name]
    rays, position_m = draw_rays(one, seed_of(name, half), number)
    row: Row = {
        "class": name, "number": number, "half": half, "status": "refused", "reason": "", "error_m": None,
        "radius95_m": None, "radius999_m": None, "level_m": None, "nees": None,
    }  # fmt: skip
    try:
        found = locate_rays(rays)
    except NoSolution as refusal:
        row["reason"] = str(refusal.reason)
    else:
        row |= _answer(found, position_m)
    if row["status"] == "ok" and row["error_m"] > row["radius999_m"]:
        print(
            f"{name} {number}: {row['error_m']:.1f} m, circle {row['radius999_m']:.1f} m", file=sys.stderr, flush=True
        )
    return row | {"seconds": round(time.monotonic() - start, 2)}


def seed_of(name: str, half: str) -> int:
    """The seed of a class: places and a sky of its own."""
    return int(np.random.SeedSequence([SEEDS[half], *name.encode()]).generate_state(1)[0])


def draw_rays(one: Class, seed: int, number: int) -> tuple[StarRays, Array]:
    """The rays of one frame of a class, and the true position (3,)."""
    stated, catalog = one.stated(), load_catalog().brighter_than(FAINTEST_V_MAG)

    def stream(of: int) -> np.random.Generator:
        return np.random.default_rng([seed, number, of])

    east_m, north_m = _place(one, stated, stream(PLACE))
    camera, sky = camera_for_share(SHARE)
    series = Series(
        camera=camera, terrain=stated, catalog=catalog, seed=seed, exposure_s=EXPOSURE_S, sky_v_mag_arcsec2=sky,
        faint_v_mag=FAINTEST_V_MAG, east_m=east_m, north_m=north_m,
    )  # fmt: skip
    scene, _ = series.scene(number)
    scene = one.scene(replace(scene, terrain=one.ground(stated, stream(GROUND))), stream(STARS))
    assert scene.time_utc is not None
    time_utc = scene.time_utc + timedelta(seconds=one.clock_s(stream(CLOCK)))
    rays = simulate_rays(scene, catalog, stated, time_utc=time_utc, time_sigma_s=one.time_sigma_s, rng=stream(NOISE))
    return one.rays(rays, stream(ROWS)), scene.position_enu_m


def _place(one: Class, stated: Terrain, rng: np.random.Generator) -> tuple[float | None, float | None]:
    """East and north [m]; None: anywhere in the search area."""
    if one.away_m is not None:
        east_m, north_m = draw_place(stated, one.away_m, rng).tolist()
    elif isinstance(stated, HeightMap):
        east_m, north_m = draw_position(stated, FLOOR_M, FLOOR_SLOPE_RAD, rng).tolist()
    else:
        return None, None
    return east_m, north_m


def _answer(found: StarFix, position_m: Array) -> Row:
    """What a fix states, beside its error."""
    if found.fix.ambiguous or found.fix.integrity is None:
        return {"status": "ambiguous", "reason": "ambiguous"}
    fix, off = found.fix, (found.fix.position_enu_m - position_m)[:2]
    level_m = found.fix.integrity.protection_level_m
    return {
        "status": "ok", "error_m": float(np.hypot(*off)), "radius95_m": float(fix.radius95_m),
        "radius999_m": float(fix.radius999_m), "level_m": float(level_m) if np.isfinite(level_m) else None,
        "nees": float(off @ np.linalg.solve(fix.covariance_m2, off)),
    }  # fmt: skip


def answered(rows: list[Row]) -> list[Row]:
    """The rows with a position."""
    return [row for row in rows if row["status"] == "ok"]


def beyond(rows: list[Row], key: str = "radius999_m", times: float = 1.0) -> list[Row]:
    """The rows whose error exceeds what they state by that factor."""
    return [row for row in answered(rows) if row[key] is not None and row["error_m"] > times * row[key]]


def median(rows: list[Row], key: str) -> str:
    """The median of a quantity of the answers."""
    values = [row[key] for row in answered(rows)]
    return f"{np.median(values):.1f}" if values else "-"


def refusals(rows: list[Row]) -> str:
    """How many were refused, and why."""
    reasons = Counter(row["reason"] for row in rows if row["status"] != "ok")
    words = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
    return f"{sum(reasons.values())}" + (f" ({words})" if words else "")


def summary(name: str, rows: list[Row]) -> list[str]:
    """One line of the table."""
    wrong = beyond(rows)
    sizes = ", ".join(f"{row['error_m']:.0f} of {row['radius999_m']:.0f} m" for row in wrong[:6])
    sizes += ", ..." if len(wrong) > 6 else ""
    return [
        CLASSES[name].kind, name, str(len(rows)), str(len(answered(rows))), refusals(rows), median(rows, "error_m"),
        median(rows, "radius999_m"), f"{len(wrong)} ({sizes})" if wrong else "0",
        str(len(beyond(rows, times=2.0))), str(len(beyond(rows, "level_m"))),
    ]  # fmt: skip


def totals(rows: dict[str, list[Row]]) -> str:
    """The sums of each kind of class, as a text below the table."""
    lines = []
    for kind, words in KINDS.items():
        found = [row for name, some in rows.items() if CLASSES[name].kind == kind for row in some]
        lines.append(
            f"- {words}: {len(found)} frames, {len(answered(found))} answered, {len(beyond(found))} beyond the 99.9 % "
            f"circle, {len(beyond(found, times=2.0))} beyond twice it, {len(beyond(found, 'level_m'))} beyond the "
            "protection level"
        )
    return "\n\n" + "\n".join(lines)


def every(name: str) -> int:
    """One frame of a class where others have so many."""
    return CLASSES[name].every
