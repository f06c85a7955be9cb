"""Results as JSON: every number against the truth of the scene or a formula from elsewhere."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stage_helpers import as_stage

from startrack.catalog import load_catalog
from startrack.chain import pipeline
from startrack.chain.stages import Oriented
from startrack.core.types import BadInput, Mode
from startrack.localization.thesis_methods import point_fix
from startrack.output import (
    boresight_rad,
    refused_dict,
    result_dict,
    verbose_text,
    write_json,
)

ARCSEC = np.pi / 648_000
KEYS = {
    "position": "frame terrain east_m north_m up_m covariance_m2 radius95_m radius999_m "
    "protection_level_m protection_risk carried_by unstated latitude_deg longitude_deg "
    "evidence search dropped_probability",
    "search": "outcome dropped_probability",
    "attitude": "quat_xyzw_cam_icrs ra_deg dec_deg roll_deg sigma_arcsec lens_error_included quat_xyzw_body_enu "
    "heading_deg pitch_deg roll_body_deg sigma_heading_deg sigma_pitch_deg sigma_roll_body_deg",
    "middle": "x_px y_px ra_deg dec_deg sigma_deg scale_arcsec_per_px rotation_deg",
    "stars": "detected identified unexplained predicted_visible rms_px false_alarm_probability",
    "evidence": "blocked off_map damage",
    "sky": "brightness_mag_arcsec2 unused",
    "clock": "offset_s sigma_s",
    "timing_ms": "read detect identify attitude evidence locate",
    "provenance": "version kernels image_sha256 camera terrain catalog localizer near time_utc time_sigma_s exposure_s "
    "mask_sha256 dark_sha256 flat_sha256",
}


@pytest.fixture(scope="module")
def fix(located):
    return result_dict(located.result)


def remove_terrain(result):
    return as_stage(result, Oriented, terrain=None)


def make_ambiguous(result):
    modes = (Mode(east_m=6000.0, north_m=-2500.0, weight=0.7), Mode(east_m=-3000.0, north_m=4000.0, weight=0.3))
    fix = replace(result.fix, modes=modes, ambiguous=True)
    return replace(result, fix=fix)


def without_circle(result):
    """The result as of a method without a posterior."""
    return replace(result, fix=point_fix(result.fix.position_enu_m[:2], result.terrain))


def flat_frame(result):
    exposure = replace(result.exposure, pixels_adu=np.full((1024, 1024), 300.0, dtype=np.float32))
    return pipeline.detect(exposure, result.camera)


def test_the_keys_are_those_of_the_format(fix):
    assert list(fix)[:5] == ["format", "image", "status", "reason", "message"]
    assert list(fix)[5:] == [
        "advice", "position", "modes", "search", "attitude", "middle", "explain", "stars", "bodies", "evidence", "sky",
        "clock", "timing_ms", "provenance", "warnings",
    ]  # fmt: skip
    for part, keys in KEYS.items():
        assert " ".join(fix[part]) == keys
    assert fix["format"] == "startrack.fix/1"
    assert (fix["status"], fix["reason"]) == ("ok", None)
    json.dumps(fix, allow_nan=False)


def test_the_position_is_where_the_camera_was(fix, located):
    position, truth = fix["position"], located.truth.position_enu_m
    error = np.array([position["east_m"], position["north_m"]]) - truth[:2]
    assert np.linalg.norm(error) < position["radius999_m"] < 200
    assert error @ np.linalg.solve(position["covariance_m2"], error) < 20
    assert position["up_m"] == pytest.approx(truth[2], abs=1e-6)
    assert fix["modes"][0]["weight"] == pytest.approx(1.0, abs=0.01)


def test_latitude_and_longitude_are_as_far_from_the_origin_as_the_position(fix):
    position = fix["position"]
    lat, lon, lat0, lon0 = np.radians([position["latitude_deg"], position["longitude_deg"], -89.66, 129.78])
    a = np.sin((lat - lat0) / 2) ** 2 + np.cos(lat) * np.cos(lat0) * np.sin((lon - lon0) / 2) ** 2
    arc_m = 2 * 1_737_400 * np.arcsin(np.sqrt(a))
    assert arc_m == pytest.approx(np.hypot(position["east_m"], position["north_m"]), abs=0.1)


def test_the_quaternion_is_scipys_and_rotates_icrs_to_camera(fix, located):
    R = Rotation.from_quat(fix["attitude"]["quat_xyzw_cam_icrs"])
    error = (R * Rotation.from_matrix(located.truth.R_cam_icrs).inv()).magnitude()
    assert error < 20 * ARCSEC
    sigma = fix["attitude"]["sigma_arcsec"]
    assert len(sigma) == 3
    assert error < 5 * np.linalg.norm(sigma) * ARCSEC


def test_body_angles_are_those_that_were_rendered(fix, located):
    attitude = fix["attitude"]
    angles = [attitude["heading_deg"], attitude["pitch_deg"], attitude["roll_body_deg"]]
    np.testing.assert_allclose(angles, located.heading_pitch_roll_deg, atol=0.01)
    # Forward and up of the body, in enu, straight from the rendered angles: SciPy's rotations, other code than ours.
    forward, up = Rotation.from_quat(attitude["quat_xyzw_body_enu"]).inv().apply([[1, 0, 0], [0, 0, 1]])
    heading, pitch, _ = np.radians(located.heading_pitch_roll_deg)
    expected = [np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), np.sin(pitch)]
    np.testing.assert_allclose(forward, expected, atol=2e-4)
    assert up[2] == pytest.approx(np.cos(np.radians(2.0)) * np.cos(np.radians(3.0)), abs=2e-4)


@pytest.mark.parametrize("seed", range(4))
def test_boresight_and_roll_are_astropys(seed):
    from astropy.coordinates import SkyCoord, UnitSphericalRepresentation

    R = Rotation.random(random_state=seed).as_matrix()
    # The second point lies a little towards the image's top: -y of the camera.
    boresight, above = (
        SkyCoord(SkyCoord(*v, representation_type="cartesian").represent_as(UnitSphericalRepresentation))
        for v in (R.T @ [0, 0, 1], R.T @ [0, -1e-4, 1])
    )
    expected = [boresight.ra.deg, boresight.dec.deg, boresight.position_angle(above).deg]
    np.testing.assert_allclose(np.degrees(boresight_rad(R)), expected, atol=0.02)


def test_star_counts(fix, located):
    stars, result = fix["stars"], located.result
    assert stars["detected"] == len(result.detections)
    assert stars["identified"] == len(result.identification) > 500
    assert 0 < stars["rms_px"] < 0.5
    assert 0 <= stars["false_alarm_probability"] < 1e-9
    # The truth states which stars the wall hides; the position found may change a few of them.
    visible = set(located.truth.sources.catalog_id[~located.truth.hidden].tolist())
    measured = result.stars.catalog_id[result.photometry.star[result.photometry.usable]].tolist()
    assert stars["predicted_visible"] == pytest.approx(sum(star in visible for star in measured), abs=8)


def test_matches_are_the_measured_positions_of_their_stars(located):
    d = result_dict(located.result, "identification")
    assert d["format"] == "startrack.identification/1"
    assert "position" not in d
    assert "modes" not in d
    assert d["camera"]["size_px"] == [1024, 1024]
    truth = dict(zip(located.truth.sources.hip.tolist(), located.truth.xy_px.tolist(), strict=True))
    error = [np.subtract((m["x_px"], m["y_px"]), truth[m["hip"]]) for m in d["matches"] if m["hip"] is not None]
    assert len(error) > 0.99 * len(d["matches"]) > 500
    assert np.median(np.linalg.norm(error, axis=1)) < 0.3


def test_a_star_without_hipparcos_number_is_null(located):
    nameless = replace(located.result.stars, hip=np.zeros(len(located.result.stars)))
    d = result_dict(replace(located.result, stars=nameless), "identification")
    assert {m["hip"] for m in d["matches"]} == {None}


def test_detections_are_brightest_first(located):
    d = result_dict(located.result, "detections")
    assert d["format"] == "startrack.detection/1"
    assert set(d["detections"][0]) == {"x_px", "y_px", "flux_e", "snr"}
    assert len(d["detections"]) == len(located.result.detections)
    flux = np.array([one["flux_e"] for one in d["detections"]])
    assert flux[:50].min() > np.median(flux)


def test_without_a_terrain_there_are_no_values_in_enu(located):
    d = result_dict(remove_terrain(located.result))
    without = {key for key in KEYS["attitude"].split() if "body" in key or "heading" in key or "pitch" in key}
    assert {key for key, value in d["attitude"].items() if value is None} == without
    assert d["position"] is None
    assert d["stars"]["predicted_visible"] is None


def test_the_bound_of_the_probability_left_out_is_stated(located, fix):
    assert 0.0 < fix["position"]["dropped_probability"] == located.result.fix.dropped_probability < 0.01


def test_a_method_without_a_posterior_states_no_circle(located):
    position = result_dict(without_circle(located.result))["position"]
    stated = ("dropped_probability", "covariance_m2", "radius95_m", "radius999_m")
    assert [position[key] for key in stated] == [None] * 4
    assert position["search"] == "approximate"
    json.dumps(position, allow_nan=False)


def test_an_ambiguous_result_has_modes_and_no_position(located):
    d = result_dict(make_ambiguous(located.result))
    assert (d["status"], d["reason"]) == ("ambiguous", "ambiguous")
    assert d["position"] is None
    assert sum(mode["weight"] for mode in d["modes"]) == pytest.approx(1.0)


def test_a_refused_result_has_its_reason_and_the_known_values(located):
    d = result_dict(flat_frame(located.result))
    assert (d["status"], d["reason"]) == ("refused", "no_stars")
    assert "flat" in d["message"]
    assert (d["position"], d["attitude"], d["modes"]) == (None, None, [])
    assert d["stars"]["detected"] == d["stars"]["identified"] == 0
    assert d["stars"]["rms_px"] is d["stars"]["false_alarm_probability"] is None
    assert d["timing_ms"]["locate"] == 0.0
    assert d["timing_ms"]["detect"] > 0.0


def test_provenance(located, fix):
    assert fix["provenance"]["time_utc"] == "2030-06-01T00:00:00.000000Z"
    assert fix["provenance"]["catalog"] == "hipparcos"
    assert fix["provenance"]["localizer"] == "posterior"
    stars_only = pipeline.identify(located.result.exposure, located.result.camera, load_catalog().brighter_than(7.0))
    assert result_dict(stars_only, "identification")["provenance"]["localizer"] is None
    unknown = replace(located.result, exposure=replace(located.result.exposure, time_utc=None))
    assert result_dict(unknown)["provenance"]["time_utc"] is None
    assert refused_dict("night/a.png", "bad_image", "it is truncated")["image"] == "a.png"


def test_an_unknown_time_widens_the_attitude(located, fix):
    unknown = replace(located.result, exposure=replace(located.result.exposure, time_utc=None))
    sigma = result_dict(unknown)["attitude"]["sigma_arcsec"]
    np.testing.assert_allclose(sigma, np.hypot(fix["attitude"]["sigma_arcsec"], 60.0), rtol=1e-9)


def test_sigma_states_whether_it_includes_the_lens(located, fix):
    assert fix["attitude"]["lens_error_included"] is False
    assert "taken as exact" in verbose_text(located.result)
    camera = located.result.camera
    stated = replace(camera, covariance_order=("cx", "cy"), covariance=np.diag([0.3**2, 0.4**2]))
    result = pipeline.identify(located.result.exposure, stated, load_catalog().brighter_than(7.0))
    attitude = result_dict(result)["attitude"]
    assert attitude["lens_error_included"] is True
    assert "taken as exact" not in verbose_text(result)
    # A shift of the centre by 0.3 px resembles a rotation about y; stars far off the axis distinguish the two, and
    # correct the centre.
    px_arcsec = 1 / camera.focal_px[0] / ARCSEC
    assert fix["attitude"]["sigma_arcsec"][1] < attitude["sigma_arcsec"][1] < 0.05 * px_arcsec


def test_json_files_are_whole_and_the_same_each_time(tmp_path, fix):
    first, second = tmp_path / "a.json", tmp_path / "deep" / "b.json"
    write_json(first, fix)
    write_json(second, fix)
    assert json.loads(first.read_text(encoding="utf-8")) == fix
    assert first.read_bytes() == second.read_bytes()
    with pytest.raises(ValueError, match="JSON"):
        write_json(first, {**fix, "position": {"east_m": float("nan")}})
    assert json.loads(first.read_text(encoding="utf-8")) == fix
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["a.json"]
    with pytest.raises(BadInput, match="cannot be written"):
        write_json(first / "below-a-file.json", fix)
