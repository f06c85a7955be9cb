"""What the HTML page draws itself: the layers in the annotated picture's file, and the evidence by azimuth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from PIL import Image

from startrack.output import png_bytes, write_results
from startrack.output.html.details import picture_of, sectors_of, star_table_of
from startrack.output.picture.annotate import Layers, layers_of
from startrack.output.picture.backdrop import bare_picture
from startrack.output.picture.canvas import Ink

RADIUS_M, DEPTH_M = 10_000.0, 2_000.0  # of the thesis's crater


@pytest.fixture(scope="module")
def folder(located, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("results")
    write_results(located.result, out / "small.fix.json")
    return out


@pytest.fixture(scope="module")
def layers(folder) -> Layers:
    found = layers_of((folder / "small.annotated.png").read_bytes())
    assert found is not None
    return found


def horizon_from(east_m: float, north_m: float):
    """The crater's rim by its formula."""

    def horizon_rad(azimuth):
        along = east_m * np.sin(azimuth) + north_m * np.cos(azimuth)
        distance = np.sqrt(along**2 + RADIUS_M**2 - east_m**2 - north_m**2) - along
        return np.arctan2(DEPTH_M - 1.5, distance)

    return horizon_rad


def count_colour(pixels, colour) -> int:
    return int((np.abs(pixels.astype(int) - colour).sum(axis=-1) < 40).sum())


def test_the_file_holds_the_picture_without_marks(folder, layers, located):
    """A JPEG of it; other programs read the annotated picture as before."""
    annotated = np.asarray(Image.open(folder / "small.annotated.png").convert("RGB"))
    bare = bare_picture(located.result)
    assert layers.bare.shape == bare.shape
    assert np.abs(layers.bare.astype(int) - bare).mean() < 3
    for colour in (Ink.IDENTIFIED, Ink.HIDDEN, Ink.SKYLINE):
        assert count_colour(annotated[:, : bare.shape[1]], colour) > 100
        assert count_colour(layers.bare, colour) < 5


def test_marks_are_where_the_exposure_shows_them(layers, located):
    """The skyline from the truth by the crater's formula, and every detection either named or one of the others."""
    (x, y, _), camera = located.truth.position_enu_m, located.result.camera
    azimuth = np.radians(np.arange(0.0, 360.0, 5.0))
    elevation = horizon_from(x, y)(azimuth)
    level = np.cos(elevation)
    rays = np.stack([np.sin(azimuth) * level, np.cos(azimuth) * level, np.sin(elevation)], axis=-1)
    xy_px, _ = camera.project(rays @ located.truth.R_cam_enu.T)
    (line,) = layers.overlay["skyline"]
    distance = np.linalg.norm(xy_px[:, None] - np.array(line)[None], axis=-1).min(axis=1)
    assert distance.max() < 2.0  # the line has a point every 1.4 px
    result = located.result
    named = {tuple(np.round(one, 1)) for one in result.detections.xy_px[result.identification.detection]}
    others = {tuple(one) for one in layers.overlay["others"]}
    assert not named & others
    inside = camera.angle_rad(result.detections.xy_px) <= camera.max_angle_rad
    assert len(layers.overlay["others"]) + layers.overlay["undrawn"] == inside.sum() - len(
        result.identification.detection
    )
    north = next(tick for tick in layers.overlay["compass"] if tick[0] == 0)
    foot = camera.unproject(np.array(north[1])) @ located.truth.R_cam_enu
    assert abs(np.arctan2(foot[0], foot[1])) < 0.01


@pytest.mark.parametrize("damage", ["no layers", "cut off", "no picture"])
def test_without_layers_the_page_shows_the_annotated_picture(folder, tmp_path, damage):
    raw = (folder / "small.annotated.png").read_bytes()
    annotated = np.array(Image.open(folder / "small.annotated.png").convert("RGB"))
    data = {"no layers": png_bytes(annotated), "cut off": raw[:-30], "no picture": b"no picture"}[damage]
    (tmp_path / "small.annotated.png").write_bytes(data)
    shown = picture_of(tmp_path / "small.annotated.png", 1400)
    if damage == "no layers":
        assert shown is not None and not {"marks", "scale"} & shown.keys()
    assert layers_of(data) is None


def test_stars_near_the_skyline_are_counted_by_azimuth(folder, located):
    table = Table.read(folder / "small.stars.ecsv", format="ascii.ecsv")
    east, north, _ = located.result.fix.position_enu_m
    shown, stars = star_table_of(folder / "small.stars.ecsv", 10)
    sectors = sectors_of(stars, horizon_from(east, north))
    above = np.radians(table["elevation_deg"]) - horizon_from(east, north)(np.radians(table["azimuth_deg"]))
    near = np.abs(np.degrees(above)) < sectors["near_deg"]
    known = ~np.ma.getmaskarray(table["evidence"])
    for k in range(72):
        chosen = near & known & (np.floor(table["azimuth_deg"] / 5.0) == k)
        for side, at in (("above", above > 0), ("below", above <= 0)):
            for status in ("seen", "hidden"):
                assert sectors[side][status][k] == np.sum(chosen & at & (table["status"] == status))
        sign = np.where(above[chosen] > 0, 1.0, -1.0) * table["evidence"][chosen]
        assert sectors["supports"][k] == pytest.approx(sign[sign > 0].sum(), abs=0.02)
        assert sectors["opposes"][k] == pytest.approx(-sign[sign < 0].sum(), abs=0.02)
    assert len(shown["columns"]["id"]) == 10 and shown["total"] == len(table)


def test_a_wrong_position_is_contradicted_by_its_sectors(folder, located):
    east, north, _ = located.result.fix.position_enu_m
    stars = star_table_of(folder / "small.stars.ecsv", 0)[1]

    def contradicted(shift_m: float) -> int:
        found = sectors_of(stars, horizon_from(east + shift_m, north))
        nats = [value for value in found["nats"] if value is not None]
        assert max(nats) <= 0
        return sum(value < found["contradicted_nats"] for value in nats)

    assert contradicted(0.0) == 0
    assert contradicted(300.0) > 10
    assert sectors_of(stars, lambda azimuth: np.full(len(azimuth), np.nan)) is None
