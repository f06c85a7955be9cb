"""The Stellarium landscape of the photographs: read as Stellarium reads it, of a painted frame with a known skyline."""

from __future__ import annotations

import configparser
import io
import zipfile
from dataclasses import replace

import cv2
import numpy as np
import pytest
from horizon_helpers import CAMERA, R_CAM_ENU, SITE, painted_frame, skyline_deg

from startrack.applications.horizon import measure_skyline, write_skyline
from startrack.applications.horizon.write import landscape_picture
from startrack.catalog import load_catalog
from startrack.core.types import BadInput
from startrack.frames import rays_from_azel

LAMP_DEG = np.array([30.0, 2.0])  # azimuth and elevation of a lamp in front of a hill
SKY_DEG = 3.0  # above and below the skyline where it is tested


@pytest.fixture(scope="module")
def photographed():
    """The result of a painted frame, with a lamp of 5 x 5 px in the photograph that was not there for the skyline."""
    found = measure_skyline([painted_frame(1)], load_catalog(), SITE, camera=CAMERA)
    xy, _ = CAMERA.project(rays_from_azel(*np.radians(LAMP_DEG))[None] @ R_CAM_ENU.T)
    x, y = np.rint(xy[0]).astype(int)
    (frame,) = found.frames
    image_e = frame.detections.image_e.copy()
    image_e[y - 2 : y + 3, x - 2 : x + 3] = image_e.max()
    return replace(found, frames=(replace(frame, detections=replace(frame.detections, image_e=image_e)),))


@pytest.fixture(scope="module")
def files(photographed, tmp_path_factory):
    """The files in the archive by their names."""
    path = tmp_path_factory.mktemp("landscape") / "garden.zip"
    write_skyline(photographed.skyline, SITE, photographed.frames, str(path), overwrite=False)
    first = path.read_bytes()
    write_skyline(photographed.skyline, SITE, photographed.frames, str(path), overwrite=True)
    assert path.read_bytes() == first
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.fixture(scope="module")
def texture(files):
    """Blue, green, red and alpha as read from the file."""
    return cv2.imdecode(np.frombuffer(files["garden/panorama.png"], np.uint8), cv2.IMREAD_UNCHANGED)


def settings_of(files):
    settings = configparser.ConfigParser()
    settings.read_string(files["garden/landscape.ini"].decode())
    return settings


def stellarium_pixels(texture, azimuth_deg, elevation_deg, landscape):
    """Pixels (n, 4) that Stellarium samples in directions (n,), as `LandscapeSpherical::getOpacity` does."""
    height, width = texture.shape[:2]
    top, bottom, turned = (float(landscape[key]) for key in ("maptex_top", "maptex_bottom", "angle_rotatez"))
    x = ((np.asarray(azimuth_deg) - 90.0 - turned) % 360.0) / 360.0 * width  # the left edge is the east
    y = (top - np.asarray(elevation_deg)) / (top - bottom) * height
    return texture[y.astype(int), x.astype(int)]


def test_the_settings_are_those_of_a_spherical_landscape(files, texture):
    assert sorted(files) == ["garden/horizon.txt", "garden/landscape.ini", "garden/panorama.png"]
    settings = settings_of(files)
    landscape = settings["landscape"]
    assert (landscape["type"], landscape["name"], landscape["maptex"]) == ("spherical", "garden", "panorama.png")
    assert texture.shape == (2048, 4096, 4)
    assert float(settings["location"]["latitude"]) == pytest.approx(46.0)
    points = np.loadtxt(io.BytesIO(files[f"garden/{landscape['polygonal_horizon_list']}"]))
    assert points.shape == (360, 2)


def test_the_sky_is_transparent_and_the_ground_opaque(files, texture, photographed):
    azimuth_deg = np.arange(360.0)
    edge_deg = skyline_deg(azimuth_deg)
    smooth = np.array([np.ptp(skyline_deg(one + np.linspace(-2, 2, 41))) < 2.0 for one in azimuth_deg])
    tested = smooth & photographed.skyline.known
    assert tested.sum() > 250
    landscape = settings_of(files)["landscape"]
    for shift_deg, alpha in ((SKY_DEG, 0), (-SKY_DEG, 255)):
        pixels = stellarium_pixels(texture, azimuth_deg[tested], edge_deg[tested] + shift_deg, landscape)
        assert (pixels[:, 3] == alpha).all()
    assert (stellarium_pixels(texture, azimuth_deg, np.full(360, -60.0), landscape)[:, 3] == 255).all()


def test_the_ground_is_that_of_the_photograph_in_its_place(files, texture):
    landscape = settings_of(files)["landscape"]
    lamp = stellarium_pixels(texture, LAMP_DEG[:1], LAMP_DEG[1:], landscape)[0, :3]
    around = stellarium_pixels(texture, LAMP_DEG[0] + [-4.0, 4.0, 0.0], LAMP_DEG[1] + [0.0, 0.0, 4.0], landscape)[:, :3]
    assert lamp.min() > around.max() + 50
    assert (around == around[:, :1]).all()  # grey
    beyond = stellarium_pixels(texture, [10.0, 200.0], [-20.0, -80.0], landscape)[:, :3]
    assert (beyond == [38, 51, 38]).all()  # what no photograph shows


def test_the_picture_of_a_skyline_shows_the_photograph_behind_it(photographed, tmp_path):
    """The lamp is light grey there; without photographs nothing is."""
    paths = [tmp_path / "with.png", tmp_path / "without.png"]
    for path, frames in zip(paths, (photographed.frames, ()), strict=True):
        write_skyline(photographed.skyline, SITE, frames, str(path), overwrite=False)
    pictures = [cv2.imread(str(path))[32:-40] for path in paths]
    column = round(64 + LAMP_DEG[0] / 360 * (pictures[0].shape[1] - 64 - 16))
    lit, plain = (np.argwhere((np.ptp(one, axis=2) == 0) & (one[:, :, 0] > 180))[:, 1] for one in pictures)
    assert (np.abs(lit - column) < 8).sum() > 3 and len(plain) == 0
    assert np.mean(pictures[0] != pictures[1]) > 0.5


def test_unknown_azimuths_are_half_transparent_and_marked(files, photographed):
    skyline = photographed.skyline
    unknown = (skyline.azimuth_rad > np.radians(29.5)) & (skyline.azimuth_rad < np.radians(40.5))
    hole = replace(skyline, elevation_rad=np.where(unknown, np.nan, skyline.elevation_rad),
                   sigma_rad=np.where(unknown, np.inf, skyline.sigma_rad))  # fmt: skip
    texture = landscape_picture(photographed.frames, hole)[:, :, [2, 1, 0, 3]]
    landscape, azimuth_deg = settings_of(files)["landscape"], np.arange(32.0, 39.0)
    above, below, deep = (
        stellarium_pixels(texture, azimuth_deg, np.full(7, elevation), landscape) for elevation in (20.0, 2.0, -30.0)
    )
    assert (above[:, 3] == 0).all() and (below[:, 3] == 128).all() and (deep[:, 3] == 255).all()
    assert (deep[:, :3] == [30, 45, 110]).all()
    assert (below[:, 2].astype(int) > below[:, 0].astype(int) + 20).all()  # the photograph, reddish
    nothing = replace(skyline, elevation_rad=np.full(360, np.nan), sigma_rad=np.full(360, np.inf))
    with pytest.raises(BadInput, match="unknown at all azimuths"):
        landscape_picture(photographed.frames, nothing)
