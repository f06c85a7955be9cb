"""Camera calibration against simulated truth, and on a real photograph.

    python benchmarks/calibration.py                the whole table, about five minutes
    python benchmarks/calibration.py --trials 10    a quick look (nothing is written)

Truth: f = 652 px/rad, centre off the middle by 10 px (s.d.), random attitudes, stars evenly over the sky to 90 degrees
off the axis (orthographic: 80). Map error: RMS over solid angle to the calibrated angle, vector, best rotation removed.
ANEES: the map's error in units of its stated covariance, per degree of freedom (1 is perfect, below is cautious).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from _results import table, write_section

from startrack.applications.calibration import calibrate, fit_lens, initial_state, observations
from startrack.camera import Camera, KannalaBrandt, cap_grid, compensating_rotation, lens_jacobian
from startrack.catalog import load_catalog
from startrack.exposure import read_exposure
from startrack.frames import R_from_quat_xyzw, R_from_rotvec, Site

Law = Callable[[np.ndarray], np.ndarray]
FOCAL_PX, SIZE_PX = 652.0, (2048, 2048)
LAWS: dict[str, Law | None] = {
    "equidistant": lambda a: a,
    "equisolid": lambda a: 2 * np.sin(a / 2),
    "stereographic": lambda a: 2 * np.tan(a / 2),
    "orthographic": np.sin,
    "random k1 to k4": None,
}
TOP_DEG = {"orthographic": 80.0}
MAP_POINTS = 1500
PHOTO = Path(__file__).parent.parent / "sample_images/lowell-2018-08-06.fits.bz2"
PHOTO_SITE = Site("earth", np.radians(34.7443), np.radians(-111.4223), 2361.0)


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    name: str
    frames: int
    stars: int
    sigma_px: float
    wrong: float = 0.0  # fraction of wrong matches
    top_deg: float | None = None
    from_nothing: bool = False  # no approximate camera: only the matches


@dataclass(frozen=True)
class Trial:
    """One calibration, scored."""

    error_px: float
    nees: float
    freedom: int
    calibrated_deg: float
    seconds: float


CASES = (
    Case("1 frame, 100 stars, 0.2 px", 1, 100, 0.2),
    Case("20 frames, 300 stars each, 0.1 px", 20, 300, 0.1),
    Case("1 frame, 100 stars, 20 % wrong", 1, 100, 0.2, wrong=0.2, from_nothing=True),
    Case("1 frame, 300 stars inside 60 degrees", 1, 300, 0.2, top_deg=60.0),
)


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200, help="per case; the lenses alternate")
    parser.add_argument("--seed", type=int, default=2026)
    args = parser.parse_args()
    rows = []
    for case in CASES:
        found = {law: list(trials(case, law, args.trials // len(LAWS), args.seed)) for law in LAWS}
        rows += [row(case.name, law, some) for law, some in found.items()]
        rows.append(row(case.name, "**all**", [trial for some in found.values() for trial in some]))
        print(rows[-1], flush=True)
    head = ["case", "lens", "trials", "map error px: median", "90 %", "ANEES", "calibrated to", "s per fit"]
    body = table(head, rows) + "\n\n" + photograph()
    print(body)
    if args.trials >= 200:
        write_section("Calibration", f"python benchmarks/calibration.py --trials {args.trials}", ("numpy",), body)


def trials(case: Case, law: str, count: int, seed: int) -> Iterator[Trial]:
    """Calibrations of random cameras under random skies."""
    for number in range(count):
        rng = np.random.default_rng([seed, number, case.frames, case.stars, list(LAWS).index(law)])
        yield trial(case, law, rng)


def trial(case: Case, law: str, rng: np.random.Generator) -> Trial:
    """One calibration of a random camera under a random sky."""
    rho, centre = LAWS[law] or random_law(rng), 1023.5 + rng.normal(0, 10, 2)
    top = np.radians(case.top_deg or TOP_DEG.get(law, 90.0))
    xy, rays, R = [], [], []
    for _ in range(case.frames):
        seen = even_rays(top, case.stars, rng)
        quaternion = rng.normal(size=4)
        R.append(R_from_quat_xyzw(quaternion / np.linalg.norm(quaternion)))
        rays.append(seen @ R[-1])
        xy.append(project(rho, centre, seen) + rng.normal(0, case.sigma_px, (case.stars, 2)))
        wrong = rng.permutation(case.stars)[: int(case.wrong * case.stars)]
        xy[-1][wrong] = rng.uniform(0, SIZE_PX[0] - 1, (len(wrong), 2))
    start = time.perf_counter()
    points = observations(xy, rays, case.sigma_px**2)
    if case.from_nothing:
        state = initial_state(points, SIZE_PX)
        fit = fit_lens(state.camera, state.R_cam_icrs, points)
    else:
        fit = fit_lens(approximate_camera(), np.stack([R_from_rotvec(rng.normal(0, 0.01, 3)) @ r for r in R]), points)
    seconds = time.perf_counter() - start
    error, nees, freedom = map_error(fit.camera, rho, centre)
    return Trial(error, nees, freedom, float(np.degrees(fit.camera.calibrated_angle_rad)), seconds)


def approximate_camera() -> Camera:
    """The approximate camera: 2 % of focal length and 10 px of centre off."""
    return Camera(
        name="rough", size_px=SIZE_PX, focal_px=(640.0, 640.0), centre_px=(1023.5, 1023.5),
        max_angle_rad=np.pi / 2, calibrated_angle_rad=np.pi / 2,
    )  # fmt: skip


def random_law(rng: np.random.Generator) -> Law:
    """A Kannala-Brandt lens whose radius increases up to 100 degrees."""
    while True:
        lens = KannalaBrandt(tuple(rng.normal(0, [0.05, 0.02, 0.008, 0.002])))
        if lens.max_invertible_rad > np.radians(100):
            return lens.rho


def even_rays(top_rad: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Rays (n, 3) in cam, evenly over the cap."""
    z, b = rng.uniform(np.cos(top_rad), 1, count), rng.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(b), r * np.sin(b), z], axis=1)


