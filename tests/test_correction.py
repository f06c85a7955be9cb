"""Dark frame and flat field: fixed patterns of the sensor leave the counts, and nothing else changes."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from render_helpers import FISHEYE, SENSOR
from scipy.spatial import cKDTree
from scipy.stats import kstest

from startrack.applications.calibration.sensor import fit_photon_transfer
from startrack.camera import save_camera
from startrack.catalog import load_catalog
from startrack.chain import job_sha256, pipeline
from startrack.cli.main import main
from startrack.core.types import BadInput, Exposure
from startrack.detection import Detector
from startrack.detection.damage import find_damage
from startrack.detection.frame import electrons
from startrack.exposure import Facts, read_exposure, write_exposure, write_sidecar
from startrack.exposure.correction import correct_counts, correction_warnings
from startrack.rendering import Series, light_e
from startrack.rendering.compose import read_out

TOP_ADU = 65535.0
EVERY_CHI2_2DOF = 18.4  # 99.99 %
DARK_FRAMES = 25
FLAT_ADU = 30_000.0


def correct_exposure(exposure, *, dark=None, flat=None):
    """The exposure corrected by the images `dark` and `flat`."""
    pixels, correction = correct_counts(exposure.pixels_adu, exposure.saturation_adu, dark, flat)
    notes = exposure.warnings + correction_warnings(dark, flat, exposure.exposure_s)
    return replace(exposure, pixels_adu=pixels, correction=correction, warnings=notes)


@dataclass(frozen=True)
class Night:
    """One sky by a perfect sensor and by one with hot pixels and vignetting, and the files that correct the second."""

    clean: Exposure
    recorded: Exposure
    dark: Path
    flat: Path
    known: Any  # the result of the fixture `located`, of the same pose
    truth: Any


def draw_dark_e(rng: np.random.Generator, shape: tuple[int, int]) -> Any:
    """Dark charge (H, W) [e]: uneven everywhere, single hot pixels, and groups of warm ones that look like stars."""
    dark = rng.exponential(3.0, shape)
    hot = rng.choice(dark.size, 3000, replace=False)
    dark.flat[hot] += np.exp(rng.uniform(np.log(50), np.log(20_000), len(hot)))
    for y, x in rng.integers(20, shape[0] - 20, (150, 2)):
        dark[y : y + 2, x : x + 2] += np.exp(rng.uniform(np.log(100), np.log(3000)))
    return dark


def draw_sensitivity(rng: np.random.Generator, shape: tuple[int, int]) -> Any:
    """Sensitivity (H, W): vignetting to 0.45, nothing outside the image circle, 1 % from pixel to pixel."""
    y, x = np.indices(shape)
    radius = np.hypot(x - 0.5 * shape[1], y - 0.5 * shape[0]) / (0.5 * shape[0])
    vignetting = np.where(radius < 1.0, 1.0 - 0.55 * np.square(radius), 0.0)
    return np.maximum(vignetting * (1.0 + 0.01 * rng.standard_normal(shape)), 0.0)


@pytest.fixture(scope="module")
def night(located, tmp_path_factory) -> Night:
    folder = tmp_path_factory.mktemp("night")
    known = located.result
    heading, pitch, roll = np.radians(located.heading_pitch_roll_deg).tolist()
    east, north, _ = located.truth.position_enu_m
    series = Series(
        camera=known.camera, terrain=known.terrain, catalog=load_catalog().brighter_than(7.0), seed=7,
        time_utc=datetime(2030, 6, 1, tzinfo=UTC), east_m=east, north_m=north, heading_rad=heading, pitch_rad=pitch,
        roll_rad=roll, faint_v_mag=None, hot_pixels=0,
    )  # fmt: skip
    scene, _ = series.scene(0, "night")
    light, rng = light_e(scene), np.random.default_rng(3)
    dark, sensitivity = draw_dark_e(rng, light.shape), draw_sensitivity(rng, light.shape)
    clean, recorded = (
        replace(known.exposure, pixels_adu=read_out(mean, scene.sensor, rng=rng))
        for mean in (light, light * sensitivity + dark)
    )
    master = np.mean([read_out(dark, scene.sensor, rng=rng) for _ in range(DARK_FRAMES)], axis=0)
    return Night(
        clean, recorded,
        write_exposure(folder / "dark.fits", Exposure(pixels_adu=master)),
        write_exposure(folder / "flat.png", Exposure(pixels_adu=np.rint(FLAT_ADU * sensitivity))),
        known, located.truth,
    )  # fmt: skip


def false_detections(detections: Any, truth: Any) -> int:
    """Detections without a star within 1.5 px; a blend of two faint ones counts as well."""
    distance, _ = cKDTree(truth.xy_px[~truth.hidden]).query(detections.xy_px)
    return int(np.count_nonzero(distance > 1.5))


def nees(result: Any, truth: Any) -> float:
    assert result.status == "ok", result.message
    error = result.fix.position_enu_m[:2] - truth.position_enu_m[:2]
    return float(error @ np.linalg.solve(result.fix.covariance_m2, error))


@pytest.mark.slow
def test_a_corrected_frame_gives_the_position_and_the_photometry_of_the_clean_one(night):
    catalog, known = load_catalog().brighter_than(7.0), night.known
    corrected = correct_exposure(night.recorded, dark=night.dark, flat=night.flat)
    raw, clean, found = (
        pipeline.locate(one, known.camera, known.terrain, catalog) for one in (night.recorded, night.clean, corrected)
    )
    assert nees(found, night.truth) < EVERY_CHI2_2DOF
    false = [false_detections(one.detections, night.truth) for one in (raw, clean, found)]
    assert false[0] > 40  # warm pixels in groups look like stars
    assert false[2] < false[1] + 12
    ours, theirs = found.detections, clean.detections
    distance, near = cKDTree(theirs.xy_px).query(ours.xy_px)
    alike = (distance < 1.0) & (ours.snr > 12.0)
    ours, theirs = ours.take(alike), theirs.take(near[alike])
    assert len(ours) > 300
    scale = np.exp(np.median(np.log(ours.flux_e / theirs.flux_e)))  # 1 at the flat's median, not on the axis
    sigma = np.hypot(ours.flux_sigma_e / scale, theirs.flux_sigma_e)
    pulls = (ours.flux_e / scale - theirs.flux_e) / sigma
    assert 0.8 < 1.4826 * np.median(np.abs(pulls)) < 1.2
    outer = np.hypot(*(ours.xy_px - 511.5).T) > 350.0
    assert abs(np.median(pulls[outer])) < 4.0 * 1.25 / np.sqrt(np.count_nonzero(outer))
    moved = (ours.xy_px - theirs.xy_px) / np.sqrt(
        np.diagonal(ours.covariance_px2 + theirs.covariance_px2, axis1=1, axis2=2)
    )
    assert kstest(moved.ravel(), "norm").pvalue > 1e-4


def test_without_a_flat_the_outer_stars_are_too_faint(night):
    """The comparison of the test before can fail."""
    found = Detector()(correct_exposure(night.recorded, dark=night.dark), night.known.camera)
    clean = Detector()(night.clean, night.known.camera)
    distance, near = cKDTree(clean.xy_px).query(found.xy_px)
    alike = (distance < 1.0) & (found.snr > 12.0)
    radius = np.hypot(*(found.xy_px[alike] - 511.5).T)
    ratio = found.flux_e[alike] / clean.flux_e[near[alike]]
    assert np.median(ratio[radius > 350.0]) < 0.8 * np.median(ratio[radius < 200.0])


def test_flag_before_sidecar_and_the_hashes_in_the_record(night, tmp_path, capsys):
    image = write_exposure(tmp_path / "frame.png", replace(night.recorded, camera="fisheye-2048", terrain=None))
    other = write_exposure(tmp_path / "other.fits", Exposure(pixels_adu=np.full((1024, 1024), 100.0)))
    write_sidecar(image, Facts(dark=str(other), flat=str(night.flat)))
    assert json.loads((tmp_path / "frame.json").read_text())["dark"] == "other.fits"
    camera = str(tmp_path / "camera.toml")
    save_camera(night.known.camera, camera)
    for flags, dark in (([], other), (["--dark", str(night.dark)], night.dark)):
        common = [str(image), "-c", camera, "-D", str(tmp_path / "out"), "--no-plots", "--json"]
        assert main(["identify", *common, *flags]) == 0
        provenance = json.loads(capsys.readouterr().out)["provenance"]
        for key, file in (("dark", dark), ("flat", night.flat)):
            assert provenance[f"{key}_sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
        assert provenance["mask_sha256"] is None


@pytest.mark.parametrize("flag", ["--dark", "--flat"])
def test_what_cannot_correct_the_image_is_refused_in_one_line(tmp_path, capsys, flag):
    image = write_exposure(tmp_path / "frame.png", Exposure(pixels_adu=np.full((40, 60), 300.0)))
    small = write_exposure(tmp_path / "small.fits", Exposure(pixels_adu=np.full((60, 40), 300.0)))
    (tmp_path / "text.fits").write_text("no picture")
    useless = TOP_ADU if flag == "--dark" else 0.0
    write_exposure(tmp_path / "useless.png", Exposure(pixels_adu=np.full((40, 60), useless)))
    name = {"--dark": "dark frame", "--flat": "flat field"}[flag]
    for file, words in (
        (small, f"the {name} is 40 x 60 px, the image 60 x 40"),
        (tmp_path / "none.fits", f"{name} .*none.fits: cannot be opened"),
        (tmp_path / "text.fits", f"{name} .*text.fits: is not a file of PNG"),
        (tmp_path / "useless.png", f"{name} .*useless.png: (every pixel is saturated|is dark)"),
    ):
        with pytest.raises(BadInput, match=words) as refusal:
            read_exposure(image, **{flag[2:]: str(file)})
        assert "\n" not in str(refusal.value)
        assert main(["detect", str(image), flag, str(file), "-D", str(tmp_path / "out")]) == 4
        assert f"refused  {refusal.value.reason}: " in capsys.readouterr().out


def test_counts_are_neither_clipped_nor_cut_and_saturation_is_that_of_the_recorded_ones(tmp_path):
    recorded = np.full((32, 32), 1000.0, dtype=np.float32)
    recorded[0, :3] = 0.0, 64_000.0, TOP_ADU
    dark, flat = np.full((32, 32), 100.0), np.full((32, 32), 20_000.0)
    dark[0, 0], dark[0, 2], flat[0, 1] = 400.0, 5000.0, 10_000.0
    dark[5, 5], flat[6, 6] = TOP_ADU, 500.0
    files = {
        "dark": write_exposure(tmp_path / "dark.png", Exposure(pixels_adu=dark)),
        "flat": write_exposure(tmp_path / "flat.png", Exposure(pixels_adu=flat)),
    }
    exposure = correct_exposure(Exposure(pixels_adu=recorded, saturation_adu=TOP_ADU), **files)
    assert exposure.pixels_adu.dtype == np.float32
    assert exposure.pixels_adu[0, :3].tolist() == [-300.0, 127_900.0, TOP_ADU]  # 100 + (64000 - 100) / 0.5
    assert exposure.pixels_adu[1, 1] == 1000.0
    _, saturated = electrons(exposure, None)
    assert np.argwhere(saturated).tolist() == [[0, 2]]
    assert exposure.correction is not None and exposure.correction.mask is not None
    assert np.argwhere(exposure.correction.mask.masked).tolist() == [[5, 5], [6, 6]]


def test_the_black_level_is_not_divided(tmp_path):
    """With a dark frame the pedestal stays; without one the camera's bias is divided by the flat before subtraction."""
    rng = np.random.default_rng(4)
    sensitivity = draw_sensitivity(rng, (512, 512))
    recorded = Exposure(pixels_adu=read_out(400.0 * sensitivity, SENSOR, rng=rng), saturation_adu=TOP_ADU)
    dark = write_exposure(tmp_path / "dark.fits", Exposure(pixels_adu=np.full((512, 512), SENSOR.bias_adu)))
    flat = write_exposure(tmp_path / "flat.fits", Exposure(pixels_adu=FLAT_ADU * sensitivity))
    y, x = np.indices((512, 512))
    radius = np.hypot(x - 255.5, y - 255.5)
    for files in ({"dark": dark, "flat": flat}, {"flat": flat}):
        image, _ = electrons(correct_exposure(recorded, **files), FISHEYE)
        levels = [image[(radius > r) & (radius < r + 40.0)].mean() for r in (0.0, 100.0, 200.0)]
        assert levels == pytest.approx([levels[0]] * 3, abs=1.0)  # a divided bias of 50 e would differ by 50 e
        assert image[radius > 262.0].mean() == pytest.approx(0.0, abs=0.2)


