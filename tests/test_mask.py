"""Masks: pixels of a mast, a ridge or a lamp that do not count."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from render_helpers import FISHEYE

from startrack.applications.calibration.static_parts import PredictedStars, find_obstructed
from startrack.camera import load_camera, save_camera
from startrack.catalog import StarCatalog, load_catalog
from startrack.chain import Located, are_unchanged, input_hashes, pipeline
from startrack.cli.main import main
from startrack.core.types import Array, BadInput, Bools, Exposure
from startrack.detection import Detector
from startrack.detection.damage import fill_masked
from startrack.exposure import (
    combine_masks,
    mask_of,
    read_exposure,
    read_mask,
    touch_masked,
    with_facts,
    write_exposure,
)
from startrack.frames import azel_from_rays
from startrack.output import result_dict
from startrack.output.tables import status_of

LIT_ADU, DARK_ADU = 30_000.0, 100.0
EVERY_CHI2_2DOF = 18.4  # 99.99 %


@pytest.fixture(scope="module")
def catalog() -> StarCatalog:
    return load_catalog().brighter_than(7.0)


def mast(size_px: tuple[int, int], width_px: int) -> Bools:
    """The pixels (H, W) of a mast that stands at the lower edge of the image and reaches over its middle."""
    x, y = np.meshgrid(np.arange(size_px[0]), np.arange(size_px[1]))
    return (np.abs(x - 0.6 * size_px[0]) < width_px / 2) & (y > 0.45 * size_px[1])


def ridge(located: Any) -> Bools:
    """The pixels (H, W) of a near ridge that rises 5 degrees above a sixth of the crater's horizon."""
    known = located.result
    x, y = np.meshgrid(*(np.arange(n) for n in known.camera.size_px))
    rays = known.camera.unproject(np.stack([x, y], axis=-1).astype(float))
    azimuth, elevation = azel_from_rays(rays @ (known.attitude.R_cam_icrs @ known.R_enu_icrs.T))
    horizon = known.terrain.horizon_rad(located.truth.position_enu_m[None, :2], azimuth.ravel()).reshape(azimuth.shape)
    return (azimuth > 1.0) & (azimuth < 2.0) & (elevation < horizon + np.radians(5.0)) & (elevation > -0.05)


def paint(exposure: Exposure, where: Bools, level_adu: float) -> Exposure:
    """The exposure with an even surface of this brightness, and its photon noise, in front of the sky."""
    pixels = np.array(exposure.pixels_adu)
    noise = np.random.default_rng(5).normal(0.0, np.sqrt(level_adu), np.count_nonzero(where))
    pixels[where] = np.rint(level_adu + noise)
    return replace(exposure, pixels_adu=pixels)


def nees(result: Any, located: Any) -> float:
    assert isinstance(result, Located) and result.status == "ok", result.message
    error = result.fix.position_enu_m[:2] - located.truth.position_enu_m[:2]
    return float(error @ np.linalg.solve(result.fix.covariance_m2, error))


def write_mask(path: Path, masked: Bools) -> Path:
    cv2.imwrite(str(path), np.where(masked, 0, 255).astype(np.uint8))
    return path


@pytest.mark.parametrize("width_px", [80, 130])
def test_behind_a_masked_mast_the_fix_stays_right_and_a_lamp_on_it_does_no_harm(located, catalog, width_px):
    known = located.result
    hidden = mast(known.camera.size_px, width_px)
    dark, lit = (
        pipeline.locate(
            with_facts(paint(known.exposure, hidden, level), mask=mask_of(hidden)), known.camera, known.terrain, catalog
        )
        for level in (DARK_ADU, LIT_ADU)
    )
    assert nees(dark, located) < EVERY_CHI2_2DOF
    assert np.array_equal(lit.fix.position_enu_m, dark.fix.position_enu_m)
    assert np.array_equal(lit.detections.xy_px, dark.detections.xy_px)
    columns, rows = np.rint(dark.photometry.xy_px).astype(int).T
    behind = hidden[np.clip(rows, 0, 1023), np.clip(columns, 0, 1023)]
    assert np.count_nonzero(behind) > 50
    assert set(status_of(dark.photometry)[behind]) == {"unusable"}
    assert "masked" in set(dark.photometry.cause[behind])
    near = touch_masked(hidden, dark.photometry.xy_px, 8)
    assert not np.any(dark.photometry.cause[~near] == "masked")
    assert len(dark.photometry.evidence()) < len(known.photometry.evidence())


def test_a_masked_ridge_that_hugs_the_horizon_does_not_move_the_fix(located, catalog):
    known, hidden = located.result, ridge(located)
    exposure = paint(known.exposure, hidden, DARK_ADU)
    unmasked = pipeline.locate(exposure, known.camera, known.terrain, catalog)
    assert unmasked.status != "ok" or unmasked.fix.blocked is not None  # the stars that it hides are noticed
    right = pipeline.locate(with_facts(exposure, mask=mask_of(hidden)), known.camera, known.terrain, catalog)
    assert nees(right, located) < EVERY_CHI2_2DOF


