"""The sigma of an exposure's clock: flag, then sidecar, then header, then 1 s; and values that cannot be used."""

from __future__ import annotations

import argparse
import json
from datetime import UTC, datetime

import numpy as np
import pytest
import tifffile
from astropy import units as u
from astropy.io import fits
from batch_helpers import frames, task_of
from PIL import Image, PngImagePlugin

from startrack.applications.batch import locate_image
from startrack.applications.batch.task import valid_stored_record
from startrack.chain.inputs import exposure_input, time_sigma_input
from startrack.cli.flags import FACTS
from startrack.cli.images import flag_facts
from startrack.cli.main import main
from startrack.core.errors import BadInput
from startrack.core.types import TIME_SIGMA_S, Exposure
from startrack.exposure import Facts, read_exposure, with_facts, write_exposure, write_sidecar
from startrack.exposure.sidecar import MAX_TIME_SIGMA_S
from startrack.localization import clock_at
from startrack.terrain import load_terrain

FRAME = np.arange(12, dtype=np.uint16).reshape(3, 4)


def write_png(path, **entries):
    text = PngImagePlugin.PngInfo()
    for key, value in entries.items():
        text.add_text(key, str(value))
    Image.fromarray(FRAME).save(path, pnginfo=text)
    return path


def write_fits(path, **entries):
    fits.PrimaryHDU(FRAME, header=fits.Header(entries)).writeto(path)
    return path


def write_tiff(path, **entries):
    tifffile.imwrite(path, FRAME, description=json.dumps(entries), metadata=None)
    return path


WRITERS = {"a.png": write_png, "a.fits": write_fits, "a.tif": write_tiff}


@pytest.mark.parametrize("name", WRITERS)
def test_flag_then_sidecar_then_header_then_default(tmp_path, name):
    bare = read_exposure(WRITERS[name](tmp_path / f"bare {name}"))
    assert bare.time_sigma_s == TIME_SIGMA_S == 1.0 and not bare.time_sigma_is_stated
    image = WRITERS[name](tmp_path / name, STTSIG=2.5)
    assert read_exposure(image).time_sigma_s == 2.5 and read_exposure(image).time_sigma_is_stated
    image.with_suffix(".json").write_text('{"time_sigma_s": null}')
    assert read_exposure(image).time_sigma_s == 2.5
    image.with_suffix(".json").write_text('{"time_sigma_s": 30}')
    assert read_exposure(image).time_sigma_s == 30.0
    assert read_exposure(image, time_sigma_s=0.0).time_sigma_s == 0.0
    assert read_exposure(image, time_sigma_s=MAX_TIME_SIGMA_S).warnings == ()


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("value", ["long", -1.0, 1e6, True])
def test_an_unusable_header_gives_a_warning(tmp_path, name, value):
    exposure = read_exposure(WRITERS[name](tmp_path / name, STTSIG=value))
    assert exposure.time_sigma_s == 1.0
    (warning,) = exposure.warnings
    assert warning.startswith("STTSIG ") and "is not a number of seconds from 0 to 864000; not used" in warning


@pytest.mark.parametrize("value", ["-0.1", "1e6", "NaN", "Infinity", "true", '"1"', "[1]", "1" + "0" * 400])
def test_an_unusable_sidecar_is_refused(tmp_path, value):
    image = write_png(tmp_path / "a.png")
    (tmp_path / "a.json").write_text(f'{{"time_sigma_s": {value}}}')
    with pytest.raises(BadInput, match=r"sidecar .*a\.json: time_sigma_s must be a number") as caught:
        read_exposure(image)
    assert caught.value.reason == "bad_image" and len(str(caught.value)) < 400


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf"), 1e6, True, "1"])
def test_an_unusable_argument_is_refused(tmp_path, value):
    image = write_png(tmp_path / "a.png")
    for use in (
        lambda: read_exposure(image, time_sigma_s=value),
        lambda: with_facts(Exposure(pixels_adu=FRAME), time_sigma_s=value),
        lambda: Facts(time_sigma_s=value),
    ):
        with pytest.raises(ValueError, match="time_sigma_s must be a number"):
            use()
    with pytest.raises(BadInput, match=r"time_sigma= must be a number.*: give seconds or an astropy duration") as bad:
        time_sigma_input(value)
    assert bad.value.reason == "no_time"


@pytest.mark.parametrize("value", [2 * u.m, [1.0, 2.0] * u.s, np.array([1.0, 2.0]), -1 * u.min])
def test_a_quantity_that_is_no_duration_is_refused(value):
    with pytest.raises(BadInput) as caught:
        time_sigma_input(value)
    assert caught.value.reason == "no_time"


