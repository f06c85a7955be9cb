"""Hazards in rendered frames of the thesis's crater: all classes have the same poses."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from _cameras import EXPOSURE_S, camera_for_share
from _file_hazards import CAMERA_HAZARDS, CLOCK_HAZARDS, TERRAIN_HAZARDS
from _sky_view import expose
from _view_hazards import VIEW_HAZARDS

from startrack.catalog import load_catalog
from startrack.chain import Located, Settings, locate
from startrack.rendering import Series
from startrack.terrain import load_terrain

HAZARDS = {**VIEW_HAZARDS, **CAMERA_HAZARDS, **TERRAIN_HAZARDS, **CLOCK_HAZARDS}
HEAD = ["class", "frames", "answered rightly", "refused", "beyond the 99.9 % circle"]
SEED, SHARE = 1907, 0.07


def measure_frame(job: tuple[str, int]) -> dict[str, Any]:
    """One frame of one class."""
    name, number = job
    true, catalog, hazard = load_terrain("shackleton-thesis"), load_catalog(), HAZARDS[name]
    camera, sky = camera_for_share(SHARE)
    series = Series(
        camera=camera, terrain=true, catalog=catalog, seed=SEED, exposure_s=EXPOSURE_S, hot_pixels=200, cosmic_rays=30,
        max_tilt_rad=float(np.radians(5)), sky_v_mag_arcsec2=sky,
    )  # fmt: skip
    scene, _ = series.scene(number)
    rng = np.random.default_rng([SEED, number, *name.encode()])
    exposure, truth, stated = expose(scene, hazard, rng)
    result = locate(exposure, stated, hazard.terrain(true, rng), catalog, Settings())
    if not isinstance(result, Located) or result.status != "ok":
        return {"reason": str(result.reason)}
    error = float(np.linalg.norm((result.fix.position_enu_m - truth.position_enu_m)[:2]))
    return {"reason": "", "error_m": error, "circle_m": result.fix.radius999_m}


def summary(name: str, rows: list[dict[str, Any]]) -> list[str]:
    """One line of the table."""
    located = [row for row in rows if not row["reason"]]
    beyond = [row for row in located if row["error_m"] > row["circle_m"]]
    reasons = Counter(row["reason"] for row in rows if row["reason"])
    refused = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
    wrong = ", ".join(f"{row['error_m']:.0f} of {row['circle_m']:.0f} m" for row in beyond)
    return [
        name, str(len(rows)), str(len(located) - len(beyond)),
        f"{len(rows) - len(located)}" + (f" ({refused})" if refused else ""),
        f"{len(beyond)}" + (f" ({wrong})" if wrong else ""),
    ]  # fmt: skip