def test_a_dark_frame_of_another_exposure_time_and_a_flat_field_alone_give_a_warning(tmp_path):
    flat = Exposure(pixels_adu=np.full((8, 8), 1000.0))
    files = {"flat": write_exposure(tmp_path / "flat.fits", flat)}
    for name, seconds in (("dark", 30.0), ("short", 10.0)):
        write_exposure(tmp_path / f"{name}.fits", replace(flat, exposure_s=seconds))
    image = replace(flat, exposure_s=31.0)
    assert correct_exposure(image, dark=tmp_path / "dark.fits", **files).warnings == ()
    (note,) = correct_exposure(image, dark=tmp_path / "short.fits", **files).warnings
    assert note == "the dark frame was exposed for 10 s, the image for 31 s"
    (note,) = correct_exposure(image, **files).warnings
    assert note.startswith("flat field without a dark frame: the black level is divided too")


def test_the_noise_of_coarse_counts_is_right_after_correction(tmp_path):
    """Rounding to whole counts is part of the noise, though the corrected counts are not whole."""
    rng, shape = np.random.default_rng(6), (512, 512)
    slope = np.linspace(0.9, 1.1, 512) * np.ones(shape)
    flat = write_exposure(tmp_path / "flat.fits", Exposure(pixels_adu=100.0 * slope))
    stars = np.zeros(shape)
    stars[100:400:60, 100:400:60] = 400.0
    light = 20.0 + cv2.GaussianBlur(stars, (0, 0), 1.2)
    values = np.rint((light + 0.8 * rng.standard_normal(shape)) * slope)
    exposure = correct_exposure(Exposure(pixels_adu=values, saturation_adu=255.0), flat=flat)
    noise = Detector(psf_sigma_px=1.2)(exposure).noise_e
    expected = float(np.std(exposure.pixels_adu[410:]))
    assert float(np.median(noise)) == pytest.approx(expected, rel=0.02)  # 5 % too low without the recorded step


