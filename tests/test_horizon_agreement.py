"""Pictures of one fixed camera whose time or site is wrong are named and left out, or refused."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest
from horizon_helpers import CAMERA, SITE, TIME, painted_frame
from scipy.spatial.transform import Rotation

from startrack.applications.horizon import measure_skyline
from startrack.catalog import load_catalog
from startrack.chain import identify
from startrack.core.errors import BadInput
from startrack.estimation import fixed_camera as fixed
from startrack.frames import R_enu_icrs, Site

HOURS = (0.0, 3.0, 5.0, -1.5)
WRONG = {
    "an hour early": timedelta(hours=-1),
    "an hour late": timedelta(hours=1),
    "a day": timedelta(days=1),
    "a day early": timedelta(days=-1),
}


@pytest.fixture(scope="module")
def pictures():
    """Four pictures with their stars, right in time and site."""
    frames = [painted_frame(k + 1, TIME + timedelta(hours=hours)) for k, hours in enumerate(HOURS)]
    return [identify(frame, CAMERA, load_catalog(), site=SITE) for frame in frames]


def split_fixed(pictures, site, **flags):
    """The pictures that agree, and the names and reasons of those that do not."""
    R = np.array([one.attitude_fit.attitude.R_cam_icrs for one in pictures])
    wrong = fixed.find_disagreeing([one.exposure for one in pictures], R, site, **flags)
    out = [(pictures[k].exposure.name, text) for k, text in wrong.items()]
    return [one for k, one in enumerate(pictures) if k not in wrong], out


def at_time(picture, by):
    """The picture with a stamp that is off; its stars stay where they were seen (aberration changes by 0.02 arcsec)."""
    return replace(picture, exposure=replace(picture.exposure, time_utc=picture.exposure.time_utc + by))


def seen_from(picture, latitude_deg, longitude_deg):
    """The picture of a camera with the same attitude above another site."""
    there = Site("earth", np.radians(latitude_deg), np.radians(longitude_deg), SITE.height_m)
    when = picture.exposure.time_utc
    fit = picture.attitude_fit
    R_cam_enu = fit.attitude.R_cam_icrs @ R_enu_icrs(SITE, when).T
    attitude = replace(fit.attitude, R_cam_icrs=R_cam_enu @ R_enu_icrs(there, when))
    return replace(picture, attitude_fit=replace(fit, attitude=attitude))


def assert_named_or_refused(pictures, wrong):
    """Of 2 pictures nothing is answered; of more, the wrong one is named and left out."""
    for count in (2, 3, 4):
        for k in range(count):
            mixed = [wrong(one) if number == k else one for number, one in enumerate(pictures[:count])]
            if count == 2:
                with pytest.raises(BadInput, match=r"no majority of the 2 pictures.*check the times") as refusal:
                    split_fixed(mixed, SITE)
                assert refusal.value.reason == "inconsistent_evidence"
                assert f"frame-{2 - k}" in str(refusal.value)
                continue
            kept, out = split_fixed(mixed, SITE)
            assert [name for name, _ in out] == [f"frame-{k + 1}"]
            assert "its time or site is wrong" in out[0][1]
            assert len(kept) == count - 1


def test_right_pictures_agree(pictures):
    for count in (1, 2, 3, 4):
        assert split_fixed(pictures[:count], SITE) == (pictures[:count], [])


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_time_is_named_or_refused(pictures, name):
    assert_named_or_refused(pictures, lambda picture: at_time(picture, WRONG[name]))


@pytest.mark.parametrize("place_deg", [(47.0, 7.0), (46.0, 8.0), (-46.0, 7.0), (46.0, -7.0)])
def test_a_wrong_site_is_named_or_refused(pictures, place_deg):
    assert_named_or_refused(pictures, lambda picture: seen_from(picture, *place_deg))


def test_two_pictures_with_one_stamp_an_hour_off_give_no_skyline():
    frames = [painted_frame(1), painted_frame(2, TIME + timedelta(hours=3))]
    late = replace(frames[1], time_utc=frames[1].time_utc + timedelta(hours=1))
    with pytest.raises(BadInput, match=r"frame-1: no majority of the 2 pictures.*frame-2 is turned by 15"):
        measure_skyline([frames[0], late], load_catalog(), SITE, camera=CAMERA)


def test_two_and_two_are_refused(pictures):
    mixed = [at_time(one, timedelta(hours=1)) if k % 2 else one for k, one in enumerate(pictures)]
    with pytest.raises(BadInput, match="no majority of the 4 pictures"):
        split_fixed(mixed, SITE)


def test_all_wrong_alike_agree(pictures):
    """What pictures cannot show: the skyline is then turned as a whole."""
    wrong = [at_time(one, timedelta(hours=1)) for one in pictures]
    assert split_fixed(wrong, SITE)[1] == []


def turned(picture, rotvec_enu):
    """The picture of a camera that was turned by a rotation vector [rad] among east, north and up."""
    fit, when = picture.attitude_fit, picture.exposure.time_utc
    by_icrs = R_enu_icrs(SITE, when).T @ Rotation.from_rotvec(rotvec_enu).as_matrix() @ R_enu_icrs(SITE, when)
    attitude = replace(fit.attitude, R_cam_icrs=fit.attitude.R_cam_icrs @ by_icrs)
    return replace(picture, attitude_fit=replace(fit, attitude=attitude))


def test_a_camera_that_may_move_has_pictures_of_wrong_times_named_or_refused(pictures):
    late = at_time(pictures[1], timedelta(hours=1))
    moved = turned(pictures[3], (0.0, 0.5, 0.2))
    kept, out = split_fixed([pictures[0], late, pictures[2], moved], SITE, may_move=True)
    assert kept == [pictures[0], pictures[2], moved]
    [(name, message)] = out
    assert name == "frame-2" and "turned by 15.0 degrees about the celestial pole against most pictures" in message
    with pytest.raises(BadInput, match=r"frame-1: no majority of the 2 pictures.*frame-2 is turned by 15.0 degrees"):
        split_fixed([pictures[0], late, moved], SITE, may_move=True)


def test_a_camera_may_be_turned_between_pictures_and_may_follow_the_stars(pictures):
    rng = np.random.default_rng(3)
    by_hand = [turned(one, rng.normal(size=3)) for one in pictures]
    panned = [turned(one, (0.0, 0.0, k)) for k, one in enumerate(pictures)]
    R = pictures[0].attitude_fit.attitude.R_cam_icrs
    follows = [
        replace(p, attitude_fit=replace(p.attitude_fit, attitude=replace(p.attitude_fit.attitude, R_cam_icrs=R)))
        for p in pictures
    ]
    for right in (pictures, by_hand, panned, follows, [*pictures[:2], *by_hand[2:]]):
        assert split_fixed(right, SITE, may_move=True) == (right, [])
    at_the_pole = Site("earth", np.radians(89.9), 0.0, 0.0)  # a turn about the vertical resembles one about the pole
    there = [seen_from(one, 89.9, 0.0) for one in pictures]
    R_there = [
        one.attitude_fit.attitude.R_cam_icrs
        @ R_enu_icrs(at_the_pole, one.exposure.time_utc).T
        @ Rotation.from_rotvec((0.0, 0.0, k)).as_matrix()
        @ R_enu_icrs(at_the_pole, one.exposure.time_utc)
        for k, one in enumerate(there)
    ]
    assert fixed.find_disagreeing([one.exposure for one in there], np.array(R_there), at_the_pole, may_move=True) == {}


def test_two_pictures_of_a_hand_held_camera_rarely_keep_the_pole():
    """Of 100,000 pairs of attitudes one is taken for a wrong time: the pole stays within 0.3 degrees."""
    assert fixed.log_odds_kept(np.radians(0.2)) > 0.0 > fixed.log_odds_kept(np.radians(0.3))
    assert 0.5 * (1.0 - np.cos(np.radians(0.3))) < 1e-5


def test_angles_between_rotations_are_those_of_scipy():
    rotations = Rotation.random(6, random_state=np.random.default_rng(1))
    found = fixed.turns_rad(rotations.as_matrix())
    np.testing.assert_allclose(found[2], (rotations[2] * rotations.inv()).magnitude(), atol=1e-7)


def test_small_moves_of_a_camera_do_not_matter():
    """Of pictures that are turned by the stated sigma, fewer than one of 100,000 is taken for wrong."""
    rng = np.random.default_rng(2)
    apart = np.linalg.norm(rng.normal(size=(100_000, 2, 3)).sum(axis=1), axis=1) * fixed.MOVED_SIGMA_RAD
    assert (fixed.log_odds_fixed(apart) > 0.0).all()
    assert fixed.log_odds_fixed(np.radians(0.5)) > 0.0 > fixed.log_odds_fixed(np.radians(0.7))
