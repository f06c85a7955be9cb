"""A range of fields of view: guesses without gaps, and one search for all of them."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from startrack.cli.flags import field_or_range_rad
from startrack.cli.main import main
from startrack.estimation.radial_fit import PINHOLE_BEND, largest_angle_rad, radius_of
from startrack.identification.lens_guesses import WIDE_FIELD_RAD, guess_fields

LOWELL = str(Path(__file__).parents[1] / "sample_images/lowell-2018-08-06.fits.bz2")  # 180 degrees


@pytest.mark.parametrize("size_px", [(1400, 1100), (640, 480)])
@pytest.mark.parametrize(("low", "high"), [(8.0, 20.0), (2.0, 280.0), (60.0, 60.0), (170.0, 175.0), (90.0, 110.0)])
def test_the_guesses_leave_no_gap(low: float, high: float, size_px: tuple[int, int]) -> None:
    """Of pinholes below 100 degrees, and of fisheyes whose image circle touches the frame with any bend tried."""
    fields = guess_fields(size_px, *np.radians([low, high]), (None,))
    checked = 0
    for fov_rad in np.radians(np.geomspace(low, high, 300)):
        is_wide = fov_rad >= WIDE_FIELD_RAD
        edge_px = 0.5 * (min(size_px) if is_wide else size_px[0])
        guesses = [guess for field in fields if field.is_wide == is_wide for guess in field.guesses]
        for bend in {guess.bend for guess in guesses} if is_wide else {PINHOLE_BEND}:
            if fov_rad / 2 < 0.89 * largest_angle_rad(bend):
                focal_px = edge_px / float(radius_of(np.array(fov_rad / 2), bend))
                some = [guess for guess in guesses if guess.bend == bend]
                assert min(abs(np.log(focal_px / guess.focal_px)) - guess.log_spread for guess in some) < 1e-9
                checked += 1
    assert checked >= 300


def test_pixels_that_are_not_square_keep_the_width_of_the_field() -> None:
    (field,) = guess_fields((1400, 1100), *np.radians([18.0, 22.0]), (None,))
    (guess,) = field.guesses
    narrower = guess.with_aspect(0.8, keeps_width=True)
    assert narrower.focal_px * narrower.scale_px[0] == pytest.approx(guess.focal_px * guess.scale_px[0])
    assert narrower.scale_px[0] / narrower.scale_px[1] == pytest.approx(0.8)


@pytest.mark.parametrize("text", ["20..8", "1..20", "8..", "..20", "8..x"])
def test_a_wrong_range_is_wrong_usage(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError):
        field_or_range_rad(text, 2.0, 280.0)


@pytest.mark.parametrize("command", ["calibrate", "horizon --site=34,-111 -o a.csv"])
def test_a_range_where_one_number_counts_is_wrong_usage(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([*command.split(), LOWELL, "--fov", "150..200"])
    assert end.value.code == 2
    assert "'150..200': give one number; startrack identify takes MIN..MAX" in capsys.readouterr().err


@pytest.mark.slow
def test_a_photograph_is_identified_within_a_range(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["identify", LOWELL, "-D", str(tmp_path), "--no-plots", "--fov"]
    assert main([*words, "120..200", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["stars"]["identified"] > 300
    assert main([*words, "20..25"]) == 3
    assert "no lens of 20 to 25 degrees explains" in capsys.readouterr().out
