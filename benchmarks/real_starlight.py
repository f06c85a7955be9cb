"""Positions from real starlight: photographs of the Lowell all-sky camera behind the wall of an invented crater.

    python benchmarks/real_starlight.py [PHOTOGRAPH ...] [--camera lowell-ldt] [--places 3] [--seed 29]

Without files: the shipped photograph. Others of the same camera are in github.com/mommermi/cloudynight
(example_data/images, BSD-3-Clause). A photograph with fewer than 150 bright stars is named and left out.

What no renderer has is real here: point spread, magnitudes, extinction, gradients, and a lens that differs from night
to night. Pixels below the skyline of a crater 4 km wide and 1 km deep are replaced by the level and the noise of the
same frame outside its image circle; the edge is 0.9 px soft (stars: 0.5 px). The direction of a pixel is not
startrack's: a lens is fitted here to the stars of the same frame, in azimuths and apparent elevations by astropy.
Trees and the dome, of which some stand above the wall, are stated as obstacles; --unstated leaves that out.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from _results import table, write_section
from astropy import units as u
from astropy.coordinates import AltAz, Distance, EarthLocation, SkyCoord
from astropy.time import Time
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import Located, Oriented, identify, locate
from startrack.core.obstacles import Obstacles
from startrack.core.statistics import robust_sigma
from startrack.core.types import Array, Exposure
from startrack.exposure import read_exposure
from startrack.frames import Site, rays_from_azel
from startrack.terrain import load_terrain

ROOT = Path(__file__).parent.parent
PHOTOGRAPH = ROOT / "sample_images/lowell-2018-08-06.fits.bz2"
SITE = Site("earth", np.radians(34.7443), np.radians(-111.4223), 2361.0)  # the telescope; the headers' is wrong
PRESSURE_HPA, TEMPERATURE_C, HUMIDITY_1, WAVELENGTH_UM = 765.0, 10.0, 0.3, 0.55  # usual there
RADIUS_M, DEPTH_M, CAMERA_M = 2000.0, 1000.0, 1.5
REACH_M = 1000.0  # of the places from the axis: the wall is then 18 to 45 degrees high
# Azimuth and elevation of what stands about the camera: the dome, and trees, 1 degree beyond their outlines in the
# photographs of 2018-07-29 (before clouds) and 2018-08-06. Between them it is below 14 degrees.
STANDING_DEG = (
    (0.0, 36.5), (5.0, 36.5), (12.0, 36.5), (17.0, 31.0), (18.5, 17.0), (18.5, 2.0), (88.0, 10.0), (97.0, 17.5),
    (107.0, 17.5), (112.0, 10.0), (118.0, 8.0), (245.0, 20.5), (253.0, 20.5), (261.0, 20.5), (268.0, 20.5),
    (275.0, 15.0), (330.0, 13.0), (339.0, 13.0), (344.0, 16.0), (347.0, 22.0), (351.0, 25.0), (355.0, 25.0),
    (356.0, 36.5),
)  # fmt: skip
OUTSIDE_PX = 525.0  # from the middle of the image circle: no light comes through the lens
PSF_SIGMA_PX = 0.9
BRIGHT_MAG, LEAST_STARS, WRONG_PX = 5.5, 150, 1.5  # of the stars that the lens is fitted to
SCALE_PX = 500.0  # unit of radius
TERRAIN = f"""
format = 1
name = "invented"
body = "earth"
cylinder = {{diameter_m = {2 * RADIUS_M}, depth_m = {DEPTH_M}, exact = true}}
rover = {{camera_height_m = {CAMERA_M}}}
search = {{radius_m = {0.95 * RADIUS_M}}}

[air]
pressure_hpa = {PRESSURE_HPA}
temperature_c = {TEMPERATURE_C}
humidity_1 = {HUMIDITY_1}