def test_the_library_takes_seconds_and_astropy_durations(tmp_path):
    assert [time_sigma_input(value) for value in (None, 0, 2, np.float32(0.5), 2 * u.min)] == [None, 0, 2, 0.5, 120]
    image = write_png(tmp_path / "a.png", STTSIG=2.5)
    for given in (image, FRAME, Exposure(pixels_adu=FRAME)):
        assert exposure_input(given, None, 3 * u.ms).time_sigma_s == pytest.approx(0.003)
    assert exposure_input(image, None).time_sigma_s == 2.5
    assert exposure_input(FRAME, datetime(2030, 1, 1, tzinfo=UTC)).time_sigma_s == 1.0


def test_the_default_number_may_be_stated(tmp_path):
    image = write_png(tmp_path / "a.png")
    assert not read_exposure(image).time_sigma_is_stated
    assert read_exposure(image, time_sigma_s=1.0).time_sigma_is_stated
    assert exposure_input(image, None, 1.0).time_sigma_is_stated
    assert with_facts(Exposure(pixels_adu=FRAME), time_sigma_s=1.0).time_sigma_is_stated
    assert Exposure(pixels_adu=FRAME, time_sigma_s=2.0).time_sigma_is_stated
    assert not exposure_input(FRAME, None).time_sigma_is_stated
    (tmp_path / "a.json").write_text('{"time_sigma_s": 1}')
    assert read_exposure(image).time_sigma_is_stated


def test_a_default_is_not_written_as_stated(tmp_path):
    silent = Exposure(pixels_adu=FRAME, time_utc=datetime(2030, 1, 1, tzinfo=UTC), saturation_adu=65535.0)
    for name, exposure in (("silent.png", silent), ("stated.png", with_facts(silent, time_sigma_s=1.0))):
        image = write_exposure(tmp_path / name, exposure)
        assert read_exposure(image).time_sigma_is_stated == exposure.time_sigma_is_stated
        assert ("time_sigma_s" in json.loads(write_sidecar(image, exposure).read_text())) == (name == "stated.png")


def test_a_clock_that_nobody_states_may_be_grossly_wrong():
    site, when = load_terrain("shackleton-thesis").site, datetime(2030, 1, 1, tzinfo=UTC)
    stated, silent = clock_at(site, when, 1.0), clock_at(site, when, 1.0, is_stated=False)
    assert (stated.gross_probability, stated.gross_sigma_s) == (0.0, 21_600.0)
    assert (silent.sigma_s, silent.gross_probability, silent.gross_sigma_s) == (1.0, 0.01, 3600.0)


def test_with_facts_leaves_the_rest_alone():
    before = Exposure(pixels_adu=FRAME, time_utc=datetime(2030, 1, 1, tzinfo=UTC), exposure_s=2.0)
    after = with_facts(before, time_sigma_s=7)
    assert (after.time_sigma_s, after.time_utc, after.exposure_s) == (7.0, before.time_utc, 2.0)
    assert with_facts(after, exposure_s=3.0).time_sigma_s == 7.0


def flags(*words):
    parser = argparse.ArgumentParser()
    for one in FACTS:
        parser.add_argument(*one.names, **one.options)
    return flag_facts(argparse.Namespace(**vars(parser.parse_args(words))))


def test_the_flag_is_a_fact():
    assert flags("--time-sigma", "0.5") == {"time_sigma_s": 0.5}
    assert flags("--time-sigma", "0") == {"time_sigma_s": 0.0}
    assert flags() == {}


@pytest.mark.parametrize("command", ["locate", "batch", "identify", "detect", "render"])
@pytest.mark.parametrize("value", ["-1", "nan", "inf", "864001", "soon", ""])
def test_an_unusable_flag_is_wrong_usage(capsys, command, value):
    words = [command, *(["x"] if command != "render" else []), "--time-sigma", value]
    with pytest.raises(SystemExit) as leaving:
        main(words)
    assert leaving.value.code == 2
    assert "argument --time-sigma:" in capsys.readouterr().err


def test_another_sigma_is_another_task_of_a_batch(tmp_path):
    (image,) = frames(tmp_path, 1)
    task = task_of(image, tmp_path / "out", time_sigma_s=2.0)
    record, _ = locate_image(task)
    assert record["provenance"]["time_sigma_s"] == 2.0
    assert valid_stored_record(task) == record
    assert valid_stored_record(task_of(image, tmp_path / "out")) is None
    assert valid_stored_record(task_of(image, tmp_path / "out", time_sigma_s=3.0)) is None
