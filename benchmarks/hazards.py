"""Located frames of which something is wrong that no file states: right, refused, or confident and wrong.

    python benchmarks/hazards.py [--frames 24] [--only dust mast]
    python benchmarks/hazards.py --evidence 300 [--only clock]

Rendered frames of the thesis's crater (5 sigma at V 6, sky 7 % of the background). Each row: answers within their own
99.9 % circle, refusals by reason, and answers beyond that circle. All classes have the same poses.

With --evidence the stars' photometry is simulated instead of the pixels, and located by the stars alone: many more
frames, of the classes that need no pixels, also on height maps. Slow classes have fewer frames.
"""

from __future__ import annotations

import sys
from collections import Counter
from typing import Any

import _evidence_hazards as by_evidence
import numpy as np
from _classes import run_classes
from _file_hazards import CAMERA_HAZARDS, CLOCK_HAZARDS, TERRAIN_HAZARDS
from _sky_scenes import EXPOSURE_S, camera_for_share
from _sky_view import expose
from _view_hazards import VIEW_HAZARDS

from startrack.catalog import load_catalog
from startrack.pipeline import Settings, locate
from startrack.rendering import Series
from startrack.stages import Located
from startrack.terrain import load_terrain

HAZARDS = {**VIEW_HAZARDS, **CAMERA_HAZARDS, **TERRAIN_HAZARDS, **CLOCK_HAZARDS}
SEED, SHARE = 1907, 0.07


def main() -> None:
    """Run the classes, print the table; write the section if all were run."""
    if any(word.startswith("--evidence") for word in sys.argv):
        run_classes(
            __file__, __doc__, "Hazards at the level of evidence", list(by_evidence.CLASSES), 300, by_evidence.HEAD,
            by_evidence.measure_frame, by_evidence.summary, by_evidence.every, "--evidence", by_evidence.totals,
        )  # fmt: skip
        return
    head = ["class", "frames", "answered rightly", "refused", "beyond the 99.9 % circle"]
    run_classes(__file__, __doc__, "Hazards", list(HAZARDS), 24, head, measure_frame, summary)


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


if __name__ == "__main__":
    main()