def test_the_background_beside_a_masked_lamp_is_that_of_the_sky():
    rng = np.random.default_rng(2)
    sky = rng.normal(200.0, 5.0, (300, 330)).astype(np.float32)
    hidden = mast((330, 300), 90)
    bright = Exposure(pixels_adu=np.where(hidden, np.float32(LIT_ADU), sky), saturation_adu=65535.0)
    filled = fill_masked(np.asarray(bright.pixels_adu), hidden)
    assert np.array_equal(filled[~hidden], sky[~hidden])
    assert filled[hidden].mean() == pytest.approx(200.0, abs=0.2)
    assert filled[hidden].std() == pytest.approx(5.0, abs=0.2)


def test_a_mask_over_nearly_everything_is_refused(located):
    known = located.result
    hidden = np.ones(known.camera.size_px[::-1], dtype=bool)
    hidden[500, 500] = False
    result = pipeline.detect(with_facts(known.exposure, mask=mask_of(hidden)), known.camera)
    assert (result.status, result.reason) == ("refused", "no_stars")
    assert "mask" in result.message


def test_masked_arrays_hide_what_they_hold(located, catalog):
    import startrack

    known, hidden = located.result, mast(located.result.camera.size_px, 100)
    pixels = np.ma.array(np.where(hidden, np.nan, known.exposure.pixels_adu), mask=hidden)
    found = startrack.detect(pixels, camera=known.camera).result
    expected = Detector()(with_facts(known.exposure, mask=mask_of(hidden)), known.camera)
    same = np.isin(np.round(found.detections.xy_px, 3), np.round(expected.xy_px, 3)).all(axis=1)
    assert np.mean(same) > 0.98  # a floating-point array has no saturation of its own
    assert not touch_masked(hidden, found.detections.xy_px, 3).any()


def test_masks_of_camera_and_image_combine(tmp_path):
    left, top = np.zeros((2, 20, 30), dtype=bool)
    left[:, :5], top[:4] = True, True
    one, other = write_mask(tmp_path / "left.png", left), write_mask(tmp_path / "top.png", top)
    found = combine_masks(str(one), str(other), (30, 20))
    assert np.array_equal(found.masked, left | top)
    assert found.sha256 == f"{read_mask(other).sha256}+{read_mask(one).sha256}"
    assert combine_masks(None, None, (30, 20)) is None
    assert mask_of(np.zeros((3, 3))) is None


def test_a_pixel_counts_from_128(tmp_path):
    grey = np.array([[0, 127], [128, 255]], np.uint8)
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    assert np.array_equal(read_mask(tmp_path / "grey.png").masked, [[True, True], [False, False]])
    cv2.imwrite(str(tmp_path / "grey.png"), 255 - grey)  # another file of the same name is read anew
    assert np.array_equal(read_mask(tmp_path / "grey.png").masked, [[False, False], [True, True]])


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (np.ones((8, 8), np.uint8), "all pixels are below 128"),
        (np.full((8, 8), 65535, np.uint16), "not an 8-bit image"),
        (None, "cannot be opened"),
    ],
)
def test_what_is_no_mask_is_refused_with_the_reason_of_its_owner(tmp_path, pixels, words):
    path = tmp_path / "mask.png"
    if pixels is not None:
        cv2.imwrite(str(path), pixels)
    for of_image, of_camera, reason in ((str(path), None, "bad_image"), (None, str(path), "bad_calibration")):
        with pytest.raises(BadInput, match=words) as refusal:
            combine_masks(of_image, of_camera, (8, 8))
        assert refusal.value.reason == reason


def test_a_mask_of_another_size_is_a_size_mismatch(located):
    known = located.result
    result = pipeline.detect(with_facts(known.exposure, mask=mask_of(np.eye(8))), known.camera)
    assert result.reason == "size_mismatch"
    assert "the mask is 8 x 8 px, the image 1024 x 1024" in result.message