[origin]
latitude_deg = {np.degrees(SITE.latitude_rad)}
longitude_deg = {np.degrees(SITE.longitude_rad)}
height_m = {SITE.height_m}
"""


@dataclass(frozen=True)
class FrameLens:
    """Directions of pixels in east, north, up, of one frame.

    The angle off the axis is an odd polynomial of the radius; pixels may be sheared and the lens decentred.
    """

    parameters: Array  # centre (2) [px], shear (2), decentring (2), rotation vector (3), odd polynomial (4)

    def rays_enu(self, xy_px: Array) -> Array:
        """Directions (..., 3) of pixels (..., 2)."""
        (x0, y0, skew, aspect, p1, p2), turn, odd = np.split(self.parameters, [6, 9])
        x, y = (xy_px[..., 0] - x0) / SCALE_PX, (xy_px[..., 1] - y0) / SCALE_PX
        x, y = x + skew * y, y * (1 + aspect)
        r2 = x * x + y * y
        x, y = x + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y, y + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
        r = np.hypot(x, y)
        angle = r * np.polyval(odd[::-1], r * r)
        side = np.sin(angle) / np.maximum(r, 1e-9)
        return np.stack([side * x, side * y, np.cos(angle)], axis=-1) @ Rotation.from_rotvec(turn).as_matrix().T

    def azel_rad(self, xy_px: Array) -> tuple[Array, Array]:
        """Azimuth and apparent elevation (...) [rad] of pixels (..., 2)."""
        east, north, up = np.moveaxis(self.rays_enu(xy_px), -1, 0)
        return np.arctan2(east, north), np.arctan2(up, np.hypot(east, north))


def star_rays_enu(one: Oriented, star: Array) -> Array:
    """Apparent directions (n, 3) of identified stars in east, north, up, by astropy with refraction."""
    catalog, when = load_catalog(), Time(one.exposure.time_utc)
    row_of = {int(hip): row for row, hip in enumerate(catalog.hip)}
    rows = [row_of[int(hip)] for hip in one.stars.hip[star]]
    ray, motion = catalog.rays_icrs[rows], catalog.motion_rad_yr[rows]
    ray = ray + motion * (when.jyear - catalog.epoch_yr)
    stars = SkyCoord(*ray.T, representation_type="cartesian", frame="icrs")
    stars = SkyCoord(stars.spherical.lon, stars.spherical.lat, Distance(parallax=1e-6 * u.arcsec), frame="icrs")
    place = EarthLocation.from_geodetic(
        np.degrees(SITE.longitude_rad) * u.deg, np.degrees(SITE.latitude_rad) * u.deg, SITE.height_m * u.m
    )
    air = {
        "pressure": PRESSURE_HPA * u.hPa, "temperature": TEMPERATURE_C * u.deg_C, "relative_humidity": HUMIDITY_1,
        "obswl": WAVELENGTH_UM * u.micron,
    }  # fmt: skip
    seen = stars.transform_to(AltAz(obstime=when, location=place, **air))
    return rays_from_azel(seen.az.rad, seen.alt.rad)


def fit_lens(one: Oriented) -> tuple[FrameLens, float]:
    """The lens of a frame, fitted to its bright stars, and the rms [px] of their distances per axis."""
    bright = one.stars.v_mag[one.identification.star] < BRIGHT_MAG
    rays = star_rays_enu(one, one.identification.star[bright])
    xy_px = one.detections.xy_px[one.identification.detection[bright]]
    if len(xy_px) < LEAST_STARS:
        raise ValueError(f"{len(xy_px)} bright stars")
    R_enu_cam = np.linalg.lstsq(one.camera.unproject(xy_px), rays, rcond=None)[0].T  # nearly a rotation
    turn = Rotation.from_matrix(R_enu_cam).as_rotvec()
    start = np.array([*one.camera.centre_px, 0, 0, 0, 0, *turn, SCALE_PX / one.camera.focal_px[0], 0.1, 0.0, 0.0])

    def miss_px(parameters: Array) -> Array:
        return (FrameLens(parameters).rays_enu(xy_px) - rays) * SCALE_PX / start[9]

    scale = np.array([1, 1, 1e-3, 1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2, 0.1, 0.1, 0.1, 0.1])
    robust = least_squares(lambda p: miss_px(p).ravel(), start, loss="soft_l1", f_scale=0.5, x_scale=scale)
    right = np.linalg.norm(miss_px(robust.x), axis=1) < WRONG_PX
    plain = least_squares(lambda p: miss_px(p)[right].ravel(), robust.x, x_scale=scale)
    return FrameLens(plain.x), float(np.sqrt(np.mean(np.sum(miss_px(plain.x)[right] ** 2, axis=1)) / 2))


def put_behind_wall(exposure: Exposure, lens: FrameLens, place_m: Array, rng: np.random.Generator) -> Exposure:
    """The exposure with the wall seen from a place (2,) on the floor: east, north of the axis."""
    pixels = exposure.pixels_adu
    x, y = np.meshgrid(np.arange(pixels.shape[1], dtype=float), np.arange(pixels.shape[0], dtype=float))
    azimuth, elevation = lens.azel_rad(np.stack([x, y], axis=-1))
    along = place_m[0] * np.sin(azimuth) + place_m[1] * np.cos(azimuth)
    distance = np.sqrt(np.maximum(along**2 + RADIUS_M**2 - place_m @ place_m, 0.0)) - along
    above = elevation - np.arctan2(DEPTH_M - CAMERA_M, distance)
    slope = np.hypot(*np.gradient(above))
    part = ndtr(above / (np.hypot(PSF_SIGMA_PX, np.sqrt(1 / 12)) * np.maximum(slope, 1e-6)))
    away = np.hypot(x - lens.parameters[0], y - lens.parameters[1])
    outside = pixels[away > OUTSIDE_PX]
    noise = robust_sigma(np.diff(outside)) / np.sqrt(2)
    dark = np.median(outside) + noise * rng.standard_normal(pixels.shape)
    mixed = np.where(away <= OUTSIDE_PX, part * pixels + (1 - part) * dark, pixels)
    return replace(exposure, pixels_adu=np.rint(mixed).astype(np.float32), camera=None, terrain=None)


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photographs", nargs="*", type=Path, default=[PHOTOGRAPH])
    parser.add_argument("--camera", default="lowell-ldt")
    parser.add_argument("--places", type=int, default=3)
    parser.add_argument("--seed", type=int, default=29)
    parser.add_argument("--unstated", action="store_true", help="do not state the trees and the dome as obstacles")
    args = parser.parse_args()
    standing = None if args.unstated else Obstacles(*np.radians(STANDING_DEG).T)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "invented.toml"
        file.write_text(TERRAIN, encoding="utf-8")
        terrain = load_terrain(file)
    camera, catalog, rng = load_camera(args.camera), load_catalog(), np.random.default_rng(args.seed)
    rows, errors, nees, beyond, places = [], [], [], 0, 0
    for path in args.photographs:
        exposure = read_exposure(path)
        one = identify(exposure, camera, catalog, site=SITE)
        try:
            lens, rms_px = fit_lens(one) if isinstance(one, Oriented) else (None, 0.0)
        except ValueError as few:
            one, lens = str(few), None
        if lens is None:
            rows.append([path.name, "", "left out: " + getattr(one, "message", str(one)), "", "", "", ""])
            continue
        for _ in range(args.places):
            place_m = rng.uniform(0, REACH_M) * rays_from_azel(rng.uniform(0, 2 * np.pi), 0.0)[:2]
            behind = replace(put_behind_wall(exposure, lens, place_m, rng), obstacles=standing)
            found, places = locate(behind, camera, terrain, catalog), places + 1
            row = [path.name, f"{rms_px:.2f} px", f"{place_m[0]:.0f} {place_m[1]:.0f}"]
            if not isinstance(found, Located) or found.fix.ambiguous:
                rows.append([*row, f"{found.reason}: {found.message[:60]}", "", "", ""])
                continue
            miss_m = found.fix.position_enu_m[:2] - place_m
            errors.append(float(np.hypot(*miss_m)))
            nees.append(float(miss_m @ np.linalg.solve(found.fix.covariance_m2, miss_m)))
            beyond += errors[-1] > found.fix.radius999_m
            rows.append([
                *row, "ok", f"{errors[-1]:.2f} m", f"{found.fix.radius95_m:.2f}, {found.fix.radius999_m:.2f} m",
                f"{nees[-1]:.1f}",
            ])  # fmt: skip
            print(*rows[-1], flush=True)
    summary = (
        f"{len(errors)} of {places} located: mean error {np.mean(errors):.2f} m, largest {np.max(errors):.2f} m, "
        f"mean NEES {np.mean(nees):.1f}, {beyond} beyond the 99.9 % circle"
        if errors
        else "none located"
    )
    head = ["photograph", "stars' rms", "east, north [m]", "status", "error", "95 %, 99.9 % circle", "NEES"]
    body = f"{summary}.\n\n{table(head, rows)}"
    print(body)
    names = " ".join(path.name for path in args.photographs)
    command = f"python benchmarks/real_starlight.py {names} --places {args.places} --seed {args.seed}"
    if args.unstated:
        command += " --unstated"
    write_section(f"Real starlight{', trees not stated' * args.unstated}", command, ("astropy",), body)


if __name__ == "__main__":
    main()
