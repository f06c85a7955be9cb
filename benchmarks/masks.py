"""Masks that `startrack calibrate` proposes from one picture, against other nights of the same camera.

    python benchmarks/masks.py PHOTOGRAPH PHOTOGRAPH ... [--site 34.7443 -111.4223 2361] [--fov 180]

Photographs of one fixed camera: those of the Lowell all-sky camera are in github.com/mommermi/cloudynight
(example_data/images, BSD-3-Clause). Each is calibrated alone. Those that give a mask are clear, dark nights: their mask
is compared with that of all the other clear nights together, inside the calibrated angle of the picture. Of the stars
that other photographs show, those in the mask are counted.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from _results import table, write_section

from startrack.applications.calibration import calibrate
from startrack.applications.calibration.run import Calibration
from startrack.catalog import load_catalog
from startrack.core.types import Array, Bools, NoSolution
from startrack.exposure import read_exposure
from startrack.frames import Site


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photographs", nargs="+", type=Path)
    parser.add_argument("--site", nargs=3, type=float, default=(34.7443, -111.4223, 2361.0), help="degrees, metres")
    parser.add_argument("--fov", type=float, default=180.0, help="degrees")
    args = parser.parse_args()
    site, catalog = Site("earth", *np.radians(args.site[:2]), args.site[2]), load_catalog()

    def calibrated(paths: list[Path]) -> Calibration:
        return calibrate([read_exposure(path) for path in paths], catalog, fov_rad=np.radians(args.fov), site=site)

    alone: dict[Path, Calibration] = {}
    rows = []
    for path in args.photographs:
        try:
            alone[path] = calibrated([path])
        except NoSolution as cause:
            rows.append([path.name, "", "", "", cause.reason])
    clear = [path for path, found in alone.items() if found.obstructed is not None]
    for path, found in alone.items():
        seen = np.concatenate([stars_px(other) for name, other in alone.items() if name != path])
        masked = np.zeros(found.camera.size_px[::-1], bool) if found.obstructed is None else found.obstructed
        column, row = np.rint(seen).astype(int).T
        part = ""
        if path in clear and len(clear) > 1:
            together = calibrated([name for name in clear if name != path]).obstructed
            part = f"{100 * masked[together & inside(found)].mean():.0f} %"
        wrong = f"{np.count_nonzero(masked[row, column])} of {len(seen)}"
        rows.append([path.name, str(np.count_nonzero(masked)), part, wrong, found.no_mask_because])
    body = table(["photograph", "pixels", "of those of the other nights", "stars masked", "none because"], sorted(rows))
    print(body)
    write_section("Proposed masks", "python benchmarks/masks.py ...", ("numpy",), body)


def stars_px(found: Calibration) -> Array:
    """Pixels (n, 2) of the bright stars that the photograph shows."""
    bright = found.joint.matches[0].bright
    return bright.xy_px[bright.found]


def inside(found: Calibration) -> Bools:
    """Pixels (H, W) inside the calibrated angle."""
    camera = found.camera
    x, y = ((np.arange(n) - c) / f for n, c, f in zip(camera.size_px, camera.centre_px, camera.focal_px, strict=True))
    return np.hypot(x, y[:, None]) <= camera.lens.rho(np.array(camera.calibrated_angle_rad))


if __name__ == "__main__":
    main()
