"""World coordinates as astropy reads them back, against the camera model and against real stars."""

from __future__ import annotations

import warnings
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation

from startrack.camera import Camera, Decentring, KannalaBrandt, Pinhole
from startrack.cli.main import main
from startrack.output.wcs import header_block, wcs_cards

SAMPLES = Path(__file__).parent.parent / "sample_images"
FISHEYE = Camera(
    name="fisheye", size_px=(2048, 2048), focal_px=(652.0, 650.0), centre_px=(1030.0, 1015.0),
    max_angle_rad=float(np.radians(92)), calibrated_angle_rad=1.6, lens=KannalaBrandt((-0.03, 0.002, -0.0005, 0.0001)),
)  # fmt: skip
EQUIDISTANT = replace(FISHEYE, name="equidistant", lens=KannalaBrandt())
NARROW = Camera(
    name="narrow", size_px=(1280, 1024), focal_px=(2900.0, 2905.0), centre_px=(639.5, 520.0),
    max_angle_rad=float(np.radians(25)), calibrated_angle_rad=1.0, lens=Pinhole(),
)  # fmt: skip
DECENTRED = replace(NARROW, name="decentred narrow", decentring=Decentring(p1=8e-3, p2=-5e-3))
DECENTRED_FISHEYE = replace(FISHEYE, name="decentred fisheye", decentring=Decentring(p1=4e-4, p2=-3e-4))
CAMERAS = [FISHEYE, EQUIDISTANT, NARROW, replace(NARROW, name="mirrored", mirrored=True), DECENTRED, DECENTRED_FISHEYE]


def read_back(camera: Camera, R_cam_icrs: np.ndarray) -> WCS:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a header that astropy has to correct is wrong
        warnings.filterwarnings("ignore", message="The WCS transformation has more axes")  # no pixels in a .wcs file
        header = fits.Header.fromstring(header_block(wcs_cards(camera, R_cam_icrs)).decode("ascii"))
        return WCS(header)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.name)
def test_the_header_is_written_as_astropy_writes_it(camera: Camera) -> None:
    cards = wcs_cards(camera, Rotation.random(random_state=7).as_matrix())
    header = fits.Header()
    for key, value in cards.items():
        if key.startswith("COMMENT"):
            header.add_comment(value)
        else:
            header[key] = value
    assert header_block(cards) == header.tostring().encode("ascii")


def whole_field(camera: Camera) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, camera.size_px[0] - 1, 61), np.linspace(0, camera.size_px[1] - 1, 53))
    px = np.stack([x.ravel(), y.ravel()], axis=1)
    return px[camera.angle_rad(px) < camera.max_angle_rad - 1e-6]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.name)
@pytest.mark.parametrize("seed", range(3))
def test_astropy_reads_the_same_sky_over_the_whole_field(camera: Camera, seed: int) -> None:
    R = Rotation.random(random_state=seed).as_matrix()
    wcs, px = read_back(camera, R), whole_field(camera)
    ra, dec = np.radians(wcs.all_pix2world(px, 0).T)
    rays = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    back, _ = camera.project(rays @ R.T)
    assert len(px) > 2000
    assert np.abs(back - px).max() < (0.05 if camera.decentring else 1e-6)
    sky = np.degrees(np.stack([ra, dec], axis=1))
    again = wcs.all_world2pix(sky[::17], 0) if camera.decentring else wcs.wcs_world2pix(sky[::17], 0)
    assert np.abs(again - px[::17]).max() < 1e-3


def test_boresight_at_the_pole() -> None:
    wcs = read_back(NARROW, np.eye(3))
    px = whole_field(NARROW)
    ra, dec = np.radians(wcs.all_pix2world(px, 0).T)
    rays = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    assert np.abs(NARROW.project(rays)[0] - px).max() < 1e-6


def test_identify_writes_world_coordinates_on_which_catalogue_stars_fall(tmp_path, monkeypatch) -> None:
    """Catalogue positions from the file itself, carried by astropy to the date, against the measured centroids."""
    monkeypatch.chdir(tmp_path)
    assert main(["identify", str(SAMPLES / "near-wall.png"), "--no-plots", "-q"]) == 0
    wcs = WCS(str(tmp_path / "startrack-out/near-wall.wcs"))
    corr = Table.read(tmp_path / "startrack-out/near-wall.corr")
    assert len(corr) > 1000
    x, y = wcs.all_world2pix(corr["index_ra"], corr["index_dec"], 1)
    with fits.open(tmp_path / "startrack-out/near-wall.corr") as units:
        again = BytesIO()
        columns = [fits.Column(c.name, c.format, c.unit, array=units[1].data[c.name]) for c in units[1].columns]
        fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns, name="CORR")]).writeto(again)
    assert (tmp_path / "startrack-out/near-wall.corr").read_bytes() == again.getvalue()
    off = np.hypot(x - corr["index_x"], y - corr["index_y"])
    assert off.max() < 0.1  # aberration over the whole sky: the fitted rotation removes its mean
    error = np.hypot(x - corr["field_x"], y - corr["field_y"])
    assert np.median(error) < 0.25  # most are faint
    sky = wcs.all_pix2world(np.stack([corr["field_x"], corr["field_y"]], axis=1), 1)
    assert np.abs(sky[:, 1] - corr["field_dec"]).max() < 1e-6
