"""The night of the Kjell Henriksen Observatory, Svalbard, for real_ground.py: an all-sky picture beside a height map.

Camera and attitude are by the stars of the picture, as `startrack horizon` finds them. The map begins 1.8 km north of
the camera; invented low ground lies between, and bears the camera. The ridge in the north is 6 % brighter than the sky
above it: one shift of the model's skyline is fitted to the light of all columns together.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from pyproj import Transformer

from startrack.applications.horizon import SkyFrame, measure_frames, orient_frames
from startrack.catalog import load_catalog
from startrack.exposure import read_exposure
from startrack.frames import Site, parse_utc, rays_from_azel
from startrack.terrain import Terrain, load_terrain

PICTURE, MAP = "LYR-Sony-110116_190014.jpg", "DEM_NP_2009_13835_UTM33N_20m.tif"
TIME_UTC = "2016-01-11T19:00:14Z"  # of the name; the header's camera time is another
PLACE_DEG, HEIGHT_M = (78.148, 16.043), 520.0  # of the camera; scripts that come with the picture say 78.20, 15.70
FOV_RAD = np.radians(172.0)  # of the image circle; light is followed 4.5 degrees beyond its edge, where it falls
UTM, PLAIN_POSTS, PLAIN_POST_M, HILL_M = "EPSG:25833", 141, 100.0, (300.0, 513.0)  # low ground, and that of the camera
FROM_DEG, TO_DEG = -2.5, 9.0  # azimuths in which the map has the ridge
STEP_DEG, BLOCK_COLUMNS, DRAWS = 0.1, 10, 200  # of azimuth; of a bootstrap, as wide as a block of the JPEG
BELOW_DEG, ABOVE_DEG, BRIGHTEST_ADU = 2.5, 3.5, 70.0  # of the columns about the model's skyline; without stars
SHIFTS_DEG, EDGE_DEG = np.arange(-1.5, 1.51, 0.02), 0.12  # tried, and the width of the edge: a pixel


def compare_night(folder: Path, out: Path) -> str:
    """What `startrack horizon` and the light of the picture in `folder` say beside the model, in sentences.

    A figure of the model's skyline on the picture, and the terrain, are written to `out`.
    """
    terrain = make_terrain(folder, out)
    site = Site("earth", *np.radians(PLACE_DEG), HEIGHT_M).with_air({})
    exposure = read_exposure(folder / PICTURE, time_utc=parse_utc(TIME_UTC))
    (frame,), _ = orient_frames([exposure], load_catalog(), site, camera=None, fov_rad=FOV_RAD)
    stars = f"{len(frame.matched_star)} stars fit the lens, {frame.extra_sigma_px:.2f} px off."
    azimuth_deg = np.arange(FROM_DEG, TO_DEG, STEP_DEG)
    model_deg = horizon_deg(terrain, azimuth_deg)
    found = measure_frames((frame,), (), site).skyline
    degree = np.degrees(found.azimuth_rad)
    here = ((degree - FROM_DEG) % 360.0 <= TO_DEG - FROM_DEG) & found.known
    off_deg = np.degrees(found.elevation_rad[here]) - horizon_deg(terrain, degree[here])
    words = f", {np.median(off_deg):+.2f} degrees off the model (median)" if here.any() else ""
    horizon = (
        f"`startrack horizon` knows {found.known.sum()} azimuths of 360, {here.sum()} of those from {FROM_DEG:g} to "
        f"{TO_DEG:g}, where the model has the ridge{words}."
    )
    offsets_deg, light = columns_about(frame, folder / PICTURE, azimuth_deg, model_deg)
    shift_deg, step = best_shift(offsets_deg, light.mean(axis=1))
    rng, blocks = (
        np.random.default_rng(0),
        np.array_split(np.arange(len(azimuth_deg)), len(azimuth_deg) // BLOCK_COLUMNS),
    )
    drawn = [np.concatenate([blocks[k] for k in rng.integers(len(blocks), size=len(blocks))]) for _ in range(DRAWS)]
    spread = np.percentile([best_shift(offsets_deg, light[:, one].mean(axis=1))[0] for one in drawn], [16, 84])
    columns = (
        f"By the light of all columns together the model stands {-shift_deg:+.2f} degrees above the picture "
        f"({-spread[1]:+.2f} to {-spread[0]:+.2f}); the light below the ridge over that above it is "
        f"{1.0 + step / light.mean():.2f}."
    )
    draw_skyline(folder / PICTURE, pixels_of(frame, azimuth_deg, model_deg), out / "svalbard.png", brighter=4.0)
    return f"{stars} {horizon} {columns}"


def make_terrain(folder: Path, out: Path) -> Terrain:
    """The terrain of the map and of the invented ground, imported by the command."""
    latitude, longitude = PLACE_DEG
    at = np.array(Transformer.from_crs("EPSG:4326", UTM, always_xy=True).transform(longitude, latitude))
    line_m = (np.arange(PLAIN_POSTS) - PLAIN_POSTS // 2) * PLAIN_POST_M
    away_m = np.hypot(*np.meshgrid(line_m, line_m))
    np.save(out / "plain.npy", np.where(away_m < HILL_M[0], HILL_M[1], 0.0).astype(np.float32))
    corner = at[0] + line_m[0], at[1] + line_m[-1]
    command = [
        sys.executable, "-m", "startrack", "terrain", "import", folder / MAP, out / "plain.npy", "-o",
        out / "svalbard.toml", "-O", "-q", "--latitude", latitude, "--longitude", longitude, "--radius", "100", "--crs",
        UTM, "--post", PLAIN_POST_M, "--corner", *corner, "--camera-height", HEIGHT_M - HILL_M[1], "--unusual-heights",
    ]  # fmt: skip
    subprocess.run([str(word) for word in command], check=True)
    return load_terrain(str(out / "svalbard.toml"))


def horizon_deg(terrain: Terrain, azimuth_deg: np.ndarray) -> np.ndarray:
    """The model's skyline (n,) [deg] seen from the camera."""
    return np.degrees(np.ravel(terrain.horizon_rad(np.zeros((1, 2)), np.radians(azimuth_deg % 360.0))))


