"""Effect of each part of the evidence, and of a longer exposure: from pixels to position, in one table each.

    python benchmarks/evidence.py --frames 300 --deep-frames 100

The true sky is Hipparcos and the Gaia stars that it lacks (extra `deep`); the locator uses Gaia's only where the frame
is deep enough. "full" is the method of `locate`; each other line omits one part, and the second measurement near the
skyline. 2048 px fisheye, 3 % scatter of the fluxes beside the catalogue's own errors, hot pixels, cosmic rays, random
positions, dates, headings, tilt to 5 degrees. All lines of a table use the same frames, or the first of them.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np
from _results import table, write_section
from chain import SENSOR

from startrack.camera import load_camera
from startrack.catalog import load_catalog, load_deep_catalog
from startrack.chain import Located, Measured, Settings, last_value, locate
from startrack.core.types import Array, Evidence, Fix, NoSolution
from startrack.evidence import StarPhotometer, StarPhotometry, flux_scale, star_photometer
from startrack.localization import ExactPosterior
from startrack.rendering import Series, exposure_for_snr, render
from startrack.terrain import load_terrain

CHI2_2 = {"50": 1.3863, "95": 5.9915, "99.9": 13.8155}  # of two degrees of freedom
LISTS = {"full": "as deep as the frame", "Hipparcos alone": "Hipparcos alone"}
CERTAIN = 9.0  # nats: largest evidence of a list for one star


@dataclass(frozen=True)
class Depth:
    """Depth of the frames, and the catalogues used for them."""

    v_mag: float
    frames: int
    compared: int = 0  # number of frames evaluated with parts left out, and with Hipparcos alone


def main() -> None:
    """Run all depths and write both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300, help="at V 6.0")
    parser.add_argument("--deep-frames", type=int, default=100, help="at V 7.5")
    parser.add_argument("--other-frames", type=int, default=20, help="at V 5, 7 and 8")
    parser.add_argument("--seed", type=int, default=1736)
    parser.add_argument("-j", "--jobs", type=int, default=2)
    args = parser.parse_args()
    depths = (
        Depth(5.0, args.other_frames), Depth(6.0, args.frames, min(args.frames, 100)), Depth(7.0, args.other_frames),
        Depth(7.5, args.deep_frames, args.other_frames), Depth(8.0, args.other_frames),
    )  # fmt: skip
    jobs = [(args.seed, depth, number) for depth in depths for number in range(depth.frames)]
    rows: dict[tuple[float, str], list[dict[str, Any]]] = {}
    with ProcessPoolExecutor(args.jobs) as pool:
        for done, (job, lines) in enumerate(zip(jobs, pool.map(measure_frame, jobs), strict=True), 1):
            for name, row in lines.items():
                rows.setdefault((job[1].v_mag, name), []).append(row)
            if done % 20 == 0:
                print(f"{done} of {len(jobs)}", {key: line(found) for key, found in rows.items()}, flush=True)
    command = f"python benchmarks/evidence.py --frames {args.frames} --deep-frames {args.deep_frames}"
    ablated = [depth.v_mag for depth in depths if depth.compared]
    parts = [[f"{v:.1f}", name, *line(found)] for (v, name), found in rows.items() if v in ablated]
    deep = [[f"{v:.1f}", LISTS[name], *line(found)] for (v, name), found in sorted(rows.items()) if name in LISTS]
    for title, text in (
        ("Evidence, part by part", table(["5 sigma at V", "evidence", *HEAD], parts)),
        ("Depth", table(["5 sigma at V", "list", *HEAD], deep)),
    ):
        print(text)
        write_section(title, command, ("numpy", "scipy"), text)


HEAD = ["frames", "refused", "mean, m", "s.d.", "max", "NEES", "50 %", "95 %", "99.9 %", "95 % circle"]


def line(rows: list[dict[str, Any]]) -> list[str]:
    """One line of a table; coverage is that of the ellipses of the stated covariance, and of the stated circle."""
    good = [row for row in rows if "error_m" in row]
    if not good:
        return [str(len(rows)), str(len(rows)), *["-"] * (len(HEAD) - 2)]
    error, nees = (np.array([row[key] for row in good]) for key in ("error_m", "nees"))
    inside = [f"{100 * np.mean(nees < limit):.1f}" for limit in CHI2_2.values()]
    spread = [f"{value:.2f}" for value in (error.mean(), error.std(), error.max(), nees.mean())]
    circle = f"{100 * np.mean([row['in95'] for row in good]):.1f}"
    return [str(len(rows)), str(len(rows) - len(good)), *spread, *inside, circle]