def test_a_camera_file_names_its_mask(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    mask = write_mask(tmp_path / "mast.png", mast(FISHEYE.size_px, 40))
    save_camera(replace(FISHEYE, mask=str(mask)), tmp_path / "elsewhere/camera.toml")
    assert 'mask = "../mast.png"' in (tmp_path / "elsewhere/camera.toml").read_text()
    known = load_camera(tmp_path / "elsewhere/camera.toml")
    assert combine_masks(None, known.mask, FISHEYE.size_px).sha256 == read_mask(mask).sha256
    with pytest.raises(ValueError, match="give its path"):
        save_camera(replace(FISHEYE, mask=read_mask(mask)), tmp_path / "camera.toml")


def test_flag_before_sidecar_and_the_hash_in_the_record(located, tmp_path, capsys):
    known, image = located.result, tmp_path / "frame.png"
    write_exposure(image, replace(known.exposure, camera=None, terrain=None))
    by_sidecar = write_mask(tmp_path / "sidecar.png", mast(known.camera.size_px, 60))
    by_flag = write_mask(tmp_path / "flag.png", mast(known.camera.size_px, 90))
    (tmp_path / "frame.json").write_text(json.dumps({"mask": "sidecar.png"}))
    assert read_exposure(image).mask == str(by_sidecar)
    save_camera(known.camera, tmp_path / "camera.toml")
    common = [str(image), "-c", str(tmp_path / "camera.toml"), "-D", str(tmp_path / "out"), "--no-plots", "--json"]
    for flags, mask in ((["--mask", str(by_flag)], by_flag), ([], by_sidecar)):
        assert main(["detect", *common, *flags]) == 0
        record = json.loads(capsys.readouterr().out)
        assert record["provenance"]["mask_sha256"] == read_mask(mask).sha256
    assert main(["detect", *common, "--mask", str(tmp_path / "none.png")]) == 4
    assert result_dict(known)["provenance"]["mask_sha256"] is None


def test_a_batch_repeats_an_image_whose_mask_has_changed(tmp_path):
    image, hidden = tmp_path / "frame.png", np.zeros((8, 8), dtype=bool)
    of_camera, of_image = (write_mask(tmp_path / name, hidden) for name in ("a.png", "b.png"))
    (tmp_path / "camera.toml").write_text('mask = "a.png"\n')
    for changed in (of_camera, of_image):
        hashes = input_hashes(str(image), [str(tmp_path / "camera.toml")], None, str(of_image))
        assert set(hashes) == {"camera.toml", "a.png", "b.png"}
        assert are_unchanged(str(image), hashes)
        write_mask(changed, np.eye(8, dtype=bool))
        assert not are_unchanged(str(image), hashes)


def predicted_stars(rng: np.random.Generator, hidden: Bools, rate: float, count: int = 12_000) -> PredictedStars:
    """Bright stars spread evenly over the image, of which a part is missed at random and those behind `hidden` all."""
    height, width = hidden.shape
    xy_px = rng.uniform(0, [width - 1, height - 1], (count, 2))
    columns, rows = np.rint(xy_px).astype(int).T
    return PredictedStars(np.arange(count), xy_px, (rng.random(count) < rate) & ~hidden[rows, columns])


def light_1(rng: np.random.Generator, hidden: Bools, level_1: float) -> Array:
    """The light of an uneven sky (H, W) about 1, and `level_1` of it where it is hidden."""
    return np.where(hidden, level_1, 1.0) * rng.normal(1.0, 0.1, hidden.shape)


@pytest.mark.slow
@pytest.mark.parametrize("darkest", [0.0, 0.7])
def test_open_sky_is_hardly_ever_proposed_for_the_mask(darkest):
    """However dark it is."""
    rng, size = np.random.default_rng(8), (1024, 1024)
    nothing = np.zeros(size, dtype=bool)
    lights = (rng.uniform(darkest, 1.0, size) for _ in range(60))  # 60 at once are 0.5 GB
    wrong = [find_obstructed(predicted_stars(rng, nothing, 0.8), light).any() for light in lights]
    assert sum(wrong) <= 3  # 0.6 expected at most; more than 3 in 0.3 % of such tests


@pytest.mark.parametrize("level_1", [0.05, 0.3])
def test_what_is_dark_and_shows_no_star_is_proposed_and_its_outline_followed(level_1):
    rng, hidden = np.random.default_rng(9), mast((1024, 1024), 100)
    stars, light = predicted_stars(rng, hidden, 0.9), light_1(rng, hidden, level_1)
    found = find_obstructed(stars, light)
    assert np.mean(found[hidden]) > 0.8
    assert not np.any(found & ~hidden)


def test_few_stars_are_no_proof():
    rng, hidden = np.random.default_rng(9), mast((1024, 1024), 100)
    light = light_1(rng, hidden, 0.2)
    assert not find_obstructed(predicted_stars(rng, hidden, 0.9, count=40), light).any()
    assert find_obstructed(predicted_stars(rng, hidden, 0.9, count=400), light).any()


def test_one_star_missed_in_every_frame_is_no_obstruction():
    rng, hidden = np.random.default_rng(9), mast((1024, 1024), 100)
    stars, light = predicted_stars(rng, hidden, 0.9, count=2_000), light_1(rng, hidden, 0.2)
    columns, rows = np.rint(stars.xy_px).astype(int).T
    behind = hidden[rows, columns]
    beside = 616.0 + rng.uniform(-5.0, 5.0, stars.xy_px.shape)
    one = replace(stars, star=np.where(behind, 1, stars.star), xy_px=np.where(behind[:, None], beside, stars.xy_px))
    assert behind.sum() > 50
    assert find_obstructed(stars, light).any()
    assert not find_obstructed(one, light).any()


def test_what_is_as_bright_as_the_sky_is_not_proposed():
    rng, hidden = np.random.default_rng(9), mast((1024, 1024), 100)
    stars = predicted_stars(rng, hidden, 0.9)
    assert not find_obstructed(stars, np.ones(hidden.shape)).any()
    assert not find_obstructed(stars, light_1(rng, hidden, 0.8)).any()
    assert not find_obstructed(stars, light_1(rng, ~hidden, 0.2)).any()  # the open sky is the darker part