def project(rho: Law, centre_px: np.ndarray, rays_cam: np.ndarray) -> np.ndarray:
    """True pixels (n, 2), computed independently of the package."""
    s = np.hypot(rays_cam[:, 0], rays_cam[:, 1])
    return centre_px + FOCAL_PX * (rho(np.arctan2(s, rays_cam[:, 2])) / s)[:, None] * rays_cam[:, :2]


def map_error(camera: Camera, rho: Law, centre_px: np.ndarray) -> tuple[float, float, int]:
    """RMS error [px] with the best rotation removed, its NEES, and the NEES's degrees of freedom."""
    grid = cap_grid(camera.calibrated_angle_rad, MAP_POINTS)
    rotation = camera.jacobian_px_per_rad(grid).reshape(-1, 3)
    error = (camera.project_unlimited(grid) - project(rho, centre_px, grid)).reshape(-1)
    error = error - rotation @ np.linalg.lstsq(rotation, error, rcond=None)[0]
    order = camera.covariance_order
    lens = lens_jacobian(camera, grid, order).reshape(-1, len(order)) + rotation @ compensating_rotation(camera, order)
    covariance = camera.covariance
    if camera.focal_px[0] == camera.focal_px[1]:  # square pixels: fx and fy are one unknown
        lens = np.concatenate([lens[:, :1] + lens[:, 1:2], lens[:, 2:]], axis=1)
        covariance = np.delete(np.delete(covariance, 1, axis=0), 1, axis=1)
    u, s, _ = np.linalg.svd(lens @ np.linalg.cholesky(covariance), full_matrices=False)
    nees = float(np.sum(np.square(u.T @ error / s)))
    return float(np.sqrt(np.mean(np.sum(error.reshape(-1, 2) ** 2, axis=1)))), nees, len(s)


def row(case: str, law: str, some: list[Trial]) -> list[str]:
    """A row of the table."""
    errors = [trial.error_px for trial in some]
    anees = sum(trial.nees for trial in some) / sum(trial.freedom for trial in some)
    return [
        case, law, str(len(some)), f"{np.median(errors):.4f}", f"{np.quantile(errors, 0.9):.4f}", f"{anees:.2f}",
        f"{np.median([t.calibrated_deg for t in some]):.1f}°", f"{np.median([t.seconds for t in some]):.2f}",
    ]  # fmt: skip


def photograph() -> str:
    """The shipped all-sky photograph, from `--fov 180` alone."""
    exposure = read_exposure(PHOTO)
    start = time.perf_counter()
    found = calibrate([exposure], load_catalog(), fov_rad=np.pi, site=PHOTO_SITE)
    fit = found.joint.fit
    gates = "all passed" if found.accepted else ", ".join(gate.name for gate in found.failed_checks) + " FAILED"
    opposite = next(gate.value for gate in found.checks if gate.name.startswith("opposite"))
    reach = np.degrees(fit.camera.calibrated_angle_rad)
    return (
        f"`{PHOTO.name}` from cold (`--fov 180`), {time.perf_counter() - start:.1f} s: {int(fit.used.sum())} stars, "
        f"held-out RMS distance {fit.held_out_rms_px:.3f} px, calibrated to {reach:.1f}°; gates: {gates}; "
        f"the opposite handedness misses by {opposite:.0f} px."
    )


if __name__ == "__main__":
    main()