def measure_frame(job: tuple[int, Depth, int]) -> dict[str, dict[str, Any]]:
    """One frame by every method: name to its figures."""
    seed, depth, number = job
    sky, catalog = load_deep_catalog(), load_catalog()
    camera, terrain = replace(load_camera("fisheye-2048"), sensor=SENSOR), load_terrain("shackleton-thesis")
    series = Series(
        camera=camera, terrain=terrain, catalog=sky, seed=seed, hot_pixels=200, cosmic_rays=30, faint_v_mag=None,
        exposure_s=exposure_for_snr(camera, 22.0, v_mag=depth.v_mag, snr=5.0),
    )  # fmt: skip
    scene, rng = series.scene(number)
    exposure, truth = render(scene, rng=rng)
    position = truth.position_enu_m[:2]
    fast = Settings(localizer=ExactPosterior())
    result = locate(exposure, camera, terrain, catalog, fast)
    rows = {"full": _score_fix(_fix(result), position)}
    value = last_value(result)
    if number < depth.compared and isinstance(value, Measured):
        plain = locate(exposure, camera, terrain, catalog, replace(fast, deep_stars=False))
        rows["Hipparcos alone"] = _score_fix(_fix(plain), position)
        for name, evidence, localizer in _ablations(value):
            try:
                fix = localizer(evidence, terrain)
            except NoSolution:
                fix = None
            rows[name] = _score_fix(fix, position)
    return rows


def _fix(outcome: Any) -> Fix | None:
    return outcome.fix if isinstance(outcome, Located) and not outcome.fix.ambiguous else None


def _score_fix(fix: Fix | None, position_m: Array) -> dict[str, Any]:
    if fix is None:
        return {}
    d = fix.position_enu_m[:2] - position_m
    error = float(np.hypot(*d))
    return {"error_m": error, "nees": float(d @ np.linalg.solve(fix.covariance_m2, d)), "in95": error < fix.radius95_m}


def _ablations(result: Measured) -> Iterator[tuple[str, Evidence, ExactPosterior]]:
    full = ExactPosterior()
    yield "without remeasuring near the skyline", _photometry(result).evidence(), full
    yield "list at 5 sigma", _list_evidence(result.photometry, 5.0), full
    yield "list at 3 sigma", _list_evidence(result.photometry, 3.0), full
    lonely = _photometry(result, visible=np.zeros(len(result.stars)))  # neighbours that are never visible
    yield "without crowding", lonely.evidence(), full
    yield "without flux uncertainty", _photometry(result, certain=True).evidence(), full
    yield "without caps", _photometry(result, settings=_Uncapped()).evidence(), full


class _Uncapped(StarPhotometer):
    """Plain Gaussian ratios; whether neighbours are visible is guessed as always."""

    def judge(self, found: Any, light: Any) -> StarPhotometry:
        none = {"MISSING_PROBABILITY": 0.0, "ANOMALY_PROBABILITY": 0.0, "CAP": np.inf}
        with patch.multiple(star_photometer, **none), np.errstate(divide="ignore"):
            return super().judge(found, light)


def _list_evidence(photometry: StarPhotometry, threshold: float) -> Evidence:
    """Evidence of a list: whether each star expected above the threshold was detected, and nothing else."""
    from scipy.stats import norm

    use = photometry.usable & (photometry.expected_e > threshold * photometry.sigma_e)
    expected = photometry.expected_e[use] / photometry.sigma_e[use]
    seen = photometry.flux_e[use] > threshold * photometry.sigma_e[use]
    present = norm.logsf(threshold - expected) - norm.logsf(threshold)
    absent = norm.logcdf(threshold - expected) - norm.logcdf(threshold)
    return Evidence(
        azimuth_rad=photometry.azimuth_rad[use],
        elevation_rad=photometry.elevation_rad[use],
        llr=np.clip(np.where(seen, present, absent), -CERTAIN, CERTAIN),
        edge_sigma_rad=np.zeros(int(use.sum())),
    )


def _photometry(
    result: Measured, *, visible: Array | None = None, certain: bool = False, settings: StarPhotometer | None = None
) -> StarPhotometry:
    """The frame's evidence once more, with a part left out."""
    stars, R, found = result.stars, result.attitude_fit.attitude.R_cam_icrs, result.identification
    scale = flux_scale(result.detections, result.camera, stars, (found.detection, found.star), R)
    extra_px = result.attitude_fit.extra_sigma_px
    if certain:
        stars, scale = replace(stars, v_sigma_mag=np.zeros(len(stars))), replace(scale, scatter=0.0)
        extra_px = 0.0
    return (settings or StarPhotometer())(
        result.detections, result.camera, stars, list(result.bodies),
        result.attitude_fit.attitude.R_cam_icrs, result.R_enu_icrs, scale, extra_px, visible,
    )  # fmt: skip


if __name__ == "__main__":
    main()
