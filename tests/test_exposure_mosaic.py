"""Colour mosaics: levels and gains of the four kinds of pixels found, and a frame located through them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

import startrack
from startrack.core.types import BadInput, Exposure
from startrack.exposure import read_exposure, write_exposure
from startrack.exposure.mosaic import equalize_mosaic

SAMPLE = Path(__file__).parents[1] / "sample_images" / "near-wall"
PATTERN = (((0, 0), "R"), ((0, 1), "G"), ((1, 0), "G"), ((1, 1), "B"))
GAIN = {"R": 0.45, "G": 1.0, "B": 0.6}  # relative flux of the stars
SKY_E = {"R": 20.0, "G": 8.0, "B": 3.0}
DNG_TAGS = [  # required by the DNG standard: version, pattern, white, black, model, colour matrix, illuminant
    (50706, "B", 4, (1, 4, 0, 0), True), (50707, "B", 4, (1, 1, 0, 0), True), (33421, "H", 2, (2, 2), True),
    (33422, "B", 4, (0, 1, 1, 2), True), (50717, "I", 1, (4095,), True), (50714, "H", 1, (64,), True),
    (50708, "s", 0, "Test", True), (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
    (50778, "H", 1, (21,), True),
]  # fmt: skip


@pytest.fixture(scope="module")
def colours(tmp_path_factory) -> Path:
    """The sample as a camera with a mosaic would have taken it: each filter lets part of the electrons pass."""
    rng, exposure = np.random.default_rng(1), read_exposure(SAMPLE.with_suffix(".png"))
    electrons = np.maximum((exposure.pixels_adu - 100) * 0.5, 0).astype(int)
    seen = np.empty(electrons.shape, np.float32)
    for (i, j), colour in PATTERN:
        own = electrons[i::2, j::2]
        seen[i::2, j::2] = rng.binomial(own, GAIN[colour]) + rng.poisson(SKY_E[colour], own.shape)
    path = tmp_path_factory.mktemp("colours") / "mosaic.png"
    write_exposure(path, replace(exposure, pixels_adu=np.rint(seen / 0.5 + 100)))
    return path


def add_sidecar(image: Path, **more: str) -> Path:
    facts = json.loads(SAMPLE.with_suffix(".json").read_text())
    image.with_suffix(".json").write_text(json.dumps(facts | more))
    return image


def test_a_mosaic_is_located_and_shows_more_stars_than_its_raw_pixels(colours):
    plain = startrack.locate(add_sidecar(colours))
    solution = startrack.locate(add_sidecar(colours, bayer_pattern="RGGB"))
    truth = json.loads(SAMPLE.with_suffix(".truth.json").read_text())["position_enu_m"]
    assert solution and solution.result.identification is not None and plain.result.identification is not None
    assert len(solution.result.identification.star) > 2 * len(plain.result.identification.star)
    assert np.hypot(*(solution.position_m - truth)[:2]) < solution.result.fix.radius999_m
    assert solution.result.exposure.warnings[0].startswith("colour mosaic")


def test_levels_become_one_and_gains_are_found(colours):
    pixels = read_exposure(add_sidecar(colours)).pixels_adu
    even = equalize_mosaic(pixels, 65535.0)
    middles = [np.median(even[i:400:2, j:400:2]) for (i, j), _ in PATTERN]
    assert np.ptp(middles) < 1.0 < np.ptp([np.median(pixels[i:400:2, j:400:2]) for (i, j), _ in PATTERN])
    bright = even > 2000  # stars: sums over many are the phases' gains
    sums = np.array([even[i::2, j::2][bright[i::2, j::2]].sum() for (i, j), _ in PATTERN])
    assert np.ptp(sums) / sums.mean() < 0.25


def test_saturated_pixels_stay_saturated():
    rng = np.random.default_rng(5)
    pixels = rng.normal(300, 5, (256, 256)).astype(np.float32)
    pixels[0::2, 0::2] += 500
    pixels[100:104, 100:104] = 4095.0
    even = equalize_mosaic(pixels, 4095.0)
    assert np.all(even[100:104, 100:104] >= 4095.0)
    assert abs(np.median(even[0::2, 0::2]) - np.median(even[1::2, 1::2])) < 1.0


@pytest.mark.parametrize("pattern", ["RGBW", "RBGG", "GGRB", "mono", 3])
def test_other_patterns_are_refused_in_a_sidecar(colours, pattern):
    with pytest.raises(BadInput, match="bayer_pattern must be RGGB or BGGR or GRBG or GBRG"):
        read_exposure(add_sidecar(colours, bayer_pattern=pattern))


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG", " grbg "])
def test_the_four_patterns_are_taken(tmp_path, pattern):
    write_exposure(tmp_path / "a.png", Exposure(pixels_adu=np.full((8, 8), 300.0), saturation_adu=65535.0))
    (tmp_path / "a.json").write_text(json.dumps({"bayer_pattern": pattern}))
    assert read_exposure(tmp_path / "a.png").warnings[0].startswith("colour mosaic")


def test_a_tiff_mosaic_and_a_camera_raw_file_give_the_sensors_counts(tmp_path):
    counts = np.random.default_rng(0).integers(200, 4000, (64, 96)).astype(np.uint16)  # too small to be equalised
    tifffile.imwrite(tmp_path / "a.tif", counts, photometric=32803)
    pytest.importorskip("rawpy", reason="camera raw files need the extra raw")
    tifffile.imwrite(tmp_path / "b.dng", counts, photometric=32803, extratags=DNG_TAGS, subfiletype=0)
    for name, white in (("a.tif", 65535.0), ("b.dng", 4095.0)):
        exposure = read_exposure(tmp_path / name)
        np.testing.assert_array_equal(exposure.pixels_adu, counts)
        assert exposure.saturation_adu == white
        assert exposure.warnings[0].startswith("colour mosaic")
    (tmp_path / "c.dng").write_bytes((tmp_path / "b.dng").read_bytes()[:300])
    with pytest.raises(BadInput, match=r"c\.dng: truncated or damaged camera raw file"):
        read_exposure(tmp_path / "c.dng")
