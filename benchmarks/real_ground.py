"""Real pictures on real ground: Finse, Norway, by day, and Svalbard by night (the files: RESULTS.md, "Real ground").

    python benchmarks/real_ground.py FOLDER [--out OUT]

FOLDER holds `finse/` with two pictures of a webcam, an elevation model of 4 m posts and one of 100 m, and 45 control
points. Camera and attitude are fitted to the control points, the skyline is traced on the pictures, and
`startrack.locate_skyline` finds the place, with heading and tilt stated to 0.02 degrees, or left open. The true place
is the one by the control points. Of `svalbard/`: see `_real_night`.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import rasterio
from _real_night import compare_night, draw_skyline
from _results import table, write_section
from pyproj import Transformer
from scipy.ndimage import gaussian_filter, median_filter
from scipy.optimize import least_squares

import startrack
from startrack.camera import Camera, KannalaBrandt
from startrack.frames import R_from_rotvec, azel_from_rays, enu_from_latlon, nearest_rotation, rays_from_azel
from startrack.terrain import Terrain, load_terrain

PICTURES = ("2019-05-24_12-00_ori.jpg", "2022-07-08.jpg")
STATED_M = np.array([419169.2, 6718421.3, 1212.0])  # of CamFinseInit.json, UTM 32N
UTM, NO_DATA = "EPSG:32632", 1137.75
SIZE_PX = (1920, 1080)
ROOF_M, ABOVE_M = 80.0, 1.5  # about the camera, and above the median: the hut on which it stands
ASTER_LOWER_M = 6.0  # than the model of 4 m posts, by the median over that
WINDOW_PX = 9  # to either side of the model's skyline, in which the picture's is traced
LEAST_NOISE = 0.3  # of the change of brightness from row to row in the sky [ADU]
CLEAR, STRONG = 4.0, 12.0  # changes of brightness, in that noise: of an edge; beyond the second all count alike
ABOVE, JUMP = 0.3, 3.0  # cost of a clear edge above the path, and of a step of one pixel from column to column
APART_PX = 5  # between two edges: a blurred one is so high
PATCH_PX, ALIKE, AGREED_RAD = 80, 0.35, np.radians(0.1)  # of the comparison of two pictures
SIGMA_PX, CORRELATION_DEG = 1.2, 10.0  # of the skyline: that of the lens, by the control points, is the largest error
FINSE = """\
Finse, Norway: a webcam (1920 x 1080 px, about 68 degrees wide) of github luc-girod/ProjectImageToDEM
(commit 86adb64b, `projimdem/example/FinseDemoData/`, MIT), its elevation model of 4 m posts, and ASTER
posts of 100 m of github ArcticSnow/TopoPyScale_examples (commit e6cb96f9, `ex1_norway_finse/inputs/dem/`,
MIT); FOLDER holds them in `finse/`. Lens (2.0 px median residual) and attitude of 2019 are by 45 control
points, the attitude of 2022 by 141 patches of the picture of 2019. The skyline is traced over 78 degrees of
azimuth by the greatest change of brightness within 9 px of the model's; its sigma is 1.2 px, correlated
over 10 degrees, as the lens errs. The hut on which the camera stands is cut out of the model (`--cut-out`),
which is right to 0.31 m a post by its roughness. The model's skyline on each picture is drawn into the
output folder."""
AXES_NOTE = """\
The line of sight is at azimuth 61. Where the tilt alone is open the long axis lies along it. Where the
heading is open too, a move across it and a turn nearly do the same, since the ridge is all at about the
same distance (1.26 to 1.56 km): the long axis lies across the line of sight, and so does the error. A
search by another program (rays through the 4 m model in steps of 2 m, heading and tilts fitted at each
place) shows the same: 40 m across the line of sight raise its cost from 0.240 to 0.249 and 0.253, 40 m
along it to 0.55 and 0.68. The attitude by the control points and that by the skyline differ by 0.09 and
0.07 degrees in the two pictures, more than the stated 0.02; what is left beside the best attitude, 0.03
degrees with the same shape in both, is 0.8 m on the ridge."""
NIGHT = """\
Kjell Henriksen Observatory, Svalbard, by night: an all-sky JPEG of github n-brindley/all-sky-calibration
(commit 1ab99c79, MIT), 2016-01-11 19:00:14 UT by its name, and the 20 m model of the Norwegian Polar
Institute (CC BY 4.0, doi 10.21334/npolar.2014.dce53a47), 1.8 km north of the camera; FOLDER holds them in
`svalbard/`."""
STATED_DEG = ((0.02, 0.02), (0.02, 3.0), (180.0, 3.0))  # errors of heading and tilt
HEAD = [
    "picture", "error of heading, of each tilt, degrees", "along the line of sight, m", "across, m", "sigma, m",
    "azimuth of the long axis", "95 %, m", "NEES (2)", "skyline off the model's, degrees",
]  # fmt: skip
NAMES = {"2019": "2019-05-24, snow", "2022": "2022-07-08"}  # of the pictures, by their year
AXIS = (62.0, -7.0)  # azimuth and elevation with which the fit of the pose begins


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("real-ground"))
    args = parser.parse_args()
    args.out.mkdir(exist_ok=True)
    night = compare_night(args.folder / "svalbard", args.out)
    finse = args.folder / "finse"
    terrain = make_terrain(finse, args.out)
    camera, R_cam_enu, place_m = fit_pose(finse / "GCPs_pointagev4.csv", terrain)
    away_m = place_m[2] - terrain.ground_m(place_m[None, :2])[0]
    print(f"place by the control points E {place_m[0]:.1f} N {place_m[1]:.1f}, {away_m:.2f} m above the map")
    first, rows = finse / PICTURES[0], []
    for name in PICTURES:
        R = R_cam_enu if name == PICTURES[0] else turn_to(first, finse / name, camera) @ R_cam_enu
        polyline = args.out / f"{name[:4]}.csv"
        traced_px = trace_skyline(finse / name, camera, R, place_m, terrain)
        np.savetxt(polyline, np.stack(traced_px, axis=1), "%.2f", ",", header="x_px,y_px,sigma_px", comments="")
        draw_skyline(finse / name, model_px(camera, R, place_m, terrain), args.out / f"{name[:4]}.png")
        for heading_deg, tilt_deg in STATED_DEG:
            rows.append(locate(str(polyline), camera, R, place_m, terrain, heading_deg, tilt_deg))
            print(rows[-1], flush=True)
    texts = (FINSE, table(HEAD, rows), AXES_NOTE, f"{NIGHT} {night}")
    body = "\n\n".join(text if text.startswith("|") else text.replace("\n", " ") for text in texts)
    print(body)
    write_section("Real ground", "python benchmarks/real_ground.py FOLDER", ("numpy", "scipy"), body)


def locate(
    polyline: str, camera: Camera, R_cam_enu: np.ndarray, place_m: np.ndarray, terrain: Terrain, heading_deg: float,
    tilt_deg: float,
) -> list[str]:  # fmt: skip
    """Row of the table: the place by a polyline whose attitude is right to `heading_deg` and `tilt_deg`."""
    azimuth, pitch = np.degrees(azel_from_rays(R_cam_enu[2]))
    roll = np.degrees(np.arctan2(-R_cam_enu[0, 2], -R_cam_enu[1, 2]))
    found = startrack.locate_skyline(
        polyline, terrain=terrain, camera=camera, attitude=(azimuth, pitch, roll), heading_sigma=heading_deg,
        tilt_sigma=tilt_deg, correlation=CORRELATION_DEG,
    )  # fmt: skip
    stated = [NAMES[Path(polyline).stem], f"{heading_deg:g}, {tilt_deg:g}"]
    if found.position_m is None:
        return [*stated, f"refused: {found.reason}", *["-"] * (len(HEAD) - 3)]
    off, sight = found.position_m[:2] - place_m[:2], rays_from_azel(np.radians(azimuth), 0.0)[:2]
    sigmas, axes = np.linalg.eigh(found.covariance_m2)
    long_deg = np.degrees(np.arctan2(*axes[:, 1])) % 180.0
    nees = off @ np.linalg.solve(found.covariance_m2, off)
    raised = found.skyline["elevation_deg"].value - np.degrees(
        np.ravel(terrain.horizon_rad(found.position_m[None, :2], np.radians(found.skyline["azimuth_deg"].value)))
    )
    misfit = 1.4826 * np.nanmedian(np.abs(raised - np.nanmedian(raised)))
    return [
        *stated, f"{off @ sight:+.1f}", f"{off @ [sight[1], -sight[0]]:+.1f}",
        f"{sigmas[1] ** 0.5:.1f} by {sigmas[0] ** 0.5:.1f}", f"{long_deg:.0f}", f"{found.radius95_m:.1f}",
        f"{nees:.1f}", f"{misfit:.3f}",
    ]  # fmt: skip


def make_terrain(finse: Path, out: Path) -> Terrain:
    """The terrain of both models, imported by the command, without the roof on which the camera stands."""
    with rasterio.open(finse / "time_lapse_finse_DSM_midfilled.tif") as file:
        heights, at = file.read(1), file.transform
    rows, columns = np.indices(heights.shape)
    away = np.hypot(at.c + 4 * (columns + 0.5) - STATED_M[0], at.f - 4 * (rows + 0.5) - STATED_M[1])
    roof = (away < ROOF_M) & (heights > median_filter(heights, 21) + ABOVE_M)
    size = {"height": len(heights), "width": heights.shape[1], "count": 1, "dtype": "float32"}
    with rasterio.open(out / "dsm.tif", "w", driver="GTiff", crs=UTM, transform=at, nodata=NO_DATA, **size) as file:
        file.write(np.where(roof, NO_DATA, heights).astype(np.float32), 1)
    command = [
        sys.executable, "-m", "startrack", "terrain", "import", out / "dsm.tif", finse / "ASTER_Finse.tif",
        "-o", out / "finse.toml", "-O", "-q", "--latitude", "60.594", "--longitude", "7.526", "--radius", "600",
        "--offset", "0", f"{ASTER_LOWER_M:g}", "--highest-beyond", "1900", "--camera-height", "7.4",
        "--cut-out", f"{2 * ROOF_M:g}",
    ]  # fmt: skip
    subprocess.run([str(word) for word in command], check=True)
    terrain = load_terrain(str(out / "finse.toml"))
    terrain.prepare()
    return terrain


def fit_pose(path: Path, terrain: Terrain) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Camera, its attitude (3, 3) from enu, and its place (3,) in enu by the control points in the table at `path`."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    points = np.array([[float(row[name]) for name in ("x_world", "y_world", "z_world")] for row in rows])
    seen_px = np.array([[float(row["x_img"]), float(row["y_img"])] for row in rows])
    longitude, latitude = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(points[:, 0], points[:, 1])
    points_m = enu_from_latlon(terrain.site, np.radians(latitude), np.radians(longitude), points[:, 2])
    start_m = points_m[np.argmin(np.linalg.norm(points - STATED_M, axis=1))] + [0.0, 0.0, 8.0]
    axis = rays_from_azel(*np.radians(AXIS))
    right = np.array([axis[1], -axis[0], 0.0]) / np.hypot(axis[0], axis[1])
    R0 = np.stack([right, np.cross(axis, right), axis])

    def pose(p: np.ndarray) -> tuple[Camera, np.ndarray, np.ndarray]:
        centre = (0.5 * (SIZE_PX[0] - 1), 0.5 * (SIZE_PX[1] - 1))
        lens = KannalaBrandt((p[1], p[2], 0.0, 0.0))
        camera = Camera(name="finse", size_px=SIZE_PX, focal_px=(1e3 * p[0],) * 2, centre_px=centre, lens=lens,
                        max_angle_rad=0.9, calibrated_angle_rad=0.8)  # fmt: skip
        return camera, R_from_rotvec(p[3:6]) @ R0, start_m + p[6:9]

    def residuals(p: np.ndarray) -> np.ndarray:
        camera, R, place_m = pose(p)
        return (camera.project_unlimited((points_m - place_m) @ R.T) - seen_px).ravel()

    scale = np.r_[np.full(6, 0.1), np.full(3, 10.0)]
    found = least_squares(residuals, np.r_[1.45, np.zeros(8)], loss="soft_l1", x_scale=scale)
    off = np.linalg.norm(residuals(found.x).reshape(-1, 2), axis=1)
    print(f"control points: median residual {np.median(off):.1f} px, focal length {1e3 * found.x[0]:.1f} px")
    return pose(found.x)


def turn_to(first: Path, second: Path, camera: Camera) -> np.ndarray:
    """The rotation (3, 3) of the camera from the picture `first` to the picture `second`.

    By patches of edges below the hills, which snow changes least: each is sought in the second picture, and the
    rotation that most of them agree with counts.
    """
    edges = [edge_strength(path) for path in (first, second)]
    half, reach, found = PATCH_PX // 2, PATCH_PX // 2 + 5, []
    for y in range(330, 640, 24):
        for x in range(2 * reach, SIZE_PX[0] - 2 * reach, 30):
            patch = edges[0][y - half : y + half + 1, x - half : x + half + 1]
            where = edges[1][y - half - reach : y + half + reach + 1, x - half - reach : x + half + reach + 1]
            _, score, _, at = cv2.minMaxLoc(cv2.matchTemplate(where, patch, cv2.TM_CCOEFF_NORMED))
            if score > ALIKE and patch.std() > 8.0:
                found.append((x, y, x + at[0] - reach, y + at[1] - reach))
    rays = [camera.unproject(np.array(found, dtype=float)[:, k : k + 2]) for k in (0, 2)]
    rng, agree = np.random.default_rng(0), np.zeros(len(found), dtype=bool)
    for _ in range(3000):
        i, j = rng.choice(len(found), 2, replace=False)
        (a, b), (c, d) = ((one[i], one[j]) for one in rays)
        R = nearest_rotation(np.outer(c, a) + np.outer(d, b) + np.outer(np.cross(c, d), np.cross(a, b)))
        good = np.linalg.norm(rays[1] - rays[0] @ R.T, axis=1) < AGREED_RAD
        if good.sum() > agree.sum():
            agree, best = good, R

    def off(w: np.ndarray) -> np.ndarray:
        return (rays[1][agree] - rays[0][agree] @ best.T @ R_from_rotvec(w).T).ravel()

    R = R_from_rotvec(least_squares(off, np.zeros(3), loss="soft_l1", f_scale=5e-4).x) @ best
    print(
        f"{second.name}: turned by {np.degrees(np.arccos(0.5 * np.trace(R) - 0.5)):.2f} degrees, {agree.sum()} patches"
    )
    return R


def edge_strength(path: Path) -> np.ndarray:
    """Strength (H, W) of the edges in the picture at `path`."""
    grey = cv2.GaussianBlur(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.float32), (0, 0), 1.2)
    return np.minimum(np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)), 80.0)


def model_px(camera: Camera, R_cam_enu: np.ndarray, place_m: np.ndarray, terrain: Terrain) -> np.ndarray:
    """The model's skyline (n, 2) [px] in a picture."""
    azimuth = np.radians(np.arange(0.0, 360.0, 0.02))
    elevation = np.ravel(terrain.horizon_rad(place_m[None, :2], azimuth))
    px, inside = camera.project(rays_from_azel(azimuth, elevation) @ R_cam_enu.T)
    return px[inside]


