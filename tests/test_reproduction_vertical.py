"""Positions by stars and a measured vertical: errors over the drawn tilts, against the Moon's radius."""

import numpy as np
import pytest

from startrack.applications.reproduction.published.malay import REST_TILT_ARCSEC, draw_readings, locate_at_rest
from startrack.applications.reproduction.published.vertical import (
    INCLINOMETER_ARCSEC,
    locate_by_inclinometer,
    position_of_vertical,
    tilt_vertical,
    vertical_at,
)
from startrack.applications.reproduction.simulator import SHACKLETON, draw_positions
from startrack.frames import R_enu_fixed, Site, latlon_from_enu, sphere_radius_m
from startrack.output import ARCSEC_PER_RAD

METRES_PER_ARCSEC = 1_737_400.0 * np.pi / 180 / 3600  # of the Moon's sphere: 8.42
PLACES = draw_positions(0, 0, 0, 100)


@pytest.mark.parametrize("site", [SHACKLETON, Site(body="moon", latitude_rad=0.3, longitude_rad=-2.0)])
def test_the_vertical_is_up_at_the_latitude_and_longitude(site):
    for position in PLACES[:5]:
        up = sphere_radius_m(site) * (vertical_at(position, site)[2] - 1.0)
        latitude, longitude = latlon_from_enu(site, *position, up)
        there = Site(body="moon", latitude_rad=float(latitude), longitude_rad=float(longitude))
        expected = R_enu_fixed(site) @ R_enu_fixed(there)[2]
        np.testing.assert_allclose(vertical_at(position, site), expected, atol=1e-10)
        np.testing.assert_allclose(position_of_vertical(expected, site), position, atol=1e-3)


def test_a_tilt_is_an_angle_from_the_vertical():
    vertical = vertical_at(PLACES[0], SHACKLETON)
    tilted = tilt_vertical(vertical, np.array([300.0, -400.0]) / ARCSEC_PER_RAD)
    angle = np.arcsin(np.linalg.norm(np.cross(vertical, tilted)))
    assert angle * ARCSEC_PER_RAD == pytest.approx(500.0, rel=1e-4)


def test_an_inclinometer_is_off_by_its_tilt():
    answers = [
        locate_by_inclinometer(place, SHACKLETON, rng=np.random.default_rng(k)) for k, place in enumerate(PLACES)
    ]
    errors = np.array([np.hypot(*(answer - place)) for (answer, _), place in zip(answers, PLACES, strict=True)])
    tilts = np.array([np.hypot(*tilt) for _, tilt in answers]) * ARCSEC_PER_RAD
    np.testing.assert_allclose(errors / tilts, METRES_PER_ARCSEC, rtol=0.005)
    assert tilts.mean() == pytest.approx(INCLINOMETER_ARCSEC, rel=0.15)


def test_a_rover_at_rest_is_off_by_its_tilt():
    drawn = [draw_readings(place, SHACKLETON, rng=np.random.default_rng(k)) for k, place in enumerate(PLACES)]
    answers = np.array([locate_at_rest(readings, SHACKLETON) for readings in drawn])
    tilts = np.array([np.hypot(*readings.error_rad) for readings in drawn]) * ARCSEC_PER_RAD
    np.testing.assert_allclose(np.hypot(*(answers - PLACES).T) / tilts, METRES_PER_ARCSEC, rtol=0.005)
    assert tilts.mean() == pytest.approx(REST_TILT_ARCSEC, rel=0.15)
