"""Detection of the image circle in a frame, and a photograph of another camera that needs it."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from startrack.catalog import load_catalog
from startrack.chain import identify_blind
from startrack.core.types import Exposure
from startrack.detection import Detector, image_circle
from startrack.exposure import read_exposure

DATA = Path(__file__).parent / "data"


def disc(centre: tuple[float, float], radius: float, *, rng: np.random.Generator, trees: float = 0.0) -> np.ndarray:
    """A vignetted sky (480, 640) with moonlight on one side, over a pedestal; `trees` hide that part of its edge."""
    y, x = np.mgrid[0:480, 0:640]
    off = np.hypot(x - centre[0], y - centre[1])
    direction = (np.arctan2(y - centre[1], x - centre[0]) / (2 * np.pi)) % 1
    sky = 300 * (1 - 0.4 * (off / radius) ** 2) * (1 + 0.5 * x / 640)
    lit = (off < radius) & ~((direction < trees) & (off > 0.8 * radius))
    return (2000 + np.where(lit, sky, 0) + rng.normal(0, 5, (480, 640))).astype(np.float32)


@pytest.mark.parametrize(
    ("centre", "radius", "trees"), [((320, 240), 200, 0.0), ((345, 225), 230, 0.3), ((300, 250), 270, 0.0)]
)
def test_the_disc_of_the_sky_is_found(centre: tuple[float, float], radius: float, trees: float) -> None:
    found = image_circle(disc(centre, radius, rng=np.random.default_rng(3), trees=trees))
    assert found is not None
    assert found.centre_px == pytest.approx(centre, abs=0.075 * radius)
    assert found.radius_px == pytest.approx(radius, rel=0.05)  # the search tolerates errors of 0.13


def test_a_frame_full_of_sky_has_no_disc() -> None:
    rng = np.random.default_rng(4)
    x = np.linspace(0, 1, 640)
    assert image_circle((1000 + 300 * x + rng.normal(0, 5, (480, 640))).astype(np.float32)) is None
    assert image_circle(np.zeros((480, 640), np.float32)) is None


def test_clouds_do_not_pass_for_stars_out_of_focus() -> None:
    rng = np.random.default_rng(5)
    clouds = cv2.GaussianBlur(rng.normal(0, 1, (512, 512)), (0, 0), 5.0)
    clouds = 60 * clouds / clouds.std()
    xy = rng.uniform(20, 492, (60, 2))
    y, x = np.mgrid[0:512, 0:512]
    stars = sum(4000 * np.exp(-0.5 * ((x - a) ** 2 + (y - b) ** 2) / 0.9**2) / (2 * np.pi * 0.9**2) for a, b in xy)
    frame = 2000 + clouds + stars + rng.normal(0, 10, (512, 512))
    found = Detector()(Exposure(pixels_adu=frame.astype(np.float32), saturation_adu=65535.0))
    assert found.psf_sigma_px == pytest.approx(np.sqrt(0.9**2 - 1 / 12), rel=0.05)  # not blurred by pixels
    assert (cKDTree(found.xy_px).query(xy)[0] < 0.5).mean() > 0.9


def test_a_mirrored_photograph_of_another_camera_is_named_as_its_makers_did() -> None:
    result = identify_blind(read_exposure(DATA / "mmt-2019-03-06.fits.bz2"), np.pi, load_catalog())
    assert result.status == "ok", result.message
    assert result.camera.mirrored
    with (DATA / "mmt-2019-03-06-stars.csv").open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    px = np.array([[float(row["x_px"]), float(row["y_px"])] for row in rows])
    ra, dec = np.radians([[float(row["ra_deg"]), float(row["dec_deg"])] for row in rows]).T
    rays = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    found = result.identification
    distance, nearest = cKDTree(px).query(result.detections.xy_px[found.detection])
    both = distance < 1.5
    off = np.linalg.norm(result.stars.rays_icrs[found.star][both] - rays[nearest[both]], axis=1)
    assert both.sum() >= 20
    assert off.max() < np.radians(0.1)
    again, _ = result.camera.project(rays @ found.R_cam_icrs.T)
    assert np.mean(np.linalg.norm(again - px, axis=1) < 1.1) >= 0.95
