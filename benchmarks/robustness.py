"""Fixes with wrong inputs or disturbed scenes: from pixels, one kind of trouble at a time.

    python benchmarks/robustness.py --frames 16

Each row: frames located in spite of it, frames refused or ambiguous, and among the located ones how many errors lie
beyond the stated 99.9 % circle. "Caught" is the sum of what is right and what is refused.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Any

import numpy as np
from _results import table, write_section
from chain import SENSOR

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import Located, Settings, locate
from startrack.core.types import Array
from startrack.evidence import StarPhotometer
from startrack.frames import R_from_rotvec
from startrack.localization import ExactPosterior
from startrack.rendering import Series, render
from startrack.terrain import Cylinder, load_terrain

BOULDER_AZIMUTH_RAD = np.radians(75.0)


@dataclass(frozen=True, kw_only=True)
class Obstructed(Cylinder):
    """The crater with an unmapped ridge: `width` of azimuth, `height` above the crater's own horizon."""

    width_rad: float
    height_rad: float

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        horizon = super().horizon_rad(points_m, azimuths_rad)
        off = np.abs((azimuths_rad - BOULDER_AZIMUTH_RAD + np.pi) % (2 * np.pi) - np.pi)
        return np.where(off < self.width_rad / 2, horizon + self.height_rad, horizon)


@dataclass(frozen=True)
class Trouble:
    """Difference between the true scene and the inputs of the locator."""

    name: str
    world: Callable[[Cylinder], Cylinder] = lambda crater: crater
    stated: Callable[[Cylinder], Cylinder] = lambda crater: crater
    clock_s: float = 0.0
    tilt_deg: float = 5.0
    swapped: float = 0.0  # fraction of the catalogue's stars with exchanged identities
    attitude_bias_arcsec: float = 0.0  # about each axis of the camera


@dataclass(frozen=True)
class Biased:
    """The evidence measured at an attitude with an error."""

    arcsec: float

    def __call__(self, *what: Any) -> Any:
        turn = R_from_rotvec(np.radians(np.full(3, self.arcsec) / 3600))
        return StarPhotometer()(*what[:4], turn @ what[4], *what[5:])  # the fifth is the attitude


def ridge(width_deg: float, height_deg: float) -> Callable[[Cylinder], Cylinder]:
    """A crater with an unmapped ridge."""
    return lambda crater: Obstructed(
        **{**vars(crater), "width_rad": np.radians(width_deg), "height_rad": np.radians(height_deg)}
    )


TROUBLES = (
    Trouble("none"),
    Trouble("ridge of 5 by 5 degrees", world=ridge(5, 5)),
    Trouble("ridge of 20 by 10 degrees", world=ridge(20, 10)),
    Trouble("depth 1 % too large", stated=lambda c: replace(c, depth_m=1.01 * c.depth_m)),
    Trouble("depth 1 % too small", stated=lambda c: replace(c, depth_m=0.99 * c.depth_m)),
    Trouble("diameter 1 % too large", stated=lambda c: replace(c, diameter_m=1.01 * c.diameter_m)),
    Trouble("diameter 1 % too small", stated=lambda c: replace(c, diameter_m=0.99 * c.diameter_m)),
    Trouble(
        "depth 1 % too large, depth_sigma_m 20",
        stated=lambda c: replace(c, depth_m=1.01 * c.depth_m, depth_sigma_m=0.01 * c.depth_m),
    ),
    Trouble("clock wrong by one hour", clock_s=3600.0),
    Trouble("3 % of identities wrong", swapped=0.03),
    Trouble("attitude biased by 3 sigma (3.5 arcsec per axis)", attitude_bias_arcsec=3.5),
    Trouble("tilt to 10 degrees", tilt_deg=10.0),
    Trouble("tilt to 20 degrees", tilt_deg=20.0),
    Trouble("tilt to 30 degrees", tilt_deg=30.0),
)


def main() -> None:
    """Run all troubles at the same positions and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("-j", "--jobs", type=int, default=2)
    args = parser.parse_args()
    jobs = [(index, number) for index in range(len(TROUBLES)) for number in range(args.frames)]
    with ProcessPoolExecutor(args.jobs) as pool:
        rows = list(pool.map(measure_frame, jobs, chunksize=4))
    body = table(
        ["trouble", "located", "refused or ambiguous", "mean error, m", "max", "beyond the 99.9 % circle", "caught"],
        [summary(t, [r for (i, _), r in zip(jobs, rows, strict=True) if i == k]) for k, t in enumerate(TROUBLES)],
    )
    print(body)
    write_section("Robustness", f"python benchmarks/robustness.py --frames {args.frames}", ("numpy", "scipy"), body)


def measure_frame(job: tuple[int, int]) -> dict[str, Any]:
    """One frame under one trouble."""
    trouble, number = TROUBLES[job[0]], job[1]
    true = load_terrain("shackleton-thesis")
    assert isinstance(true, Cylinder)
    catalog = load_catalog()
    series = Series(
        camera=replace(load_camera("fisheye-2048"), sensor=SENSOR), terrain=trouble.world(true), catalog=catalog,
        seed=31, exposure_s=10.0, hot_pixels=200, cosmic_rays=30, max_tilt_rad=float(np.radians(trouble.tilt_deg)),
    )  # fmt: skip
    scene, rng = series.scene(number)
    exposure, truth = render(scene, rng=rng)
    assert exposure.time_utc is not None
    exposure = replace(exposure, time_utc=exposure.time_utc + timedelta(seconds=trouble.clock_s))
    if trouble.swapped:
        chosen = np.flatnonzero(np.random.default_rng(number).random(len(catalog)) < trouble.swapped)
        rays = np.array(catalog.rays_icrs)
        rays[chosen] = rays[np.roll(chosen, 1)]
        catalog = replace(catalog, rays_icrs=rays)
    evidence = Biased(trouble.attitude_bias_arcsec) if trouble.attitude_bias_arcsec else StarPhotometer()
    settings = Settings(localizer=ExactPosterior(), photometer=evidence)  # type: ignore[arg-type]
    result = locate(exposure, scene.camera, trouble.stated(true), catalog, settings)
    if not isinstance(result, Located) or result.status != "ok":
        return {"status": result.status, "reason": result.reason}
    error = float(np.linalg.norm((result.fix.position_enu_m - truth.position_enu_m)[:2]))
    return {"status": "ok", "error_m": error, "beyond": error > result.fix.radius999_m}


def summary(trouble: Trouble, rows: list[dict[str, Any]]) -> list[str]:
    """One line of the table."""
    located = [row for row in rows if row["status"] == "ok"]
    errors = [row["error_m"] for row in located]
    beyond = sum(row["beyond"] for row in located)
    reasons = sorted({str(row["reason"]) for row in rows if row["status"] != "ok"})
    away = f"{len(rows) - len(located)}" + (f" ({', '.join(reasons)})" if reasons else "")
    mean, most = (f"{np.mean(errors):.1f}", f"{max(errors):.1f}") if errors else ("-", "-")
    return [trouble.name, str(len(located)), away, mean, most, str(beyond), f"{len(rows) - beyond} of {len(rows)}"]


if __name__ == "__main__":
    main()