def trace_skyline(
    path: Path, camera: Camera, R_cam_enu: np.ndarray, place_m: np.ndarray, terrain: Terrain
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The edge between sky and ground in the picture at `path`, column by column: x, y and sigma [px].

    The model's skyline says where to look; the path of the greatest change of brightness within a window about it is
    found over all columns together, a step from row to row costing JUMP a pixel.
    """
    grey = gaussian_filter(cv2.imread(str(path)).astype(float).mean(axis=2), 1.0)
    px = model_px(camera, R_cam_enu, place_m, terrain)
    order = np.argsort(px[:, 0])
    columns = np.arange(int(px[:, 0].min()) + 5, int(px[:, 0].max()) - 5)
    model = np.interp(columns, px[order, 0], px[order, 1])
    offsets = np.arange(-WINDOW_PX, WINDOW_PX + 1)
    rows = np.clip(np.rint(model).astype(int)[:, None] + offsets, 2, SIZE_PX[1] - 3)
    change = np.abs(np.gradient(grey, axis=0))
    sky = change[np.clip(rows - 2 * WINDOW_PX, 1, None), columns[:, None]]
    edge = change[rows, columns[:, None]] / np.maximum(median_filter(np.median(sky, axis=1), 31), LEAST_NOISE)[:, None]
    beyond = np.maximum(edge - CLEAR, 0.0)
    above = np.cumsum(np.minimum(beyond, STRONG), axis=1)
    above = np.pad(above, ((0, 0), (APART_PX, 0)))[:, : len(offsets)]
    gain = np.minimum(edge, STRONG) - ABOVE * above
    total, back = gain[0], np.zeros(gain.shape, dtype=int)
    for k in range(1, len(columns)):
        steps = np.abs(rows[k][:, None] - rows[k - 1])
        value = total - JUMP * steps
        back[k] = np.argmax(value, axis=1)
        total = gain[k] + np.max(value, axis=1)
    at = int(np.argmax(total))
    found, clear = np.empty(len(columns)), np.empty(len(columns), dtype=bool)
    for k in range(len(columns) - 1, -1, -1):
        best = at + int(np.argmax(edge[k, at : at + APART_PX]))  # the path keeps to the upper side of a blurred edge
        y, c = rows[k, best], columns[k]
        a, b, d = (float(np.abs(grey[y + s + 1, c] - grey[y + s - 1, c])) for s in (-1, 0, 1))
        bend = a - 2 * b + d
        found[k] = y + (np.clip(0.5 * (a - d) / bend, -1, 1) if bend < 0.0 else 0.0)
        clear[k] = edge[k, best] > CLEAR
        at = back[k, at]
    return columns[clear].astype(float), found[clear], np.full(int(clear.sum()), SIGMA_PX)


if __name__ == "__main__":
    main()
