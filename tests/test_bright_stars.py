"""Bright stars and planets of an 8-bit picture whose brightest light is cut off, named by place and brightness."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.coordinates import get_body
from astropy.time import Time

from startrack.camera import load_camera
from startrack.catalog import load_catalog, star_names
from startrack.chain import identify
from startrack.chain.bright_stars import name_bright_sources
from startrack.core.types import Body
from startrack.exposure import read_exposure
from startrack.output import result_dict

ROOT = Path(__file__).parent.parent
PHOTO = ROOT / "sample_images/lowell-2018-08-06.fits.bz2"
STARS = Path(__file__).parent / "data/lowell-2018-08-06-stars.csv"  # matched without startrack
WHITE_ADU, BLACK_ADU, GAMMA = 4375.0, 2266.0, 1.5  # white is beyond the light of a star of magnitude 4.5


@pytest.fixture(scope="module")
def clipped():
    """The photograph as a JPEG of 8 bits in which the bright stars are discs of 255."""
    photo = read_exposure(PHOTO)
    light = np.clip((photo.pixels_adu - BLACK_ADU) / (WHITE_ADU - BLACK_ADU), 0.0, 1.0)
    coded = cv2.imencode(".jpg", np.rint(255 * light ** (1 / GAMMA)).astype(np.uint8))[1]
    pixels = cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE).astype(np.float32)
    return replace(photo, pixels_adu=pixels, saturation_adu=255.0, sha256="")


@pytest.fixture(scope="module")
def result(clipped):
    return identify(clipped, load_camera("lowell-ldt"), load_catalog())


@pytest.fixture(scope="module")
def reference():
    """Hipparcos number to pixel (2,)."""
    with STARS.open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    return {int(row["hip"]): (float(row["x_px"]), float(row["y_px"])) for row in rows}


def names_at(result, exposure):
    """The names of an image that differs from that of `result` in some pixels, as if its attitude were known."""
    image = exposure.pixels_adu
    sources = replace(result.detections, image_e=image, dead=image >= 0.98 * 255.0)
    return names_of(result, sources, result.bodies)


def names_of(result, sources, bodies):
    found, R = result.identification, result.attitude_fit.attitude.R_cam_icrs
    return name_bright_sources(sources, result.camera, result.stars, found, R, bodies, None)


def index_of(result, name):
    hip = next(number for number, known in star_names().items() if known == name)
    return int(np.flatnonzero(result.stars.hip == hip)[0])


def place_of(result, star):
    return result.camera.project(result.attitude_fit.attitude.R_cam_icrs @ result.stars.rays_icrs[star])[0]


def test_the_brightest_stars_are_named_and_none_is_wrong(result, reference):
    named, stars = result.names.stars, result.stars
    hips = stars.hip[named.star]
    known = [k for k, hip in enumerate(hips.tolist()) if hip in reference]
    off_px = np.hypot(*(named.xy_px[known] - [reference[hip] for hip in hips[known].tolist()]).T)
    assert np.mean(off_px > 3.0) < 0.005  # 1 % of the rows of the reference are wrong
    assert off_px[stars.v_mag[named.star[known]] < 3.0].max() < 2.5  # of Shaula, whose light is one with Lesath's
    brightest = [hip for hip in stars.hip.tolist() if hip in reference][:15]
    assert len(set(brightest) & set(hips.tolist())) >= 14
    assert len(set(brightest) & set(stars.hip[result.identification.star].tolist())) < 10
    assert named.saturated[np.isin(hips, brightest)].all()


def test_they_are_in_the_record_and_not_in_the_fit(result):
    record = result_dict(result, "identification")
    assert len(record["matches"]) == record["stars"]["identified"] > len(result.identification)
    vega = next(match for match in record["matches"] if match["hip"] == 91262)
    assert vega["saturated"]
    assert not all(match["saturated"] for match in record["matches"])
    assert len(result.attitude_fit.used) == len(result.identification)


def test_planets_are_named_where_a_time_is_known_and_no_site(result, clipped):
    time = Time(clipped.time_utc.replace(tzinfo=None))
    found = {body["name"]: body for body in result_dict(result, "identification")["bodies"]}
    assert {"Mars", "Jupiter", "Saturn"} == set(found)
    for name, body in found.items():
        ray = get_body(name.lower(), time).gcrs.cartesian.get_xyz().value
        px = result.camera.project(result.attitude_fit.attitude.R_cam_icrs @ (ray / np.linalg.norm(ray)))[0]
        assert np.hypot(body["x_px"] - px[0], body["y_px"] - px[1]) < 0.5
        apart_px = np.hypot(*(result.detections.xy_px - px).T)
        assert not result.names.is_nameless[apart_px < 0.7].any()


def test_a_lamp_beside_the_place_of_a_star_and_the_moon_over_it_have_no_name(result, clipped):
    vega, arcturus = (index_of(result, name) for name in ("Vega", "Arcturus"))
    assert {vega, arcturus} <= set(result.names.stars.star.tolist()) - set(result.identification.star.tolist())
    pixels = clipped.pixels_adu.copy()
    for star, offset_px, radius in ((vega, 5, 3), (arcturus, 0, 40)):
        x, y = np.rint(place_of(result, star)).astype(int)
        pixels[y - 4 : y + 5, x - 4 : x + 5] = np.median(pixels[y - 20 : y + 20, x - 20 : x + 20])
        cv2.circle(pixels, (int(x) + offset_px, int(y)), radius, 255.0, -1)
    named = names_at(result, replace(clipped, pixels_adu=pixels)).stars.star.tolist()
    assert vega not in named
    assert arcturus not in named
    assert index_of(result, "Altair") in named


def test_a_planet_at_the_place_of_a_star_has_the_planets_name(result):
    vega = index_of(result, "Vega")
    planet = Body(name="Venus", ray_icrs=result.stars.rays_icrs[vega], v_mag=-4.0)
    names = names_of(result, result.detections, (*result.bodies, planet))
    assert vega not in names.stars.star
    known = index_of(result, "Rasalhague")
    assert known in result.identification.star
    planet = replace(planet, ray_icrs=result.stars.rays_icrs[known], v_mag=float(result.stars.v_mag[known]) - 0.5)
    assert known not in names_of(result, result.detections, (*result.bodies, planet)).stars.star


def test_hardly_a_name_is_given_where_the_sky_is_another(result):
    """All names are wrong ones at attitudes that are not that of the picture."""
    names = 0
    bright = result.names.stars.star[len(result.identification) :]
    for x, y in np.random.default_rng(1).uniform(-25.0, 25.0, (15, 2)):
        moved = replace(result.camera, centre_px=(result.camera.centre_px[0] + x, result.camera.centre_px[1] + y))
        names += len(names_of(replace(result, camera=moved), result.detections, ()).stars) - len(result.identification)
    assert len(bright) >= 15
    assert names <= 2