def test_clipping_shows_after_the_dark_is_subtracted(tmp_path):
    rng = np.random.default_rng(8)
    clipped = Exposure(pixels_adu=np.maximum(rng.normal(0.0, 8.0, (512, 512)), 0.0), saturation_adu=TOP_ADU)
    dark = write_exposure(tmp_path / "dark.fits", Exposure(pixels_adu=rng.normal(50.0, 4.0, (512, 512))))
    for exposure in (clipped, correct_exposure(clipped, dark=dark)):
        damage = find_damage(exposure)
        assert damage is not None and "clipped" in damage.cause


def test_each_colour_of_a_mosaic_has_its_own_median(tmp_path):
    rng = np.random.default_rng(9)
    colour = np.tile(np.array([[0.5, 1.0], [1.0, 0.6]]), (128, 128))
    slope = np.linspace(0.6, 1.4, 256)[:, None] * np.ones((1, 256))
    dark = np.full((256, 256), 200.0)
    dark[rng.integers(0, 256, 300), rng.integers(0, 256, 300)] += 4000.0
    light = 3000.0 * colour * slope
    for name, values in (("frame", light + dark), ("dark", dark), ("flat", 20_000.0 * colour * slope)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.rint(values).astype(np.uint16))
    (tmp_path / "frame.json").write_text('{"bayer_pattern": "RGGB", "dark": "dark.png", "flat": "flat.png"}')
    corrected = read_exposure(tmp_path / "frame.png")
    assert float(np.ptp(corrected.pixels_adu)) < 6.0  # rounding of 3000; hot pixels of 4000 and the slope are gone
    uncorrected = replace_sidecar(tmp_path, {"bayer_pattern": "RGGB"})
    assert float(np.ptp(uncorrected.pixels_adu)) > 2000.0