def pixels_of(frame: SkyFrame, azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) of directions (...), also beyond the stated edge of the image circle."""
    camera = replace(frame.camera, max_angle_rad=frame.camera.lens.max_invertible_rad)
    rays = rays_from_azel(np.radians(azimuth_deg), np.radians(elevation_deg))
    return camera.project(rays @ frame.R_cam_enu.T)[0]


def columns_about(
    frame: SkyFrame, picture: Path, azimuth_deg: np.ndarray, model_deg: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Heights (k,) [deg] above the model's skyline (n,), and the light (k, n) of the `picture` there."""
    offsets_deg = np.arange(-BELOW_DEG, ABOVE_DEG, 0.05)
    elevation_deg = model_deg + offsets_deg[:, None]
    xy = pixels_of(frame, np.broadcast_to(azimuth_deg, elevation_deg.shape), elevation_deg).astype(np.float32)
    grey = cv2.imread(str(picture)).mean(axis=2).astype(np.float32)
    return offsets_deg, np.minimum(cv2.remap(grey, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR), BRIGHTEST_ADU)


def best_shift(offsets_deg: np.ndarray, light: np.ndarray) -> tuple[float, float]:
    """Where along a column (k,) the light steps between two sloping levels [deg], and by how much, below less above."""
    found = []
    for shift in SHIFTS_DEG:
        below = np.clip((shift - offsets_deg) / EDGE_DEG + 0.5, 0.0, 1.0)
        slopes = np.maximum(shift - offsets_deg, 0.0), np.maximum(offsets_deg - shift, 0.0)
        design = np.stack([np.ones_like(below), below, *slopes], axis=1)
        fitted = np.linalg.lstsq(design, light, rcond=None)[0]
        found.append((float(np.sum(np.square(design @ fitted - light))), float(shift), float(fitted[1])))
    return min(found)[1:]


def draw_skyline(picture: Path, px: np.ndarray, path: Path, brighter: float = 1.0) -> None:
    """Write the part of a `picture` about points (n, 2) [px] of a model's skyline, which are drawn on it."""
    image = cv2.convertScaleAbs(cv2.imread(str(picture)), alpha=brighter)
    cv2.polylines(image, [np.rint(px).astype(np.int32)], False, (255, 180, 80), 1, cv2.LINE_AA)
    low, high = px.min(axis=0).astype(int) - 60, px.max(axis=0).astype(int) + 60
    part = image[max(low[1], 0) : high[1], max(low[0], 0) : high[0]]
    cv2.imwrite(str(path), cv2.resize(part, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC))