def replace_sidecar(folder: Path, values: dict[str, str]) -> Exposure:
    (folder / "frame.json").write_text(json.dumps(values))
    return read_exposure(folder / "frame.png")


def test_the_gain_is_measured_on_the_recorded_counts(tmp_path):
    rng = np.random.default_rng(10)
    sensitivity = np.linspace(0.2, 1.5, 512) * np.ones((512, 512))
    flat = write_exposure(tmp_path / "flat.fits", Exposure(pixels_adu=FLAT_ADU * sensitivity))
    frames = [Exposure(pixels_adu=read_out(2000.0 * sensitivity, SENSOR, rng=rng)) for _ in range(2)]
    transfer = fit_photon_transfer([tuple(correct_exposure(frame, flat=flat) for frame in frames)])
    assert transfer is not None
    assert abs(transfer.gain_e_per_adu - SENSOR.gain_e_per_adu) < 4.0 * transfer.gain_sigma


@pytest.mark.parametrize("by", ["flags", "sidecar"])
def test_a_batch_repeats_an_image_whose_dark_or_flat_has_changed(tmp_path, by):
    image, files = tmp_path / "frame.png", {key: tmp_path / f"{key}.fits" for key in ("dark", "flat")}
    facts = {key: str(path) for key, path in files.items()} if by == "flags" else {}
    if by == "sidecar":
        (tmp_path / "frame.json").write_text('{"dark": "dark.fits", "flat": "flat.fits"}')
    hashes = {job_sha256(str(image), "?", facts)}
    for path in files.values():
        write_exposure(path, Exposure(pixels_adu=np.ones((8, 8))))
        hashes.add(job_sha256(str(image), "?", facts))
    assert len(hashes) == 3
